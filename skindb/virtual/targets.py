"""Calibration targets in the virtual dome, drawn whenever its cameras are triggered: a board, a
white square, a mirror ball, diffusers before the lenses, a colour chart.

The frame of the subject is that of the holder: every flat target stands in its origin.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from skindb.calibration.boards import printed_board
from skindb.calibration.cameras import chart_reference
from skindb.calibration.setup import chart_places
from skindb.errors import require
from skindb.files import Json, make_private, private_file
from skindb.format.dome import DomeRecord
from skindb.types import Float64, Values16, lengths, unit
from skindb.virtual.capture import DEVICE_SEED, dome_record
from skindb.virtual.dome import (
    TARGET_HALF_SIZE,
    TARGET_REFLECTANCE,
    Dome,
    DomeCamera,
    DomeLight,
    FrameWriter,
    Sensor,
    build_dome,
)

SAMPLES = 3  # along each side of a pixel
BOARD = {"squares": [5, 7], "square": 34.0, "marker": 26.0, "dictionary": "DICT_4X4_50"}
BALL_RADIUS = 30.0  # mm
CHART_PITCH = 18.0  # mm between the centres of patches
BOARD_PX_MM = 6  # of its drawing
TURN = 0.3  # rad, standard deviation of the poses of the board about each axis
MAX_TURN = 0.5
SHIFT = 12.0  # mm, as TURN
BALL_PLACES = ((-40.0, 25.0, 10.0), (40.0, 0.0, 30.0), (0.0, -45.0, 50.0))
# of a light on the ball, over the unit of radiance; its blur by the lens in px
HIGHLIGHT = 100.0
BLUR_PX = 1.0
CARD = -60.0  # mm, z of a grey card behind the ball
CARD_REFLECTANCE = 0.05
DIFFUSER = 20.0  # radiance of an opal sheet before the lens


def write_laboratory(
    folder: Path, *, cameras: int, lights: int, width: int, height: int
) -> None:
    """Write what is known of the virtual dome before it is calibrated: its devices, and the
    sizes of the targets.
    """
    rng = np.random.default_rng(DEVICE_SEED)
    dome = build_dome(lights, cameras, width=width, height=height, rng=rng)
    complete = dome_record(dome, Sensor(), datetime.now(UTC))
    stated = {
        "cameras": ("id", "width", "height", "bit_depth", "black_level", "white_level"),
        "lights": ("id", "disc_radius"),
    }
    record: Json = {
        key: [{name: item[name] for name in names} for item in complete[key]]
        for key, names in stated.items()
    }
    record["exposures"] = complete["exposures"]
    record["white"] = {
        "reflectance": TARGET_REFLECTANCE,
        "half_size": TARGET_HALF_SIZE,
    }
    make_private(folder / "dome")
    for name, content in (
        ("dome", record),
        ("boards", BOARD),
        (
            "calibration",
            {"ball": {"radius": BALL_RADIUS}, "chart": {"pitch": CHART_PITCH}},
        ),
    ):
        text = json.dumps(content, indent=1)
        private_file(folder / f"dome/{name}.json").write_text(text, encoding="utf-8")


def rehearsed_dome(dome: DomeRecord) -> tuple[Dome, Sensor]:
    """The virtual dome with the lights and cameras of a set-up, and its sensor.

    Raises
    ------
    InputError
        If the set-up has other ids or levels than the virtual dome.
    """
    first = dome.cameras[0]
    virtual = build_dome(
        len(dome.lights),
        len(dome.cameras),
        width=first.width,
        height=first.height,
        rng=np.random.default_rng(DEVICE_SEED),
    )
    sensor = Sensor()
    levels = {(camera.sensor.black, camera.sensor.white) for camera in dome.cameras}
    same = (
        dome.light_ids == [light.name for light in virtual.lights]
        and dome.camera_ids == [camera.name for camera in virtual.cameras]
        and levels == {(sensor.black, sensor.white)}
    )
    require(
        same,
        str(dome.file),
        "--virtual rehearses with the virtual dome: lights l000, ..., cameras c00, ..., "
        f"black_level {sensor.black}, white_level {sensor.white}",
        "others",
        "name a new folder, into which --virtual writes these",
    )
    return virtual, sensor


class TargetScene:
    """What the cameras of a virtual dome see in calibration recordings.

    Parameters
    ----------
    dome, sensor
        The devices.
    kind
        Kind of the recording.
    seconds
        Id of an exposure -> s.
    rng
        Noise of the frames.
    """

    def __init__(
        self,
        dome: Dome,
        sensor: Sensor,
        kind: str,
        seconds: Mapping[str, float],
        *,
        rng: np.random.Generator,
    ) -> None:
        self.number = 1  # of the pose, or of the place of the ball
        self._kind = kind
        self._seconds = seconds
        self._lights = {light.name: light for light in dome.lights}
        self._writers = dict[str, FrameWriter]()
        self._rays = dict[str, Float64]()  # of several points in each pixel
        self._planes = dict[tuple[str, int], _Plane]()
        devices = np.random.default_rng(DEVICE_SEED).spawn(len(dome.cameras))
        for camera, device in zip(dome.cameras, devices, strict=True):
            pattern = sensor.pattern((camera.height, camera.width, 3), rng=device)
            self._writers[camera.name] = FrameWriter(
                Path(), camera, sensor, pattern, rng
            )

    def frame(
        self, camera: str, exposure: str, factors: Mapping[str, float]
    ) -> Values16:
        """A frame under these lights, each with its factor."""
        writer = self._writers[camera]
        radiance = np.zeros((writer.camera.height, writer.camera.width, 3))
        for light, factor in factors.items():
            radiance += factor * self._radiance(writer.camera, self._lights[light])
        return writer.exposed(radiance.astype(np.float32), self._seconds[exposure])

    def _radiance(self, camera: DomeCamera, light: DomeLight) -> Float64:
        """Radiance (h, w, 3) under one light."""
        shape = (camera.height, camera.width, 3)
        if self._kind == "flat":
            return np.full(shape, DIFFUSER)
        view = (camera.name, self.number)
        if view not in self._planes:
            if camera.name not in self._rays:
                self._rays[camera.name] = camera.rays(_pixels(camera, SAMPLES))
            ray = self._rays[camera.name]
            self._planes[view] = _plane(camera, ray, self._kind, self.number)
        plane = self._planes[view]
        towards = light.position - plane.point
        irradiance = np.maximum(towards @ plane.normal, 0) / lengths(towards) ** 3
        value = plane.reflectance / np.pi * irradiance[..., None] * light.intensity
        if self._kind == "ball":
            ball = np.array(BALL_PLACES[self.number - 1])
            _add_highlight(value, camera, light, ball)
        return value


@dataclass(frozen=True)
class _Plane:
    """What a camera sees of a flat target: points (h, w, 3) mm, and reflectances (h, w, 1
    or 3), the mean of several rays in each pixel.
    """

    point: Float64
    normal: Float64
    reflectance: Float64


def _plane(camera: DomeCamera, ray: Float64, kind: str, number: int) -> _Plane:
    turn, shift = np.eye(3), np.zeros(3)
    if kind == "board":
        turn, shift = board_pose(number)
    elif kind == "ball":
        shift = np.array([0.0, 0.0, CARD])
    normal = turn[:, 2]
    reach = ((shift - camera.centre) @ normal) / (ray @ normal)
    point = camera.centre + reach[..., None] * ray
    place = ((point - shift) @ turn)[..., :2]
    value = _reflectance(place.reshape(-1, 2), kind, number)

    def means(values: Float64) -> Float64:
        parts = (camera.height, SAMPLES, camera.width, SAMPLES, -1)
        return values.reshape(parts).mean(axis=(1, 3))

    return _Plane(means(point), normal, means(value))


def _pixels(camera: DomeCamera, samples: int) -> Float64:
    """Columns and rows (h samples, w samples, 2) of points in the pixels."""
    sizes = (camera.width, camera.height)
    axes = ((np.arange(size * samples) + 0.5) / samples for size in sizes)
    return np.stack(np.meshgrid(*axes), axis=-1)


def board_pose(number: int) -> tuple[Float64, Float64]:
    """Rotation (3, 3) and position (3,) mm of the board; the first pose is the frame."""
    if number == 1:
        return np.eye(3), np.zeros(3)
    rng = np.random.default_rng([DEVICE_SEED, number])
    turn = np.clip(rng.normal(0, TURN, 3), -MAX_TURN, MAX_TURN)
    return Rotation.from_rotvec(turn).as_matrix(), rng.normal(0, SHIFT, 3)


def _reflectance(place: Float64, kind: str, number: int) -> Float64:
    """Reflectance (n, 1 or 3) at places (n, 2) mm of a target."""
    if kind == "ball":
        return np.full((len(place), 1), CARD_REFLECTANCE)
    if kind == "board":
        picture = _board_picture()
        height, width = picture.shape
        column = np.floor(place[:, 0] * BOARD_PX_MM + width / 2).astype(int)
        row = np.floor(height / 2 - place[:, 1] * BOARD_PX_MM).astype(int)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        value = np.where(inside, picture[row % height, column % width], 0.5)
        return value[:, None]
    if kind == "response" or (kind, number) == ("chart", 1):
        centres = chart_places(CHART_PITCH)[:, :2]
        value = np.full((len(place), 3), 0.03)
        for centre, colour in zip(centres, chart_reference(), strict=True):
            is_patch = (np.abs(place - centre) < 0.45 * CHART_PITCH).all(axis=1)
            value[is_patch] = np.maximum(colour, 0)
        return value
    inside = (np.abs(place) <= TARGET_HALF_SIZE).all(axis=1)
    return np.where(inside, TARGET_REFLECTANCE, 0.0)[:, None]


@cache
def _board_picture() -> Float64:
    """The printed board, 0.04 where it is black and 0.9 where it is white."""
    record: Json = BOARD
    size = [round(n * record["square"] * BOARD_PX_MM) for n in record["squares"]]
    drawn = printed_board(**record).generateImage(size, marginSize=0)
    return 0.04 + 0.86 * np.asarray(drawn, float) / 255


def _add_highlight(
    value: Float64, camera: DomeCamera, light: DomeLight, ball: Float64
) -> None:
    """Draw a mirror ball over a radiance image (h, w, 3); its highlight is as blurred as by
    the lens.
    """
    ray = camera.rays(_pixels(camera, 1))
    way = ball - camera.centre
    along = ray @ way
    under = BALL_RADIUS**2 - way @ way + along**2
    hit = under > 0
    point = camera.centre + (along[hit] - np.sqrt(under[hit]))[:, None] * ray[hit]
    normal = (point - ball) / BALL_RADIUS
    mirrored = ray[hit] - 2 * (ray[hit] * normal).sum(axis=1)[:, None] * normal
    towards = unit(light.position - point)
    miss = np.arccos(np.clip((towards * mirrored).sum(axis=1), -1, 1))
    # a shift of the picture turns the normal, and the mirrored ray twice as much
    blur = 2 * BLUR_PX * camera.pixel_width(ball) / BALL_RADIUS
    bright = HIGHLIGHT * np.exp(-((miss / blur) ** 2) / 2)
    value[hit] = bright[:, None] * light.intensity / light.intensity.mean()
