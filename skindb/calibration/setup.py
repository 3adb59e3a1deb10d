"""Set-up folders: `dome/dome.json` without a face, and `dome/calibration.json` and
`contact/calibration.json`, which name the frames for the calibration of cameras, lights
and probe.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import xarray as xr

from skindb.errors import Fault, InputError, attempt, require, require_none
from skindb.files import Attributes, Json
from skindb.format.contact_probe import ProbeRecord, read_probe
from skindb.format.dome import CameraRecord, DomeRecord, read_dome
from skindb.format.fields import Fields, read_json, shown
from skindb.format.frames import (
    CAMERA,
    EXPOSURE,
    LIGHT,
    SITE,
    Frame,
    filled,
    inside,
    read_exposures,
    read_frames,
)
from skindb.limits import MAX_BALL_PLACES, MAX_KNOWN_POINTS
from skindb.types import Float64

FILE = "dome/calibration.json"
MAX_BALL_RADIUS_MM = 1_000.0  # mm; mirror balls have 5 to 200
PLACE = "place"
FLAT_FILE = "contact/calibration.json"
PROBE_FILE = "contact/probe.json"
# keys of probe.json that a set-up may lack
OF_SESSIONS = ("sites", "frames", "placements", "pressure")
MAX_REPEATS = 64
REPEAT = "repeat"
# placeholders of the frames of each kind, in the order in which cameras are calibrated
# by them
KINDS = {
    "dark": {CAMERA, REPEAT},
    "response": {CAMERA, EXPOSURE},
    "flat": {CAMERA, EXPOSURE, REPEAT},
    "chart": {CAMERA, EXPOSURE},
}
PATCHES = 24  # of a ColorChecker
CHART_COLUMNS = 6
# radius inside a patch over the distance of patches: half of a patch that is seen at 60 degrees
PATCH_FRACTION = 0.2
WHITE_FRAMES = "dome/white/{exposure}/{light}_{camera}"  # without the suffix
MIN_FLAT_FRAMES = 3  # of the flat field, for a meaningful estimate of the scatter


def read_setup_dome(
    folder: Path,
    *,
    white: bool = True,
    dark: bool = True,
    record: Attributes | None = None,
) -> DomeRecord:
    """The dome of a set-up folder, which has no frames of a face; frames of a `white`
    target are required by default.

    Without `dark`, the dark frames and the sequence of the file are ignored, because a
    session takes its own. A `record` replaces the content of the file.

    Raises
    ------
    InputError
        With every fault of `dome/dome.json` and of the frames, or without a white target.
    """
    file = folder / "dome/dome.json"
    fields = (
        _read_fields(file) if record is None else Fields(dict(record), str(file), [])
    )
    if not dark:
        fields.data = {
            key: value
            for key, value in fields.data.items()
            if key not in ("dark", "sequence")
        }
    dome = read_dome(folder, fields, face=False, calibrated=True)
    if white and dome.white is None and not fields.faults:
        fields.fault(
            "white",
            "a calibration needs the frames of a white target",
            "none",
            "photograph it, see docs/capture_format.md",
        )
    require_none(fields.faults)
    return dome


def with_placeholders(record: Attributes) -> Json:
    """The content of a dome.json whose geometry is not measured, with any geometry: cameras
    at one place, all lights at another, and the white target in the holder of the board.

    Values that cannot be read stay as they are.
    """
    filled_in = dict(record)
    for key in ("cameras", "lights"):
        items = record.get(key)
        if isinstance(items, list):
            filled_in[key] = [
                _PLACEHOLDERS[key] | item if isinstance(item, dict) else item
                for item in items
            ]
    if isinstance(white := record.get("white"), dict):
        filled_in["white"] = {"point": [0, 0, 0], "normal": [0, 0, 1]} | white
    return filled_in


_PLACEHOLDERS: dict[str, Json] = {
    "cameras": {
        "K": [[1000, 0, 0], [0, 1000, 0], [0, 0, 1]],
        "R": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
        "t": [0, 0, 1000],
    },
    "lights": {"position": [0, 0, 1000]},
}


def _read_fields(file: Path) -> Fields:
    """The JSON object of a file that must be readable."""
    faults = list[Fault]()
    data = read_json(file, faults)
    if data is None:
        raise InputError(faults)
    return Fields(data, str(file), faults)


def of_devices(
    calibration: xr.Dataset, dim: str, ids: Iterable[str], *, where: str
) -> xr.Dataset:
    """The part of a calibration for the cameras, lights or fibres of a capture, in
    their order.

    Raises
    ------
    InputError
        If the calibration lacks one of them.
    """
    names = list(ids)
    calibrated = set(map(str, calibration[dim].values))
    missing = [name for name in names if name not in calibrated]
    require(
        not missing,
        where,
        f"a calibration must have every {dim} of the capture",
        f"none of {', '.join(missing[:5])}",
        "calibrate again",
    )
    return calibration.load().sel({dim: names})


@dataclass(frozen=True)
class CameraFrames:
    """Templates of the frames of one kind.

    `places` are, by camera, the centres (24, 2) of the patches of a chart, column and row
    in px; empty arrays of other kinds.
    """

    frames: str
    repeats: int
    white: str  # chart only
    radius: float  # chart only
    places: Mapping[str, Float64]


@dataclass(frozen=True)
class KnownPoints:
    """Points (point, 3) mm of known position, and pixels (point, 2) at which a camera sees them."""

    position: Float64
    pixel: Float64


@dataclass(frozen=True)
class BallFrames:
    """Frames of a mirror ball: one for each place of the ball, light, and camera with an outline.

    `radius` is that of the ball in mm. `outlines` are, by place and camera, column, row
    and radius (3,) in px; if all are empty, the highlights of all lights give its places.
    """

    folder: Path
    frames: str
    radius: float
    outlines: Mapping[str, Mapping[str, Float64]]


@dataclass(frozen=True)
class CalibrationFrames:
    """Content of `dome/calibration.json`."""

    folder: Path
    exposures: Mapping[str, float]  # id -> seconds
    kinds: Mapping[str, CameraFrames]  # those of KINDS that the file lists
    points: Mapping[str, KnownPoints]  # by camera
    ball: BallFrames | None

    def read(
        self,
        template: str,
        camera: CameraRecord,
        exposures: Iterable[str] = ("",),
        repeats: int = 1,
    ) -> list[list[Frame]]:
        """Read the frames: the repeats of each exposure.

        Raises
        ------
        InputError
            With every frame that is missing, damaged, or of another size or depth than
            the camera's.
        """
        paths = [
            self.folder / filled(template, camera=camera.id, exposure=e, repeat=str(r))
            for e, r in product(exposures, range(1, repeats + 1))
        ]
        frames = read_frames(paths, camera.sensor.kind)
        return [frames[i : i + repeats] for i in range(0, len(frames), repeats)]


def read_calibration_frames(dome: DomeRecord) -> CalibrationFrames | None:
    """Content of `dome/calibration.json` of a set-up; None if there is no such file.

    Raises
    ------
    InputError
        With every fault of the file.
    """
    file = dome.folder / FILE
    if not file.exists():
        return None
    fields = _read_fields(file)
    require(
        dome.cameras[0].sensor.kind.bits,
        str(file),
        "cameras that write OpenEXR frames are already calibrated",
        "linear radiance",
        "remove this file",
    )
    kinds = {
        key: _camera_frames(dome, fields.object(key), key)
        for key in KINDS
        if _is_recorded(fields, key)
    }
    exposures = {}
    if "exposures" in fields.data or any(EXPOSURE in KINDS[key] for key in kinds):
        exposures = read_exposures(fields)
    points = (
        _known_points(dome, fields.object("points")) if fields.has("points") else {}
    )
    ball = None
    if _is_recorded(fields, "ball"):
        ball = _ball_frames(dome, fields.object("ball"))
    fields.require_known(
        "its keys are exposures, dark, response, flat, chart, points and ball",
        "correct the name, or remove the key",
    )
    require_none(fields.faults)
    return CalibrationFrames(dome.folder, exposures, kinds, points, ball)


def _is_recorded(fields: Fields, key: str) -> bool:
    """Whether there is more of a target than its description."""
    item = fields.get(key, None)
    return item is not None and not (
        isinstance(item, dict) and item.keys() <= {"pitch", "radius"}
    )


def _camera_frames(dome: DomeRecord, item: Fields, key: str) -> CameraFrames:
    """The frames of one kind."""
    needed = KINDS[key]
    repeats = 1
    radius = 0.0
    if REPEAT in needed:
        repeats = item.integer("repeats", minimum=2, maximum=MAX_REPEATS)
    places = {camera.id: np.empty((0, 2)) for camera in dome.cameras}
    is_chart = key == "chart"
    if is_chart and item.has("pitch"):
        places, radius = _chart_in_holder(dome, item.number("pitch", above=0.0))
    elif is_chart:
        places = _places(dome, item)
        radius = item.number("radius", above=0.0)
    return CameraFrames(
        frames=_template(dome, item, "frames", needed),
        repeats=repeats,
        white=_template(dome, item, "white", needed) if is_chart else "",
        radius=radius,
        places=places,
    )


def chart_places(pitch: float) -> Float64:
    """Centres (24, 3) mm of the patches of a chart in the holder, whose patches are so far
    apart, row by row from the top.
    """
    row, column = np.divmod(np.arange(PATCHES), CHART_COLUMNS)
    middle = (PATCHES / CHART_COLUMNS - 1) / 2
    x = (column - (CHART_COLUMNS - 1) / 2) * pitch
    return np.stack([x, (middle - row) * pitch, np.zeros(PATCHES)], axis=1)


def _chart_in_holder(
    dome: DomeRecord, pitch: float
) -> tuple[dict[str, Float64], float]:
    """Patches in the picture of every camera that sees all of them, and a radius in px."""
    places = {}
    radius = np.inf
    for camera in dome.cameras:
        place = camera.project(chart_places(pitch))
        if ((place > 0) & (place < (camera.width, camera.height))).all():
            places[camera.id] = place
            width = camera.pixel_width(np.zeros(3))
            radius = min(radius, PATCH_FRACTION * pitch / width)
    return places, radius


def _template(dome: DomeRecord, item: Fields, key: str, needed: set[str]) -> str:
    """A template whose files lie inside the folder."""
    template = item.template(key, needed)
    names = dict.fromkeys(needed, "1")
    if template:
        inside(dome.folder, filled(template, **names), item.place(key), item.faults)
    return template


def _places(dome: DomeRecord, item: Fields) -> dict[str, Float64]:
    """Patches of the chart in the picture of every camera that sees it."""
    by_camera = item.object("patches", {})
    cameras = _named_cameras(dome, by_camera)
    places = {name: by_camera.array(name, (PATCHES, 2)) for name in cameras}
    for name, place in places.items():
        size = (cameras[name].width, cameras[name].height)
        if (place < 0).any() or (place > size).any():
            by_camera.fault(
                name, "must lie inside the picture of the camera", shown(place)
            )
    return places


def _named_cameras(dome: DomeRecord, by_camera: Fields) -> dict[str, CameraRecord]:
    """The cameras that an object has as keys; other keys are faults."""
    cameras = {camera.id: camera for camera in dome.cameras}
    for name in sorted(by_camera.data.keys() - cameras.keys()):
        by_camera.fault(name, "must be a camera of the dome", shown(name))
    return {name: cameras[name] for name in by_camera.data if name in cameras}


def _known_points(dome: DomeRecord, item: Fields) -> dict[str, KnownPoints]:
    """The key "points": positions by name, and by camera the pixels of those that it sees."""
    positions = item.object("positions")
    by_camera = item.object("pixels")
    if not positions.at_most(MAX_KNOWN_POINTS, "points"):
        return {}
    position = {name: positions.array(name, (3,)) for name in positions.data}
    points = {}
    for camera in _named_cameras(dome, by_camera):
        pixels = by_camera.object(camera)
        pixel = {name: pixels.array(name, (2,)) for name in pixels.data}
        for name in pixel.keys() - position.keys():
            pixels.fault(name, "must be one of the points in positions", shown(name))
        names = [name for name in pixel if name in position]
        if names:
            points[camera] = KnownPoints(
                np.array([position[name] for name in names]),
                np.array([pixel[name] for name in names]),
            )
    return points


def _ball_frames(dome: DomeRecord, item: Fields) -> BallFrames:
    """The key "ball"."""
    template = _template(dome, item, "frames", {PLACE, LIGHT, CAMERA})
    outlines = {}
    if item.has("outlines"):
        places = item.object("outlines")
        if places.at_most(MAX_BALL_PLACES, "places of the ball"):
            for place in places.data:
                outlines[place] = _outlines(dome, places.object(place))
    else:
        count = item.integer("places", minimum=2, maximum=MAX_BALL_PLACES)
        outlines = {str(i + 1): {} for i in range(count)}
    radius = item.number("radius", above=0.0, maximum=MAX_BALL_RADIUS_MM)
    item.require_known("its keys are frames, radius, and outlines or places")
    return BallFrames(dome.folder, template, radius, outlines)


def _outlines(dome: DomeRecord, circles: Fields) -> dict[str, Float64]:
    """Outline of the ball in each camera that sees it."""
    outlines = {}
    for name, camera in _named_cameras(dome, circles).items():
        circle = circles.array(name, (3,))
        column, row, radius = circle
        # a ball that is cut off may hide its highlight
        if (
            radius > 0
            and radius <= column <= camera.width - radius
            and radius <= row <= camera.height - radius
        ):
            outlines[name] = circle
        else:
            circles.fault(
                name,
                "column, row and radius must be those of a circle in the picture",
                shown(circle),
            )
    return outlines


def read_flat_frames(folder: Path) -> ProbeRecord | None:
    """The probe of a set-up, with the repeats of its flat field as sites; None without
    `contact/calibration.json`.

    Raises
    ------
    InputError
        With every fault of the two files and of the headers of the frames.
    """
    file = folder / FLAT_FILE
    if not file.exists():
        return None
    faults = list[Fault]()
    fields = attempt(faults, lambda: _read_fields(file))
    probe = attempt(faults, lambda: _read_fields(folder / PROBE_FILE))
    if fields is None or probe is None:
        raise InputError(faults)
    template = fields.template("frames", {REPEAT, EXPOSURE})
    repeats = fields.integer("repeats", minimum=MIN_FLAT_FRAMES, maximum=MAX_REPEATS)
    fields.require_known("its keys are frames and repeats", "correct the name")
    if fields.faults or probe.faults:
        raise InputError(fields.faults + probe.faults)
    probe.data = {
        key: value for key, value in probe.data.items() if key not in OF_SESSIONS
    } | {
        "sites": [str(i + 1) for i in range(repeats)],
        "frames": template.replace(f"{{{REPEAT}}}", f"{{{SITE}}}"),
    }
    flat = read_probe(folder, probe)
    require_none(probe.faults)
    return flat
