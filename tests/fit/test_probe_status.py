"""When a probe profile is called a poor fit: hundreds of planted profiles, of one
medium and of several.

Rationale: `poor_fit` says that no single medium has this profile. Noise, fibres that
pass the noise floor by chance and the few per cent by which the profile model itself is
off must not cause it; a real mixture of media must.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from skindb.fit.probe_profile import POOR_MISFIT, ProbeFit, fit_profile
from skindb.optics.transport import transport_profile
from skindb.schema import ProbeStatus

DISTANCE = 1 + 0.5 * np.arange(28)  # mm
PROFILES = 40  # for each noise and kind
# relative error of the fibres and floor [mm^-2]
NOISE = [(0.004, 3e-9), (0.004, 3e-7), (0.02, 3e-9), (0.02, 3e-7)]
DOUBTFUL = {
    ProbeStatus.AT_BOUND,
    ProbeStatus.UNIDENTIFIED,
    ProbeStatus.OUT_OF_RANGE,
    ProbeStatus.AMBIGUOUS,
}

Distortion = Callable[[np.ndarray, np.random.Generator], np.ndarray]


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
        x = np.pi * DISTANCE / DISTANCE[-1]
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
    for _ in range(PROFILES):
        sigma_a, scattering, true = _medium(rng)
        value = distort(transport_profile(DISTANCE, sigma_a, scattering, eta=1.3), rng)
        error = np.hypot(relative * value, floor)
        noisy = value + error * rng.normal(size=len(DISTANCE))
        fit = fit_profile(
            DISTANCE,
            noisy,
            error,
            radius=0.0,
            eta=1.3,
            model="transport",
            **{"free_gain": False, **options},
        )
        found.append((fit, abs(fit.sigma_tr / true - 1)))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("misfit", [0.0, 0.02, 0.05])
@pytest.mark.parametrize(("relative", "floor"), NOISE)
def test_poor_fit__noise_and_small_smooth_errors_are_none(relative, floor, misfit):
    """480 profiles. The demo's photon noise is a smooth error of up to 7 %; 5 % RMS
    reaches 15 % at single fibres.
    """
    fits = _fits(_smooth(misfit), relative, floor, seed=5)
    assert not [fit for fit, _ in fits if fit.status == ProbeStatus.POOR_FIT]
    # where few fibres are clear, their noise alone may exceed the limit: the chance of
    # its chi-squared decides
    assert np.quantile([fit.misfit for fit, _ in fits], 0.95) < POOR_MISFIT
    fitted = [off for fit, off in fits if fit.status == ProbeStatus.FITTED]
    assert len(fitted) > 0.9 * PROFILES
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
    return value + 0.1 * value[0] * np.exp(-0.4 * (DISTANCE - 1)) / DISTANCE**2


@pytest.mark.slow
@pytest.mark.parametrize("distort", [_veil, _layers], ids=["stray light", "two media"])
@pytest.mark.parametrize(("relative", "floor"), NOISE[::2])
def test_poor_fit__other_media_never_pass_for_one(relative, floor, distort):
    """Where the profile is off by more than a tenth the status says so, or says that
    sigma_tr is doubtful.
    """
    fits = _fits(distort, relative, floor, seed=8)
    wrong = [fit for fit, off in fits if fit.misfit > 1.5 * POOR_MISFIT or off > 0.3]
    assert len(wrong) > 0.3 * PROFILES
    assert {fit.status for fit in wrong} <= {ProbeStatus.POOR_FIT, *DOUBTFUL}
    # stray light mostly leads to a bound, whose status has priority
    if distort is _layers:
        assert (
            sum(fit.status == ProbeStatus.POOR_FIT for fit, _ in fits) > 0.1 * PROFILES
        )
