"""Compiled normals from reflectance samples, surfel by surfel; see `skindb.optics.photometric`."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

from skindb.optics._row_kernels import FAST

GRAZING = 0.2  # cosine to the camera below which a pixel mixes what lies behind the silhouette
HORIZON = 0.1  # cosine to the light below which the linear model fails (half-hidden disc, terminator)
SHADE = 0.25  # quantile over cameras: below the highlights, above the darkest outliers
INDEPENDENT = 8  # lights; against 150 the scan's prior would be lost: 95 % of errors fall from 7.4 to 4.3 degrees
TUKEY, ITERATIONS = 4.685, 12  # 95 % efficiency for normal noise; converges in 6 to 10
STILL = 1e-14  # squared change of the normal that ends the iteration: 1e-7 rad, below float32


@nb.njit(cache=True, nogil=True, inline="always")
def _finite(value: float) -> bool:
    """math.isfinite is x - x == x - x, which FAST turns into True."""
    return abs(value) < np.inf


@nb.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _transmittance(cosine: float, eta: float) -> float:
    square = eta * eta - 1.0 + cosine * cosine
    if square <= 0.0:
        return 1.0 if eta == 1.0 else 0.0
    g = math.sqrt(square)
    a = (g - cosine) / (g + cosine)
    b = (cosine * (g + cosine) - 1.0) / (cosine * (g - cosine) + 1.0)
    return 1.0 - 0.5 * a * a * (1.0 + b * b)


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _directions(point: Any, targets: Any, out: Any) -> None:
    for t in range(targets.shape[0]):
        x, y, z = targets[t, 0] - point[0], targets[t, 1] - point[1], targets[t, 2] - point[2]
        scale = 1.0 / math.sqrt(x * x + y * y + z * z)
        out[t, 0], out[t, 1], out[t, 2] = x * scale, y * scale, z * scale


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _median(values: Any) -> float:
    """Median of finite values, which it orders; 0 of none."""
    count = values.shape[0]
    if count == 0:
        return 0.0
    values.sort()
    return 0.5 * (values[(count - 1) // 2] + values[count // 2])


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _unit(v: Any) -> bool:
    """Scale v to length 1; False and NaN where it has none."""
    size = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    for k in range(3):
        v[k] = v[k] / size if size > 0.0 else np.nan
    return bool(size > 0.0)


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _copy(a: Any, out: Any) -> None:
    """A loop, as everywhere here: `out[:] = a` takes seconds to compile, and expressions of arrays one each."""
    for k in range(a.shape[0]):
        out[k] = a[k]


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _sandwich(left: Any, meat: Any, right: Any, out: Any) -> None:
    """Write left meat right^T of 3 x 3 matrices."""
    for j in range(3):
        for k in range(3):
            total = 0.0
            for p in range(3):
                for q in range(3):
                    total += left[j, p] * meat[p, q] * right[k, q]
            out[j, k] = total


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _inverse(a: Any, out: Any) -> None:
    """Inverse of a 3 x 3 matrix by cofactors; a ridge of 1e-6 of its trace keeps 9 digits."""
    for j in range(3):
        p, q = (j + 1) % 3, (j + 2) % 3
        for k in range(3):
            u, v = (k + 1) % 3, (k + 2) % 3
            out[k, j] = a[p, u] * a[q, v] - a[p, v] * a[q, u]
    f = 1.0 / (a[0, 0] * out[0, 0] + a[0, 1] * out[1, 0] + a[0, 2] * out[2, 0])
    for j in range(3):
        for k in range(3):
            out[k, j] *= f


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _add_outer(matrix: Any, factor: float, v: Any) -> None:
    for j in range(3):
        for k in range(3):
            matrix[j, k] += factor * v[j] * v[k]


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _shades(sample: Any, through: Any, white: Any, tinted: Any, buffer: Any) -> None:
    """(l,) low quantile over cameras of the mean channel, and median of the part along the colour; NaN where none."""
    total, count, tint = np.zeros(3), np.zeros(3), np.zeros(3)
    for i in range(sample.shape[0]):
        for o in range(sample.shape[1]):
            if through[o] > 0.0:
                for k in range(3):
                    if _finite(sample[i, o, k]):
                        total[k] += sample[i, o, k]
                        count[k] += 1.0
    grey = 0.0
    for k in range(3):
        tint[k] = total[k] / count[k] if count[k] > 0.0 else np.nan
        grey += tint[k] / 3.0
    for k in range(3):
        tint[k] -= grey
    if not _unit(tint):
        tint[:] = 0.0
    for i in range(sample.shape[0]):
        n_white = n_tinted = 0
        for o in range(sample.shape[1]):
            if through[o] > 0.0:
                r, g, b = np.float64(sample[i, o, 0]), np.float64(sample[i, o, 1]), np.float64(sample[i, o, 2])
                if _finite(r + g + b):
                    buffer[0, n_white] = (r + g + b) / (3.0 * through[o])
                    n_white += 1
                    buffer[1, n_tinted] = (r * tint[0] + g * tint[1] + b * tint[2]) / through[o]
                    n_tinted += 1
        if n_white > 0:
            ordered = buffer[0, :n_white]
            ordered.sort()
            white[i] = ordered[int(np.rint(SHADE * (n_white - 1)))]
            tinted[i] = _median(buffer[1, :n_tinted])
        else:
            white[i] = tinted[i] = np.nan


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _photometric(
    shade: Any, to_light: Any, scan: Any, eta: float, prior: float, work: Any, normal: Any,
    covariance: Any, pull: Any, score: Any, half: Any,
) -> float:  # fmt: skip
    """Robust photometric stereo: shade = F_t(n.l) g.l for one g; writes g/|g| and its covariance, returns residual/|g|.

    Tukey weights leave out shadows and what is left of highlights. The scan's normal enters as a prior on the
    direction of g: it decides where few lights or mixed pixels leave the direction open.
    """
    lights = shade.shape[0]
    weight, through, residual, buffer = work[0], work[1], work[2], work[3]
    weight[:] = 1.0
    _copy(scan, normal)
    spread, size, share, count = 0.0, 1.0, 0.0, 0
    data, matrix, inverse, right, g = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for step in range(ITERATIONS):
        data[:], right[:], count = 0.0, 0.0, 0
        for i in range(lights):
            cosine = normal[0] * to_light[i, 0] + normal[1] * to_light[i, 1] + normal[2] * to_light[i, 2]
            through[i] = _transmittance(min(cosine, 1.0), eta) if cosine > HORIZON and _finite(shade[i]) else 0.0
            if through[i] > 0.0:
                count += 1
                _add_outer(data, weight[i] * through[i] ** 2, to_light[i])
                for k in range(3):
                    right[k] += weight[i] * through[i] * shade[i] * to_light[i, k]
        for k in range(3):
            _copy(data[k], matrix[k])
        if step > 0:
            # what spoils one light spoils its neighbours: however many there are, they count as INDEPENDENT
            share = max(count / INDEPENDENT, 1.0) * (spread / (size * max(prior, 1e-9))) ** 2
            _add_outer(matrix, -share, scan)
            for k in range(3):
                matrix[k, k] += share
        # a ridge far below the data: surfels without light solve to zero, hence to a NaN normal
        ridge = 1e-6 * (matrix[0, 0] + matrix[1, 1] + matrix[2, 2]) + 1e-12
        for k in range(3):
            matrix[k, k] += ridge
        _inverse(matrix, inverse)
        moved = 0.0
        for k in range(3):
            g[k] = inverse[k, 0] * right[0] + inverse[k, 1] * right[1] + inverse[k, 2] * right[2]
        size = math.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        if not size > 0.0:
            normal[:], covariance[:], pull[:], half[:] = np.nan, np.nan, np.nan, np.nan
            return np.nan
        for k in range(3):
            moved += (g[k] / size - normal[k]) ** 2
            normal[k] = g[k] / size
        at = 0
        for i in range(lights):
            if through[i] > 0.0:
                model = through[i] * (g[0] * to_light[i, 0] + g[1] * to_light[i, 1] + g[2] * to_light[i, 2])
                residual[i] = shade[i] - model
                buffer[at] = abs(residual[i])
                at += 1
        spread = 1.4826 * _median(buffer[:at]) + 0.01 * size
        if moved < STILL or step == ITERATIONS - 1:
            break
        for i in range(lights):
            u = (residual[i] / (TUKEY * spread)) ** 2 if through[i] > 0.0 else 0.0
            weight[i] = (1.0 - u) ** 2 if u < 1.0 else 0.0
    _covariance(
        weight, through, residual, to_light, eta, spread, share, size, normal, data, matrix, covariance, pull,
        score, half,
    )  # fmt: skip
    return spread / size


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _covariance(
    weight: Any, through: Any, residual: Any, to_light: Any, eta: float, spread: float, share: float, size: float,
    normal: Any, data: Any, matrix: Any, out: Any, pull: Any, score: Any, half: Any,
) -> None:  # fmt: skip
    """Of the normal, from the residuals themselves (Huber's sandwich); and how it follows the scan's normal.

    Also the scores of the lights and the matrix `half` that turns a sum of score times direction into a turn.
    """
    slope, total, count = 0.0, 0.0, 0
    meat, bent, inverse = np.zeros((3, 3)), np.zeros((3, 3)), np.empty((3, 3))
    for i in range(through.shape[0]):
        score[i] = 0.0
        if through[i] > 0.0 and weight[i] > 0.0:
            u = (residual[i] / (TUKEY * spread)) ** 2
            bend = (1.0 - u) * (1.0 - 5.0 * u) if u < 1.0 else 0.0
            slope += bend * through[i] ** 2
            total += weight[i] * through[i] ** 2
            count += 1
            _add_outer(bent, bend * through[i] ** 2, to_light[i])
            # a turn of the normal changes F_t too: towards grazing it says more than the cosine alone
            c = normal[0] * to_light[i, 0] + normal[1] * to_light[i, 1] + normal[2] * to_light[i, 2]
            steep = (through[i] - _transmittance(max(c - 1e-4, 1e-6), eta)) / 1e-4
            for j in range(3):
                for k in range(3):
                    bent[j, k] += bend * through[i] * c * steep * to_light[i, j] * (to_light[i, k] - c * normal[k])
            score[i] = weight[i] * through[i] * residual[i]
            _add_outer(meat, score[i] ** 2, to_light[i])
    # three unknowns have been fitted to the residuals; the influence function slopes less than its weights
    more = count / max(count - 3.0, 1.0)
    for i in range(score.shape[0]):
        score[i] *= math.sqrt(more)
    for j in range(3):
        for k in range(3):
            meat[j, k] *= more
            matrix[j, k] += bent[j, k] - data[j, k] if slope > 0.5 * total else -0.5 * data[j, k]
    _inverse(matrix, inverse)
    for j in range(3):  # only what lies across the normal turns it
        along = inverse[0, j] * normal[0] + inverse[1, j] * normal[1] + inverse[2, j] * normal[2]
        for k in range(3):
            half[k, j] = (inverse[k, j] - along * normal[k]) / size
    _sandwich(half, meat, half, out)
    for k in range(3):  # a turn of the scan's normal lies across it
        along = half[k, 0] * normal[0] + half[k, 1] * normal[1] + half[k, 2] * normal[2]
        for j in range(3):
            pull[k, j] = (half[k, j] - along * normal[j]) * share * size


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _peak(sample: Any, to_light: Any, to_camera: Any, seen: Any, buffer: Any, half: Any, weight: Any) -> None:
    """(c, 3) half vectors of the brightest lights and their weights; see `peak_normals`."""
    best, place, maximum = np.empty(5), np.empty(5, np.int64), np.empty(3)
    for o in range(to_camera.shape[0]):
        half[o], weight[o], count = 0.0, 0.0, 0
        if not seen[o] > 0.0:
            continue
        best[:] = -np.inf
        for i in range(sample.shape[0]):
            r, g, b = sample[i, o, 0], sample[i, o, 1], sample[i, o, 2]
            if not _finite(r + g + b):
                continue
            dark = np.float64(min(r, g, b))
            buffer[count] = dark
            count += 1
            if dark > best[4]:
                q = 4
                while q > 0 and dark > best[q - 1]:
                    best[q], place[q] = best[q - 1], place[q - 1]
                    q -= 1
                best[q], place[q] = dark, i
        if count < 5:
            continue
        maximum[:] = 0.0
        for q in range(4):
            for k in range(3):
                maximum[k] += (best[q] - best[4]) * to_light[place[q], k]
        if best[0] > 0.0:  # in units of the brightest: the same at any brightness
            weight[o] = max(best[0] / max(_median(buffer[:count]), 1e-6 * best[0]) - 1.0, 0.0)
        if _unit(maximum):
            for k in range(3):
                half[o, k] = maximum[k] + to_camera[o, k]
            if not _unit(half[o]):
                half[o] = 0.0


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _robust_mean(vectors: Any, weight: Any, kept: Any, angle: Any, buffer: Any, mean: Any) -> None:
    """Mean direction of (c, 3), each by the inverse of its angle to the mean, outliers left out."""
    _copy(weight, kept)
    for step in range(9):
        mean[:] = 0.0
        for o in range(vectors.shape[0]):
            for k in range(3):
                mean[k] += kept[o] * vectors[o, k]
        if not _unit(mean) or step == 8:
            return
        at = 0
        for o in range(vectors.shape[0]):
            cosine = vectors[o, 0] * mean[0] + vectors[o, 1] * mean[1] + vectors[o, 2] * mean[2]
            angle[o] = math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
            if weight[o] > 0.0:
                buffer[at] = angle[o]
                at += 1
        limit = 2.5 * max(1.4826 * _median(buffer[:at]), 2.0)
        for o in range(vectors.shape[0]):
            kept[o] = weight[o] / max(angle[o], 1.0) if angle[o] < limit else 0.0


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def estimate(
    sample: Any, position: Any, light: Any, camera: Any, scan: Any, eta: float, prior: float,
    peak: Any, normal: Any, spread: Any, covariance: Any, cross: Any, pull: Any,
) -> None:  # fmt: skip
    """All surfels: (n, 3) peak; (n, 2, 3) normals from shading and from colour, (n, 2) spread, twice (n, 2, 3, 3).

    Between them, `cross` (n, 3, 3) is the covariance of the first with the second.
    """
    lights, cameras = light.shape[0], camera.shape[0]
    to_light, to_camera, through = np.empty((lights, 3)), np.empty((cameras, 3)), np.empty(cameras)
    shade, work, buffer = np.empty((2, lights)), np.empty((4, lights)), np.empty((2, cameras))
    half, weight, extra = np.empty((cameras, 3)), np.empty(cameras), np.empty((2, cameras))
    score, turn, meat = np.zeros((2, lights)), np.empty((2, 3, 3)), np.empty((3, 3))
    for s in range(position.shape[0]):
        _directions(position[s], light, to_light)
        _directions(position[s], camera, to_camera)
        for o in range(cameras):
            cosine = scan[s, 0] * to_camera[o, 0] + scan[s, 1] * to_camera[o, 1] + scan[s, 2] * to_camera[o, 2]
            through[o] = _transmittance(min(cosine, 1.0), eta) if cosine > GRAZING else 0.0
        _shades(sample[s], through, shade[0], shade[1], buffer)
        for q in range(2):
            spread[s, q] = _photometric(
                shade[q], to_light, scan[s], eta, prior, work, normal[s, q], covariance[s, q], pull[s, q],
                score[q], turn[q],
            )  # fmt: skip
        meat[:] = 0.0  # noise that grows with the signal is not alike in all channels: both signals share some of it
        for i in range(lights):
            _add_outer(meat, score[0, i] * score[1, i], to_light[i])
        _sandwich(turn[0], meat, turn[1], cross[s])
        _peak(sample[s], to_light, to_camera, through, work[0], half, weight)
        _robust_mean(half, weight, extra[0], extra[1], buffer[0], peak[s])
