"""Noise of sensors, dark frames and defect pixels."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.calibration.sensor_noise import average_dark, fit_noise
from skindb.errors import InputError


def flat_pairs(
    rng, gain=0.31, read=6.0, levels=(0.0, 0.01, 0.05, 0.2, 0.5, 0.8), step=1.0
):
    pattern = 1 + 0.02 * rng.standard_normal((100, 100))
    pairs = []
    for level in levels:
        electrons = rng.poisson(
            level * 20000 * pattern, (2, 100, 100)
        ) + read * rng.standard_normal((2, 100, 100))
        pairs.append(
            np.clip(np.rint((1024 + electrons / gain) / step) * step, 0, 65520)
        )
    return np.array(pairs)


def test_fit_noise__knows_gain_read_noise_and_their_errors():
    fits = [
        fit_noise(flat_pairs(np.random.default_rng(s)), black=1024, white=65520)
        for s in range(40)
    ]
    gain = np.array(
        [(f.electrons_per_dn - 0.31) / f.electrons_per_dn_error for f in fits]
    )
    read = np.array([(f.read_noise - 6.0) / f.read_noise_error for f in fits])
    # 40 z-scores: their mean has a deviation of 0.16, their deviation one of 0.11
    assert abs(gain.mean()) < 0.6
    assert abs(read.mean()) < 0.6
    assert 0.65 < gain.std() < 1.35
    assert 0.65 < read.std() < 1.35
    assert 0.5 < np.mean([f.chi_square for f in fits]) < 1.5


def test_fit_noise__takes_quantisation_off_and_leaves_saturated_pairs_out():
    pairs = flat_pairs(
        np.random.default_rng(3), levels=(0.0, 0.02, 0.1, 0.4, 1.1), step=32.0
    )
    fit = fit_noise(pairs, black=1024, white=65520, step=32.0)
    assert abs(fit.read_noise - 6) < 4 * fit.read_noise_error
    assert np.isnan(fit.mean).tolist() == [False] * 4 + [True]


@pytest.mark.parametrize(
    "pairs",
    [
        np.full((5, 2, 20, 20), 65520.0),
        np.full((5, 2, 20, 20), 1024.0),
        np.full((5, 2, 20, 20), np.nan),
        np.zeros((2, 20, 20)),
        1024 + np.random.default_rng(1).normal(100, 1, (5, 2, 20, 20)),
    ],
)
def test_fit_noise__refuses_what_tells_nothing(pairs):
    with pytest.raises(InputError, match="pairs of flat frames"):
        fit_noise(pairs, black=1024, white=65520)


def test_average_dark__marks_hot_stuck_and_noisy_pixels():
    rng = np.random.default_rng(2)
    frames = np.rint(1000 + 5 * rng.standard_normal((16, 100, 120, 3)))
    frames[:, 10, 20, 0] += 300  # hot
    frames[:, 30, 40, 1] = 1000  # stuck at an ordinary value
    # noisy, with an ordinary mean
    frames[:, 50, 60, 2] += 100 * (-1.0) ** np.arange(16)
    dark = average_dark(frames)
    assert {tuple(at) for at in np.argwhere(dark.defect)} >= {
        (10, 20, 0),
        (30, 40, 1),
        (50, 60, 2),
    }
    # of 36,000; the deviation of 16 values has a longer tail than a Gaussian
    assert dark.defect.sum() <= 5
    z = (dark.mean[~dark.defect] - 1000) / dark.error[~dark.defect]
    # Student's t of 15 degrees of freedom
    assert abs(np.median(np.abs(z)) - 0.691) < 0.02


def test_average_dark__of_even_frames_has_no_defect():
    dark = average_dark(np.full((4, 10, 10, 3), 7))
    assert not dark.defect.any()
    assert (dark.mean == 7).all()


@pytest.mark.parametrize(
    "frames",
    [np.zeros((1, 9, 9, 3)), np.zeros((9, 9, 3)), np.full((2, 9, 9, 3), np.nan)],
)
def test_average_dark__refuses_what_tells_nothing(frames):
    with pytest.raises(InputError, match="at least two frames"):
        average_dark(frames)
