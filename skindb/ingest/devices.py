"""`dome.json` and `probe.json`: cameras, lights, fibres, and where their frames are."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.ingest.fields import IDENTIFIER, Fields, inside
from skindb.ingest.frames import FrameKind, frame_size, header_faults, is_linear

Array = NDArray[np.float64]
ROTATION_TOLERANCE = 1e-4  # of R R^T - 1: five digits in the file
GAIN_ERROR = 0.005  # of a flat field of fibres, where the file does not say
EXPOSURE, LIGHT, CAMERA, SITE = "exposure", "light", "camera", "site"


@dataclass(frozen=True)
class SensorRecord:
    """Levels and noise in values of the file; `kind.bits` 0 for linear OpenEXR, where they do not matter."""

    kind: FrameKind
    black: float
    white: float
    read_noise: float  # electrons
    electrons_per_dn: float  # infinity: shot noise unknown
    step: float = 1.0  # between neighbouring values that occur: 16 for a 12-bit converter in 16-bit files
    response: Array | None = None  # (n, 4) dn, r, g, b; None for linear
    response_file: Path | None = None

    @property
    def full_electrons(self) -> float:
        """Electrons that reach the white level."""
        return self.electrons_per_dn * (self.white - self.black)


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
    """One light; intensity None: from the white target."""

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

    def frame(self, light: str, camera: str, exposure: str, *, white: bool = False) -> Path:
        """File of a frame."""
        template = self.white.frames if white and self.white else self.frames
        return self.folder / filled(template, exposure=exposure, light=light, camera=camera)


@dataclass(frozen=True)
class ProbeRecord:
    """The contact probe of a capture."""

    folder: Path
    sites: tuple[str, ...]
    distance: Array  # (fibre,) mm
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
    pressure: Mapping[str, float]

    def frame(self, site: str, exposure: str) -> Path:
        """File of a frame."""
        return self.folder / filled(self.frames, site=site, exposure=exposure)


def filled(template: str, **names: str) -> str:
    """The template with its placeholders replaced."""
    for name, value in names.items():
        template = template.replace(f"{{{name}}}", value)
    return template


def read_dome(folder: Path, fields: Fields) -> DomeRecord:
    """The dome of `dome.json`; faults are noted in `fields`, also those of frames by their headers."""
    exposures = _exposures(fields)
    several = {EXPOSURE} if len(exposures) > 1 else set()
    frames = fields.template("frames", {LIGHT, CAMERA} | several, {EXPOSURE})
    linear = is_linear(frames)
    if linear:
        _require_merged(fields, exposures)
    cameras = tuple(_camera(folder, item, linear=linear) for item in fields.items("cameras"))
    lights = tuple(_light(item) for item in fields.items("lights"))
    dark = fields.template("dark", {CAMERA} | several, {EXPOSURE}, default=None) or None
    white = _white(fields, {c.id for c in cameras}, several)
    if white is None and (unknown := [light.id for light in lights if light.intensity is None]):
        found = f"{len(unknown)} lights without intensity, first {unknown[0]}"
        fields.fault("white", "lights need an intensity or a white target", found, "measure one of them")
    dome = DomeRecord(folder, cameras, lights, exposures, frames, None if linear else dark, white)
    _check_frames(dome, fields)
    return dome


def read_probe(folder: Path, fields: Fields) -> ProbeRecord:
    """The probe of `probe.json`; faults are noted in `fields`."""
    fibres = fields.items("fibres")
    exposures = _exposures(fields)
    several = {EXPOSURE} if len(exposures) > 1 else set()
    frames = fields.template("frames", {SITE} | several, {EXPOSURE})
    if is_linear(frames):
        _require_merged(fields, exposures)
    scale = fields.get("scale", None)
    sites = fields.names("sites")
    pressure = Fields(fields.get("pressure", {}), f"{fields.where}[pressure]", fields.faults)
    probe = ProbeRecord(
        folder=folder,
        sites=sites,
        distance=np.array([fibre.number("distance", above=0.0) for fibre in fibres]),
        centre=np.array([fibre.array("centre", (2,)) for fibre in fibres]).reshape(-1, 2),
        radius=np.array([fibre.number("radius", above=0.0) for fibre in fibres]),
        exposures=exposures,
        frames=frames,
        gain=fields.gains("gain", len(fibres)),
        gain_error=fields.number("gain_error", default=GAIN_ERROR, least=0.0),
        face=fields.number("fibre_radius", default=0.0, least=0.0),
        scale=None if scale is None else fields.number("scale", above=0.0),
        sensor=_sensor(folder, fields, FrameKind(0, 0, 0), linear=is_linear(frames)),
        fibres=tuple(fibre.text("id", pattern=IDENTIFIER) for fibre in fibres),
        pressure={site: pressure.number(site) for site in pressure.data},
    )
    _check_probe_frames(probe, fields)
    return probe


def _exposures(fields: Fields) -> dict[str, float]:
    items = fields.items("exposures")
    return {item.text("id", pattern=IDENTIFIER): item.number("seconds", above=0.0) for item in items}


def _require_merged(fields: Fields, exposures: Mapping[str, float]) -> None:
    """Radiance is per second, whatever took it: other times would be a second scale."""
    if exposures and [*exposures.values()] != [1.0]:
        found = ", ".join(f"{seconds:g} s" for seconds in exposures.values())
        rule = "OpenEXR frames are merged radiance: one exposure of 1 second"
        fields.fault("exposures", rule, found, "merge them, divide by their seconds, and name one exposure of 1")


def _camera(folder: Path, item: Fields, *, linear: bool) -> CameraRecord:
    K, R = item.array("K", (3, 3), fallback=np.eye(3)), item.array("R", (3, 3), fallback=np.eye(3))
    error = float(np.abs(R @ R.T - np.eye(3)).max())
    if error > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        found = f"R R^T differs from 1 by {error:.2g}, determinant {np.linalg.det(R):.3g}"
        item.fault("R", "must be a rotation", found, "calibrate the camera again")
    if K[0, 0] <= 0 or K[1, 1] <= 0 or (K[2] != (0, 0, 1)).any():
        item.fault("K", "must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels", K.tolist())
    width, height = item.integer("width", least=1), item.integer("height", least=1)
    return CameraRecord(
        id=item.text("id", pattern=IDENTIFIER),
        width=width,
        height=height,
        K=K,
        R=R,
        t=item.array("t", (3,)),
        distortion=item.array("distortion", (5,), default=[0.0] * 5),
        sensor=_sensor(folder, item, FrameKind(width, height, 0), linear=linear),
        colour_matrix=item.array("colour_matrix", (3, 3), default=np.eye(3).tolist()),
        vignette=item.array("vignette", (3,), default=[0.0] * 3),
    )


def _sensor(folder: Path, item: Fields, size: FrameKind, *, linear: bool) -> SensorRecord:
    if linear:
        return SensorRecord(size, 0.0, np.inf, 0.0, np.inf)
    bits = item.integer("bit_depth", least=1, most=16, default=16)
    black = item.number("black_level", least=0.0, default=0.0)
    white = item.number("white_level", above=0.0, default=float(2**bits - 1))
    if white <= black:
        item.fault("white_level", f"must be above black_level {black:g}", white)
        white = black + 1
    missing = [key for key in ("read_noise_e", "electrons_per_dn") if item.get(key, None) is None]
    if len(missing) == 1:
        rule = "read_noise_e and electrons_per_dn come together: noise is counted in electrons, pixels in values"
        item.fault(missing[0], rule, "nothing", "add it, or leave both out")
    response = _response(folder, item)
    return SensorRecord(
        kind=FrameKind(size.width, size.height, bits),
        black=black,
        white=white,
        read_noise=item.number("read_noise_e", least=0.0, default=0.0),
        electrons_per_dn=item.number("electrons_per_dn", above=0.0, default=1e30),
        step=2.0 ** max(bits - item.integer("adc_bits", least=1, most=16, default=bits), 0),
        response=None if response is None else response[0],
        response_file=None if response is None else response[1],
    )


def _response(folder: Path, item: Fields) -> tuple[Array, Path] | None:
    name = item.text("response", default="linear")
    path = None if name in ("linear", "") else inside(folder, name, f"{item.where}[response]", item.faults)
    if path is None:
        return None
    try:
        table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    except (OSError, ValueError) as error:
        item.fault("response", "must be a CSV file dn,r,g,b of numbers", f"{name}: {error}")
        return None
    rising = table.ndim == 2 and table.shape[1] == 4 and len(table) > 1 and bool((np.diff(table, axis=0) > 0).all())
    if not rising or not np.isfinite(table).all():
        item.fault("response", "must be finite columns dn,r,g,b that all rise", f"{name} of shape {table.shape}")
        return None
    return np.asarray(table), path


def _light(item: Fields) -> LightRecord:
    intensity = None if item.get("intensity", None) is None else item.array("intensity", (3,))
    if intensity is not None and (intensity <= 0).any():
        item.fault("intensity", "must be positive", intensity.tolist())
    position = item.array("position", (3,))
    axis = item.array("axis", (3,), default=(-position).tolist())
    length = float(np.linalg.norm(axis))
    if length == 0:
        item.fault("axis", "must have a direction", axis.tolist())
    return LightRecord(
        id=item.text("id", pattern=IDENTIFIER),
        position=position,
        disc_radius=item.number("disc_radius", least=0.0, default=0.0),
        intensity=intensity,
        axis=axis / (length or 1.0),
        falloff=item.number("falloff", least=0.0, default=0.0),
    )


def _white(fields: Fields, cameras: set[str], several: set[str]) -> WhiteRecord | None:
    given = fields.get("white", None)
    if given is None:
        return None
    white = Fields(given, f"{fields.where}[white]", fields.faults)
    normal = white.array("normal", (3,))
    record = WhiteRecord(
        frames=white.template("frames", {LIGHT, CAMERA} | several, {EXPOSURE}),
        reflectance=white.number("reflectance", above=0.0),
        point=white.array("point", (3,)),
        normal=normal / (float(np.linalg.norm(normal)) or 1.0),
        half_size=white.number("half_size", above=0.0),
        cameras=white.names("cameras"),
    )
    if unknown := set(record.cameras) - cameras:
        white.fault("cameras", "must be cameras of the dome", ", ".join(sorted(unknown)))
    return record


def _check_frames(dome: DomeRecord, fields: Fields) -> None:
    """Headers of every frame the folder promises."""
    known = dict[Path, bool]()
    for key, name, camera in promised_frames(dome):
        where = f"{fields.where}[{key}]"
        path = inside(dome.folder, name, where, fields.faults, known)
        if path is not None:
            fields.faults += header_faults(path, camera.sensor.kind, where)


def promised_frames(dome: DomeRecord) -> Iterator[tuple[str, str, CameraRecord]]:
    """Key, path in the folder and camera of every frame the folder must hold."""

    def names(key: str, template: str, lights: Sequence[str], cameras: Sequence[CameraRecord]) -> Any:
        for exposure, light, camera in product(dome.exposures, lights, cameras):
            yield key, filled(template, exposure=exposure, light=light, camera=camera.id), camera

    lights = [light.id for light in dome.lights]
    if dome.frames:
        yield from names("frames", dome.frames, lights, dome.cameras)
    if dome.dark:
        yield from names("dark", dome.dark, [""], dome.cameras)
    if dome.white is not None and dome.white.frames:
        with_white = [camera for camera in dome.cameras if camera.id in dome.white.cameras]
        yield from names("white", dome.white.frames, lights, with_white)


def _check_probe_frames(probe: ProbeRecord, fields: Fields) -> None:
    """All frames must have the size of the first, and the depth promised."""
    size: FrameKind | None = None
    for site, exposure in product(probe.sites, probe.exposures if probe.frames else ()):
        where = f"{fields.where}[frames]"
        path = inside(probe.folder, filled(probe.frames, site=site, exposure=exposure), where, fields.faults)
        if path is None:
            continue
        size = size or _kind_of(path, probe.sensor.kind.bits)
        fields.faults += header_faults(path, size or probe.sensor.kind, where)


def _kind_of(path: Path, bits: int) -> FrameKind | None:
    size = frame_size(path)
    return None if size is None else FrameKind(*size, bits)
