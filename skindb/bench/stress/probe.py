"""Stress cases of fits of probe profiles, which must return the planted values or a
status with the reason.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.bench.case import close, combinations, each, expect
from skindb.fit.probe_profile import MODELS, ProbeFit, fit_profile
from skindb.optics.diffusion import sigma_tr
from skindb.schema import ProbeStatus

Array = NDArray[Any]
ETA = 1.3
PROBES = tuple(MODELS)
RECOVERED = "Coefficients are recovered."

FIBRES = 1 + 0.5 * np.arange(28)
MEDIUM = (0.17, 2.3)


def _profile(
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
        _probe(model, _profile(model)[:count], distance=FIBRES[:count]), rtol=0.01
    )


def _three_fibres(model: str) -> None:
    fit = _probe(model, _profile(model)[:3], distance=FIBRES[:3])
    if fit.status not in (ProbeStatus.UNIDENTIFIED, ProbeStatus.AMBIGUOUS):
        _is_truth(fit, rtol=0.01)


def _too_few_fibres(model: str, count: int) -> None:
    fit = _probe(model, _profile(model)[:count], distance=FIBRES[:count])
    expect(
        fit.status == ProbeStatus.TOO_FEW_FIBRES
        and np.isnan(fit.sigma_tr)
        and fit.used == count,
        fit,
    )


def _many_readings(model: str) -> None:
    """2,400 readings of the same fibres give the truth, as one reading per fibre does."""
    distance = np.repeat(FIBRES, 86)[:2400]
    _is_truth(_probe(model, _profile(model, distance=distance), distance=distance))


def _bad_fibre(model: str, bad: float) -> None:
    value = _profile(model)
    value[[4, 9]] = bad
    fit = _probe(model, value, 0.004 * _profile(model))
    _is_truth(fit)
    expect(fit.used == 26, fit.used)


def _bad_error(model: str, bad: float) -> None:
    error = 0.004 * _profile(model)
    error[[4, 9]] = bad
    fit = _probe(model, _profile(model), error)
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
    value = _profile(model, a, s)
    _flagged_or_right(_probe(model, value, 0.01 * value + 1e-30), a, s)


def _flat_profile(model: str) -> None:
    """A constant is not a profile, and its fit must not look valid."""
    fit = _probe(model, np.full(28, 1e-3))
    expect(fit.status != ProbeStatus.FITTED or fit.residual > 0.3, fit)


def _gain(model: str, gain: float) -> None:
    """A gain in the range of the fit is recovered; outside the range the status says so."""
    value = _profile(model) * gain
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
        model, _profile(model, a, s, FIBRES * factor), distance=FIBRES * factor
    )
    _is_truth(fit, a, s, rtol=5e-3)


def _matched_index(model: str) -> None:
    value = MODELS[model].profile(FIBRES, *MEDIUM, eta=1.0)
    fit = fit_profile(
        FIBRES, value, 0.004 * value, radius=0.0, eta=1.0, model=model, free_gain=False
    )
    _is_truth(fit)


def _zero_error(model: str) -> None:
    _is_truth(_probe(model, _profile(model), np.zeros(28)))


PROBE = (
    *each(
        "probe",
        "{}: {} fibres",
        RECOVERED,
        _enough_fibres,
        *combinations(PROBES, 5, 28),
    ),
    *each(
        "probe",
        "{}: 3 fibres",
        "Coefficients are recovered, or a status is set: three values may be ambiguous.",
        _three_fibres,
        *PROBES,
    ),
    *each(
        "probe",
        "{}: only {} fibres",
        "The fit is refused with a status.",
        _too_few_fibres,
        *combinations(PROBES, 0, 1, 2),
    ),
    *each("probe", "{}: 2400 readings", RECOVERED, _many_readings, *PROBES),
    *each(
        "probe",
        "{}: two fibres {}",
        "They are excluded, and coefficients are recovered from the others.",
        _bad_fibre,
        *combinations(PROBES, np.nan, np.inf, 0.0, -1.0),
    ),
    *each(
        "probe",
        "{}: two errors {}",
        "They are excluded, and coefficients are recovered from the others.",
        _bad_error,
        *combinations(PROBES, np.nan, np.inf),
    ),
    *each(
        "probe",
        "{}: all {}",
        "The fit is refused with a status.",
        _dead_probe,
        *combinations(PROBES, 0.0, np.nan, np.inf, -1.0),
    ),
    *each(
        "probe",
        "{}: sigma_a {:g}, sigma_s' {:g}",
        "sigma_tr is within 2 % or three errors, or flagged.",
        _medium,
        *combinations(
            PROBES,
            (0.0, 2.0),
            (1e-8, 2.0),
            (1e-6, 2.0),
            (0.1, 1e-4),
            (0.1, 1e-3),
            (20.0, 1.0),
            (1e-3, 50.0),
        ),
    ),
    *each(
        "probe",
        "{}: constant",
        "The fit is flagged, or has a large residual.",
        _flat_profile,
        *PROBES,
    ),
    *each(
        "probe",
        "{}: gain {:g}",
        "The gain is recovered, or the status says that it is out of range.",
        _gain,
        *combinations(PROBES, 1e-6, 1e6),
        ("dipole", 1e-30),
        ("dipole", 1e30),
    ),
    *each(
        "probe",
        "{}: distances times {:g}",
        "Coefficients are divided by it.",
        _near_and_far,
        *combinations(PROBES, 0.2, 3.0),
    ),
    *each("probe", "{}: eta 1", RECOVERED, _matched_index, "dipole"),
    *each("probe", "{}: errors of zero", RECOVERED, _zero_error, *PROBES),
)
