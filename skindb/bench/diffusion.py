"""Subsurface light: the inverse of eq. 5, profiles R(r), and fits of profiles, against
mpmath and Monte Carlo; and stress cases of fits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.optimize import brentq

from skindb.bench.case import close, combinations, expect, stress_cases
from skindb.bench.curve import Curve, Point, cpu_time
from skindb.errors import Fault, InputError
from skindb.fit.probe_profile import MODELS, ProbeFit, fit_profile
from skindb.optics import transport
from skindb.optics.diffusion import (
    S_MAX,
    diffuse_reflectance,
    dipole_s,
    reduced_albedo,
    sigma_tr,
)
from skindb.optics.fresnel import boundary_factor
from skindb.optics.transport import (
    Walk,
    half_space_profile,
    moment_basis,
    radial_profile,
    random_walk,
)
from skindb.schema import ProbeStatus
from skindb.types import Array

ETA = 1.3
DISTANCE = (0.5, 1.0, 2.0, 5.0, 10.0)  # transport mean free paths
WIDTH = 1.05  # rings extend from r / WIDTH to r WIDTH
FAR_OFF = 0.25  # relative error above which a fit counts as failed
FAILS_WITH_FREE_GAIN = "a free gain has two minima; measure the gain"
FAILS_WHERE_NEAR = "the profile is wrong where the albedo is low or the fibres are near"
NOISY = 0.1  # relative standard error of the random walk above which a ring is ignored
FIBRES = 1 + 0.5 * np.arange(28)  # mm, of the probe
SKIN = (
    (0.05, 2.4),
    (0.17, 2.3),
    (0.36, 2.9),
    (0.3, 1.0),
    (0.54, 0.79),
)  # sigma_a, sigma_s' [mm-1]; albedo 0.98 to 0.59
PROBES = tuple(MODELS)
RECOVERED = "Coefficients are recovered."
MEDIUM = (0.17, 2.3)


@lru_cache(maxsize=1)
def _walk(quick: bool) -> Walk:
    rng = np.random.default_rng(0)
    return random_walk(
        40_000 if quick else 200_000,
        eta=ETA,
        max_path=60.0 if quick else 240.0,
        rng=rng,
    )


def inverse_curves(quick: bool) -> list[Curve]:
    """The dipole's s from R_d, from nearly black to nearly white."""
    n = 20 if quick else 60
    diffuse = np.concatenate(
        [np.geomspace(1e-6, 0.5, n), 1 - np.geomspace(0.5, 1e-9, n)[1:]]
    )
    exact = np.array([_exact(float(value)) for value in diffuse])
    dipole_s(diffuse, eta=ETA)  # caches F_dr
    seconds, s = cpu_time(lambda: dipole_s(diffuse, eta=ETA)[0], len(diffuse))
    took, plain = cpu_time(
        lambda: np.array([_bracketed(value) for value in diffuse]), len(diffuse)
    )
    single = np.sqrt(
        3 * (1 - reduced_albedo(exact).astype(np.float32).astype(np.float64))
    )
    double = np.sqrt(3 * (1 - reduced_albedo(exact)))
    cancels = "1 - R_d(s) is lost to cancellation where R_d is near 1"
    bright = _exact(0.999)
    wrong = abs((1 - np.float32(reduced_albedo(bright))) / (bright**2 / 3) - 1)
    stored = (
        f"1 - alpha' is lost to cancellation: {wrong:.0%} off at R_d = 0.999, all of "
        "it at 1 - 1e-9"
    )
    points = (
        _inverse("skindb dipole_s", seconds, s, exact),
        _inverse(
            "skindb dipole_s, stored in single precision",
            seconds,
            s.astype(np.float32),
            exact,
        ),
        _inverse("SciPy brentq on eq. 5", took, plain, exact, cancels),
        _inverse(
            "alpha' in double precision",
            seconds,
            double,
            exact,
            "1 - alpha' is lost to cancellation near 1",
        ),
        _inverse("alpha' in single precision", seconds, single, exact, stored),
    )
    label = f"largest relative error of s over {len(diffuse)} R_d from 1e-6 to 1 - 1e-9"
    return [
        Curve(
            "inverse",
            label,
            "mpmath, 40 digits",
            "a value",
            "SciPy brentq on eq. 5",
            points,
        )
    ]


def _inverse(
    name: str, took: float, s: Array, exact: Array, failure: str = ""
) -> Point:
    relative = np.abs(s / exact - 1)
    return Point(
        name,
        "",
        took,
        float(relative.max()),
        failure,
        {"median": float(np.median(relative))},
    )


def _bracketed(value: float) -> float:
    return float(
        brentq(
            lambda s: float(diffuse_reflectance(s, eta=ETA)) - value,
            0,
            S_MAX,
            xtol=1e-300,
            rtol=1e-15,
        )
    )


def require_mpmath() -> Any:
    """Import mpmath; raises `InputError` with the install command if it is missing."""
    try:
        import mpmath
    except ImportError:
        cure = "pip install 'skindb[bench]', or choose other kernels with --only"
        raise InputError(
            Fault("bench inverse", "mpmath must be installed", "no module mpmath", cure)
        ) from None
    return mpmath


def _exact(value: float) -> float:
    mpmath = require_mpmath()
    with mpmath.workdps(40):
        b = mpmath.mpf(4) / 3 * mpmath.mpf(boundary_factor(ETA))
        bracket = (mpmath.mpf("1e-12"), mpmath.sqrt(3))

        def off(s: Any) -> Any:
            return (1 - s * s / 3) / 2 * (1 + mpmath.exp(-b * s)) * mpmath.exp(
                -s
            ) - mpmath.mpf(value)

        return float(mpmath.findroot(off, bracket, solver="anderson", tol=1e-60))


def transport_curves(quick: bool) -> list[Curve]:
    """R(r) of a medium by model, and by moments of several degrees, from which the
    table is made.
    """
    walk = _walk(quick)
    points = []
    r = np.linspace(0.5, 20, 1000)
    for albedo in (0.7, 0.9) if quick else (0.3, 0.7, 0.9, 0.99):
        ratio = (1 - albedo) / albedo
        # in units of 1 / sigma_s', of which a mean free path is `albedo`
        middle = np.array(DISTANCE) * albedo
        (value, noise), ring = rings(walk, ratio, middle), across(middle)
        for name, model in MODELS.items():
            model.profile(1.0, ratio, 1.0, eta=ETA)  # makes the table
            took, _ = cpu_time(
                lambda m=model, a=ratio: m.profile(r, a, 1.0, eta=ETA),  # type: ignore[misc]
                1000,
            )
            profile = model.profile(ring, ratio, 1.0, eta=ETA)
            points.append(
                _profile(
                    f"skindb {name}",
                    albedo,
                    took,
                    ring_mean(profile, middle),
                    value,
                    noise,
                )
            )
        for degree in (3, 7, 11) if quick else (3, 5, 7, 9, 11, 13):
            basis = moment_basis(degree, eta=ETA, anisotropy=transport.ANISOTROPY)
            took, (level, kappa) = cpu_time(
                lambda a=ratio, b=basis: half_space_profile(r, a, b),  # type: ignore[misc]
                1000,
            )
            with np.errstate(invalid="ignore"):
                level, kappa = half_space_profile(
                    ring.ravel().astype(np.float64), ratio, basis
                )
            profile = np.exp(level - kappa * ring.ravel()).reshape(ring.shape)
            points.append(
                _profile(
                    f"moments of degree {degree}",
                    albedo,
                    took,
                    ring_mean(profile, middle),
                    value,
                    noise,
                )
            )
    label = (
        f"RMS over {', '.join(f'{d:g}' for d in DISTANCE)} mean free paths of the "
        "relative error of R(r)"
    )
    noise_of = f"random walk of {walk.packets:,} photons, with the noise `walk_noise`"
    return [
        Curve(
            "transport",
            label,
            noise_of,
            "a distance",
            f"skindb dipole, {_albedo(0.9)}",
            tuple(points),
        )
    ]


def _albedo(value: float) -> str:
    return f"albedo {value:g}"


def across(middle: Array, width: float = WIDTH) -> Array:
    """Distances (21, d) from r / width to r width of a ring around each distance r (d,)."""
    return np.linspace(middle / width, middle * width, 21)


def ring_mean(values: Array, middle: Array, width: float = WIDTH) -> Array:
    """Mean (d,) over each ring of values at `across`, weighted by area."""
    r = across(middle, width)
    return np.asarray((values * r).sum(axis=0) / r.sum(axis=0))


def rings(
    walk: Walk, ratio: float, middle: Array, width: float = WIDTH
) -> tuple[Array, Array]:
    """R in a ring around each distance, and its relative standard error; sigma_s' = 1,
    sigma_a = `ratio`.
    """
    profiles = [
        radial_profile(walk, ratio, 1.0, np.array([r / width, r * width]))
        for r in middle
    ]
    value = np.concatenate([v for v, _ in profiles])
    error = np.concatenate([e for _, e in profiles])
    with np.errstate(invalid="ignore", divide="ignore"):
        return value, np.asarray(np.where(value > 0, error / value, np.inf))


def _profile(
    name: str, albedo: float, took: float, mean: Array, value: Array, noise: Array
) -> Point:
    clear = (noise < NOISY) & np.isfinite(mean)
    off = mean[clear] / value[clear] - 1
    details = {
        f"at_{d:g}": float(e)
        for d, e in zip(np.array(DISTANCE)[clear], off, strict=True)
    }
    details["walk_noise"] = float(np.sqrt((noise[clear] ** 2).mean()))
    diffusion = (
        "the diffusion approximation is invalid within some mean free paths and for "
        "strong absorption"
    )
    error = float(np.sqrt((off**2).mean()))
    few = (
        f"{error:.0%} off: too few moments"
        if name.startswith("moments") and error > 0.1
        else ""
    )
    negative = ", ".join(f"{d:g}" for d in np.array(DISTANCE)[np.isnan(mean)])
    few = (
        f"negative at {negative} mean free paths (not in the error): too few moments"
        if negative
        else few
    )
    return Point(
        name,
        _albedo(albedo),
        took,
        error,
        diffusion if name.endswith("dipole") else few,
        details,
    )


def probe_curves(quick: bool) -> list[Curve]:
    """sigma_tr from the fibres of the probe, by profile model, number of fibres, and
    known or fitted gain.
    """
    walk = _walk(quick)
    points = []
    skin = SKIN[1:4:2] if quick else SKIN
    edges = np.append(FIBRES - 0.25, FIBRES[-1] + 0.25)
    photons = [radial_profile(walk, a, s, edges) for a, s in skin]
    for model in MODELS:
        MODELS[model].profile(1.0, *SKIN[0], eta=ETA)  # makes the table
        for free in (False, True):
            for fibres in (28,) if quick else (4, 6, 8, 12, 28):
                fit = _fitter(model, free, fibres, photons)
                took, fits = cpu_time(fit, len(skin))
                off = np.array(
                    [
                        f.sigma_tr / sigma_tr(*x) - 1
                        for f, x in zip(fits, skin, strict=True)
                    ]
                )
                details = {
                    f"{a:g}, {s:g}": float(e)
                    for (a, s), e in zip(skin, off, strict=True)
                }
                failure = (
                    ""
                    if np.isfinite(off).all()
                    else "some profiles were not fitted, see `more`"
                )
                if np.nanmax(np.abs(off)) > FAR_OFF:
                    failure = f"{np.nanmax(np.abs(off)):.0%} off in one medium: " + (
                        FAILS_WITH_FREE_GAIN if free else FAILS_WHERE_NEAR
                    )
                name = f"skindb {model}, gain {'fitted' if free else 'known'}"
                points.append(
                    Point(
                        name,
                        f"{fibres} fibres",
                        took,
                        float(np.sqrt(np.nanmean(off**2))),
                        failure,
                        details,
                    )
                )
    label = f"RMS over {len(skin)} kinds of skin of the relative error of sigma_tr"
    reference = (
        f"random walk of {walk.packets:,} photons through media of known coefficients"
    )
    base = f"skindb dipole, gain known, {len(FIBRES)} fibres"
    return [Curve("probe", label, reference, "a profile", base, tuple(points))]


def _fitter(
    model: str, free: bool, fibres: int, photons: Sequence[tuple[Array, Array]]
) -> Callable[[], list[Any]]:
    def fit() -> list[Any]:
        return [
            fit_profile(
                FIBRES[:fibres],
                v[:fibres],
                e[:fibres],
                radius=0.0,
                eta=ETA,
                model=model,
                free_gain=free,
            )
            for v, e in photons
        ]

    return fit


def _true_profile(
    model: str, a: float = MEDIUM[0], s: float = MEDIUM[1], distance: Array = FIBRES
) -> Array:
    return MODELS[model].profile(distance, a, s, eta=ETA)


def _probe(
    model: str,
    value: Array,
    error: Array | None = None,
    distance: Array = FIBRES,
    *,
    free: bool = False,
) -> ProbeFit:
    error = 0.004 * value if error is None else error
    return fit_profile(
        distance, value, error, radius=0.0, eta=ETA, model=model, free_gain=free
    )


def _is_truth(
    fit: ProbeFit, a: float = MEDIUM[0], s: float = MEDIUM[1], rtol: float = 2e-3
) -> None:
    expect(fit.status == ProbeStatus.FITTED, fit.status)
    close([fit.sigma_tr, fit.sigma_s_prime], [sigma_tr(a, s), s], rtol=rtol)


def _enough_fibres(model: str, count: int) -> None:
    _is_truth(
        _probe(model, _true_profile(model)[:count], distance=FIBRES[:count]), rtol=0.01
    )


def _three_fibres(model: str) -> None:
    fit = _probe(model, _true_profile(model)[:3], distance=FIBRES[:3])
    if fit.status not in (ProbeStatus.UNIDENTIFIED, ProbeStatus.AMBIGUOUS):
        _is_truth(fit, rtol=0.01)


def _too_few_fibres(model: str, count: int) -> None:
    fit = _probe(model, _true_profile(model)[:count], distance=FIBRES[:count])
    expect(
        fit.status == ProbeStatus.TOO_FEW_FIBRES
        and np.isnan(fit.sigma_tr)
        and fit.used == count,
        fit,
    )


def _many_readings(model: str) -> None:
    """2,400 readings of the same fibres give the truth, as one reading per fibre does."""
    distance = np.repeat(FIBRES, 86)[:2400]
    _is_truth(_probe(model, _true_profile(model, distance=distance), distance=distance))


def _bad_fibre(model: str, bad: float) -> None:
    value = _true_profile(model)
    value[[4, 9]] = bad
    fit = _probe(model, value, 0.004 * _true_profile(model))
    _is_truth(fit)
    expect(fit.used == 26, fit.used)


def _bad_error(model: str, bad: float) -> None:
    error = 0.004 * _true_profile(model)
    error[[4, 9]] = bad
    fit = _probe(model, _true_profile(model), error)
    _is_truth(fit)
    expect(fit.used == 26, fit.used)


def _dead_probe(model: str, value: float) -> None:
    fit = _probe(model, np.full(28, value), np.full(28, 1e-9))
    expect(fit.status == ProbeStatus.TOO_FEW_FIBRES and np.isnan(fit.sigma_tr), fit)


def _flagged_or_right(fit: ProbeFit, a: float, s: float) -> None:
    true = float(sigma_tr(a, s))
    near = abs(fit.sigma_tr / true - 1) < 0.02 if true > 0 else False
    inside = abs(fit.sigma_tr - true) < 3 * np.hypot(
        fit.sigma_tr_error, fit.sigma_tr_model_error
    )
    expect(near or inside or fit.status != ProbeStatus.FITTED, fit)


def _medium(model: str, a: float, s: float) -> None:
    value = _true_profile(model, a, s)
    _flagged_or_right(_probe(model, value, 0.01 * value + 1e-30), a, s)


def _flat_profile(model: str) -> None:
    """A constant is not a profile, and its fit must not look valid."""
    fit = _probe(model, np.full(28, 1e-3))
    expect(fit.status != ProbeStatus.FITTED or fit.residual > 0.3, fit)


def _gain(model: str, gain: float) -> None:
    """A gain in the range of the fit is recovered; outside the range the status says so."""
    value = _true_profile(model) * gain
    fit = _probe(model, value, free=True)
    if 1e-10 < gain < 1e10:
        _is_truth(fit, rtol=0.02)
        close(fit.gain, gain, rtol=0.02)
    else:
        expect(fit.status != ProbeStatus.FITTED, fit)


def _near_and_far(model: str, factor: float) -> None:
    """If all lengths are multiplied by `factor`, the fitted coefficients are divided by it."""
    a = MEDIUM[0] / factor
    s = MEDIUM[1] / factor
    fit = _probe(
        model, _true_profile(model, a, s, FIBRES * factor), distance=FIBRES * factor
    )
    _is_truth(fit, a, s, rtol=5e-3)


def _matched_index(model: str) -> None:
    value = MODELS[model].profile(FIBRES, *MEDIUM, eta=1.0)
    fit = fit_profile(
        FIBRES, value, 0.004 * value, radius=0.0, eta=1.0, model=model, free_gain=False
    )
    _is_truth(fit)


def _zero_error(model: str) -> None:
    _is_truth(_probe(model, _true_profile(model), np.zeros(28)))


PROBE = stress_cases(
    "probe",
    ("{}: {} fibres", RECOVERED, _enough_fibres, combinations(PROBES, 5, 28)),
    (
        "{}: 3 fibres",
        "Coefficients are recovered, or a status is set: three values may be ambiguous.",
        _three_fibres,
        PROBES,
    ),
    (
        "{}: only {} fibres",
        "The fit is refused with a status.",
        _too_few_fibres,
        combinations(PROBES, 0, 1, 2),
    ),
    ("{}: 2400 readings", RECOVERED, _many_readings, PROBES),
    (
        "{}: two fibres {}",
        "They are excluded, and coefficients are recovered from the others.",
        _bad_fibre,
        combinations(PROBES, np.nan, np.inf, 0.0, -1.0),
    ),
    (
        "{}: two errors {}",
        "They are excluded, and coefficients are recovered from the others.",
        _bad_error,
        combinations(PROBES, np.nan, np.inf),
    ),
    (
        "{}: all {}",
        "The fit is refused with a status.",
        _dead_probe,
        combinations(PROBES, 0.0, np.nan, np.inf, -1.0),
    ),
    (
        "{}: sigma_a {:g}, sigma_s' {:g}",
        "sigma_tr is within 2 % or three errors, or flagged.",
        _medium,
        combinations(
            PROBES,
            (0.0, 2.0),
            (1e-08, 2.0),
            (1e-06, 2.0),
            (0.1, 0.0001),
            (0.1, 0.001),
            (20.0, 1.0),
            (0.001, 50.0),
        ),
    ),
    (
        "{}: constant",
        "The fit is flagged, or has a large residual.",
        _flat_profile,
        PROBES,
    ),
    (
        "{}: gain {:g}",
        "The gain is recovered, or the status says that it is out of range.",
        _gain,
        (
            *combinations(PROBES, 1e-06, 1000000.0),
            ("dipole", 1e-30),
            ("dipole", 1e30),
        ),
    ),
    (
        "{}: distances times {:g}",
        "Coefficients are divided by it.",
        _near_and_far,
        combinations(PROBES, 0.2, 3.0),
    ),
    ("{}: eta 1", RECOVERED, _matched_index, ("dipole",)),
    ("{}: errors of zero", RECOVERED, _zero_error, PROBES),
)
