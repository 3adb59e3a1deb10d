"""Extreme inputs of fits of probe profiles, with both profile models."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.fit.probe_profile import MODELS, fit_profile
from skindb.optics.diffusion import sigma_tr
from skindb.schema import ProbeStatus

FIBRES = 1 + 0.5 * np.arange(28)  # mm
MEDIUM = (0.17, 2.3)  # sigma_a, sigma_s' [mm-1]
ETA = 1.3

each_model = pytest.mark.parametrize("model", MODELS)


def _profile(model, medium=MEDIUM, distance=FIBRES, *, eta=ETA):
    return MODELS[model].profile(distance, *medium, eta=eta)


def _fit(model, value, error=None, distance=FIBRES, *, eta=ETA, free_gain=False):
    error = 0.004 * value if error is None else error
    options = {"radius": 0.0, "eta": eta, "model": model, "free_gain": free_gain}
    return fit_profile(distance, value, error, **options)


def _check(fit, medium=MEDIUM, rtol=2e-3):
    """The fit has the coefficients of the medium."""
    assert fit.status == ProbeStatus.FITTED
    expected = [sigma_tr(*medium), medium[1]]
    np.testing.assert_allclose([fit.sigma_tr, fit.sigma_s_prime], expected, rtol=rtol)


@each_model
def test_fit_profile__five_fibres_and_2400_readings_give_the_coefficients(model):
    _check(_fit(model, _profile(model)[:5], distance=FIBRES[:5]), rtol=0.01)
    distance = np.repeat(FIBRES, 86)[:2400]
    _check(_fit(model, _profile(model, distance=distance), distance=distance))


@each_model
def test_fit_profile__three_fibres_may_be_ambiguous(model):
    fit = _fit(model, _profile(model)[:3], distance=FIBRES[:3])
    if fit.status not in (ProbeStatus.UNIDENTIFIED, ProbeStatus.AMBIGUOUS):
        _check(fit, rtol=0.01)


@each_model
def test_fit_profile__less_than_three_fibres_are_refused(model):
    for count in (0, 1, 2):
        fit = _fit(model, _profile(model)[:count], distance=FIBRES[:count])
        assert fit.status == ProbeStatus.TOO_FEW_FIBRES
        assert np.isnan(fit.sigma_tr)
        assert fit.used == count


@each_model
def test_fit_profile__a_dead_probe_is_refused(model):
    for value in (0.0, np.nan, np.inf, -1.0):
        fit = _fit(model, np.full(28, value), np.full(28, 1e-9))
        assert fit.status == ProbeStatus.TOO_FEW_FIBRES
        assert np.isnan(fit.sigma_tr)


@each_model
def test_fit_profile__broken_fibres_are_excluded(model):
    true = _profile(model)
    for broken in (np.nan, np.inf, 0.0, -1.0):
        value = true.copy()
        value[[4, 9]] = broken
        fit = _fit(model, value, 0.004 * true)
        _check(fit)
        assert fit.used == 26
    for broken in (np.nan, np.inf):
        error = 0.004 * true
        error[[4, 9]] = broken
        fit = _fit(model, true, error)
        _check(fit)
        assert fit.used == 26


@each_model
@pytest.mark.parametrize(
    "medium",
    [
        (0.0, 2.0),
        (1e-8, 2.0),
        (1e-6, 2.0),
        (0.1, 1e-4),
        (0.1, 1e-3),
        (20, 1),
        (1e-3, 50),
    ],
)
def test_fit_profile__extreme_media_are_within_their_errors_or_flagged(model, medium):
    value = _profile(model, medium)
    fit = _fit(model, value, 0.01 * value + 1e-30)
    true = float(sigma_tr(*medium))
    error = np.hypot(fit.sigma_tr_error, fit.sigma_tr_model_error)
    off = abs(fit.sigma_tr - true)
    assert fit.status != ProbeStatus.FITTED or off < max(0.02 * true, 3 * error)


@each_model
def test_fit_profile__a_constant_does_not_look_valid(model):
    fit = _fit(model, np.full(28, 1e-3))
    assert fit.status != ProbeStatus.FITTED or fit.residual > 0.3


@each_model
def test_fit_profile__a_free_gain_is_recovered(model):
    for gain in (1e-6, 1e6):
        fit = _fit(model, _profile(model) * gain, free_gain=True)
        _check(fit, rtol=0.02)
        assert fit.gain == pytest.approx(gain, rel=0.02)


def test_fit_profile__a_gain_out_of_range_is_flagged():
    for gain in (1e-30, 1e30):
        fit = _fit("dipole", _profile("dipole") * gain, free_gain=True)
        assert fit.status != ProbeStatus.FITTED


@each_model
def test_fit_profile__coefficients_are_divided_by_the_scale_of_lengths(model):
    for scale in (0.2, 3.0):
        medium = (MEDIUM[0] / scale, MEDIUM[1] / scale)
        distance = FIBRES * scale
        value = _profile(model, medium, distance)
        _check(_fit(model, value, distance=distance), medium, rtol=5e-3)


@each_model
def test_fit_profile__errors_of_zero_count_alike(model):
    _check(_fit(model, _profile(model), np.zeros(28)))


def test_fit_profile__without_a_boundary():
    _check(_fit("dipole", _profile("dipole", eta=1.0), eta=1.0))
