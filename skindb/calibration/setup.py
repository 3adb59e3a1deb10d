"""`dome/calibration.json` of a set-up: the frames from which its cameras and light
positions are calibrated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from skindb.calibration.light_positions import BallFrames, read_ball
from skindb.errors import Fault, InputError
from skindb.format.dome import CameraRecord, DomeRecord
from skindb.format.fields import IDENTIFIER, Fields
from skindb.format.frame_paths import EXPOSURE_SECONDS, filled, inside
from skindb.format.frames import Frame, read_frames
from skindb.format.json_file import read_json, shown
from skindb.limits import MAX_EXPOSURES, MAX_KNOWN_POINTS

FILE = "dome/calibration.json"
PATCHES = 24  # of a ColorChecker
MAX_REPEATS = 64
CAMERA = "camera"
EXPOSURE = "exposure"
REPEAT = "repeat"
BRACKETED = ("response", "flat", "chart", "edge")  # kinds that need the key exposures


@dataclass(frozen=True)
class CameraFrames:
    """Templates of the frames of one kind, and where its target lies in each camera.

    `places` are, by camera, the centres (24, 2) of the patches of a chart or the
    corners (2, 2) of the region of an edge: column and row in px.
    """

    frames: str
    repeats: int = 1
    white: str = ""
    radius: float = 0.0
    contrast: float = 0.0
    places: Mapping[str, NDArray[np.float64]] | None = None


@dataclass(frozen=True)
class KnownPoints:
    """Points (point, 3) mm of known position, and pixels (point, 2) at which a camera sees them."""

    position: NDArray[np.float64]
    pixel: NDArray[np.float64]


@dataclass(frozen=True)
class CalibrationFrames:
    """Content of `dome/calibration.json`; a kind of frames that is not listed is None."""

    folder: Path
    exposures: Mapping[str, float]  # id -> seconds
    dark: CameraFrames | None
    response: CameraFrames | None
    flat: CameraFrames | None
    chart: CameraFrames | None
    edge: CameraFrames | None
    points: Mapping[str, KnownPoints]  # by camera
    ball: BallFrames | None

    def read(
        self,
        template: str,
        camera: CameraRecord,
        exposures: Sequence[str] = ("",),
        repeats: int = 1,
    ) -> list[list[Frame]]:
        """Read the frames: the repeats of each exposure.

        Raises
        ------
        InputError
            With every frame that is missing, damaged, or of another size or depth than
            the camera's.
        """
        names = product(exposures, range(1, repeats + 1))
        paths = [
            self.folder / filled(template, camera=camera.id, exposure=e, repeat=str(r))
            for e, r in names
        ]
        frames = read_frames(paths, camera.sensor.kind)
        return [frames[i * repeats : (i + 1) * repeats] for i in range(len(exposures))]


def read_calibration_frames(dome: DomeRecord) -> CalibrationFrames | None:
    """Content of `dome/calibration.json` of a set-up; None if there is no such file.

    Raises
    ------
    InputError
        With every fault of the file.
    """
    file = dome.folder / FILE
    faults = list[Fault]()
    if not file.exists():
        return None
    data = read_json(file, faults)
    if data is None:
        raise InputError(faults)
    if dome.cameras[0].sensor.kind.bits == 0:
        rule = "cameras that write OpenEXR frames are already calibrated"
        cure = "remove this file"
        raise InputError(Fault(str(file), rule, "linear radiance", cure))
    fields = Fields(data, str(file), faults)
    least, most = EXPOSURE_SECONDS
    bracketed = [kind for kind in BRACKETED if fields.data.get(kind) is not None]
    exposures = {
        item.text("id", rule=IDENTIFIER): item.number("seconds", least=least, most=most)
        for item in (
            fields.items("exposures", most=MAX_EXPOSURES)
            if bracketed or "exposures" in fields.data
            else ()
        )
    }
    read = _Reader(dome, fields)
    found = CalibrationFrames(
        dome.folder,
        exposures,
        dark=read.kind("dark", {CAMERA, REPEAT}, least_repeats=2),
        response=read.kind("response", {CAMERA, EXPOSURE}),
        flat=read.kind("flat", {CAMERA, EXPOSURE, REPEAT}, least_repeats=2),
        chart=read.kind("chart", {CAMERA, EXPOSURE}, target=("patches", (PATCHES, 2))),
        edge=read.kind("edge", {CAMERA, EXPOSURE}, target=("region", (2, 2))),
        points=_known_points(dome, fields),
        ball=read_ball(dome, fields),
    )
    if unknown := fields.unknown():
        rule = (
            "its keys are exposures, dark, response, flat, chart, edge, points and ball"
        )
        faults.append(
            Fault(
                str(file),
                rule,
                ", ".join(unknown),
                "correct the name, or remove the key",
            )
        )
    if faults:
        raise InputError(faults)
    return found


@dataclass(frozen=True)
class _Reader:
    """Reads the kinds of frames of one file."""

    dome: DomeRecord
    fields: Fields

    def kind(
        self,
        key: str,
        needed: set[str],
        *,
        least_repeats: int = 0,
        target: tuple[str, tuple[int, int]] | None = None,
    ) -> CameraFrames | None:
        """Read one kind of frames; None if it is not listed."""
        given = self.fields.get(key, None)
        if given is None:
            return None
        item = Fields(given, self.fields.place(key), self.fields.faults)
        template = self._template(item, "frames", needed)
        return CameraFrames(
            template,
            item.integer("repeats", least=least_repeats, most=MAX_REPEATS)
            if least_repeats
            else 1,
            self._template(item, "white", needed) if key == "chart" else "",
            item.number("radius", above=0.0) if key == "chart" else 0.0,
            item.number("contrast", least=0.0, most=0.9, default=0.0)
            if key == "edge"
            else 0.0,
            None if target is None else self._places(item, *target),
        )

    def _template(self, item: Fields, key: str, needed: set[str]) -> str:
        template = item.template(key, needed, set())
        if template:
            names = {CAMERA: self.dome.cameras[0].id, EXPOSURE: "e", REPEAT: "1"}
            inside(
                self.dome.folder,
                filled(template, **names),
                item.place(key),
                item.faults,
            )
        return template

    def _places(
        self, item: Fields, key: str, shape: tuple[int, int]
    ) -> dict[str, NDArray[np.float64]]:
        """Position of the target in the picture of every camera."""
        given = Fields(item.get(key, {}), item.place(key), item.faults)
        places = {
            camera.id: given.array(camera.id, shape, default=None)
            for camera in self.dome.cameras
        }
        sizes = {
            camera.id: (camera.width, camera.height) for camera in self.dome.cameras
        }
        for name in sorted(set(given.data) - set(places)):
            given.fault(name, "must be a camera of the dome", shown(name))
        for name in set(given.data) & set(places):
            if (places[name] < 0).any() or (places[name] > sizes[name]).any():
                given.fault(
                    name,
                    "must lie inside the picture of the camera",
                    shown(places[name]),
                )
        return {name: place for name, place in places.items() if name in given.data}


def _known_points(dome: DomeRecord, fields: Fields) -> dict[str, KnownPoints]:
    """The key "points": positions by name, and by camera the pixels of those that it sees."""
    given = fields.get("points", None)
    if given is None:
        return {}
    item = Fields(given, fields.place("points"), fields.faults)
    known = Fields(item.get("positions"), item.place("positions"), item.faults)
    seen = Fields(item.get("pixels"), item.place("pixels"), item.faults)
    if not known.at_most(MAX_KNOWN_POINTS, "points"):
        return {}
    position = {name: known.array(name, (3,)) for name in known.data}
    found = dict[str, KnownPoints]()
    for camera in seen.data:
        if camera not in {one.id for one in dome.cameras}:
            seen.fault(camera, "must be a camera of the dome", shown(camera))
            continue
        pixels = Fields(seen.get(camera), seen.place(camera), item.faults)
        pixel = {name: pixels.array(name, (2,)) for name in pixels.data}
        for name in pixel.keys() - position.keys():
            pixels.fault(name, "must be one of the points in positions", shown(name))
        both = [name for name in pixel if name in position]
        if both:
            found[camera] = KnownPoints(
                np.array([position[n] for n in both]),
                np.array([pixel[n] for n in both]),
            )
    return found


def regions(place: NDArray[np.float64]) -> tuple[slice, slice]:
    """Rows and columns between two corners."""
    (left, top), (right, bottom) = np.sort(place, axis=0).astype(int)
    return slice(top, bottom), slice(left, right)
