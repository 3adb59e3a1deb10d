"""Reading `dome.json` and `probe.json`: cameras, lights, fibres, and the paths of their frames."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault
from skindb.format.fields import IDENTIFIER, Fields
from skindb.format.frame_paths import (
    CAMERA,
    EXPOSURE,
    LIGHT,
    filled,
    inside,
    read_exposures,
    require_merged,
    require_own_files,
)
from skindb.format.frames import FrameKind, header_faults, is_linear
from skindb.format.json_file import shown
from skindb.format.sensor import SensorRecord, read_sensor
from skindb.geometry.camera import camera_centre
from skindb.limits import (
    MAX_CAMERAS,
    MAX_FRAME_PIXELS,
    MAX_FRAMES,
    MAX_LIGHTS,
    MAX_SEQUENCE_STEPS,
)

Array = NDArray[np.float64]
ROTATION_TOLERANCE = 1e-4  # of R R^T - 1: five digits in the file
MAX_DISC_RADIUS_MM = 2_000.0  # mm: the largest soft boxes have a radius of 1 m
# exponent of the cosine: a narrow spot, half as bright at 1.5 degrees from the axis
MAX_FALLOFF = 2_000.0
TARGET_HALF_SIZES_MM = (1.0, 2_000.0)  # mm: from a patch of a colour chart to a wall
MIN_VIGNETTE_GAIN = 0.05  # at a corner: a lens that darkens by 4 stops has 0.06
# relative to the principal point; lenses darken towards the corners
MAX_VIGNETTE_GAIN = 4.0
# distortion at the farthest corner; fisheyes have 0.5 and 0.01
RADIAL_FACTORS = (0.1, 10.0)
MAX_TANGENTIAL = 0.5
MAX_SECONDS = 1e6  # of a session; more indicates inconsistent clocks
SEQUENCE_CURE = "write what the controller acknowledged, or remove the sequence"
# radii from the centre to a corner at which the gain of a lens is checked
VIGNETTE_STEPS = 1000


@dataclass(frozen=True)
class CameraRecord:
    """One camera: `x_cam = R x + t`, distortion k1 k2 p1 p2 k3."""

    id: str
    width: int
    height: int
    K: Array
    R: Array
    t: Array
    distortion: Array
    sensor: SensorRecord
    colour_matrix: Array
    vignette: Array  # a2 a4 a6


@dataclass(frozen=True)
class LightRecord:
    """One light; if its intensity is None, the white target determines it."""

    id: str
    position: Array
    disc_radius: float
    intensity: Array | None
    axis: Array
    falloff: float


@dataclass(frozen=True)
class WhiteRecord:
    """A Lambertian square, and the cameras that photographed it."""

    frames: str
    reflectance: float
    point: Array
    normal: Array
    half_size: float
    cameras: tuple[str, ...]


@dataclass(frozen=True)
class SequenceRecord:
    """Steps in the order in which they were executed."""

    light: tuple[str, ...]  # id of the light of each step
    exposure: tuple[str, ...]
    on: Array  # (step,) s since the first light went on
    off: Array  # (step,) s
    triggers: NDArray[np.int64]  # (step,) number of trigger pulses


@dataclass(frozen=True)
class DomeRecord:
    """The dome of a capture."""

    folder: Path
    cameras: tuple[CameraRecord, ...]
    lights: tuple[LightRecord, ...]
    exposures: Mapping[str, float]  # id -> seconds
    frames: str
    dark: str | None
    white: WhiteRecord | None
    file: Path = Path("dome.json")
    sequence: SequenceRecord | None = None

    @property
    def frame_count(self) -> int:
        """Number of frames of the face."""
        return len(self.cameras) * len(self.lights) * len(self.exposures)

    def frame(
        self, light: str, camera: str, exposure: str, *, white: bool = False
    ) -> Path:
        """File of a frame."""
        template = self.white.frames if white and self.white else self.frames
        return self.folder / filled(
            template, exposure=exposure, light=light, camera=camera
        )


def pixel_width(camera: CameraRecord, point: Array) -> float:
    """Width [mm] of a pixel at the distance of a point."""
    distance = float(np.linalg.norm(camera_centre(camera.R, camera.t) - point))
    return distance / float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))


def read_dome(
    folder: Path,
    fields: Fields,
    version: int = 2,
    *,
    calibrated: bool = False,
    face: bool = True,
) -> DomeRecord:
    """The dome of `dome.json`; its faults, and those of the headers of its frames, are
    recorded in `fields`.

    If it is `calibrated`, a calibration provides the intensities; without `face` it is
    a set-up without face frames.
    """
    exposures = read_exposures(fields)
    several = {EXPOSURE} if len(exposures) > 1 else set()
    frames = (
        fields.template("frames", {LIGHT, CAMERA} | several, {EXPOSURE}) if face else ""
    )
    target = fields.get("white", None)
    linear = is_linear(
        frames or (str(target.get("frames", "")) if isinstance(target, dict) else "")
    )
    if linear:
        require_merged(fields, exposures)
    cameras = tuple(
        _camera(folder, item, linear=linear)
        for item in fields.items("cameras", most=MAX_CAMERAS)
    )
    lights = tuple(_light(item) for item in fields.items("lights", most=MAX_LIGHTS))
    dark = fields.template("dark", {CAMERA} | several, {EXPOSURE}, default=None) or None
    white = _white(fields, {c.id for c in cameras}, several)
    if (
        white is None
        and not calibrated
        and (unknown := [light.id for light in lights if light.intensity is None])
    ):
        found = f"{len(unknown)} lights without intensity, first {unknown[0]}"
        fields.fault(
            "white",
            "lights need an intensity or a white target",
            found,
            "measure one of them",
        )
    # version 1 keeps the sequence as an unchecked attribute
    order = (
        read_sequence(fields, [light.id for light in lights], exposures)
        if version > 1
        else None
    )
    dome = DomeRecord(
        folder,
        cameras,
        lights,
        exposures,
        frames,
        None if linear else dark,
        white,
        Path(fields.where),
        order,
    )
    _check_frames(dome, fields)
    return dome


def _camera(folder: Path, item: Fields, *, linear: bool) -> CameraRecord:
    noted = len(item.faults)
    K = item.array("K", (3, 3), fallback=np.eye(3))
    R = item.array("R", (3, 3), fallback=np.eye(3))
    error = float(np.abs(R @ R.T - np.eye(3)).max())
    if error > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        found = (
            f"R R^T differs from 1 by {error:.2g}, determinant {np.linalg.det(R):.3g}"
        )
        item.fault("R", "must be a rotation", found, "calibrate the camera again")
    if K[0, 0] <= 0 or K[1, 1] <= 0 or K[1, 0] != 0 or (K[2] != (0, 0, 1)).any():
        item.fault(
            "K", "must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels", shown(K)
        )
    colours = item.array("colour_matrix", (3, 3), default=np.eye(3).tolist())
    if not (colours.sum(axis=1) > 0).all():
        item.fault(
            "colour_matrix",
            "must give white a positive R, G and B: each row sums to more than 0",
            shown(colours),
        )
    width, height = _size(item)
    vignette = item.array("vignette", (3,), default=[0.0] * 3)
    lens = item.array("distortion", (5,), default=[0.0] * 5, fallback=0.0)
    if len(item.faults) == noted and (
        fault := distortion_fault(item.where, lens, K, np.array([width, height]))
    ):
        item.faults.append(fault)
    if not linear and len(item.faults) == noted:
        _require_light(item, vignette, K[:2, 2], np.array([width, height]))
    return CameraRecord(
        id=item.text("id", rule=IDENTIFIER),
        width=width,
        height=height,
        K=K,
        R=R,
        t=item.array("t", (3,)),
        distortion=lens,
        sensor=read_sensor(folder, item, FrameKind(width, height, 0), linear=linear),
        colour_matrix=colours,
        vignette=vignette,
    )


def _size(item: Fields) -> tuple[int, int]:
    """Width and height of the pictures, within the limit that the memory is planned for."""
    width = item.integer("width", least=1)
    height = item.integer("height", least=1)
    if width * height <= MAX_FRAME_PIXELS:
        return width, height
    rule = f"a picture must have at most {MAX_FRAME_PIXELS:,} pixels"
    cure = "correct width and height"
    item.fault("width", rule, f"{width} x {height}", cure)
    return 1, 1


def _require_light(item: Fields, vignette: Array, centre: Array, size: Array) -> None:
    """Require a vignette within limits: a polynomial fitted to the centre alone may be
    negative at the corners.
    """
    near = np.clip(centre, 0, size) - centre
    far = np.maximum(np.abs(centre), np.abs(size - centre))
    r2 = np.linspace(near @ near, far @ far, VIGNETTE_STEPS) / (size @ size / 4)
    gain = 1 + r2 * (vignette[0] + r2 * (vignette[1] + r2 * vignette[2]))
    if not ((gain > MIN_VIGNETTE_GAIN) & (gain <= MAX_VIGNETTE_GAIN)).all():
        rule = (
            f"1 + a2 r^2 + a4 r^4 + a6 r^6 must be above {MIN_VIGNETTE_GAIN:g} and "
            f"at most {MAX_VIGNETTE_GAIN:g} "
            "in the whole picture"
        )
        worst = gain.argmax() if gain.max() > MAX_VIGNETTE_GAIN else gain.argmin()
        found = f"{gain[worst]:.3g} at r = {np.sqrt(r2[worst]):.3g}"
        item.fault(
            "vignette",
            rule,
            found,
            "r is 1 at half the image diagonal; measure the lens up to the corners",
        )


def _light(item: Fields) -> LightRecord:
    intensity = (
        None if item.get("intensity", None) is None else item.array("intensity", (3,))
    )
    if intensity is not None and (intensity <= 0).any():
        item.fault("intensity", "must be positive", shown(intensity))
    position = item.array("position", (3,))
    axis = item.array("axis", (3,), default=(-position).tolist())
    length = float(np.linalg.norm(axis))
    if length == 0:
        item.fault("axis", "must have a direction", shown(axis))
    return LightRecord(
        id=item.text("id", rule=IDENTIFIER),
        position=position,
        disc_radius=item.number(
            "disc_radius", least=0.0, most=MAX_DISC_RADIUS_MM, default=0.0
        ),
        intensity=intensity,
        axis=axis / (length or 1.0),
        falloff=item.number("falloff", least=0.0, most=MAX_FALLOFF, default=0.0),
    )


def _white(fields: Fields, cameras: set[str], several: set[str]) -> WhiteRecord | None:
    given = fields.get("white", None)
    if given is None:
        return None
    white = Fields(given, f"{fields.where}[white]", fields.faults)
    normal = white.array("normal", (3,))
    reflectance = white.number("reflectance", above=0.0)
    length = float(np.linalg.norm(normal))
    if length == 0:
        white.fault("normal", "must have a direction", shown(normal))
    if reflectance > 1:
        white.fault(
            "reflectance",
            "must be a fraction of the light, at most 1",
            shown(reflectance),
            "give a fraction instead of a percentage: 0.99 for 99 %",
        )
    record = WhiteRecord(
        frames=white.template("frames", {LIGHT, CAMERA} | several, {EXPOSURE}),
        reflectance=reflectance,
        point=white.array("point", (3,)),
        normal=normal / (length or 1.0),
        half_size=white.number(
            "half_size", least=TARGET_HALF_SIZES_MM[0], most=TARGET_HALF_SIZES_MM[1]
        ),
        cameras=white.names("cameras", most=MAX_CAMERAS),
    )
    if unknown := set(record.cameras) - cameras:
        white.fault(
            "cameras", "must be cameras of the dome", ", ".join(sorted(unknown))
        )
    return record


def _check_frames(dome: DomeRecord, fields: Fields) -> None:
    """Check the headers of all frames that the folder must hold."""
    if dome.frame_count > MAX_FRAMES:
        found = f"{dome.frame_count:,}: cameras x lights x exposures"
        cure = "remove those that were not used"
        fields.fault(
            "frames", f"a capture must have at most {MAX_FRAMES:,} frames", found, cure
        )
        return
    known = dict[Path, bool]()
    # for one light and camera, frames of the face and of the white target differ only
    # in their template
    views = (
        (key, filled(t, **names), {"template": key, **names})
        for key, t, names, _ in _views(dome)
    )
    require_own_files(fields, views)
    for key, name, camera in promised_frames(dome):
        where = f"{fields.where}[{key}]"
        path = inside(dome.folder, name, where, fields.faults, known)
        if path is not None:
            fields.faults += header_faults(path, camera.sensor.kind, where)


def _views(dome: DomeRecord) -> Iterator[tuple[str, str, dict[str, str], CameraRecord]]:
    """Key, template and names of every frame the folder must hold, and its camera."""

    def names(
        key: str, template: str, lights: Sequence[str], cameras: Sequence[CameraRecord]
    ) -> Any:
        for exposure, light, camera in product(dome.exposures, lights, cameras):
            yield (
                key,
                template,
                {EXPOSURE: exposure, LIGHT: light, CAMERA: camera.id},
                camera,
            )

    lights = [light.id for light in dome.lights]
    if dome.frames:
        yield from names("frames", dome.frames, lights, dome.cameras)
    if dome.dark:
        yield from names("dark", dome.dark, [""], dome.cameras)
    if dome.white is not None and dome.white.frames:
        with_white = [
            camera for camera in dome.cameras if camera.id in dome.white.cameras
        ]
        yield from names("white", dome.white.frames, lights, with_white)


def promised_frames(dome: DomeRecord) -> Iterator[tuple[str, str, CameraRecord]]:
    """Key, path in the folder and camera of every frame the folder must hold."""
    for key, template, names, camera in _views(dome):
        yield key, filled(template, **names), camera


def read_sequence(
    fields: Fields, lights: Collection[str], exposures: Collection[str]
) -> SequenceRecord | None:
    """The sequence of dome.json, or None if it has none; faults are recorded in `fields`."""
    if fields.get("sequence", None) is None:
        return None
    noted = len(fields.faults)
    steps = fields.items("sequence", most=MAX_SEQUENCE_STEPS)
    light = tuple(step.text("light") for step in steps)
    exposure = tuple(step.text("exposure") for step in steps)
    on = np.array([_seconds(step, "t_on") for step in steps])
    off = np.array([_seconds(step, "t_off") for step in steps])
    triggers = np.array(
        [step.integer("trigger_count", least=0, default=1) for step in steps], np.int64
    )
    if len(fields.faults) > noted:
        return None
    for key, given, known in (
        ("light", light, lights),
        ("exposure", exposure, exposures),
    ):
        if unknown := sorted(set(given) - set(known)):
            fields.fault(
                "sequence",
                f"every {key} must be listed in dome.json",
                shown(unknown[0]),
                SEQUENCE_CURE,
            )
        if missing := sorted(set(known) - set(given)):
            fields.fault(
                "sequence",
                f"every {key} of dome.json must have a step",
                f"none of {missing[0]}",
                SEQUENCE_CURE,
            )
    if not (off > on).all():
        fields.fault(
            "sequence",
            "t_off must be after t_on",
            f"step {int((off <= on).argmax())}",
            SEQUENCE_CURE,
        )
    elif not (np.diff(on) >= 0).all():
        found = (
            f"step {int((np.diff(on) < 0).argmax()) + 1} is earlier than the one before"
        )
        fields.fault(
            "sequence",
            "steps must be in the order in which they were executed",
            found,
            SEQUENCE_CURE,
        )
    elif off.max() - on[0] > MAX_SECONDS:
        fields.fault(
            "sequence",
            f"a session must last at most {MAX_SECONDS:g} s",
            f"{off.max() - on[0]:.3g} s",
            SEQUENCE_CURE,
        )
    return SequenceRecord(light, exposure, on - on[0], off - on[0], triggers)


def _seconds(step: Fields, key: str) -> float:
    """A time in seconds, or an ISO 8601 time with its zone as seconds since 1970."""
    if isinstance(text := step.get(key), str):
        try:
            time = datetime.fromisoformat(text)
        except ValueError:
            time = datetime.min
        if time.tzinfo is None:
            step.fault(
                key,
                "must be a number of seconds, or an ISO 8601 time with its zone",
                shown(text),
                SEQUENCE_CURE,
            )
            return 0.0
        return time.timestamp()
    return step.number(key, least=-1e10, most=1e10)


def distortion_fault(where: str, lens: Array, K: Array, size: Array) -> Fault | None:
    """Fault of a distortion k1 k2 p1 p2 k3 that is too large at the corners of the picture."""
    corners = (np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size - K[:2, 2]) / [
        K[0, 0],
        K[1, 1],
    ]
    k1, k2, p1, p2, k3 = lens
    r2 = float((corners**2).sum(axis=1).max())
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    tangential = 3 * np.hypot(p1, p2) * np.sqrt(r2)
    if (
        RADIAL_FACTORS[0] <= radial <= RADIAL_FACTORS[1]
        and tangential <= MAX_TANGENTIAL
    ):
        return None
    rule = (
        f"1 + k1 r^2 + k2 r^4 + k3 r^6 must be {RADIAL_FACTORS[0]:g} to "
        f"{RADIAL_FACTORS[1]:g}, and 3 |p| r at most "
        f"{MAX_TANGENTIAL:g}, at the corners of the picture"
    )
    found = f"{radial:.3g} and {tangential:.3g} at r = {np.sqrt(r2):.3g}"
    return Fault(
        f"{where}[distortion]",
        rule,
        found,
        "the order is k1, k2, p1, p2, k3, of distances over the focal length",
    )
