"""The fit of one profile, and its status."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from skindb.fit.translucency import POOR_MISFIT, ProbeFit, fit_profile
from skindb.optics.diffusion import sigma_tr
from skindb.optics.transport import transport_profile
from skindb.schema import ProbeStatus

FIBRES = 1 + 0.5 * np.arange(28)  # mm
MEDIUM = (0.17, 2.3)  # sigma_a, sigma_s' [mm-1]
ETA = 1.3

STATUS_DISTANCE = 1 + 0.5 * np.arange(28)  # mm
STATUS_PROFILES = 40  # for each noise and kind
# relative error of the fibres and floor [mm^-2]
NOISE = [(0.004, 3e-9), (0.004, 3e-7), (0.02, 3e-9), (0.02, 3e-7)]
DOUBTFUL = {
    ProbeStatus.AT_BOUND,
    ProbeStatus.UNIDENTIFIED,
    ProbeStatus.OUT_OF_RANGE,
    ProbeStatus.AMBIGUOUS,
}

Distortion = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def _profile(medium=MEDIUM, distance=FIBRES, *, eta=ETA):
    return transport_profile(distance, *medium, eta=eta)


def _fit(value, error=None, distance=FIBRES, *, eta=ETA, free_gain=False):
    error = 0.004 * value if error is None else error
    options = {"radius": 0.0, "eta": eta, "free_gain": free_gain}
    return fit_profile(distance, value, error, **options)


def _check(fit, medium=MEDIUM, rtol=2e-3):
    """The fit has the coefficients of the medium."""
    assert fit.status == ProbeStatus.FITTED
    expected = [sigma_tr(*medium), medium[1]]
    np.testing.assert_allclose(
        [fit.sigma_tr, fit.reduced_scattering], expected, rtol=rtol
    )


def test_fit_profile__five_fibres_and_2400_readings_give_the_coefficients():
    _check(_fit(_profile()[:5], distance=FIBRES[:5]), rtol=0.01)
    distance = np.repeat(FIBRES, 86)[:2400]
    _check(_fit(_profile(distance=distance), distance=distance))


def test_fit_profile__three_fibres_may_be_ambiguous():
    fit = _fit(_profile()[:3], distance=FIBRES[:3])
    if fit.status not in (ProbeStatus.UNIDENTIFIED, ProbeStatus.AMBIGUOUS):
        _check(fit, rtol=0.01)


def test_fit_profile__less_than_three_fibres_are_refused():
    for count in (0, 1, 2):
        fit = _fit(_profile()[:count], distance=FIBRES[:count])
        assert fit.status == ProbeStatus.TOO_FEW_FIBRES
        assert np.isnan(fit.sigma_tr)
        assert fit.fibres_used == count


def test_fit_profile__a_dead_probe_is_refused():
    for value in (0.0, np.nan, np.inf, -1.0):
        fit = _fit(np.full(28, value), np.full(28, 1e-9))
        assert fit.status == ProbeStatus.TOO_FEW_FIBRES
        assert np.isnan(fit.sigma_tr)


def test_fit_profile__broken_fibres_are_excluded():
    true = _profile()
    for broken in (np.nan, np.inf, 0.0, -1.0):
        value = true.copy()
        value[[4, 9]] = broken
        fit = _fit(value, 0.004 * true)
        _check(fit)
        assert fit.fibres_used == 26
    for broken in (np.nan, np.inf):
        error = 0.004 * true
        error[[4, 9]] = broken
        fit = _fit(true, error)
        _check(fit)
        assert fit.fibres_used == 26


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
def test_fit_profile__extreme_media_are_within_their_errors_or_flagged(medium):
    value = _profile(medium)
    fit = _fit(value, 0.01 * value + 1e-30)
    true = float(sigma_tr(*medium))
    error = np.hypot(fit.sigma_tr_error, fit.sigma_tr_model_error)
    off = abs(fit.sigma_tr - true)
    assert fit.status != ProbeStatus.FITTED or off < max(0.02 * true, 3 * error)


def test_fit_profile__a_constant_does_not_look_valid():
    fit = _fit(np.full(28, 1e-3))
    assert fit.status != ProbeStatus.FITTED or fit.residual > 0.3


def test_fit_profile__a_free_gain_is_recovered():
    for gain in (1e-6, 1e6):
        fit = _fit(_profile() * gain, free_gain=True)
        _check(fit, rtol=0.02)
        assert fit.gain == pytest.approx(gain, rel=0.02)


def test_fit_profile__a_gain_out_of_range_is_flagged():
    for gain in (1e-30, 1e30):
        fit = _fit(_profile() * gain, free_gain=True)
        assert fit.status != ProbeStatus.FITTED


def test_fit_profile__coefficients_are_divided_by_the_scale_of_lengths():
    for scale in (0.2, 3.0):
        medium = (MEDIUM[0] / scale, MEDIUM[1] / scale)
        distance = FIBRES * scale
        value = _profile(medium, distance)
        _check(_fit(value, distance=distance), medium, rtol=5e-3)


def test_fit_profile__errors_of_zero_count_alike():
    _check(_fit(_profile(), np.zeros(28)))


def test_fit_profile__without_a_boundary():
    _check(_fit(_profile(eta=1.0), eta=1.0))


def _medium(rng: np.random.Generator) -> tuple[float, float, float]:
    """sigma_a, sigma_s' and sigma_tr [mm^-1] within and around the range of skin."""
    scattering = 1.5 * np.exp(0.5 * rng.normal())
    transport = np.exp(rng.uniform(np.log(0.3), np.log(2.4)))
    return (
        (np.sqrt(scattering**2 + 4 * transport**2 / 3) - scattering) / 2,
        scattering,
        transport,
    )


def _smooth(size: float) -> Distortion:
    """A factor that varies slowly with the distance, with a relative RMS of `size`."""

    def distort(value: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        x = np.pi * STATUS_DISTANCE / STATUS_DISTANCE[-1]
        wave = np.sum(
            [
                rng.normal() * np.sin(k * x + rng.uniform(0, 2 * np.pi))
                for k in (1, 2, 3)
            ],
            axis=0,
        )
        return value * np.exp(size * wave / np.sqrt(np.mean(wave**2)))

    return distort


def _fits(
    distort: Distortion, relative: float, floor: float, *, seed: int, **options: Any
) -> list[tuple[ProbeFit, float]]:
    """Fits to noisy distorted profiles of random media, and the relative error of each sigma_tr."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(STATUS_PROFILES):
        sigma_a, scattering, true = _medium(rng)
        value = distort(
            transport_profile(STATUS_DISTANCE, sigma_a, scattering, eta=1.3), rng
        )
        error = np.hypot(relative * value, floor)
        noisy = value + error * rng.normal(size=len(STATUS_DISTANCE))
        fit = fit_profile(
            STATUS_DISTANCE,
            noisy,
            error,
            radius=0.0,
            eta=1.3,
            **{"free_gain": False, **options},
        )
        found.append((fit, abs(fit.sigma_tr / true - 1)))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("misfit", [0.0, 0.05])
@pytest.mark.parametrize(("relative", "floor"), NOISE)
def test_poor_fit__noise_and_small_smooth_errors_are_none(relative, floor, misfit):
    """320 profiles. The demo's photon noise is a smooth error of up to 7 %; 5 % RMS
    reaches 15 % at single fibres.
    """
    fits = _fits(_smooth(misfit), relative, floor, seed=5)
    assert not [fit for fit, _ in fits if fit.status == ProbeStatus.POOR_FIT]
    # where few fibres are clear, their noise alone may exceed the limit: the chance of
    # its chi-squared decides
    assert np.quantile([fit.misfit for fit, _ in fits], 0.95) < POOR_MISFIT
    fitted = [off for fit, off in fits if fit.status == ProbeStatus.FITTED]
    assert len(fitted) > 0.9 * STATUS_PROFILES
    # the total error of the brightest is 1 %: of what the distortion adds a fit knows
    # only the excess of chi-squared
    assert np.median(fitted) < 0.005 + misfit / 2


@pytest.mark.slow
def test_poor_fit__noise_with_a_free_gain_is_none():
    fits = _fits(_smooth(0.0), *NOISE[0], seed=6, free_gain=True)
    assert not [fit for fit, _ in fits if fit.status == ProbeStatus.POOR_FIT]


@pytest.mark.slow
@pytest.mark.parametrize(("relative", "floor"), NOISE[:2])
def test_poor_fit__fibres_above_the_floor_by_chance_are_none(relative, floor):
    """A fibre four errors above zero and decades above the profile has a large
    logarithm, but no information.
    """

    def stray(value: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        dark = np.flatnonzero(value < 0.1 * floor)
        if len(dark):
            value[rng.choice(dark)] = 4.2 * floor
        return value

    fits = _fits(stray, relative, floor, seed=7)
    assert max(fit.residual for fit, _ in fits) > 0.5
    assert not [fit for fit, _ in fits if fit.status == ProbeStatus.POOR_FIT]


def _veil(value: np.ndarray, _: np.random.Generator) -> np.ndarray:
    """Stray light: 0.1 % of the signal of the nearest fibre on all fibres."""
    return value + 1e-3 * value[0]


def _layers(value: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A tenth of the light travels in a medium that absorbs a tenth as much: a second
    slope at a distance.
    """
    return (
        value
        + 0.1 * value[0] * np.exp(-0.4 * (STATUS_DISTANCE - 1)) / STATUS_DISTANCE**2
    )


@pytest.mark.slow
@pytest.mark.parametrize("distort", [_veil, _layers], ids=["stray light", "two media"])
@pytest.mark.parametrize(("relative", "floor"), NOISE[::2])
def test_poor_fit__other_media_never_pass_for_one(relative, floor, distort):
    """Where the profile is off by more than a tenth the status says so, or says that
    sigma_tr is doubtful.
    """
    fits = _fits(distort, relative, floor, seed=8)
    wrong = [fit for fit, off in fits if fit.misfit > 1.5 * POOR_MISFIT or off > 0.3]
    assert len(wrong) > 0.3 * STATUS_PROFILES
    assert {fit.status for fit in wrong} <= {ProbeStatus.POOR_FIT, *DOUBTFUL}
    # stray light mostly leads to a bound, whose status has priority
    if distort is _layers:
        assert (
            sum(fit.status == ProbeStatus.POOR_FIT for fit, _ in fits)
            > 0.1 * STATUS_PROFILES
        )
