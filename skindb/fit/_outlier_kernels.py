"""Samples that a fitted model does not explain, as numbers; the method is in `skindb.fit.outliers`."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from skindb.fit._arrays import BATCH, Array
from skindb.fit._surface_kernels import FITTED, Block, _bits, _through, _unit_towards, _usable, value
from skindb.numerics._reflectance_kernels import predict, to_roots, workspace
from skindb.optics._row_kernels import form_rows, row_memory

STEEP = 0.2  # cosine to light or camera: below it an error of the normal weighs more than a moved face would
# scales of the surfel's own residuals: normal noise is beyond once in two million; of six clean captures of another
# renderer 1.1 to 2.6 % are (half-hidden lights, lobes the basis lacks), of 4 scales twice as many; halved samples at 25
BEYOND = 5.0
BINS = 16  # of the histograms, a unit of the scaled residual
FINEST = (
    1e-3  # smallest scale, of the root of the surfel's mean: samples within 1.5 % of the prediction are no outliers
)


def outlying(
    sample: Array,
    position: Array,
    light: Array,
    camera: Array,
    normal: Array,
    diffuse: Array,
    weight: Array,
    *,
    table: Any,
    eta: float,
    noise_floor: float,
    min_samples: int,
) -> tuple[Block, Block]:
    """Share of outlying samples (n,), NaN where too few; histograms of the scaled residuals (lights, cameras, bins).

    A residual is the difference between the roots of sample and prediction, both averaged over the channels; its scale
    is the surfel's median of absolute residuals times 1.4826. The last bin holds what is beyond.
    """
    share = np.full(len(sample), np.nan)
    counts = np.zeros((len(light), len(camera), int(BEYOND * BINS) + 1), np.int64)
    light, camera = light.astype(np.float64), camera.astype(np.float64)
    for i in range(0, len(sample), BATCH):
        part = slice(i, min(i + BATCH, len(sample)))
        doubles = (a[part].astype(np.float64) for a in (position, normal, diffuse, weight))
        _outlying_block(
            _bits(sample[part]), *doubles, light, camera, table, float(eta), float(noise_floor), min_samples,
            share[part], counts,
        )  # fmt: skip
    return share, counts


@nb.njit(cache=True, nogil=True)
def _residuals(
    sample: Any, rows: Any, index: Any, weight: Any, d: Any, enters: Any, leaves: Any, floor: float, work: Any
) -> tuple[Any, float]:
    """Residuals of the rows of one surfel between roots, and the mean of the samples."""
    count, mean, least = index.shape[0], 0.0, np.float32(floor)
    predicted, given, s, q = work[0][0, :count], work[0][1, :count], work[0][7, :count], work[0][8, :count]
    predict(rows, count, weight, predicted, work[10])
    for r in range(count):
        i, o = index[r, 0], index[r, 1]
        predicted[r] += d * enters[i] * leaves[o]
        total = 0.0
        for c in range(3):
            total += value(sample, i, o, c)  # type: ignore[no-untyped-call]
        given[r] = total / 3.0
        mean += given[r] / count
    to_roots(given, least, s, q, work[1], work[2])
    for r in range(count):
        given[r] *= q[r]
    to_roots(predicted, least, s, q, work[1], work[2])
    for r in range(count):
        given[r] -= predicted[r] * q[r]
    return given, mean


@nb.njit(cache=True, nogil=True)
def _outlying_block(
    sample: Any, position: Any, normal: Any, diffuse: Any, weight: Any, light: Any, camera: Any, table: Any,
    eta: float, floor: float, least: int, share: Any, counts: Any,
) -> None:  # fmt: skip
    """Shares of a block; adds to the histograms."""
    lights, cameras, last = counts.shape[0], counts.shape[1], counts.shape[2] - 1
    to_light, to_camera = np.empty((lights, 3)), np.empty((cameras, 3))
    lit, seen, enters, leaves = np.empty(lights), np.empty(cameras), np.empty(lights), np.empty(cameras)
    usable, index = np.empty((lights, cameras), np.bool_), np.empty((lights * cameras, 2), np.int32)
    memory, rows = row_memory(cameras), np.empty((lights * cameras, table.shape[3]), np.float32)
    work = workspace(lights * cameras, table.shape[3], weight.shape[1])
    for s in range(len(sample)):
        p, n, d = position[s], normal[s], diffuse[s]
        if not (
            np.isfinite(p).all() and np.isfinite(n).all() and np.isfinite(d).all() and np.isfinite(weight[s]).all()
        ):
            continue
        _unit_towards(light, p, to_light)
        _unit_towards(camera, p, to_camera)
        _through(n, to_light, eta, lit, enters)
        _through(n, to_camera, eta, seen, leaves)
        enters *= lit / np.pi
        lit[lit < STEEP] = 0.0
        seen[seen < STEEP] = 0.0
        if _usable(sample[s], lit, seen, usable) != FITTED:
            continue
        count = form_rows(table, n, to_light, to_camera, usable, memory, rows, index)
        if count < least:
            continue
        residual, mean = _residuals(sample[s], rows, index[:count], weight[s], d.mean(), enters, leaves, floor, work)
        level = max(mean, floor)
        finest = FINEST * level / np.cbrt(level * level + floor * floor)
        scale = max(1.4826 * np.median(np.abs(residual)), finest)
        beyond = 0
        for r in range(count):
            place = min(int(abs(residual[r]) / scale * BINS), last)
            counts[index[r, 0], index[r, 1], place] += 1
            beyond += place == last
        share[s] = beyond / count
