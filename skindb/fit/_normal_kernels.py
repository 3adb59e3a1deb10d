"""Normals from reflectance samples, as numbers; methods and sources in `skindb.fit.normals`."""

from __future__ import annotations

import numpy as np

from skindb.fit._arrays import Array, in_batches, unit
from skindb.optics.photometric import photometric_normals

# Shares of the total error that cover 91 to 96 % of the normals of six independent captures with known truth: shadows,
# folds and what is left of highlights spoil neighbouring lights alike, which shows in the two estimates' angle
NOISE_SHARE, MODEL_ERROR = 3.0, 1.0  # factor; degree


def normals(
    sample: Array,
    position: Array,
    light: Array,
    camera: Array,
    scan: Array,
    *,
    method: str,
    eta: float,
    scan_error: float,
) -> tuple[Array, Array, Array, Array]:
    """(n, 3) normals by `method`, angle (n,) of peak and combined, standard error (n,), total error (n,) [degree]."""

    def batch(sample: Array, position: Array, scan: Array) -> tuple[Array, Array, Array, Array]:
        first = unit(scan.astype(np.float64))
        samples = sample.astype(np.float32)
        found = photometric_normals(samples, position, light, camera, first, eta=eta, prior=np.deg2rad(scan_error))
        # inverse variance: each residual relative to the signal; skin without colour leaves all to the first
        share = np.nan_to_num(1 / found.spread**2)
        share /= np.maximum(share.sum(1, keepdims=True), 1e-300)
        combined = unit(np.einsum("nq,nqk->nk", share, np.nan_to_num(found.normal)))
        white, tinted = found.normal[:, 0], found.normal[:, 1]
        chosen = {"peak": found.peak, "photometric": white, "chromatic": tinted, "combined": combined}[method]
        share = {"photometric": np.array([[1.0, 0.0]]), "chromatic": np.array([[0.0, 1.0]])}.get(method, share)
        # both signals share some noise, and the scan's error
        noise = np.einsum("nq,nqkk->n", share**2, np.nan_to_num(found.covariance))
        noise = noise + 2 * share.prod(axis=1) * np.einsum("nkk->n", np.nan_to_num(found.cross))
        pull = np.einsum("nq,nqjk->njk", share, np.nan_to_num(found.pull))
        variance = noise + (pull**2).sum((1, 2)) * np.deg2rad(scan_error) ** 2 / 2
        known = np.isfinite(chosen).all(1) & (method != "peak")
        error = np.where(known, np.degrees(np.sqrt(variance)), np.nan)
        apart = np.nan_to_num(_angle(white, tinted))  # skin without colour has only one of the two
        total = np.sqrt((NOISE_SHARE * error) ** 2 + apart**2 + MODEL_ERROR**2)
        total = np.where(method == "combined", total, np.nan)
        return chosen, _angle(found.peak, combined), error, total

    return in_batches(batch, (sample, position, scan))


def _angle(a: Array, b: Array) -> Array:
    """(n,) degree between unit vectors (n, 3)."""
    return np.asarray(np.degrees(np.arccos(np.clip(np.einsum("nk,nk->n", a, b), -1, 1))))
