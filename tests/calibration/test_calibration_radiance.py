"""Radiance of merged exposures."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from merged_by_numpy import merged_by_numpy

from skindb.calibration._merge_kernels import DARK, OK, SATURATED
from skindb.calibration.radiance import (
    FrameMerger,
    frame_merger,
    merge_exposures,
    radiance_floor,
    vignette_gain,
)
from skindb.format.folder import read_capture
from skindb.format.frames import FrameKind
from skindb.format.sensor import SensorRecord

SENSOR = SensorRecord(
    FrameKind(40, 40, 16),
    black=256.0,
    white=65535.0,
    read_noise=6.0,
    electrons_per_dn=0.3,
)
SECONDS = (0.04, 0.005)


def expose(radiance, seconds, rng, sensor=SENSOR):
    full = sensor.electrons_per_dn * (sensor.white - sensor.black)
    electrons = rng.poisson(
        radiance * seconds * full
    ) + sensor.read_noise * rng.standard_normal(radiance.shape)
    return np.clip(
        np.rint(sensor.black + electrons / sensor.electrons_per_dn), 0, sensor.white
    ).astype(np.uint16)


@pytest.mark.parametrize("level", [0.05, 1.0, 20.0, 60.0, 150.0])
def test_merge_exposures__is_unbiased_and_knows_its_error(level):
    rng = np.random.default_rng(3)
    truth = np.full((120, 120, 3), level)
    radiance, error, flag = merge_exposures(
        [expose(truth, s, rng) for s in SECONDS], SECONDS, SENSOR
    )
    assert (flag == OK).all()
    # 43,200 values: the mean is known to 1 / 208 of an error, the deviation to 1 / 294;
    # five of them
    assert abs((radiance - truth).mean() / error.mean()) < 5 / 208
    # and half a per cent as the estimated variance follows the noise
    assert abs(((radiance - truth) / error).std() - 1) < 5 / 294 + 0.005


def test_merge_exposures__weights_are_better_than_either_exposure():
    rng = np.random.default_rng(4)
    truth = np.full((60, 60, 3), 10.0)
    frames = [expose(truth, s, rng) for s in SECONDS]
    both, _, _ = merge_exposures(frames, SECONDS, SENSOR)
    one, _, _ = merge_exposures(frames[:1], SECONDS[:1], SENSOR)
    assert both.std() < one.std()


def test_merge_exposures__flags_saturated_and_dark():
    rng = np.random.default_rng(5)
    truth = np.full((4, 4, 3), 5.0)
    truth[0, :, 1] = 400.0  # above white in both exposures
    truth[1] = 60.0  # above white in the long one only
    truth[2] = 0.0
    quiet = replace(SENSOR, read_noise=0.1)
    radiance, _, flag = merge_exposures(
        [expose(truth, s, rng, quiet) for s in SECONDS], SECONDS, quiet
    )
    assert flag[:, 0].tolist() == [SATURATED, OK, DARK, OK]
    assert np.isnan(radiance[0, :, 1]).all()
    np.testing.assert_allclose(radiance[1], 60.0, rtol=0.1)


def test_merge_exposures__subtracts_the_dark_frame_and_divides_the_vignette():
    dark = np.full((4, 4, 3), 356, np.uint16)
    frame = np.full((4, 4, 3), 356 + 6528, np.uint16)
    vignette = np.full((4, 4, 1), 0.5, np.float32)
    radiance, _, _ = merge_exposures(
        [frame], (0.1,), SENSOR, dark=dark[None], vignette=vignette
    )
    np.testing.assert_allclose(radiance, 6528 / (65535 - 256) / 0.1 / 0.5, rtol=1e-6)


def test_merge_exposures__follows_the_response():
    x = np.linspace(0, 1, 400)
    table = np.column_stack([256 + x * (65535 - 256), x**2.2, x**2.0, x**1.8])
    sensor = replace(SENSOR, response=table)
    frame = np.full((2, 2, 3), 30000, np.uint16)
    radiance, _, _ = merge_exposures([frame], (0.5,), sensor)
    level = (30000 - 256) / (65535 - 256)
    # 400 pieces
    np.testing.assert_allclose(
        radiance[0, 0], level ** np.array([2.2, 2.0, 1.8]) / 0.5, rtol=1e-4
    )


def test_merge_exposures__linear_files_are_radiance():
    frame = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    frame[0, 0, 0] = np.inf
    sensor = replace(SENSOR, kind=FrameKind(2, 2, 0))
    radiance, _, flag = merge_exposures([frame], (1.0,), sensor)
    assert flag.tolist() == [[SATURATED, OK], [OK, OK]]
    np.testing.assert_array_equal(radiance[0, 1], frame[0, 1])


def test_radiance_floor__is_the_noise_of_darkness():
    rng = np.random.default_rng(6)
    sensor = replace(SENSOR, black=2000.0)
    dark = np.zeros((200, 200, 3))
    radiance, _, _ = merge_exposures(
        [expose(dark, s, rng, sensor) for s in SECONDS], SECONDS, sensor
    )
    floor = radiance_floor(sensor, dict(zip("ab", SECONDS, strict=True)))
    assert radiance.std() == pytest.approx(floor, rel=0.02)


def test_frame_merger__applies_vignette_and_colour_matrix(pristine):
    dome = read_capture(pristine).dome
    swap = np.array([[0, 1, 0], [1, 0, 0], [0, 0, 2.0]])
    camera = replace(
        dome.cameras[0], vignette=np.array([-0.4, 0.1, 0.0]), colour_matrix=swap
    )
    frames = [np.full((64, 72, 3), (1000, 2000, 3000), np.uint16)] * 2
    plain, _ = FrameMerger(dome.cameras[0], (1.0, 1.0)).merge(frames)
    made, _ = frame_merger(
        replace(dome, exposures={"long": 1.0, "short": 1.0}), camera
    ).merge(frames)
    expected = plain[..., [1, 0, 2]] * (1, 1, 2) / vignette_gain(camera)
    np.testing.assert_allclose(made, expected, rtol=1e-5)


@pytest.mark.parametrize("kind", [FrameKind(6, 1, 16), FrameKind(6, 1, 0)])
def test_frame_merger__divides_the_channels_by_the_gains_of_the_camera(kind):
    sensor = replace(SENSOR, kind=kind)
    gain = (0.5, 1.0, 2.0)
    frame = np.full((2, 3, 3), 1000, np.uint16 if kind.bits else np.float32)
    plain, made = (
        FrameMerger(
            SimpleNamespace(
                sensor=sensor,
                colour_matrix=np.eye(3),
                vignette=np.zeros(3),
                gain=gain,
            ),
            (1.0,),
        ).merge([frame])[0]
        for gain in ((1.0, 1.0, 1.0), gain)
    )
    np.testing.assert_allclose(made, plain / np.float32(gain), rtol=1e-6)


def test_vignette_gain__corner_and_centre(pristine):
    camera = replace(
        read_capture(pristine).dome.cameras[0], vignette=np.array([-0.4, 0.1, -0.05])
    )
    gain = vignette_gain(camera)[..., 0]
    r2 = (35.5**2 + 31.5**2) / (36**2 + 32**2)
    assert gain[0, 0] == pytest.approx(
        1 - 0.4 * r2 + 0.1 * r2**2 - 0.05 * r2**3, rel=1e-5
    )
    assert gain.max() < 1


@pytest.mark.slow
@pytest.mark.parametrize("with_dark", [False, True])
@pytest.mark.parametrize("curved", [False, True])
def test_frame_merger__develops_as_merge_exposures(pristine, with_dark, curved):
    """Twin: the NumPy formulas. Values everywhere between 0 and white, below black and
    above white among them.
    """
    for count in [1, 2, 3]:
        for bits in [8, 16]:
            rng = np.random.default_rng(count)
            top = 2**bits - 1
            black, dtype = (256.4, np.uint16) if bits == 16 else (9.5, np.uint8)
            x = np.linspace(0, 1, 60)
            table = np.column_stack(
                [black + x * (top - black), x**2.2, x**2.0, 0.3 * x + 0.7 * x**1.8]
            )
            sensor = replace(
                SENSOR,
                kind=FrameKind(37, 21, bits),
                black=black,
                white=float(top),
                step=4.0,
            )
            sensor = replace(sensor, response=table) if curved else sensor
            matrix = np.array([[1.2, -0.1, 0.0], [0.1, 0.8, -0.2], [0.0, 0.3, 1.0]])
            camera = read_capture(pristine).dome.cameras[0]
            camera = replace(
                camera,
                sensor=sensor,
                width=37,
                height=21,
                vignette=np.array([-0.4, 0.1, 0.0]),
            )
            seconds = (0.04, 0.005, 0.3)[:count]
            dark = (
                rng.integers(0, int(2 * black), (count, 21, 37, 3)).astype(dtype)
                if with_dark
                else None
            )
            frames = [
                np.asarray((top + 1) * rng.random((21, 37, 3)) ** 4, dtype)
                for _ in seconds
            ]
            frames[0][:4, :9], frames[-1][2:6, :9] = top, 0
            for frame in frames:
                frame[9:12, 9:12], frame[9:12, 12:15, 1] = 0, top
            gain = vignette_gain(camera)
            options = {"dark": dark, "vignette": gain}
            want, spread, want_flag = merged_by_numpy(
                frames, seconds, sensor, **options
            )
            whole, error, _ = merge_exposures(frames, seconds, sensor, **options)
            np.testing.assert_allclose(error, spread, rtol=1e-6)
            got, flag = FrameMerger(camera, seconds, dark).merge(frames)
            np.testing.assert_array_equal(got, whole)
            np.testing.assert_array_equal(flag, want_flag)
            assert set(np.unique(flag)) == {OK, SATURATED, DARK}
            # single precision: a handful of roundings of 6e-8; differences of nearly
            # equal values need atol
            scale = np.nanmax(np.abs(want))
            np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-8 * scale)
            coloured, _ = FrameMerger(
                replace(camera, colour_matrix=matrix), seconds, dark
            ).merge(frames)
            np.testing.assert_allclose(
                coloured, want @ matrix.T, rtol=2e-6, atol=1e-7 * scale
            )


@pytest.mark.parametrize("lens", [0.0, -0.4])
def test_frame_merger__develops_spans_as_it_does_the_whole(pristine, lens):
    """The same bits inside, and nothing usable beside them; rows of none and of all are
    among them.
    """
    rng = np.random.default_rng(5)
    camera = replace(
        read_capture(pristine).dome.cameras[0],
        width=37,
        height=21,
        vignette=np.array([lens, 0, 0]),
    )
    frames = [
        np.asarray(65536 * rng.random((21, 37, 3)) ** 3, np.uint16) for _ in range(2)
    ]
    merger = FrameMerger(camera, (0.1, 0.02))
    spans = np.sort(rng.integers(0, 38, (21, 2)), axis=1)
    spans[3], spans[4], spans[5] = (0, 37), (37, 0), (7, 7)
    inside = (np.arange(37) >= spans[:, :1]) & (np.arange(37) < spans[:, 1:])
    (whole, whole_flag), (part, flag) = (
        merger.merge(frames),
        merger.merge(frames, spans),
    )
    np.testing.assert_array_equal(part[inside], whole[inside])
    np.testing.assert_array_equal(flag, np.where(inside, whole_flag, SATURATED))


def test_frame_merger__a_sensor_without_noise(pristine):
    """Variance 0: the weights stay finite, and the photons of an unknown gain count nothing."""
    sensor = replace(SENSOR, read_noise=0.0, step=0.0, electrons_per_dn=np.inf)
    camera = replace(read_capture(pristine).dome.cameras[0], sensor=sensor)
    frames = [np.full((2, 2, 3), 256 + 6528, np.uint16)] * 2
    radiance, _ = FrameMerger(camera, (0.1, 0.1)).merge(frames)
    np.testing.assert_allclose(radiance, 6528 / (65535 - 256) / 0.1, rtol=1e-6)


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


def expose_brackets(radiance, rng, *, curved, brackets=BRACKETS):
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
            expose_brackets(truth, rng, curved=curved),
            BRACKETS,
            sensor_of(curved=curved),
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
    frames = expose_brackets(truth, rng, curved=False)
    assert (frames[0] >= WHITE).all()
    both, _, _ = merge_exposures(frames, BRACKETS, sensor_of(curved=False))
    rest, _, _ = merge_exposures(frames[2:], BRACKETS[2:], sensor_of(curved=False))
    np.testing.assert_allclose(both, rest, rtol=1e-6)  # single precision


def test_merge_exposures__has_no_halo_at_bright_edges():
    rng = np.random.default_rng(10)
    truth = np.full((KIND.height, KIND.width, 3), 0.02 / BRACKETS[0])
    truth[:, 50:] = 6.0 / BRACKETS[0]  # saturated in all brackets but the shortest
    radiance, error, _ = merge_exposures(
        expose_brackets(truth, rng, curved=False), BRACKETS, sensor_of(curved=False)
    )
    z = ((radiance - truth) / error).mean(axis=(0, 2))
    # a mean of 600 values with unit variance in each of 100 columns: 5 standard errors
    assert np.abs(z).max() < 5 / np.sqrt(600)


# extreme inputs

LEVEL = 6528 / (65535 - 256) / 0.04  # radiance of a value of 256 + 6528 after 0.04 s


def _uniform_frames(count=2):
    """Frames of the same radiance, exposed for `SECONDS`."""
    values = [256 + round(6528 * s / SECONDS[0]) for s in SECONDS[:count]]
    return [np.full((3, 4, 3), value, np.uint16) for value in values]


def test_merge_exposures__black_is_zero_within_its_error():
    for value in (256, 250):
        frames = [np.full((3, 4, 3), value, np.uint16)] * 2
        radiance, error, flag = merge_exposures(frames, SECONDS, SENSOR)
        assert (flag == DARK).all()
        assert np.isfinite(error).all()
        assert (np.abs(radiance) <= 3 * error).all()


def test_merge_exposures__a_sensor_without_noise():
    for count, changes in (
        (1, {"read_noise": 0.0, "step": 0.0}),
        (2, {"read_noise": 0.0, "electrons_per_dn": np.inf}),
    ):
        sensor = replace(SENSOR, **changes)
        radiance, error, flag = merge_exposures(
            _uniform_frames(count), SECONDS[:count], sensor
        )
        np.testing.assert_allclose(radiance, LEVEL, rtol=1e-3)
        assert np.isfinite(error).all()
        assert (flag == OK).all()


def test_merge_exposures__scales_with_the_exposure_times():
    frames = _uniform_frames()
    expected, expected_error, _ = merge_exposures(frames, SECONDS, SENSOR)
    for scale in (1e-30, 1e-12, 1e12, 1e30):
        times = tuple(s * scale for s in SECONDS)
        radiance, error, flag = merge_exposures(frames, times, SENSOR)
        assert (flag == OK).all()
        scaled = radiance.astype(np.float64) * scale
        np.testing.assert_allclose(scaled, expected, rtol=1e-5)
        scaled_error = error.astype(np.float64) * scale
        np.testing.assert_allclose(scaled_error, expected_error, rtol=1e-5)


def test_merge_exposures__any_number_of_pixels():
    for rows, columns in ((0, 4), (1, 1), (3, 7)):
        frame = np.full((rows, columns, 3), 256 + 6528, np.uint16)
        radiance, error, flag = merge_exposures([frame], SECONDS[:1], SENSOR)
        assert radiance.shape == error.shape == (rows, columns, 3)
        assert flag.shape == (rows, columns)
        np.testing.assert_allclose(radiance, LEVEL, rtol=1e-6)


def test_merge_exposures__the_same_exposure_twice_has_a_smaller_error():
    frames = _uniform_frames(1)
    radiance, error, _ = merge_exposures(frames, SECONDS[:1], SENSOR)
    twice, error_of_twice, _ = merge_exposures(frames * 2, SECONDS[:1] * 2, SENSOR)
    np.testing.assert_allclose(twice, radiance, rtol=1e-6)
    np.testing.assert_allclose(error_of_twice, error / np.sqrt(2), rtol=1e-6)


def test_merge_exposures__a_linear_pixel_that_is_not_finite_is_flagged():
    sensor = SensorRecord(FrameKind(2, 2, 0), 0.0, 1.0, 0.0, np.inf)
    for value in (np.nan, np.inf):
        frame = np.full((2, 2, 3), 0.25, np.float32)
        frame[0, 1, 2] = value
        radiance, _, flag = merge_exposures([frame], (1.0,), sensor)
        assert flag.tolist() == [[OK, SATURATED], [OK, OK]]
        assert np.isnan(radiance[0, 1]).all()
        np.testing.assert_array_equal(radiance[1], 0.25)
