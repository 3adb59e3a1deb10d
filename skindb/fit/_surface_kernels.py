"""Fits of measured BRDFs to what the diffuse term leaves, as numbers; methods in `skindb.fit.surface`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.fit._albedo_kernels import LARGE, SMALL
from skindb.fit._arrays import Array, cosines, directions, in_batches
from skindb.fit._segments import Segments
from skindb.numerics.nnls import Mode, fit_reflectance
from skindb.optics.brdf_table import TableGrid
from skindb.optics.fresnel import fresnel_transmittance
from skindb.optics.rows import basis_rows
from skindb.schema import FitStatus

GRAZING = 0.1  # cosine to light or camera below which samples are left out: half-hidden discs, mixed pixels


@dataclass(frozen=True)
class Tables:
    """BRDF tables as the kernels use them: a reduced space and the way back."""

    reduced: NDArray[np.float32]  # (nh, nd, np, r) sr^-1
    grid: TableGrid
    lift: Array  # (r, m)


@dataclass(frozen=True)
class Rows:
    """Usable samples of a batch of surfels, one row each, as they enter the least squares."""

    surface: NDArray[np.float32]  # (total, r) cos(theta_i) b
    offsets: NDArray[np.int64]  # (n + 1,)
    sample: Array  # (total, 3) as measured
    diffuse: Array  # (total, 3) cos(theta_i) F_t F_t R_d / pi

    def residuals(self, coefficient: Array) -> tuple[Array, Array]:
        """(n,) RMS error over RMS of the samples, linear and between cube roots, for coefficients (n, r)."""
        segments = Segments(self.offsets)
        predicted = np.einsum("tr,tr->t", self.surface, coefficient[segments.owner])[:, None] + self.diffuse
        errors = []
        for given, found in ((self.sample, predicted), (np.cbrt(self.sample), np.cbrt(predicted))):
            wrong = segments.sum(((found - given) ** 2).sum(1))
            whole = segments.sum((given**2).sum(1))
            errors.append(segments.scatter(np.sqrt(wrong / np.where(whole > 0, whole, np.nan))))
        return errors[0], errors[1]


def form_rows(
    sample: Array,
    position: Array,
    light: Array,
    camera: Array,
    normal: Array,
    diffuse: Array,
    tables: Tables,
    eta: float,
) -> Rows:
    """Rows of the usable samples of a batch (eq. 7), lights outer, cameras inner."""
    to_light, to_camera = directions(position, light), directions(position, camera)
    normal, diffuse = normal.astype(np.float64), diffuse.astype(np.float64)
    lit, seen = cosines(normal, to_light), cosines(normal, to_camera)
    known = np.asarray(np.isfinite(diffuse).all(axis=1))[:, None, None]
    usable = np.isfinite(sample).all(-1) & (lit > GRAZING)[:, :, None] & (seen > GRAZING)[:, None] & known
    rows, offsets, index = basis_rows(tables.reduced, tables.grid, normal, to_light, to_camera, usable)
    i, o = index[:, 0], index[:, 1]
    s = np.repeat(np.arange(len(sample)), np.diff(offsets))
    shape = (lit * fresnel_transmittance(np.fmax(lit, 0), eta) / np.pi)[s, i]
    shape *= fresnel_transmittance(np.fmax(seen, 0), eta)[s, o]
    return Rows(rows, offsets, sample[s, i, o].astype(np.float64), shape[:, None] * diffuse[s])


def surface_weights(
    sample: Array,
    position: Array,
    light: Array,
    camera: Array,
    normal: Array,
    diffuse: Array,
    *,
    tables: Tables,
    eta: float,
    mode: Mode,
    noise_floor: float,
    min_samples: int,
) -> tuple[NDArray[Any], ...]:
    """(n, m) weights, KKT residual, linear and perceptual residual of the samples, status; all (n,)."""

    def batch(sample: Array, position: Array, normal: Array, diffuse: Array) -> tuple[NDArray[Any], ...]:
        rows = form_rows(sample, position, light, camera, normal, diffuse, tables, eta)
        fit = fit_reflectance(
            rows.surface,
            rows.offsets,
            rows.sample - rows.diffuse,
            None,
            tables.lift,
            mode=mode,
            noise_floor=noise_floor,
            min_samples=min_samples,
        )
        linear, perceptual = rows.residuals(fit.weight @ tables.lift.T)
        status = _status(sample, position, normal, diffuse, fit.status)
        return fit.weight, fit.kkt, linear, perceptual, status

    return in_batches(batch, (sample, position, normal, diffuse))


def _status(
    sample: Array, position: Array, normal: Array, diffuse: Array, solved: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """What became of each surfel; the first cause in the order of the stages wins."""
    status = solved.copy()
    clamped = ((diffuse <= np.float32(SMALL)) | (diffuse >= np.float32(LARGE))).any(1)
    status[clamped & (status == FitStatus.FITTED)] = FitStatus.DIFFUSE_CLAMPED
    status[~np.isfinite(diffuse).all(1)] = FitStatus.NO_DIFFUSE_ESTIMATE
    status[~np.isfinite(normal).all(1)] = FitStatus.TOO_FEW_SAMPLES  # a normal needs light that is not grazing
    status[~np.isfinite(position).all(1) | np.isinf(sample).any((1, 2, 3))] = FitStatus.NOT_FINITE
    status[np.isnan(sample).all((1, 2, 3))] = FitStatus.UNSEEN
    return status
