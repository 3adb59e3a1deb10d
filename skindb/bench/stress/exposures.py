"""Stress cases of exposures: saturated, black, without noise, at any scale."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.bench.case import SCALES, Case, close, each, expect
from skindb.calibration.pixel_flags import DARK, OK, SATURATED
from skindb.calibration.radiance import merge_exposures
from skindb.format.frames import FrameKind
from skindb.format.sensor import SensorRecord

Array = NDArray[Any]


def _sensor(**changes: Any) -> SensorRecord:
    levels: dict[str, Any] = {
        "black": 256.0,
        "white": 65535.0,
        "read_noise": 6.0,
        "electrons_per_dn": 0.3,
    }
    return SensorRecord(FrameKind(4, 3, 16), **(levels | changes))


SECONDS = (0.04, 0.005)


def _frames(value: int, shape: tuple[int, ...] = (3, 4, 3)) -> list[Array]:
    return [np.full(shape, value, np.uint16) for _ in SECONDS]


def _white() -> None:
    radiance, _, flag = merge_exposures(_frames(65535), SECONDS, _sensor())
    expect((flag == SATURATED).all() and np.isnan(radiance).all(), (flag, radiance))


def _one_white() -> None:
    frames = _frames(65535)
    frames[1][:] = 30000
    radiance, _, flag = merge_exposures(frames, SECONDS, _sensor())
    expect((flag == OK).all(), flag)
    close(radiance, (30000 - 256) / (65535 - 256) / 0.005, rtol=1e-6)


def _no_exposure_black(value: int) -> None:
    radiance, error, flag = merge_exposures(_frames(value), SECONDS, _sensor())
    expect((flag == DARK).all(), flag)
    expect(
        (np.abs(radiance) <= 3 * error).all() and np.isfinite(error).all(),
        (radiance, error),
    )


def _dead_noise() -> None:
    """A sensor without noise gives the value over the time, without a division by zero."""
    radiance, error, flag = merge_exposures(
        _frames(256 + 6528)[:1], SECONDS[:1], _sensor(read_noise=0.0, step=0.0)
    )
    close(radiance, 6528 / (65535 - 256) / 0.04, rtol=1e-6)
    expect(np.isfinite(error).all() and (flag == OK).all(), (error, flag))


def _shot_noise_unknown() -> None:
    frames = [
        np.full((3, 4, 3), 256 + round(6528 * s / 0.04), np.uint16) for s in SECONDS
    ]
    radiance, error, flag = merge_exposures(
        frames, SECONDS, _sensor(electrons_per_dn=np.inf, read_noise=0.0)
    )
    close(radiance, 6528 / (65535 - 256) / 0.04, rtol=1e-3)
    expect(np.isfinite(error).all() and (flag == OK).all(), (error, flag))


def _scaled_times(scale: float) -> None:
    frames = [
        np.full((3, 4, 3), 256 + round(6528 * s / 0.04), np.uint16) for s in SECONDS
    ]
    want, want_error, _ = merge_exposures(frames, SECONDS, _sensor())
    times = tuple(s * scale for s in SECONDS)
    radiance, error, flag = merge_exposures(frames, times, _sensor())
    expect((flag == OK).all(), flag)
    close(radiance.astype(np.float64) * scale, want, rtol=1e-5)
    close(error.astype(np.float64) * scale, want_error, rtol=1e-5)


def _odd_sizes(rows: int, columns: int) -> None:
    radiance, error, flag = merge_exposures(
        _frames(6784, (rows, columns, 3))[:1], SECONDS[:1], _sensor()
    )
    expect(
        radiance.shape == error.shape == (rows, columns, 3)
        and flag.shape == (rows, columns),
        radiance.shape,
    )
    close(radiance, 6528 / (65535 - 256) / 0.04, rtol=1e-6)


def _duplicates() -> None:
    """The same exposure twice gives the same radiance, with an error smaller by sqrt 2."""
    one, once, _ = merge_exposures(_frames(6784)[:1], SECONDS[:1], _sensor())
    two, twice, _ = merge_exposures(_frames(6784), (SECONDS[0], SECONDS[0]), _sensor())
    close(two, one, rtol=1e-6)
    close(twice, once / np.sqrt(2), rtol=1e-6)


def _linear(bad: float) -> None:
    frame = np.full((2, 2, 3), 0.25, np.float32)
    frame[0, 1, 2] = bad
    radiance, _, flag = merge_exposures([frame], (1.0,), _linear_sensor())
    expect(
        flag.tolist() == [[OK, SATURATED], [OK, OK]] and np.isnan(radiance[0, 1]).all(),
        (flag, radiance),
    )
    close(radiance[1], 0.25)


def _linear_sensor() -> SensorRecord:
    return SensorRecord(FrameKind(2, 2, 0), 0.0, 1.0, 0.0, np.inf)


EXPOSURES = (
    Case("exposures", "all saturated", "The result is NaN and flagged.", _white),
    Case(
        "exposures", "one of two saturated", "The other exposure is used.", _one_white
    ),
    *each(
        "exposures",
        "all black, value {}",
        "The result is flagged dark, and zero within its error.",
        _no_exposure_black,
        256,
        250,
    ),
    Case(
        "exposures", "no noise", "The result is the value over the time.", _dead_noise
    ),
    Case(
        "exposures",
        "shot noise unknown",
        "The result is the value over the time, with the error of quantisation.",
        _shot_noise_unknown,
    ),
    *each(
        "exposures",
        "times multiplied by {:g}",
        "Radiance and error are divided by it.",
        _scaled_times,
        *SCALES,
    ),
    *each(
        "exposures",
        "{} x {} pixels",
        "Shapes and values are right.",
        _odd_sizes,
        (0, 4),
        (1, 1),
        (3, 7),
    ),
    Case(
        "exposures",
        "the same exposure twice",
        "The radiance is the same, and the error smaller by sqrt 2.",
        _duplicates,
    ),
    *each(
        "exposures",
        "a linear pixel is {}",
        "Only that pixel is NaN and flagged.",
        _linear,
        np.nan,
        np.inf,
    ),
)
