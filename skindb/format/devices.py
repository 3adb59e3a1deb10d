"""Reading `dome.json` and `probe.json`: cameras, lights, fibres, and the paths of their frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.format.device_checks import (
    EXPOSURE_SECONDS,
    MAX_DISC_RADIUS_MM,
    MAX_FALLOFF,
    MAX_FIBRE_RADIUS_MM,
    MAX_GAIN_ERROR,
    MAX_VIGNETTE_GAIN,
    MIN_VIGNETTE_GAIN,
    TARGET_HALF_SIZES_MM,
    distortion_fault,
    fibre_faults,
    gain_faults,
)
from skindb.format.fields import IDENTIFIER, Fields, inside
from skindb.format.frames import FrameKind, frame_size, header_faults, is_linear
from skindb.format.json_file import shown
from skindb.format.pressure import read_pressure
from skindb.format.sensor import SensorRecord, read_sensor
from skindb.format.sequence import SequenceRecord, read_sequence
from skindb.geometry.camera import camera_centre
from skindb.limits import (
    MAX_CAMERAS,
    MAX_EXPOSURES,
    MAX_FIBRES,
    MAX_FRAME_PIXELS,
    MAX_FRAMES,
    MAX_LIGHTS,
    MAX_PLACEMENTS,
    MAX_SITES,
)

Array = NDArray[np.float64]
ROTATION_TOLERANCE = 1e-4  # of R R^T - 1: five digits in the file
# radii from the centre to a corner at which the gain of a lens is checked
VIGNETTE_STEPS = 1000
GAIN_ERROR = 0.005  # relative error of a fibre's gain, where the file does not state it
EXPOSURE = "exposure"
LIGHT = "light"
CAMERA = "camera"
SITE = "site"
PLACEMENT = "placement"


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


@dataclass(frozen=True)
class ProbeRecord:
    """The contact probe of a capture."""

    folder: Path
    sites: tuple[str, ...]
    # names of the placements at each site; ("",) for a single one
    placements: Mapping[str, tuple[str, ...]]
    distance: Array  # (fibre,) mm
    azimuth: Array  # (fibre,) degrees about the source fibre; NaN if unknown
    centre: Array  # (fibre, 2) px
    radius: Array  # (fibre,) px
    exposures: Mapping[str, float]
    frames: str
    gain: Array  # (fibre, 3)
    gain_error: float  # relative, of each
    face: float  # radius of a fibre in mm; 0 if unknown
    scale: float | None
    sensor: SensorRecord
    fibres: tuple[str, ...]
    pressure: Mapping[tuple[str, str], Array]  # (site, placement) -> (n, 2) s, kPa
    file: Path  # probe.json

    def frame(self, site: str, exposure: str, placement: str = "") -> Path:
        """File of a frame."""
        return self.folder / filled(
            self.frames, site=site, exposure=exposure, placement=placement
        )

    def frame_files(self) -> Iterator[Path]:
        """Files of all frames."""
        for site in self.sites:
            for placement, exposure in product(self.placements[site], self.exposures):
                yield self.frame(site, exposure, placement)


def pixel_width(camera: CameraRecord, point: Array) -> float:
    """Width [mm] of a pixel at the distance of a point."""
    distance = float(np.linalg.norm(camera_centre(camera.R, camera.t) - point))
    return distance / float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))


def filled(template: str, **names: str) -> str:
    """The template with its placeholders replaced."""
    for name, value in names.items():
        template = template.replace(f"{{{name}}}", value)
    return template


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
    exposures = _exposures(fields)
    several = {EXPOSURE} if len(exposures) > 1 else set()
    frames = (
        fields.template("frames", {LIGHT, CAMERA} | several, {EXPOSURE}) if face else ""
    )
    target = fields.get("white", None)
    linear = is_linear(
        frames or (str(target.get("frames", "")) if isinstance(target, dict) else "")
    )
    if linear:
        _require_merged(fields, exposures)
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


def read_probe(folder: Path, fields: Fields) -> ProbeRecord:
    """The probe of `probe.json`; faults are recorded in `fields`."""
    noted = len(fields.faults)
    fibres = fields.items("fibres", most=MAX_FIBRES)
    exposures = _exposures(fields)
    several = {EXPOSURE} if len(exposures) > 1 else set()
    sites = fields.names("sites", most=MAX_SITES)
    placements = _placements(fields, sites)
    several |= (
        {PLACEMENT} if any(len(own) > 1 for own in placements.values()) else set()
    )
    frames = fields.template("frames", {SITE} | several, {EXPOSURE, PLACEMENT})
    if is_linear(frames):
        _require_merged(fields, exposures)
    scale = fields.get("scale", None)
    probe = ProbeRecord(
        folder=folder,
        sites=sites,
        placements=placements,
        azimuth=np.array([_azimuth(fibre) for fibre in fibres]),
        distance=np.array([fibre.number("distance", above=0.0) for fibre in fibres]),
        centre=np.array([fibre.array("centre", (2,)) for fibre in fibres]).reshape(
            -1, 2
        ),
        radius=np.array([fibre.number("radius", above=0.0) for fibre in fibres]),
        exposures=exposures,
        frames=frames,
        gain=fields.gains("gain", len(fibres)),
        gain_error=fields.number(
            "gain_error", default=GAIN_ERROR, least=0.0, most=MAX_GAIN_ERROR
        ),
        face=fields.number(
            "fibre_radius", default=0.0, least=0.0, most=MAX_FIBRE_RADIUS_MM
        ),
        scale=None if scale is None else fields.number("scale", above=0.0),
        sensor=read_sensor(
            folder, fields, FrameKind(0, 0, 0), linear=is_linear(frames)
        ),
        fibres=tuple(fibre.text("id", rule=IDENTIFIER) for fibre in fibres),
        pressure=read_pressure(fields, placements),
        file=Path(fields.where),
    )
    if len(fields.faults) == noted:
        fields.faults += fibre_faults(
            fields.where, probe.distance, probe.centre, probe.radius, probe.face
        )
        fields.faults += gain_faults(fields.where, probe.gain)
    _check_probe_frames(probe, fields)
    return probe


def _placements(fields: Fields, sites: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Names of the placements of the probe at each site; a site without names has a
    single placement.
    """
    given = Fields(
        fields.get("placements", {}), f"{fields.where}[placements]", fields.faults
    )
    if unknown := sorted(set(given.data) - set(sites)):
        given.fault(unknown[0], "must be one of the sites", shown(unknown[0]))
    return {
        site: given.names(site, most=MAX_PLACEMENTS) if site in given.data else ("",)
        for site in sites
    }


def _azimuth(fibre: Fields) -> float:
    given = fibre.get("azimuth", None)
    return (
        np.nan if given is None else fibre.number("azimuth", least=-360.0, most=360.0)
    )


def _exposures(fields: Fields) -> dict[str, float]:
    items = fields.items("exposures", most=MAX_EXPOSURES)
    least, most = EXPOSURE_SECONDS
    return {
        item.text("id", rule=IDENTIFIER): item.number("seconds", least=least, most=most)
        for item in items
    }


def _require_merged(fields: Fields, exposures: Mapping[str, float]) -> None:
    """Require one exposure of one second: merged radiance is per second, and another
    time would scale it again.
    """
    if exposures and [*exposures.values()] != [1.0]:
        found = ", ".join(f"{seconds:g} s" for seconds in exposures.values())
        rule = "OpenEXR frames are merged radiance: one exposure of 1 second"
        fields.fault(
            "exposures",
            rule,
            found,
            "merge them, divide by their seconds, and give one exposure of 1 second",
        )


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
    _require_own_files(fields, views)
    for key, name, camera in promised_frames(dome):
        where = f"{fields.where}[{key}]"
        path = inside(dome.folder, name, where, fields.faults, known)
        if path is not None:
            fields.faults += header_faults(path, camera.sensor.kind, where)


def _require_own_files(
    fields: Fields, views: Iterable[tuple[str, str, dict[str, str]]]
) -> None:
    """Require a separate file for every view: ids such as a_b and a with c and b_c can
    form the same path.
    """
    first = dict[Path, dict[str, str]]()
    shared = list[tuple[str, str]]()
    for key, name, names in views:
        if (other := first.setdefault(Path(name), names)) != names:
            one, two = (
                ", ".join(f"{k} {v}" for k, v in view.items() if other[k] != names[k])
                for view in (other, names)
            )
            shared.append((key, f"{Path(name).name} of {one} and of {two}"))
    if shared:
        key, found = shared[0]
        cure = "rename the ids, or separate them by folders in the template"
        fields.fault(
            key,
            "every view must have its own file",
            f"{len(shared)} shared, {found}",
            cure,
        )


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


def _check_probe_frames(probe: ProbeRecord, fields: Fields) -> None:
    """Require that all frames have the size of the first one, and the declared depth."""
    size: FrameKind | None = None
    views = [
        {SITE: site, EXPOSURE: exposure, PLACEMENT: placement}
        for site in (probe.sites if probe.frames else ())
        for placement, exposure in product(probe.placements[site], probe.exposures)
    ]
    _require_own_files(
        fields, (("frames", filled(probe.frames, **names), names) for names in views)
    )
    for names in views:
        where = f"{fields.where}[frames]"
        path = inside(probe.folder, filled(probe.frames, **names), where, fields.faults)
        if path is None:
            continue
        size = size or _kind_of(path, probe.sensor.kind.bits)
        fields.faults += header_faults(path, size or probe.sensor.kind, where)


def _kind_of(path: Path, bits: int) -> FrameKind | None:
    size = frame_size(path)
    return None if size is None else FrameKind(*size, bits)
