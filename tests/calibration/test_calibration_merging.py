"""Merging of exposures of an own simulated sensor: shot noise, read noise, response,
quantisation, saturation.
"""

from __future__ import annotations

import numpy as np
import pytest

from skindb.calibration.radiance import merge_exposures, usable_exposures
from skindb.format.frames import FrameKind
from skindb.format.sensor import SensorRecord

BLACK = 1024.0
WHITE = 65520.0
READ = 6.0
STEP = 16.0
FULL = 20000.0  # electrons at the white level
BRACKETS = (0.04, 0.02, 0.01, 0.005)
KIND = FrameKind(100, 200, 16)
# relative exposures of the longest bracket; white is 1 in the first, 2, 4 and 8 in the others
LEVELS = [0.002, 0.1, 0.9, 0.99, 1.0, 1.01, 2.0, 4.0, 7.5, 7.9]


def bend(exposure):
    """A response with a square root and a straight toe, continued below zero."""
    return (
        np.where(
            exposure < 0.01,
            5 * exposure + 0.0,
            np.sqrt(np.maximum(exposure, 0.01)) - 0.05,
        )
        / 0.95
    )


def sensor_of(*, curved):
    table = None
    if curved:
        value = np.linspace(BLACK, WHITE, 2000)
        exposure = np.linspace(0, 1, 100_001)
        column = np.interp((value - BLACK) / (WHITE - BLACK), bend(exposure), exposure)
        table = np.column_stack([value, column, column, column])
    return SensorRecord(
        KIND, BLACK, WHITE, READ, FULL / (WHITE - BLACK), STEP, response=table
    )


def expose(radiance, rng, *, curved, brackets=BRACKETS):
    frames = []
    for time in brackets:
        electrons = rng.poisson(radiance * time * FULL) + READ * rng.standard_normal(
            radiance.shape
        )
        value = bend(electrons / FULL) if curved else electrons / FULL
        frames.append(
            np.clip(
                np.rint((BLACK + value * (WHITE - BLACK)) / STEP) * STEP, 0, WHITE
            ).astype(np.uint16)
        )
    return frames


@pytest.mark.parametrize("curved", [False, True])
def test_merge_exposures__z_scores_have_unit_variance_and_bias_is_below_one_per_cent(
    curved,
):
    for level in LEVELS:
        rng = np.random.default_rng([8, round(1000 * level)])
        truth = np.full((KIND.height, KIND.width, 3), level / BRACKETS[0])
        radiance, error, flag = merge_exposures(
            expose(truth, rng, curved=curved), BRACKETS, sensor_of(curved=curved)
        )
        assert np.isfinite(radiance[flag == 0]).all()
        known = np.isfinite(radiance)
        # the bound of the requirement; measured 0.25 %
        assert abs(radiance[known].mean() / truth.flat[0] - 1) < 0.01
        # 60,000 values: the deviation is known to 0.3 %; within 1 % of a white level,
        # where noise decides whether a bracket counts, it is between 0.88 and 1.08
        edge = (
            0.13
            if min(abs(level * t / BRACKETS[0] - 1) for t in BRACKETS) < 0.02
            else 0.02
        )
        assert abs(((radiance - truth) / error)[known].std() - 1) < edge


def test_merge_exposures__takes_nothing_from_clipped_pixels():
    rng = np.random.default_rng(9)
    truth = np.full((KIND.height, KIND.width, 3), 3.0 / BRACKETS[0])
    frames = expose(truth, rng, curved=False)
    assert (frames[0] >= WHITE).all()
    both, _, _ = merge_exposures(frames, BRACKETS, sensor_of(curved=False))
    rest, _, _ = merge_exposures(frames[2:], BRACKETS[2:], sensor_of(curved=False))
    np.testing.assert_allclose(both, rest, rtol=1e-6)  # single precision


def test_merge_exposures__has_no_halo_at_bright_edges():
    rng = np.random.default_rng(10)
    truth = np.full((KIND.height, KIND.width, 3), 0.02 / BRACKETS[0])
    truth[:, 50:] = 6.0 / BRACKETS[0]  # saturated in all brackets but the shortest
    radiance, error, _ = merge_exposures(
        expose(truth, rng, curved=False), BRACKETS, sensor_of(curved=False)
    )
    z = ((radiance - truth) / error).mean(axis=(0, 2))
    # a mean of 600 values with unit variance in each of 100 columns: 5 standard errors
    assert np.abs(z).max() < 5 / np.sqrt(600)


def test_usable_exposures__counts_neither_dark_nor_saturated_ones():
    levels = np.array([0.0, 0.5, 1.5, 3.0, 6.0, 12.0]) / BRACKETS[0]
    truth = np.broadcast_to(levels[None, :, None], (1, 6, 3))
    quiet = SensorRecord(
        FrameKind(6, 1, 16), BLACK, WHITE, 1.0, FULL / (WHITE - BLACK), STEP
    )
    frames = [
        np.rint(BLACK + np.minimum(truth * t, 1) * (WHITE - BLACK)).astype(np.uint16)
        for t in BRACKETS
    ]
    assert usable_exposures(frames, quiet).tolist() == [[0, 4, 3, 2, 1, 0]]
