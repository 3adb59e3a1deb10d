"""Compiled access to the samples of one surfel: directions, Fresnel factors, selection
of samples, rows, targets.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from skindb.jit import fast_kernel, kernel
from skindb.reflectance._row_kernels import form_rows, row_memory
from skindb.reflectance._shade_kernels import transmittance
from skindb.schema import FitStatus

FITTED, UNSEEN, FEW, NO_DIFFUSE, CLAMPED, NOT_CONVERGED, NOT_FINITE, _ = (
    int(status) for status in FitStatus
)


# relative error of a model in held-out samples without noise, 2 to 6 %
# (docs/validation.md), with which the noise of a sample is compared
MODEL_ERROR = 0.05


class Noise(NamedTuple):
    """Noise model of the samples of n surfels, mean over the channels.

    For captures without the noise of each sample the arrays are (0, ...); the variance
    is then floor^2 + shot sample, or unknown if shot is 0.
    """

    per_radiance: Any  # (n, lights) reflectance of radiance 1
    pixels: Any  # (n, cameras) effective number of pixels
    # (cameras, exposures) radiance up to which an exposure is usable, from the longest
    limit: Any
    read: Any  # (cameras, exposures) variance of radiance 0
    slope: Any  # (cameras, exposures) variance over radiance
    floor: float  # sr^-1
    shot: float  # sr^-1


class Lumitexel(NamedTuple):
    """Buffers for one surfel; one set per thread."""

    values: Any  # (lights cameras 3,) samples as single floats
    to_light: Any  # (lights, 3) unit directions
    to_camera: Any  # (cameras, 3)
    lit: Any  # (lights,) cosines, 0 below the limit
    seen: Any  # (cameras,)
    enters: Any  # (lights,) F_t cos / pi, 0 below the limit
    leaves: Any  # (cameras,) F_t, 0 below the limit
    usable: Any  # (lights, cameras) which samples are used
    index: Any  # (rows, 2) light and camera of each row
    row_memory: Any
    rows: Any  # (rows, width) cos(theta_i) b_j
    given: Any  # (3, rows) samples
    scattered: Any  # (3, rows) their diffuse part
    target: Any  # (3, rows) samples minus their diffuse part
    noise: Any  # (2, rows) variance of one channel at reflectance 0, and its slope


@kernel
def lumitexel_memory(lights: int, cameras: int, width: int) -> Any:
    """Buffers for `write_rows`."""
    most = lights * cameras
    channels = np.zeros((9, most), np.float32)
    return Lumitexel(
        np.empty(most * 3, np.float32),
        np.empty((lights, 3)),
        np.empty((cameras, 3)),
        np.empty(lights),
        np.empty(cameras),
        np.empty(lights),
        np.empty(cameras),
        np.zeros((lights, cameras), np.bool_),
        np.empty((most, 2), np.int32),
        row_memory(cameras),
        np.zeros((most, width), np.float32),
        channels[:3],
        channels[3:6],
        channels[6:],
        np.zeros((2, most), np.float32),
    )


@fast_kernel
def sample_status(values: Any) -> int:
    """Status of the samples of a surfel: UNSEEN, NOT_FINITE, or FITTED if there are
    finite samples.
    """
    known = np.int32(0)
    infinite = np.int32(0)
    for i in range(values.shape[0]):
        known += np.int32(abs(values[i]) < np.inf)
        infinite += np.int32(abs(values[i]) == np.inf)
    return NOT_FINITE if infinite > 0 else FITTED if known > 0 else UNSEEN


@kernel
def write_directions(position: Any, light: Any, camera: Any, b: Any) -> None:
    """Write the directions from a surfel to every light and camera."""
    _towards(light, position, b.to_light)
    _towards(camera, position, b.to_camera)


@kernel
def _towards(target: Any, p: Any, out: Any) -> None:
    for i in range(target.shape[0]):
        x = target[i, 0] - p[0]
        y = target[i, 1] - p[1]
        z = target[i, 2] - p[2]
        scale = 1.0 / np.sqrt(x * x + y * y + z * z)
        out[i, 0], out[i, 1], out[i, 2] = x * scale, y * scale, z * scale


@kernel
def write_cosines(n: Any, eta: float, min_cosine: float, b: Any) -> None:
    """Write cosines and transmission factors for all directions; 0 below the limit."""
    _transmission(n, b.to_light, eta, min_cosine, b.lit, b.enters)
    _transmission(n, b.to_camera, eta, min_cosine, b.seen, b.leaves)
    for i in range(b.lit.shape[0]):
        b.enters[i] *= b.lit[i] / np.pi


@kernel
def _transmission(
    n: Any, towards: Any, eta: float, min_cosine: float, cosine: Any, passed: Any
) -> None:
    for i in range(towards.shape[0]):
        c = n[0] * towards[i, 0] + n[1] * towards[i, 1] + n[2] * towards[i, 2]
        above = c > min_cosine and c < 2.0  # also rejects NaN
        cosine[i] = c if above else 0.0
        passed[i] = transmittance(min(c, 1.0), eta) if above else 0.0


@kernel
def choose(b: Any) -> int:
    """Mark the samples that are finite in all channels and not grazing; returns their number."""
    cameras = b.seen.shape[0]
    count = 0
    for i in range(b.lit.shape[0]):
        above = b.lit[i] > 0.0
        for o in range(cameras):
            at = 3 * (i * cameras + o)
            # abs of inf and NaN is not below inf; a sum of three half floats is finite
            # if all three are
            known = abs(b.values[at] + b.values[at + 1] + b.values[at + 2]) < np.inf
            b.usable[i, o] = known & above & (b.seen[o] > 0.0)
            count += int(b.usable[i, o])
    return count


@kernel
def write_rows(n: Any, table: Any, b: Any) -> int:
    """Write the rows of the chosen samples for this normal, and the samples; returns
    their number.
    """
    count = form_rows(
        table, n, b.to_light, b.to_camera, b.usable, b.row_memory, b.rows, b.index
    )
    cameras = b.seen.shape[0]
    for r in range(count):
        at = 3 * (b.index[r, 0] * cameras + b.index[r, 1])
        for c in range(3):
            b.given[c, r] = b.values[at + c]
    return int(count)


@kernel
def write_noise(surfel: int, count: int, noise: Any, b: Any) -> bool:
    """Write the variance of one channel of the chosen samples, linear in reflectance;
    returns whether it is known.

    The brightest channel decides which exposures were usable. The variance does not
    depend on the values otherwise, as this would favour low values.
    """
    if noise.per_radiance.shape[0] == 0:
        b.noise[:, :count] = noise.floor * noise.floor if noise.shot > 0.0 else 0.0
        b.noise[1, :count] = noise.shot
        return bool(noise.shot > 0.0)
    last = noise.limit.shape[1] - 1
    for r in range(count):
        i = b.index[r, 0]
        o = b.index[r, 1]
        scale = noise.per_radiance[surfel, i]
        brightest = max(b.given[0, r], b.given[1, r], b.given[2, r])
        e = 0
        while e < last and brightest > noise.limit[o, e] * scale:
            e += 1
        scale_of_mean = scale / noise.pixels[surfel, o]
        b.noise[0, r] = scale_of_mean * scale * noise.read[o, e]
        b.noise[1, r] = scale_of_mean * noise.slope[o, e]
    return True


@kernel
def split_diffuse(d: Any, count: int, b: Any) -> None:
    """Write the diffuse part of the samples for R_d (3,), and the remainder."""
    for r in range(count):
        b.scattered[2, r] = b.enters[b.index[r, 0]] * b.leaves[b.index[r, 1]]
    for c in range(3):
        reflectance = np.float32(d[c])
        for r in range(count):
            b.scattered[c, r] = b.scattered[2, r] * reflectance
            b.target[c, r] = b.given[c, r] - b.scattered[c, r]
