"""Compiled access to the samples of one surfel: directions, Fresnel factors, which samples count, rows and targets."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from skindb._compiled import fast_kernel, kernel
from skindb.optics._row_kernels import form_rows, row_memory
from skindb.optics._shade_kernels import transmittance
from skindb.schema import FitStatus

FITTED, UNSEEN, FEW, NO_DIFFUSE, CLAMPED, NOT_CONVERGED, NOT_FINITE, _ = (int(status) for status in FitStatus)


class Lumitexel(NamedTuple):
    """Memory for one surfel; one a thread."""

    values: Any  # (lights cameras 3,) samples as single floats
    to_light: Any  # (lights, 3) unit directions
    to_camera: Any  # (cameras, 3)
    lit: Any  # (lights,) cosines, 0 below the limit
    seen: Any  # (cameras,)
    enters: Any  # (lights,) F_t cos / pi, 0 below the limit
    leaves: Any  # (cameras,) F_t, 0 below the limit
    usable: Any  # (lights, cameras) which samples count
    index: Any  # (rows, 2) light and camera of each row
    row_memory: Any
    rows: Any  # (rows, width) cos(theta_i) b_j
    given: Any  # (3, rows) samples
    scattered: Any  # (3, rows) their diffuse part
    target: Any  # (3, rows) what that leaves


@kernel
def lumitexel_memory(lights: int, cameras: int, width: int) -> Any:
    """Memory for `form`."""
    most = lights * cameras
    channels = np.zeros((9, most), np.float32)
    return Lumitexel(
        np.empty(most * 3, np.float32), np.empty((lights, 3)), np.empty((cameras, 3)), np.empty(lights),
        np.empty(cameras), np.empty(lights), np.empty(cameras), np.zeros((lights, cameras), np.bool_),
        np.empty((most, 2), np.int32), row_memory(cameras), np.zeros((most, width), np.float32), channels[:3],
        channels[3:6], channels[6:],
    )  # fmt: skip


@fast_kernel
def survey(values: Any) -> int:
    """What is wrong with all samples of a surfel, as a status: UNSEEN, NOT_FINITE, or else FITTED."""
    known, infinite = np.int32(0), np.int32(0)
    for i in range(values.shape[0]):
        known += np.int32(abs(values[i]) < np.inf)
        infinite += np.int32(abs(values[i]) == np.inf)
    return NOT_FINITE if infinite > 0 else FITTED if known > 0 else UNSEEN


@kernel
def point(position: Any, light: Any, camera: Any, b: Any) -> None:
    """Directions from a surfel to every light and camera."""
    _towards(light, position, b.to_light)
    _towards(camera, position, b.to_camera)


@kernel
def _towards(target: Any, p: Any, out: Any) -> None:
    for i in range(target.shape[0]):
        x, y, z = target[i, 0] - p[0], target[i, 1] - p[1], target[i, 2] - p[2]
        scale = 1.0 / np.sqrt(x * x + y * y + z * z)
        out[i, 0], out[i, 1], out[i, 2] = x * scale, y * scale, z * scale


@kernel
def face(n: Any, eta: float, min_cosine: float, b: Any) -> None:
    """Cosines of directions, and what the boundary lets through; 0 below the limit."""
    _through(n, b.to_light, eta, min_cosine, b.lit, b.enters)
    _through(n, b.to_camera, eta, min_cosine, b.seen, b.leaves)
    for i in range(b.lit.shape[0]):
        b.enters[i] *= b.lit[i] / np.pi


@kernel
def _through(n: Any, towards: Any, eta: float, min_cosine: float, cosine: Any, passed: Any) -> None:
    for i in range(towards.shape[0]):
        c = n[0] * towards[i, 0] + n[1] * towards[i, 1] + n[2] * towards[i, 2]
        above = c > min_cosine and c < 2.0  # NaN is neither
        cosine[i] = c if above else 0.0
        passed[i] = transmittance(min(c, 1.0), eta) if above else 0.0


@kernel
def choose(b: Any) -> int:
    """Mark the samples that are finite in all channels and not grazing; their number."""
    cameras, count = b.seen.shape[0], 0
    for i in range(b.lit.shape[0]):
        above = b.lit[i] > 0.0
        for o in range(cameras):
            at = 3 * (i * cameras + o)
            # abs(inf) and abs(NaN) are not below inf; a sum of three half floats is finite if all are
            known = abs(b.values[at] + b.values[at + 1] + b.values[at + 2]) < np.inf
            b.usable[i, o] = known & above & (b.seen[o] > 0.0)
            count += int(b.usable[i, o])
    return count


@kernel
def form(n: Any, table: Any, b: Any) -> int:
    """Rows of the chosen samples with this normal, and the samples; how many."""
    count = form_rows(table, n, b.to_light, b.to_camera, b.usable, b.row_memory, b.rows, b.index)
    cameras = b.seen.shape[0]
    for r in range(count):
        at = 3 * (b.index[r, 0] * cameras + b.index[r, 1])
        for c in range(3):
            b.given[c, r] = b.values[at + c]
    return int(count)


@kernel
def split_diffuse(d: Any, count: int, b: Any) -> None:
    """The diffuse part of the samples by R_d (3,), and what it leaves."""
    for r in range(count):
        b.scattered[2, r] = b.enters[b.index[r, 0]] * b.leaves[b.index[r, 1]]
    for c in range(3):
        reflectance = np.float32(d[c])
        for r in range(count):
            b.scattered[c, r] = b.scattered[2, r] * reflectance
            b.target[c, r] = b.given[c, r] - b.scattered[c, r]
