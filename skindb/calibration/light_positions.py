"""Positions of the lights of a dome from highlights on a mirror ball, and their
application to a capture.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.calibration.mirror_ball import (
    LightPosition,
    Outline,
    Pinhole,
    ball_centre,
    highlight_centre,
    light_position,
    reflected_ray,
)
from skindb.errors import Fault, InputError
from skindb.format.dome import CameraRecord, DomeRecord, LightRecord
from skindb.format.fields import Fields
from skindb.format.frame_paths import filled, inside
from skindb.format.frames import read_frame
from skindb.format.json_file import shown
from skindb.limits import MAX_BALL_PLACES
from skindb.schema import dataset

Array = NDArray[np.float64]
PLACE = "place"
LIGHT = "light"
CAMERA = "camera"
MAX_BALL_RADIUS_MM = 1_000.0  # mm; mirror balls have 5 to 200
THREADS = 2


@dataclass(frozen=True)
class BallFrames:
    """Frames of a mirror ball: one for each place of the ball, light, and camera with an outline.

    `radius` is that of the ball in mm. `outlines` are, by place and camera, column, row
    and radius (3,) in px.
    """

    folder: Path
    frames: str
    radius: float
    outlines: Mapping[str, Mapping[str, Array]]


def read_ball(dome: DomeRecord, fields: Fields) -> BallFrames | None:
    """The key "ball" of `dome/calibration.json`; None if it is absent. Its faults are
    recorded in `fields`.
    """
    given = fields.get("ball", None)
    if given is None:
        return None
    item = Fields(given, fields.place("ball"), fields.faults)
    template = item.template("frames", {PLACE, LIGHT, CAMERA}, set())
    if template:
        names = {PLACE: "a", LIGHT: dome.lights[0].id, CAMERA: dome.cameras[0].id}
        inside(
            dome.folder, filled(template, **names), item.place("frames"), item.faults
        )
    places = Fields(item.get("outlines"), item.place("outlines"), item.faults)
    outlines = dict[str, dict[str, Array]]()
    if places.at_most(MAX_BALL_PLACES, "places of the ball"):
        for place in places.data:
            circles = Fields(places.get(place), places.place(place), item.faults)
            outlines[place] = _outlines(dome, circles)
    radius = item.number("radius", above=0.0, most=MAX_BALL_RADIUS_MM)
    if unknown := item.unknown():
        item.faults.append(
            Fault(
                item.where,
                "its keys are frames, radius and outlines",
                ", ".join(unknown),
            )
        )
    return BallFrames(dome.folder, template, radius, outlines)


def _outlines(dome: DomeRecord, circles: Fields) -> dict[str, Array]:
    """Outline of the ball in each camera that sees it."""
    found = dict[str, Array]()
    cameras = {camera.id: camera for camera in dome.cameras}
    for name in circles.data:
        circle = circles.array(name, (3,))
        if name not in cameras:
            circles.fault(name, "must be a camera of the dome", shown(name))
        elif not _within(circle, cameras[name]):
            circles.fault(
                name,
                "column, row and radius must be those of a circle in the picture",
                shown(circle),
            )
        else:
            found[name] = circle
    return found


def _within(circle: Array, camera: CameraRecord) -> bool:
    column, row, radius = circle
    return bool(
        radius > 0
        and radius <= column <= camera.width - radius
        and radius <= row <= camera.height - radius
    )  # a ball that is cut off may hide its highlight


def calibrate_positions(dome: DomeRecord, ball: BallFrames) -> xr.Dataset:
    """Position of every light from its highlights on the ball, with standard errors.

    A light needs its highlight in two frames, of different cameras or places of the
    ball. Frames without a highlight are skipped: the light may be hidden, or behind the
    ball.

    Returns
    -------
    Dataset
        Group "position_calibration".

    Raises
    ------
    InputError
        With every frame that cannot be read, and every light that is seen in fewer than two frames.
    """
    cameras = {
        camera.id: Pinhole(camera.K, camera.R, camera.t, camera.distortion)
        for camera in dome.cameras
    }
    centres = dict[str, Array]()
    for place, circles in ball.outlines.items():
        try:
            seen = [cameras[name] for name in circles]
            centres[place] = ball_centre(
                seen, list(circles.values()), ball.radius
            ).centre
        except InputError as error:
            raise InputError(
                [
                    replace(fault, where=f"{fault.where}, place {place}")
                    for fault in error.faults
                ]
            ) from None
    faults = list[Fault]()

    def one(light: LightRecord) -> tuple[LightPosition | None, int]:
        try:
            rays = list(_rays(dome, ball, centres, light))
            if len(rays) < 2:
                rule = "its highlight must appear in two frames"
                cure = "expose them longer, or add a place of the ball"
                raise InputError(Fault("mirror ball", rule, f"{len(rays)}", cure))
            return light_position(*zip(*rays, strict=True)), len(rays)
        except InputError as error:
            faults.extend(
                replace(fault, where=f"light {light.id}, {fault.where}")
                for fault in error.faults
            )
            return None, 0

    with ThreadPoolExecutor(THREADS) as pool:
        pairs = list(pool.map(one, dome.lights))
    if faults:
        raise InputError(sorted(faults, key=str))
    found = [position for position, _ in pairs if position is not None]
    return dataset(
        {
            "calibrated_position": [one.position for one in found],
            "calibrated_position_error": [
                np.sqrt(np.diag(one.covariance)) for one in found
            ],
            "position_ray_count": [count for _, count in pairs],
            "position_miss": [np.sqrt(np.mean(one.miss**2)) for one in found],
        },
        coords={"light": [light.id for light in dome.lights], "xyz": ["x", "y", "z"]},
    )


def _rays(
    dome: DomeRecord, ball: BallFrames, centres: Mapping[str, Array], light: LightRecord
) -> Iterator[tuple[Array, Array]]:
    """Points of the ball, and directions from them to the light, of all frames that
    show its highlight.
    """
    for place, circles in ball.outlines.items():
        for camera in dome.cameras:
            if camera.id not in circles:
                continue
            names = {PLACE: place, LIGHT: light.id, CAMERA: camera.id}
            frame = read_frame(
                ball.folder / filled(ball.frames, **names), camera.sensor.kind
            )
            column, row, radius = circles[camera.id]
            try:
                highlight = highlight_centre(
                    frame, Outline(np.array([column, row]), radius)
                )
            except InputError:
                continue
            pinhole = Pinhole(camera.K, camera.R, camera.t, camera.distortion)
            yield reflected_ray(pinhole, centres[place], ball.radius, highlight)


def positioned_dome(
    dome: DomeRecord, calibration: xr.Dataset, *, where: str
) -> DomeRecord:
    """The dome with the light positions of a calibration; the axes of the lights are unchanged.

    Raises
    ------
    InputError
        If the calibration lacks a light.
    """
    known = calibration["calibrated_position"].load()
    names = set(map(str, known["light"].values))
    if missing := [light.id for light in dome.lights if light.id not in names]:
        found = f"none of {', '.join(missing[:5])}"
        raise InputError(
            Fault(
                where,
                "a calibration must have every light of the capture",
                found,
                "calibrate again",
            )
        )
    lights = (
        replace(light, position=known.sel(light=light.id).values)
        for light in dome.lights
    )
    return replace(dome, lights=tuple(lights))
