"""Kernel that adds the samples of a view to the equations of every texel."""

import numpy as np

from skindb.calibration._merge_kernels import OK
from skindb.ingest._sample_kernels import Halves
from skindb.jit import kernel, single
from skindb.types import ByteVector, Matrix, Matrix32, Vector


@kernel
def add_samples(
    samples: Halves,
    outcome: ByteVector,
    position: Matrix,
    normal: Matrix,
    light: Vector,
    camera: Vector,
    min_cosine: float,
    max_half_cosine: float,
    sums: Matrix32,
) -> None:
    """Add one view to the normal equations of Lambert's law, rho = b l.

    Parameters
    ----------
    samples, outcome
        (3, n) half floats and (n,) states, from `gather`.
    position, normal
        (n, 3) mm, and unit vectors of the smooth surface.
    light, camera
        (3,) mm.
    min_cosine, max_half_cosine
        Limits of the cosines to light and camera, and of that to the half vector.
    sums
        (n, 15) l l^T (xx, xy, xz, yy, yz, zz) and l rho (axis by axis, three channels each).
        Views are weighted by the squared cosine to the camera: a pixel shows more of an
        oblique surface.
    """
    way = np.empty(3)
    sight = np.empty(3)
    for i in range(len(outcome)):
        if outcome[i] != OK:
            continue
        square = 0.0
        depth = 0.0
        for k in range(3):
            way[k] = light[k] - position[i, k]
            sight[k] = camera[k] - position[i, k]
            square += way[k] * way[k]
            depth += sight[k] * sight[k]
        lit = 0.0
        seen = 0.0
        between = 0.0
        for k in range(3):
            way[k] /= np.sqrt(square)
            sight[k] /= np.sqrt(depth)
            lit += way[k] * normal[i, k]
            seen += sight[k] * normal[i, k]
            between += way[k] * sight[k]
        half = (lit + seen) / np.sqrt(2.0 + 2.0 * between)
        if lit < min_cosine or seen < min_cosine or half > max_half_cosine:
            continue
        weight = seen * seen
        place = 0
        for k in range(3):
            for m in range(k, 3):
                sums[i, place] += weight * way[k] * way[m]
                place += 1
        for k in range(3):
            for c in range(3):
                sums[i, 6 + 3 * k + c] += weight * way[k] * single(samples[c, i])
