from __future__ import annotations

import numpy as np
import pytest

from skindb.calibration.sensor_noise import average_dark
from skindb.errors import InputError


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
