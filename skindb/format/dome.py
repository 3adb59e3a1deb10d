"""The dome of a capture, `dome.json`: cameras, lights, white target, sequence, and the
paths of its frames.
"""

import glob
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from skindb.format.fields import IDENTIFIER, REQUIRED, Fields, shown, zoned_time
from skindb.format.frames import (
    CAMERA,
    EXPOSURE,
    LIGHT,
    FrameKind,
    filled,
    header_faults,
    inside,
    is_linear,
    read_exposures,
    require_merged,
    require_own_files,
)
from skindb.format.sensor import SensorRecord, read_sensor
from skindb.geometry.camera import Pinhole
from skindb.limits import (
    MAX_CAMERAS,
    MAX_FRAME_PIXELS,
    MAX_FRAMES,
    MAX_LIGHTS,
    MAX_SEQUENCE_STEPS,
)
from skindb.types import Float64, Index

ROTATION_TOLERANCE = 1e-4  # of R R^T - 1: five digits in the file
MAX_DISC_RADIUS_MM = 2_000.0  # mm: the largest soft boxes have a radius of 1 m
# mm; a light of which the direction alone is known is placed there: 0.1 degrees over a face
DISTANT_MM = 9e4
# exponent of the cosine: a narrow spot, half as bright at 1.5 degrees from the axis
MAX_FALLOFF = 2_000.0
TARGET_HALF_SIZES_MM = (1.0, 2_000.0)  # mm: from a patch of a colour chart to a wall
MIN_VIGNETTE_GAIN = 0.05  # at a corner: a lens that darkens by 4 stops has 0.06
# relative to the principal point; lenses darken towards the corners
MAX_VIGNETTE_GAIN = 4.0
# distortion at the farthest corner; fisheyes have 0.5 and 0.01
RADIAL_FACTORS = (0.1, 10.0)
MAX_TANGENTIAL = 0.5
HANDS = {"left": -1.0, "right": 1.0}  # of circular polarisers
# light of the other handedness over all that passes; films for photography have 0.001 to
# 0.05, and one half does not polarise
MAX_LEAK = 0.25
MAX_SECONDS = 1e6  # of a session; more indicates inconsistent clocks
SEQUENCE_CURE = "write what the controller acknowledged, or remove the sequence"
# radii from the centre to a corner at which the gain of a lens is checked
VIGNETTE_STEPS = 1000

# of exposures that are taken as equal: EXIF rounds them
EXPOSURE_RATIO = 1.02


@dataclass(frozen=True)
class CameraRecord(Pinhole):
    """One camera of a dome."""

    id: str
    width: int
    height: int
    sensor: SensorRecord
    colour_matrix: Float64
    vignette: Float64  # a2 a4 a6
    # degree of circular polarisation of the light that it sees: 1 right, -1 left, 0 any
    polarisation: float = 0.0
    # by a calibration from takes; the radiance of the channels is divided by it
    gain: tuple[float, ...] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class LightRecord:
    """One light; if its intensity is None, the white target determines it. A calibration
    from takes of the rig multiplies either by `gain` and adds `offset` to the position.
    """

    id: str
    position: Float64
    disc_radius: float
    intensity: Float64 | None
    axis: Float64
    falloff: float
    polarisation: float = 0.0  # as of a camera, of the light that it sends
    gain: float = 1.0
    offset: tuple[float, ...] = (0.0, 0.0, 0.0)  # mm


@dataclass(frozen=True)
class WhiteRecord:
    """A Lambertian square, and the cameras that photographed it."""

    frames: str
    reflectance: float
    point: Float64
    normal: Float64
    half_size: float
    cameras: tuple[str, ...]


@dataclass(frozen=True)
class SequenceRecord:
    """Steps in the order in which they were executed."""

    light: tuple[str, ...]  # id of the light of each step
    exposure: tuple[str, ...]
    on: Float64  # (step,) s since the first light went on
    off: Float64  # (step,) s
    triggers: Index  # (step,) number of trigger pulses


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
    # intensities are known up to a common factor for each channel
    relative: bool = False
    # takes of one rig without intensities are comparable if it is equal; 0 unknown
    relative_exposure: float = 0.0
    # strengths by region, by a calibration from takes of the rig
    lobes: Mapping[str, tuple[float, ...]] | None = None

    @property
    def light_ids(self) -> list[str]:
        """Names of the lights."""
        return [light.id for light in self.lights]

    @property
    def camera_ids(self) -> list[str]:
        """Names of the cameras."""
        return [camera.id for camera in self.cameras]

    @property
    def frame_count(self) -> int:
        """Number of frames of the face."""
        return len(self.cameras) * len(self.lights) * len(self.exposures)

    def frame(
        self, light: str, camera: str, exposure: str, *, white: bool = False
    ) -> Path:
        """File of a frame."""
        template = self.white.frames if white and self.white else self.frames
        names = {EXPOSURE: exposure, LIGHT: light, CAMERA: camera}
        return self.folder / filled(template, **names)

    def frame_files(self, *keys: str) -> list[Path]:
        """Files of all frames under these keys of dome.json: frames, dark, white."""
        return [
            self.folder / name for key, name, _ in promised_frames(self) if key in keys
        ]


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
    frames = ""
    if face:
        frames = fields.template("frames", {LIGHT, CAMERA} | several, {EXPOSURE})
    target = fields.get("white", None)
    of_target = target.get("frames", "") if isinstance(target, dict) else ""
    linear = is_linear(frames or str(of_target))
    if linear:
        require_merged(fields, exposures)
    cameras = tuple(
        _camera(folder, item, linear=linear)
        for item in fields.items("cameras", maximum=MAX_CAMERAS)
    )
    lights = tuple(_light(item) for item in fields.items("lights", maximum=MAX_LIGHTS))
    dark = fields.template("dark", {CAMERA} | several, {EXPOSURE}, default=None)
    white = None
    unknown = [light.id for light in lights if light.intensity is None]
    relative = fields.get("relative", False)
    if not isinstance(relative, bool):
        fields.fault("relative", "must be true or false", shown(relative))
    if target is not None:
        white = _white(fields.object("white"), {c.id for c in cameras}, several)
    elif unknown:
        if not calibrated and len(unknown) < len(lights):
            fields.fault(
                "white",
                "all lights need an intensity, or a white target, or none has one",
                f"{len(unknown)} lights without intensity, first {unknown[0]}",
                "measure one of them",
            )
        # unless a calibration has intensities
        relative = True
    # version 1 keeps the sequence as an unchecked attribute
    sequence = None
    if version > 1 and fields.has("sequence"):
        sequence = _sequence(fields, [light.id for light in lights], exposures)
    dome = DomeRecord(
        folder,
        cameras,
        lights,
        exposures,
        frames,
        None if linear else dark or None,
        white,
        Path(fields.where),
        sequence,
        relative and white is None,
        fields.number("relative_exposure", default=0.0, minimum=0),
    )
    _check_frames(dome, fields)
    return dome


def _camera(folder: Path, item: Fields, *, linear: bool) -> CameraRecord:
    earlier = len(item.faults)
    K, R = _matrices(item)
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
    size = np.array([width, height])
    if len(item.faults) == earlier:
        _require_distortion(item, lens, K, size)
    if not linear and len(item.faults) == earlier:
        _require_light(item, vignette, K[:2, 2], size)
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
        polarisation=_polarisation(item),
    )


def _matrices(item: Fields) -> tuple[Float64, Float64]:
    """K and R of a camera."""
    K = item.array("K", (3, 3), fallback=np.eye(3))
    R = item.array("R", (3, 3), fallback=np.eye(3))
    error = np.abs(R @ R.T - np.eye(3)).max()
    determinant = np.linalg.det(R)
    if error > ROTATION_TOLERANCE or determinant < 0:
        item.fault(
            "R",
            "must be a rotation",
            f"R R^T differs from 1 by {error:.2g}, determinant {determinant:.3g}",
            "calibrate the camera again",
        )
    if K[0, 0] <= 0 or K[1, 1] <= 0 or K[1, 0] != 0 or (K[2] != (0, 0, 1)).any():
        item.fault(
            "K", "must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels", shown(K)
        )
    return K, R


def _size(item: Fields) -> tuple[int, int]:
    """Width and height of the pictures, within the limit that the memory is planned for."""
    width = item.integer("width", minimum=1)
    height = item.integer("height", minimum=1)
    if width * height <= MAX_FRAME_PIXELS:
        return width, height
    item.fault(
        "width",
        f"a picture must have at most {MAX_FRAME_PIXELS:,} pixels",
        f"{width} x {height}",
        "correct width and height",
    )
    return 1, 1


def _require_light(
    item: Fields, vignette: Float64, centre: Float64, size: Float64
) -> None:
    """Require a vignette within limits: a polynomial fitted to the centre alone may be
    negative at the corners.
    """
    near = np.clip(centre, 0, size) - centre
    far = np.maximum(np.abs(centre), np.abs(size - centre))
    r2 = np.linspace(near @ near, far @ far, VIGNETTE_STEPS) / (size @ size / 4)
    gain = 1 + r2 * (vignette[0] + r2 * (vignette[1] + r2 * vignette[2]))
    if ((gain > MIN_VIGNETTE_GAIN) & (gain <= MAX_VIGNETTE_GAIN)).all():
        return
    worst = gain.argmax() if gain.max() > MAX_VIGNETTE_GAIN else gain.argmin()
    item.fault(
        "vignette",
        f"1 + a2 r^2 + a4 r^4 + a6 r^6 must be above {MIN_VIGNETTE_GAIN:g} and "
        f"at most {MAX_VIGNETTE_GAIN:g} in the whole picture",
        f"{gain[worst]:.3g} at r = {np.sqrt(r2[worst]):.3g}",
        "r is 1 at half the image diagonal; measure the lens up to the corners",
    )


def _light(item: Fields) -> LightRecord:
    intensity = item.array("intensity", (3,)) if item.has("intensity") else None
    if intensity is not None and (intensity <= 0).any():
        item.fault("intensity", "must be positive", shown(intensity))
    if item.has("direction"):
        if item.has("position"):
            item.fault(
                "direction",
                "a light has a position or a direction",
                "both",
                "remove the direction",
            )
        position = DISTANT_MM * _direction(item, "direction")
        # given as irradiance of a surface that faces the light
        intensity = None if intensity is None else DISTANT_MM**2 * intensity
    else:
        position = item.array("position", (3,))
    return LightRecord(
        id=item.text("id", rule=IDENTIFIER),
        position=position,
        disc_radius=item.number(
            "disc_radius", minimum=0.0, maximum=MAX_DISC_RADIUS_MM, default=0.0
        ),
        intensity=intensity,
        axis=_direction(item, "axis", default=(-position).tolist()),
        falloff=item.number("falloff", minimum=0.0, maximum=MAX_FALLOFF, default=0.0),
        polarisation=_polarisation(item),
    )


def _polarisation(item: Fields) -> float:
    """Degree of circular polarisation by the polariser of a light or camera."""
    hand = item.get("polariser", None)
    if hand is None:
        return 0.0
    if not isinstance(hand, str) or hand not in HANDS:
        item.fault(
            "polariser",
            "must be left or right, of circular polarisers, or null",
            shown(hand),
            "remove linear polarisers: they cross towards one camera only",
        )
        return 0.0
    leak = item.number("leak", minimum=0.0, maximum=MAX_LEAK, default=0.0)
    return HANDS[hand] * (1.0 - 2.0 * leak)


def _direction(item: Fields, key: str, default: Any = REQUIRED) -> Float64:
    """A unit vector (3,)."""
    vector = item.array(key, (3,), default=default)
    length = np.linalg.norm(vector)
    if length == 0:
        item.fault(key, "must have a direction", shown(vector))
    return vector / (length or 1.0)


def _white(white: Fields, cameras: set[str], several: set[str]) -> WhiteRecord:
    normal = _direction(white, "normal")
    reflectance = white.number("reflectance", above=0.0)
    if reflectance > 1:
        white.fault(
            "reflectance",
            "must be a fraction of the light, at most 1",
            shown(reflectance),
            "give a fraction instead of a percentage: 0.99 for 99 %",
        )
    smallest, largest = TARGET_HALF_SIZES_MM
    record = WhiteRecord(
        frames=white.template("frames", {LIGHT, CAMERA} | several, {EXPOSURE}),
        reflectance=reflectance,
        point=white.array("point", (3,)),
        normal=normal,
        half_size=white.number("half_size", minimum=smallest, maximum=largest),
        cameras=white.names("cameras", maximum=MAX_CAMERAS),
    )
    if unknown := sorted(set(record.cameras) - cameras):
        white.fault("cameras", "must be cameras of the dome", ", ".join(unknown))
    return record


def _check_frames(dome: DomeRecord, fields: Fields) -> None:
    """Check the headers of all frames that the folder must hold."""
    if dome.frame_count > MAX_FRAMES:
        fields.fault(
            "frames",
            f"a capture must have at most {MAX_FRAMES:,} frames",
            f"{dome.frame_count:,}: cameras x lights x exposures",
            "remove those that were not used",
        )
        return
    parents = dict[Path, bool]()
    # for one light and camera, frames of the face and of the white target differ only
    # in their template
    views = (
        (key, filled(template, **names), {"template": key, **names})
        for key, template, names, _ in _views(dome)
    )
    require_own_files(fields, views)
    for key, name, camera in promised_frames(dome):
        place = f"{fields.where}[{key}]"
        path = inside(dome.folder, name, place, fields.faults, parents)
        if path is not None:
            fields.faults += header_faults(path, camera.sensor.kind, place)


def _views(dome: DomeRecord) -> Iterator[tuple[str, str, dict[str, str], CameraRecord]]:
    """Key, template and names of every frame the folder must hold, and its camera."""
    lights = dome.light_ids
    parts = [("frames", dome.frames, lights, dome.cameras)]
    if dome.dark:
        parts.append(("dark", dome.dark, [""], dome.cameras))
    if (white := dome.white) is not None:
        cameras = tuple(c for c in dome.cameras if c.id in white.cameras)
        parts.append(("white", white.frames, lights, cameras))
    for key, template, lit, photographed in parts:
        for exposure, light, camera in product(
            dome.exposures if template else (), lit, photographed
        ):
            names = {EXPOSURE: exposure, LIGHT: light, CAMERA: camera.id}
            yield key, template, names, camera


def promised_frames(dome: DomeRecord) -> Iterator[tuple[str, str, CameraRecord]]:
    """Key, path in the folder and camera of every frame the folder must hold."""
    for key, template, names, camera in _views(dome):
        yield key, filled(template, **names), camera


def unread_frames(dome: DomeRecord) -> list[str]:
    """Paths in the folder of files that are named like frames of the face, but by
    another light, camera or exposure than those of the dome.
    """
    anything = dict.fromkeys((EXPOSURE, LIGHT, CAMERA), "*")
    pattern = filled(glob.escape(dome.frames), **anything)
    files = map(Path, glob.glob(pattern, root_dir=dome.folder))  # noqa: PTH207
    promised = {Path(name) for _, name, _ in promised_frames(dome)}
    return sorted(map(str, {*files} - promised))


def _sequence(
    fields: Fields, lights: Collection[str], exposures: Collection[str]
) -> SequenceRecord | None:
    """The sequence of dome.json; None and faults in `fields` if it is inconsistent."""
    earlier = len(fields.faults)
    steps = fields.items("sequence", maximum=MAX_SEQUENCE_STEPS)
    light = tuple(step.text("light") for step in steps)
    exposure = tuple(step.text("exposure") for step in steps)
    on = np.array([_seconds(step, "t_on") for step in steps])
    off = np.array([_seconds(step, "t_off") for step in steps])
    triggers = np.array(
        [step.integer("trigger_count", minimum=0, default=1) for step in steps],
        np.int64,
    )
    if len(fields.faults) > earlier:
        return None

    def fault(rule: str, finding: str) -> None:
        fields.fault("sequence", rule, finding, SEQUENCE_CURE)

    for key, names, listed in (
        ("light", set(light), set(lights)),
        ("exposure", set(exposure), set(exposures)),
    ):
        if unknown := sorted(names - listed):
            fault(f"every {key} must be listed in dome.json", shown(unknown[0]))
        if missing := sorted(listed - names):
            fault(f"every {key} of dome.json must have a step", f"none of {missing[0]}")
    duration = off.max() - on[0]
    if not (off > on).all():
        fault("t_off must be after t_on", f"step {int((off <= on).argmax())}")
    elif not (np.diff(on) >= 0).all():
        step = int((np.diff(on) < 0).argmax()) + 1
        rule = "steps must be in the order in which they were executed"
        fault(rule, f"step {step} is earlier than the one before")
    elif duration > MAX_SECONDS:
        rule = f"a session must last at most {MAX_SECONDS:g} s"
        fault(rule, f"{duration:.3g} s")
    return SequenceRecord(light, exposure, on - on[0], off - on[0], triggers)


def _seconds(step: Fields, key: str) -> float:
    """A time in seconds, or an ISO 8601 time with its zone as seconds since 1970."""
    text = step.get(key)
    if not isinstance(text, str):
        return step.number(key, minimum=-1e10, maximum=1e10)
    time = zoned_time(text)
    if time is not None:
        return time.timestamp()
    step.fault(
        key,
        "must be a number of seconds, or an ISO 8601 time with its zone",
        shown(text),
        SEQUENCE_CURE,
    )
    return 0.0


def _require_distortion(item: Fields, lens: Float64, K: Float64, size: Float64) -> None:
    """Require a distortion k1 k2 p1 p2 k3 that is small enough at the corners of the
    picture.
    """
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size - K[:2, 2]
    corners /= [K[0, 0], K[1, 1]]
    k1, k2, p1, p2, k3 = lens
    r2 = float((corners**2).sum(axis=1).max())
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    tangential = 3 * np.hypot(p1, p2) * np.sqrt(r2)
    smallest, largest = RADIAL_FACTORS
    if smallest <= radial <= largest and tangential <= MAX_TANGENTIAL:
        return
    item.fault(
        "distortion",
        f"1 + k1 r^2 + k2 r^4 + k3 r^6 must be {smallest:g} to {largest:g}, and 3 |p| r at "
        f"most {MAX_TANGENTIAL:g}, at the corners of the picture",
        f"{radial:.3g} and {tangential:.3g} at r = {np.sqrt(r2):.3g}",
        "the order is k1, k2, p1, p2, k3, of distances over the focal length",
    )
