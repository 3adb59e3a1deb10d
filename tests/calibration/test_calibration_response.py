"""Response and noise of a sensor."""

from __future__ import annotations

from pathlib import Path

import imagecodecs
import numpy as np
import pytest

from skindb.calibration import response
from skindb.calibration.radiance import merge_exposures
from skindb.calibration.response import (
    KNOTS,
    TOE,
    _mean_exposure_value,
    defect_pixels,
    fit_noise,
    recover_response,
    response_samples,
)
from skindb.errors import InputError
from skindb.format.frames import FrameKind
from skindb.format.sensor import SensorRecord

BLACK = 1024.0
WHITE = 65520.0
FULL = 20000.0
READ = 6.0
EIGHT = tuple(0.08 / 2.0**i for i in range(8))
PUBLISHED = Path(__file__).resolve().parents[3] / "shared/data/exposures"


def encoded(exposure, gamma):
    """A gamma curve with a linear toe: (0, 0) to (1, 1)."""
    toe = 0.004
    power = 1 / gamma
    slope = power * toe ** (power - 1)
    lift = toe**power - slope * toe
    return np.where(
        exposure < toe, slope * exposure, np.maximum(exposure, toe) ** power - lift
    ) / (1 - lift)


def scene(rng):
    """Squares of 8 px whose radiance spans four and a half decades."""
    patches = np.exp(rng.uniform(np.log(0.01), np.log(300), (40, 40)))
    return np.kron(patches, np.ones((8, 8)))[..., None] * [1.0, 0.9, 0.8]


def photographed(radiance, seconds, rng, gammas=(2.2, 2.15, 2.25)):
    """Frames of 12 bits in 16, with shot and read noise; gammas None is a linear sensor."""
    frames = []
    for time in seconds:
        electrons = radiance * time * FULL
        electrons = electrons + np.sqrt(electrons + READ**2) * rng.standard_normal(
            radiance.shape
        )
        x = np.clip(electrons / FULL, 0, 1)
        if gammas is not None:
            x = np.stack([encoded(x[..., c], g) for c, g in enumerate(gammas)], axis=-1)
        frames.append((np.rint(64 + x * 4031) * 16).astype(np.uint16))
    return np.stack(frames)


def relative_error(table, gammas=(2.2, 2.15, 2.25), low=0.05):
    value = (table[:, 0] - BLACK) / (WHITE - BLACK)
    exposure = np.linspace(0, 1, 200_001)
    truth = np.stack(
        [np.interp(value, encoded(exposure, g), exposure) for g in gammas], axis=-1
    )
    inner = (value > low) & (value < 0.99)
    ratio = table[inner, 1:] / truth[inner]
    return ratio / np.median(ratio, axis=0) - 1


@pytest.mark.parametrize(("seconds", "rms"), [(EIGHT, 0.003), ((0.04, 0.005), 0.01)])
def test_recover_response__finds_a_gamma_response(seconds, rms):
    rng = np.random.default_rng(1)
    table = recover_response(
        photographed(scene(rng), seconds, rng), seconds, black=BLACK, white=WHITE
    )
    # measured: 0.0015 of eight exposures and 0.004 of two; about twice that
    assert (np.sqrt((relative_error(table) ** 2).mean(axis=0)) < rms).all()


def test_recover_response__finds_that_a_sensor_is_linear():
    rng = np.random.default_rng(2)
    stack = photographed(scene(rng), EIGHT, rng, gammas=None)
    table = recover_response(stack, EIGHT, black=BLACK, white=WHITE)
    value = (table[:, :1] - BLACK) / (WHITE - BLACK)
    # noise of 1000 samples of 16 pixels; a gamma of 1.03 would differ by 0.011
    assert np.abs(table[:, 1:] - value).max() < 0.005


def s_shaped(exposure):
    """A gamma curve that bends back at both ends."""
    gamma = encoded(exposure, 2.2)
    return 0.5 * gamma + 0.5 * (3 * gamma**2 - 2 * gamma**3)


@pytest.mark.parametrize("form", [lambda exposure: exposure, s_shaped])
def test_recover_response__chooses_the_smoothness_by_prediction(form, monkeypatch):
    rng = np.random.default_rng(5)
    seconds = (0.04, 0.01)
    electrons = np.multiply.outer(seconds, scene(rng)) * FULL
    noisy = rng.normal(electrons, np.sqrt(electrons + READ**2)) / FULL
    # 8 bits: rounding bends the curve of all samples of a brightness in the same way
    stack = np.rint(255 * form(np.clip(noisy, 0, 1)))
    exposure = np.linspace(0.05, 0.97, 200)

    def error():
        table = recover_response(stack, seconds, black=0, white=255)
        recovered = np.interp(255 * form(exposure), *table[:, :2].T)
        return float(np.log(recovered / exposure).std())

    chosen = error()
    errors = []
    for smoothness in (1e-9, 1e-7, 1e-5, 1e-3):
        monkeypatch.setattr(response, "SMOOTHNESS", np.array([smoothness]))
        errors.append(error())
    assert chosen < 1.5 * min(errors)
    assert chosen < 0.2 * max(errors)


def test_recover_response__leaves_out_what_moved():
    rng = np.random.default_rng(3)
    radiance = scene(rng)
    stack = photographed(radiance, EIGHT, rng)
    moved = photographed(np.roll(radiance, 8, axis=0), EIGHT, rng)
    stack[::2, :, :40] = moved[::2, :, :40]  # an eighth of the frame
    table = recover_response(stack, EIGHT, black=BLACK, white=WHITE)
    assert (
        np.sqrt((relative_error(table) ** 2).mean(axis=0)) < 0.006
    ).all()  # measured 0.0006; without the test of motion 0.02


def test_recover_response__merged_radiance_is_within_one_per_cent():
    rng = np.random.default_rng(4)
    radiance = scene(rng)
    table = recover_response(
        photographed(radiance, EIGHT, rng), EIGHT, black=BLACK, white=WHITE
    )
    frames = photographed(radiance, EIGHT, np.random.default_rng(5))
    sensor = SensorRecord(
        FrameKind(320, 320, 16),
        BLACK,
        WHITE,
        READ,
        FULL / (WHITE - BLACK),
        16.0,
        response=table,
    )
    merged, error, flag = merge_exposures(list(frames), EIGHT, sensor)
    ratio = (merged / radiance)[(flag == 0) & (error / radiance < 0.02).all(axis=-1)]
    # the unit of radiance is free in each channel
    ratio = ratio / np.median(ratio, axis=0)
    brightness = np.digitize(
        np.log(radiance[..., 0][(flag == 0) & (error / radiance < 0.02).all(axis=-1)]),
        range(-3, 5),
    )
    bias = [ratio[brightness == i].mean(axis=0) - 1 for i in np.unique(brightness)]
    assert np.abs(bias).max() < 0.01  # the bound of the requirement


def test_mean_exposure_value__is_not_biased_by_noise_of_a_curved_response():
    rng = np.random.default_rng(8)
    knots = np.linspace(0, 1, KNOTS)
    value = np.sinh(knots * np.arcsinh(1 / TOE)) * TOE
    exposure = np.linspace(0, 1, 200_001)
    inverse = np.interp(value, encoded(exposure, 2.2), exposure)
    log_ratio = np.log(np.maximum(inverse, 1e-30) / np.maximum(value, 1e-30))
    log_ratio[0] = log_ratio[1]
    level = np.array([0.02, 0.1, 0.5])
    # a relative noise of 0.2 in 10,000 pixels: a mean exposure is known to 0.2 %
    noisy = level[:, None, None] * (1 + 0.2 * rng.standard_normal((3, 1, 10_000)))
    found = _mean_exposure_value(encoded(noisy, 2.2), log_ratio)[:, 0]
    recovered = np.interp(found, encoded(exposure, 2.2), exposure) / level - 1
    # three standard errors; the mean of the values is 0.8 to 1.3 % too low
    assert np.abs(recovered).max() < 0.006
    plain = (
        np.interp(
            encoded(noisy, 2.2).mean(axis=-1)[:, 0], encoded(exposure, 2.2), exposure
        )
        / level
        - 1
    )
    assert (plain < -0.006).all()


@pytest.mark.parametrize(
    ("stack", "seconds", "match"),
    [
        (np.full((2, 64, 64, 3), WHITE), (1.0, 2.0), "neither dark nor saturated"),
        (np.full((2, 64, 64, 3), BLACK), (1.0, 2.0), "neither dark nor saturated"),
        (np.full((1, 64, 64, 3), 9000.0), (1.0,), "at least two of the exposure times"),
        (
            np.full((2, 64, 64, 3), 9000.0),
            (1.0, 1.0),
            "at least two of the exposure times",
        ),
        (np.full((2, 3, 3, 3), 9000.0), (1.0, 2.0), "red 0, green 0, blue 0"),
    ],
)
def test_recover_response__refuses_what_tells_nothing(stack, seconds, match):
    with pytest.raises(InputError, match=match):
        recover_response(stack, seconds, black=BLACK, white=WHITE)


def test_response_samples__are_flat_spread_and_unsaturated(monkeypatch):
    monkeypatch.setattr(response, "SAMPLES", 400)
    rng = np.random.default_rng(7)
    stack = photographed(scene(rng), EIGHT, rng)
    green = (stack[..., 1] - float(BLACK)) / (WHITE - BLACK)
    samples = response_samples(green, np.array(EIGHT))
    assert samples.value[samples.usable].max() < 1
    assert (samples.usable.sum(axis=1) >= 2).all()
    mean = np.clip(samples.value, 0, 1).mean(axis=1)
    counts, _ = np.histogram(mean, bins=10, range=(mean.min(), mean.max()))
    assert counts.min() >= 10  # of 40 that an even spread would have


def published_stack():
    folder = PUBLISHED / "frobisher"
    if not folder.is_dir():
        pytest.skip("the published exposure stacks are not on this computer")
    names = [folder / f"IMG_{number}.jpg" for number in (2600, 2601, 2602)]
    reference = (
        folder / "reference" / "test_camera_response_function_Debevec1997_crfs.npy"
    )
    return np.stack([imagecodecs.imread(str(name)) for name in names]), np.load(
        reference
    )


def test_recover_response__agrees_with_a_published_curve():
    stack, reference = published_stack()
    table = recover_response(stack, (0.125, 1.0, 8.0), black=0, white=255)
    values = np.arange(20, 251)
    found = np.stack(
        [np.interp(values, table[:, 0], table[:, c]) for c in (1, 2, 3)],
        axis=-1,
    )
    apart = np.log(found / reference[values])
    # measured: 0.019, 0.017, 0.014; 0.116, 0.017, 0.035 with a smoothness of 1e-8
    assert (apart.std(axis=0) < 0.03).all()


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
    clipped = fit_noise(pairs[:4], black=1024, white=65520, step=32.0)
    assert fit == clipped


@pytest.mark.parametrize(
    "pairs",
    [
        np.full((5, 2, 20, 20), 65520.0),
        np.full((5, 2, 20, 20), 1024.0),
        1024 + np.random.default_rng(1).normal(100, 1, (5, 2, 20, 20)),
    ],
)
def test_fit_noise__refuses_what_tells_nothing(pairs):
    with pytest.raises(InputError, match="pairs of flat frames"):
        fit_noise(pairs, black=1024, white=65520)


def test_defect_pixels__marks_hot_stuck_and_noisy_pixels():
    rng = np.random.default_rng(2)
    frames = np.rint(1000 + 5 * rng.standard_normal((16, 100, 120, 3)))
    frames[:, 10, 20, 0] += 300  # hot
    frames[:, 30, 40, 1] = 1000  # stuck at an ordinary value
    # noisy, with an ordinary mean
    frames[:, 50, 60, 2] += 100 * (-1.0) ** np.arange(16)
    defect = defect_pixels(frames)
    assert {tuple(at) for at in np.argwhere(defect)} >= {
        (10, 20, 0),
        (30, 40, 1),
        (50, 60, 2),
    }
    # of 36,000; the deviation of 16 values has a longer tail than a Gaussian
    assert defect.sum() <= 5


def test_defect_pixels__of_even_frames_has_no_defect():
    assert not defect_pixels(np.full((4, 10, 10, 3), 7)).any()
