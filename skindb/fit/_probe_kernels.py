"""Fit of one diffuse reflectance profile, as numbers; methods and sources in `skindb.fit.translucency`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from skindb.fit._arrays import Array
from skindb.optics.dipole import dipole_profile
from skindb.optics.transport import transport_profile
from skindb.schema import ProbeStatus

FLOOR = 3.0  # standard errors above zero for a fibre to count
LEAST = 3  # fibres
# sigma_tr, sigma_s' [mm^-1] and the logarithm of the gain in units of the profile: where a fit may go
LOWER, UPPER = np.log([0.01, 0.05, 1e-12]), np.log([30.0, 100.0, 1e12])
RIVAL = 9.0  # chi-squared: minima this near to the best one are not excluded
TYPICAL, TYPICAL_SPREAD = 1.5, 0.7  # sigma_s' of skin, mm^-1, and its logarithm's standard deviation
START = ((1.0, 2.5), (0.4, 1.0), (3.0, 4.0), (0.2, 2.5))
EVALUATIONS = 200
POOR, POOR_EXCESS = 0.1, 4.0  # RMS log residual and chi-squared above both of which no one medium fits
PER_FIBRE = ("distance", "face", "log_profile", "error")


@dataclass(frozen=True)
class ProbeFit:
    """Coefficients of one profile in mm^-1, with the certificate of the fit; NaN where nothing was fitted."""

    sigma_a: float
    sigma_s_prime: float
    sigma_tr: float
    sigma_tr_error: float  # standard error by the measured errors
    sigma_tr_model_error: float  # what the profile's own error can move it
    gain: float
    residual: float
    chi_squared: float  # by both errors, per degree of freedom
    used: int
    correlation: float  # of log sigma_tr and log sigma_s'
    combination: tuple[float, float]  # exponents (a, b): sigma_tr^a sigma_s'^b is what the profile determines best
    status: ProbeStatus


@dataclass(frozen=True)
class Model:
    """A profile R(r), and how far it is off."""

    profile: Callable[..., Array]
    near: float  # relative error at one transport mean free path; falls like 1/r
    far: float  # relative error at a distance
    bright: float  # relative error of sigma_tr in fits to noise-free random walks where the albedo is near 1
    dark: float  # and what is added per 1 - alpha'


MODELS = {
    "transport": Model(transport_profile, 0.02, 0.004, 0.01, 0.0),
    "dipole": Model(dipole_profile, 0.15, 0.01, 0.03, 0.25),
}


@dataclass(frozen=True)
class Problem:
    """Usable fibres of one profile."""

    distance: Array  # (f, q) mm, over the face of each fibre
    face: Array  # (f, q) their shares of it
    log_profile: Array  # (f,)
    error: Array  # (f,) in units of the profile
    eta: float
    model: Model
    free_gain: bool

    def predict(self, p: Array) -> Array:
        """Logarithms that the model expects."""
        value = (self.model.profile(self.distance, *_coefficients(p), eta=self.eta) * self.face).sum(1)
        return np.asarray(np.log(np.maximum(value, 1e-300)) + (p[2] if self.free_gain else 0.0))

    def misfit(self, p: Array, weight: Array | float = 1.0) -> Array:
        """Weighted differences between logarithms."""
        return np.asarray((self.log_profile - self.predict(p)) * weight)

    def objective(self, p: Array, weight: Array) -> Array:
        """Weighted misfit, and where the gain is free what is known of sigma_s' beforehand."""
        prior = (p[1] - np.log(TYPICAL)) / TYPICAL_SPREAD
        misfit = self.misfit(p, weight)
        return np.append(misfit, prior) if self.free_gain else misfit

    def relative_error(self, p: Array) -> Array:
        """Measured error of each logarithm; by the expected value, as its own noise would favour the high ones."""
        return np.asarray(self.error / np.exp(np.maximum(self.predict(p), self.log_profile - 1)))

    def discrepancy(self, p: Array) -> Array:
        """What the model itself is off at each distance."""
        return np.asarray(self.model.near / (self.distance.mean(1) * sum(_coefficients(p))) + self.model.far)

    def weight(self, p: Array, measured: Array | None = None) -> Array:
        """Inverse of both errors, summed in squares."""
        measured = self.relative_error(p) if measured is None else measured
        return np.asarray(1 / np.hypot(measured, self.discrepancy(p)))


def fit_profile(
    distance: Array, profile: Array, error: Array, *, radius: float, eta: float, model: str, free_gain: bool
) -> ProbeFit:
    """Least squares between logarithms in log sigma_tr, log sigma_s' (and log gain), the best of several starts."""
    with np.errstate(invalid="ignore", divide="ignore"):
        good = np.isfinite(profile) & np.isfinite(error) & (profile > FLOOR * error) & (profile > 0) & (distance > 0)
    used = int(good.sum())
    if used < LEAST + int(free_gain):
        return _nothing(used)
    problem = Problem(
        *_faces(distance[good], radius), np.log(profile[good]), error[good], eta, MODELS[model], free_gain
    )
    found, spread = _best(problem)
    if free_gain and used > LEAST + 1:
        # the gain rests on the nearest fibres, where what the model leaves out is largest
        without = replace(problem, **{name: getattr(problem, name)[1:] for name in PER_FIBRE})
        spread = max(spread, abs(float(_best(without)[0].x[0] - found.x[0])))
    return _report(found, problem, spread)


def _best(problem: Problem) -> tuple[Any, float]:
    """The best of several starts, and how far log sigma_tr of others is away that are not excluded."""
    tries = [_descend(problem, start) for start in START]
    # each try ends with its own weights: compared with the same ones
    plain = problem.weight(np.log([1.0, TYPICAL, 1.0]), problem.error / np.exp(problem.log_profile))
    cost = [float(np.square(problem.objective(end.x, plain)).sum()) for end in tries]
    found = tries[int(np.argmin(cost))]
    rivals = [end.x[0] - found.x[0] for end, c in zip(tries, cost, strict=True) if c < min(cost) + RIVAL]
    return found, float(np.abs(rivals).max())


def _faces(distance: Array, radius: float) -> tuple[Array, Array]:
    """Distances (f, 4) over the round faces of fibres and their shares: the arcs of rings about the source."""
    if radius <= 0 or (distance <= radius).any():
        return distance[:, None], np.ones((len(distance), 1))
    angle = np.arange(1, 5) * np.pi / 5  # Gauss-Chebyshev, second kind
    d = distance[:, None]
    r = d + radius * np.cos(angle)
    arc = r * np.arccos(np.clip((r * r + d * d - radius**2) / (2 * r * d), -1, 1)) * np.sin(angle)
    return r, arc / arc.sum(axis=1, keepdims=True)


def _descend(problem: Problem, start: tuple[float, float]) -> Any:
    """Scipy's result from one start; the weights follow sigma_t' once."""
    from scipy.optimize import least_squares

    size = 3 if problem.free_gain else 2
    p = np.log([*start, 1.0])[:size]
    if problem.free_gain:
        p[2] = np.median(problem.misfit(p))
    for _ in range(2):
        p = np.clip(p, LOWER[:size] + 1e-6, UPPER[:size] - 1e-6)
        bounds = (LOWER[:size], UPPER[:size])
        found = least_squares(problem.objective, p, args=(problem.weight(p),), bounds=bounds, max_nfev=EVALUATIONS)
        p = found.x
    return found


def _coefficients(p: Array) -> tuple[float, float]:
    """sigma_a and sigma_s' of log sigma_tr and log sigma_s' (eq. 9 solved for sigma_a without cancellation)."""
    tr, s = float(np.exp(p[0])), float(np.exp(p[1]))
    third = 4 * tr * tr / 3
    return third / (2 * (s + np.sqrt(s * s + third))), s


def _report(found: Any, problem: Problem, spread: float) -> ProbeFit:
    """Estimates with their covariance by the measured errors, and apart from it what the model's own error can do.

    `spread`: how far log sigma_tr of other minima, as good as this, is away.
    """
    p = found.x
    size, used = len(p), len(problem.log_profile)
    # a ridge keeps directions the data say nothing about finite: their error exceeds any bound
    normal = np.linalg.inv(found.jac.T @ found.jac + 1e-12 * np.eye(size))
    effect = normal @ found.jac.T  # of each weighted residual on each parameter
    gain = effect[:, :used] * problem.weight(p)
    # larger residuals than both errors explain are errors too
    excess = 2 * found.cost / max(used - size, 1)
    residual = float(np.sqrt(np.mean(problem.misfit(p) ** 2)))
    covariance = (gain * problem.relative_error(p) ** 2) @ gain.T * max(1.0, excess) + 1e-18 * np.eye(size)
    covariance += effect[:, used:] @ effect[:, used:].T
    sd = np.sqrt(np.diag(covariance))
    error = float(max(sd[0], spread))
    _, vectors = np.linalg.eigh(covariance[:2, :2])
    sharp = vectors[:, 0] / np.abs(vectors[:, 0]).max()
    sharp = sharp * np.sign(sharp[0]) if sharp[0] else sharp
    a, s = _coefficients(p)
    own = problem.model.bright + problem.model.dark * a / (a + s)
    off = float(np.hypot(gain[0] @ problem.discrepancy(p), own))
    tr = float(np.exp(p[0]))
    status = ProbeStatus.FITTED
    if error > 1:
        status = ProbeStatus.UNIDENTIFIED
    elif (p - LOWER[:size] < 1e-3).any() or (UPPER[:size] - p < 1e-3).any():
        status = ProbeStatus.AT_BOUND
    elif found.status <= 0:
        status = ProbeStatus.NOT_CONVERGED
    elif residual > POOR and excess > POOR_EXCESS:
        status = ProbeStatus.POOR_FIT
    return ProbeFit(
        sigma_a=a,
        sigma_s_prime=s,
        sigma_tr=tr,
        sigma_tr_error=tr * error,
        sigma_tr_model_error=tr * off,
        gain=float(np.exp(p[2])) if problem.free_gain else 1.0,
        residual=residual,
        chi_squared=excess,
        used=used,
        correlation=float(covariance[0, 1] / (sd[0] * sd[1])),
        combination=(float(sharp[0]), float(sharp[1])),
        status=status,
    )


def _nothing(used: int) -> ProbeFit:
    nan = float("nan")
    return ProbeFit(nan, nan, nan, nan, nan, nan, nan, nan, used, nan, (nan, nan), ProbeStatus.TOO_FEW_FIBRES)
