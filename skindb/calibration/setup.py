"""Set-up folders: `dome/dome.json` without a face, and `dome/calibration.json` and
`contact/calibration.json`, which name the frames for the calibration of cameras, lights
and probe.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from skindb.calibration.fibres import MIN_FRAMES
from skindb.errors import Fault, InputError
from skindb.format.contact_probe import ProbeRecord, read_probe
from skindb.format.dome import CameraRecord, DomeRecord, read_dome
from skindb.format.fields import IDENTIFIER, Fields
from skindb.format.frame_paths import (
    CAMERA,
    EXPOSURE,
    EXPOSURE_SECONDS,
    LIGHT,
    SITE,
    filled,
    inside,
)
from skindb.format.frames import Frame, read_frames
from skindb.format.json_file import read_json, shown
from skindb.limits import MAX_BALL_PLACES, MAX_EXPOSURES, MAX_KNOWN_POINTS

Array = NDArray[np.float64]
FILE = "dome/calibration.json"
MAX_BALL_RADIUS_MM = 1_000.0  # mm; mirror balls have 5 to 200
PLACE = "place"
FLAT_FILE = "contact/calibration.json"
PROBE_FILE = "contact/probe.json"
# keys of probe.json that a set-up may lack
OF_SESSIONS = ("sites", "frames", "placements", "pressure")
PATCHES = 24  # of a ColorChecker
MAX_REPEATS = 64
REPEAT = "repeat"
BRACKETED = ("response", "flat", "chart", "edge")  # kinds that need the key exposures


def read_setup_dome(
    folder: Path, *, white: bool = True, dark: bool = True
) -> DomeRecord:
    """The dome of a set-up folder, which has no frames of a face; frames of a `white`
    target are required by default.

    Without `dark`, the dark frames and the sequence of the file are ignored, because a
    session takes its own.

    Raises
    ------
    InputError
        With every fault of `dome/dome.json` and of the frames, or without a white target.
    """
    faults = list[Fault]()
    file = folder / "dome/dome.json"
    data = read_json(file, faults)
    if data is None:
        raise InputError(faults)
    if not dark and isinstance(data, dict):
        data = {
            key: value for key, value in data.items() if key not in ("dark", "sequence")
        }
    dome = read_dome(
        folder, Fields(data, str(file), faults), face=False, calibrated=True
    )
    if white and dome.white is None and not faults:
        rule = "a calibration needs the frames of a white target"
        cure = "photograph it, see docs/capture_format.md"
        faults.append(Fault(f"{file}[white]", rule, "none", cure))
    if faults:
        raise InputError(faults)
    return dome


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
class BallFrames:
    """Frames of a mirror ball: one for each place of the ball, light, and camera with an outline.

    `radius` is that of the ball in mm. `outlines` are, by place and camera, column, row
    and radius (3,) in px.
    """

    folder: Path
    frames: str
    radius: float
    outlines: Mapping[str, Mapping[str, Array]]


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


def read_flat_frames(folder: Path) -> ProbeRecord | None:
    """The probe of a set-up, with the repeats of its flat field as sites; None without
    `contact/calibration.json`.

    Raises
    ------
    InputError
        With every fault of the two files and of the headers of the frames.
    """
    file = folder / FLAT_FILE
    faults = list[Fault]()
    if not file.exists():
        return None
    data = read_json(file, faults)
    probe = read_json(folder / PROBE_FILE, faults)
    if data is None or not isinstance(probe, dict):
        raise InputError(
            faults
            or [
                Fault(
                    str(folder / PROBE_FILE),
                    "must be a JSON object {...}",
                    "another value",
                )
            ]
        )
    fields = Fields(data, str(file), faults)
    template = fields.template("frames", {REPEAT, EXPOSURE}, set())
    repeats = fields.integer("repeats", least=MIN_FRAMES, most=MAX_REPEATS)
    if unknown := fields.unknown():
        faults.append(
            Fault(
                str(file),
                "its keys are frames and repeats",
                ", ".join(unknown),
                "correct the name",
            )
        )
    if faults:
        raise InputError(faults)
    flat = {key: value for key, value in probe.items() if key not in OF_SESSIONS}
    flat |= {
        "sites": [str(i + 1) for i in range(repeats)],
        "frames": template.replace(f"{{{REPEAT}}}", f"{{{SITE}}}"),
    }
    found = read_probe(folder, Fields(flat, str(folder / PROBE_FILE), faults))
    if faults:
        raise InputError(faults)
    return found


def regions(place: NDArray[np.float64]) -> tuple[slice, slice]:
    """Rows and columns between two corners."""
    (left, top), (right, bottom) = np.sort(place, axis=0).astype(int)
    return slice(top, bottom), slice(left, right)
