"""Samples of every surfel under every light in every camera (Weyrich et al. 2005, eq. 3)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, wait
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from skindb.calibration.frame_checks import highest_value, view_faults
from skindb.calibration.irradiance import light_falloff
from skindb.calibration.pixel_flags import OK, SATURATED
from skindb.calibration.radiance import FrameMerger, Image, radiance_floor, read_view
from skindb.errors import Fault, InputError
from skindb.format.dome import CameraRecord, DomeRecord, LightRecord, pixel_width
from skindb.format.frames import Digests, Frame
from skindb.geometry._mesh_kernels import grown
from skindb.geometry.camera import camera_centre, project
from skindb.ingest._sample_kernels import SINGLE, gather, pixel_counts, pixel_spans
from skindb.ingest.consistency import Calibration, CalibrationCheck
from skindb.ingest.consistency_checks import calibration_faults
from skindb.ingest.sample_quality import (
    SampleNoise,
    bright_fraction,
    sample_noise,
    unlit_fault,
    view_median,
)
from skindb.ingest.spool import Spool
from skindb.ingest.surfels import SurfelSet
from skindb.types import Progress

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
T = TypeVar("T")
R = TypeVar("R")
# views that are requested ahead of the one that is waited for: keeps eight threads busy
MAX_PENDING_VIEWS = 24
# px; wider footprints extend beyond the pixels that `clear` checks
MAX_CLEAR_FOOTPRINT_PX = 0.75
# px^2; about that of bilinear interpolation; larger values blur (3 % at 1 px^2,
# measured)
PIXEL_VARIANCE_PX2 = 0.2
MIN_SPLAT_VARIANCE_PX2 = 0.25  # px^2: a splat with a radius of one pixel
PenumbraRule = Literal["exclude", "keep"]  # samples at the soft edges of shadows
# visible fraction of a light's disc below which a surfel is in the penumbra
MIN_LIT_FRACTION = 0.999
FULL_SHADOW = 1e-3
MIN_COSINE_CAMERA = 0.1  # between the normal and the direction to the camera
# mm of surface covered by one pixel; beyond it, samples were measured 20 % too bright
MAX_SMEAR_MM = 12.0
# variance after bilinear interpolation over that of one pixel, mean over all positions
BILINEAR_NOISE = 4 / 9
LINEAR_NOISE_FLOOR = 1e-4  # sr^-1; for linear files, whose noise is unknown


@dataclass(frozen=True)
class Views:
    """Which surfels each light reaches and each camera sees, and where they project to."""

    surfels: SurfelSet
    lit: NDArray[np.bool_]  # (n, light) surfels that get samples, see `fully_lit`
    clear: NDArray[np.bool_]  # (n, camera)
    pixels: NDArray[np.float32]  # (n, camera, 2)
    # (n, light) visible fraction of the disc; divides samples
    light_fraction: NDArray[np.float16] | None = None
    # samples are means over the surfel's splat; otherwise interpolated bilinearly
    footprint: bool = False


@dataclass(frozen=True)
class CameraSampling:
    """Where and how one camera samples the surfels, the same under every light."""

    wanted: NDArray[np.bool_]  # (n,)
    pixels: NDArray[np.float32]  # (n, 2)
    spread: NDArray[np.float32]  # (n, 3) px^2, or (0, 3)


@dataclass(frozen=True)
class ViewLevels:
    """Levels of each view (light, camera); NaN, or nothing to report, for views of an
    earlier run.
    """

    median: Array  # sr^-1 of its samples; NaN for few samples
    bright: Array  # fraction of its samples that are too large for a surface
    highest: Array  # value of the longest exposure
    clipped: Bools  # whether the picture is cut off at its highest value


@dataclass(frozen=True)
class Lumitexels:
    """Samples, and the outcomes for all visible pairs of light and camera."""

    sample: Any  # (n, light, camera, 3) float16 sr^-1; lazy
    sample_count: NDArray[np.int32]
    saturated_count: NDArray[np.int32]
    dark_count: NDArray[np.int32]
    single_count: NDArray[np.int32]  # samples from a single exposure
    view_count: NDArray[np.int64]  # (light, camera) samples of each view
    views: ViewLevels
    noise_floor: float  # sr^-1
    shot_noise: float  # sr^-1
    photographs: Mapping[tuple[int, int], Image]
    calibration: Calibration | None = None  # None: not checked
    noise: SampleNoise | None = None  # None: the electrons of a camera are unknown


def fully_lit(
    surfels: SurfelSet,
    light_fraction: NDArray[np.float16],
    cameras: Sequence[CameraRecord],
    *,
    soft: PenumbraRule = "exclude",
) -> NDArray[np.bool_]:
    """Where (n, light) the entire disc is visible from a surfel and from all neighbours
    that a pixel may cover.

    Pixels beside a shadow include a part of it: samples were measured 14 % too dark in
    the first ring of neighbours. With `soft` "keep", any visible part of the disc is
    enough, for a surfel and for its neighbours.
    """
    least = MIN_LIT_FRACTION if soft == "exclude" else FULL_SHADOW
    pixel = max(
        pixel_width(camera, surfels.position.mean(axis=0)) for camera in cameras
    )
    rings = max(int(np.ceil(pixel / surfels.spacing())), 1)
    # the columns of lights are used one by one
    lit = np.empty_like(light_fraction, bool, order="F")
    for j in range(lit.shape[1]):
        shadow = light_fraction[:, j] < least
        for _ in range(rings):
            shadow = grown(surfels.faces, shadow)
        lit[:, j] = ~shadow
    return lit


def sample_lumitexels(
    dome: DomeRecord,
    intensity: Array,
    views: Views,
    mergers: Mapping[str, FrameMerger],
    spool: Spool,
    *,
    kept: Collection[tuple[int, int]] = (),
    check: CalibrationCheck | None = None,
    refuse: bool = True,
    pool: Executor,
    progress: Progress | None = None,
) -> Lumitexels:
    """Decode, merge and sample every view that the spool does not hold yet.

    Parameters
    ----------
    dome
        Cameras, lights and frames.
    intensity
        (light, 3) radiant intensity.
    views
        Visibility and projections.
    mergers
        Frame merger of every camera, by id.
    spool
        Receives the samples rho = L d^2 / (I falloff).
    kept
        (light, camera) pairs whose merged radiance is kept.
    check
        Views of its pairs come first, and the calibration is checked by them.
    refuse
        Whether a calibration that the photographs contradict is an error.
    pool, progress
        Threads that decode; callback with the stage, the number of views done, and
        their total number.

    Raises
    ------
    InputError
        With every frame that cannot be decoded, or for a calibration that the
        photographs contradict.
    """
    checked = frozenset[tuple[int, int]]() if check is None else check.pairs
    shots = list(
        pool.map(
            lambda c: _camera_sampling(views, dome.cameras[c], c),
            range(len(dome.cameras)),
        )
    )

    def one(pair: tuple[int, int]) -> list[Fault]:
        j, c = pair
        digests: Digests = {}
        try:
            frames = read_view(
                dome, dome.lights[j].id, dome.cameras[c], digests=digests
            )
        except InputError as error:
            return list(error.faults)
        merger = mergers[dome.cameras[c].id]
        if found := view_faults(dome, dome.lights[j].id, merger, frames):
            return found
        wanted = shots[c].wanted & views.lit[:, j]
        radiance, flag, exposures = _developed(
            merger, frames, shots[c], wanted, whole=pair in kept or pair in checked
        )
        if pair in kept:
            spool.keep(f"photograph-{j}-{c}", _without_saturated(radiance, flag))
        if check is not None and pair in checked:
            spool.keep(
                f"calibration-{j}-{c}",
                check.reduce(c, _without_saturated(radiance, flag)),
            )
        samples, outcome = _sampled(
            (radiance, flag, exposures),
            shots[c],
            wanted,
            dome.lights[j],
            intensity[j],
            views,
            j,
        )
        usable = samples[:, (outcome == OK) | (outcome == SINGLE)].view(np.float16)
        where = (
            f"{dome.file}[frames], camera {merger.camera.id}, light {dome.lights[j].id}"
        )
        if fault := unlit_fault(where, radiance[flag == OK], usable.shape[1]):
            return [fault]
        levels.median[j, c] = view_median(usable)
        levels.bright[j, c] = bright_fraction(usable)
        levels.highest[j, c], levels.clipped[j, c] = highest_value(merger, frames)
        spool.put(
            j,
            c,
            samples,
            outcome,
            {str(path): digest for path, digest in digests.items()},
        )
        return []

    faults = list[Fault]()
    shape = spool.done.shape
    levels = ViewLevels(
        np.full(shape, np.nan),
        np.zeros(shape),
        np.full(shape, np.nan),
        np.zeros(shape, bool),
    )
    missing = [(int(j), int(c)) for j, c in np.argwhere(~spool.done)]
    count = spool.done.size - len(missing)

    def sample(pairs: Iterable[tuple[int, int]]) -> None:
        nonlocal count
        for found in _in_turn(pool, one, pairs):
            faults.extend(found)
            count += 1
            if progress is not None:
                progress("sample", count, spool.done.size)

    sample(pair for pair in missing if pair in checked)
    calibration = None if check is None or faults else _evaluated(check, spool)
    wrong = (
        []
        if calibration is None or not refuse
        else calibration_faults(dome, calibration)
    )
    if not wrong:  # otherwise hours of sampling would end with the same faults
        sample(pair for pair in missing if pair not in checked)
    faults += wrong
    if faults:
        raise InputError(faults)
    usable, saturated, dark, single = spool.counts
    photographs = {
        (j, c): image
        for j, c in kept
        if (image := spool.kept(f"photograph-{j}-{c}")) is not None
    }
    noise = (
        noise_floor(dome, intensity, views.surfels),
        shot_noise(dome, intensity, views.surfels),
    )
    each = sample_noise(dome, views.pixels, _effective_pixels(dome, shots))
    return Lumitexels(
        spool.samples(),
        usable,
        saturated,
        dark,
        single,
        spool.views,
        levels,
        *noise,
        photographs,
        calibration,
        each,
    )


def checked_pictures(
    check: CalibrationCheck, mergers: Mapping[str, FrameMerger], *, pool: Executor
) -> dict[tuple[int, int], NDArray[np.float32]]:
    """The downsampled photographs of the pairs of a check, before anything is sampled.

    Raises
    ------
    InputError
        With every frame that cannot be decoded or that cannot be a photograph.
    """
    faults = list[Fault]()
    dome = check.dome

    def one(pair: tuple[int, int]) -> NDArray[np.float32] | None:
        light = dome.lights[pair[0]].id
        camera = dome.cameras[pair[1]]
        try:
            frames = read_view(dome, light, camera, digests={})
        except InputError as error:
            faults.extend(error.faults)
            return None
        if found := view_faults(dome, light, mergers[camera.id], frames):
            faults.extend(found)
            return None
        radiance, flag = mergers[camera.id].merge(frames)
        return check.reduce(pair[1], _without_saturated(radiance, flag))

    pairs = sorted(check.pairs)
    found = dict(zip(pairs, _in_turn(pool, one, pairs), strict=True))
    if faults:
        raise InputError(faults)
    return {pair: image for pair, image in found.items() if image is not None}


def _without_saturated(radiance: Image, flag: NDArray[np.uint8]) -> Image:
    """The radiance, with NaN at saturated pixels."""
    return np.where((flag == SATURATED)[..., None], np.float32(np.nan), radiance)


def _evaluated(check: CalibrationCheck, spool: Spool) -> Calibration:
    """Check the calibration by the pictures of this run and of an interrupted one that
    it resumes.
    """
    pictures = {(j, c): spool.kept(f"calibration-{j}-{c}") for j, c in check.pairs}
    return check.evaluate(
        {pair: image for pair, image in pictures.items() if image is not None}
    )


def footprints(surfels: SurfelSet, camera: CameraRecord) -> NDArray[np.float32]:
    """Variances xx, xy, yy (n, 3) px^2 of the splats in a picture, and of a pixel
    (Heckbert 1989, section 3).

    The variance of a disc in each direction is a quarter of its squared radius. Its
    diameters are projected with the distortion of the lens. NaN where the splat is no
    larger than the footprint of bilinear interpolation.
    """
    helper = np.eye(3)[np.abs(surfels.normal).argmin(axis=1)]
    first = np.cross(surfels.normal, helper)
    first *= (surfels.radius / 2 / np.maximum(np.linalg.norm(first, axis=1), 1e-30))[
        :, None
    ]
    spread = np.zeros((len(first), 3))
    for arm in (first, np.cross(surfels.normal, first)):
        ahead, _ = project(
            surfels.position + arm, camera.K, camera.R, camera.t, camera.distortion
        )
        behind, _ = project(
            surfels.position - arm, camera.K, camera.R, camera.t, camera.distortion
        )
        x, y = ((ahead - behind) / 2).T
        spread += np.stack([x * x, x * y, y * y], axis=1)
    spread[spread[:, [0, 2]].max(axis=1) < MIN_SPLAT_VARIANCE_PX2] = np.nan
    return np.asarray(
        spread + np.array([PIXEL_VARIANCE_PX2, 0, PIXEL_VARIANCE_PX2]), np.float32
    )


def _camera_sampling(views: Views, camera: CameraRecord, c: int) -> CameraSampling:
    wanted = views.clear[:, c] & _frontal(camera, views.surfels)
    spread = np.zeros((0, 3), np.float32)
    if views.footprint:
        spread = footprints(views.surfels, camera)
        wide = spread[:, [0, 2]].max(axis=1) > MAX_CLEAR_FOOTPRINT_PX**2
        wanted &= ~(wide & grown(views.surfels.faces, ~views.clear[:, c]))
    return CameraSampling(wanted, np.ascontiguousarray(views.pixels[:, c]), spread)


def _effective_pixels(
    dome: DomeRecord, shots: Sequence[CameraSampling]
) -> NDArray[np.float32]:
    """Effective number of pixels (n, camera) that a sample averages; NaN where a camera
    takes no sample.
    """
    out = np.empty((len(shots), len(shots[0].wanted)), np.float32)
    for camera, shot, row in zip(dome.cameras, shots, out, strict=True):
        pixel_counts(
            shot.wanted, shot.pixels, shot.spread, camera.height, camera.width, row
        )
    return np.ascontiguousarray(out.T)


def _developed(
    merger: FrameMerger,
    frames: list[Frame],
    shot: CameraSampling,
    wanted: Bools,
    *,
    whole: bool,
) -> tuple[Image, NDArray[np.uint8], NDArray[np.uint8]]:
    """Radiance (h, w, 3), flags and usable exposures (h, w) of a view, or of the pixels
    that wanted surfels need.
    """
    spans = (
        None
        if whole
        else pixel_spans(wanted, shot.pixels, shot.spread, *frames[0].shape[:2])
    )
    usable = np.zeros(frames[0].shape[:2], np.uint8)
    return *merger.merge(frames, spans, usable=usable), usable


def _sampled(
    picture: tuple[Image, NDArray[np.uint8], NDArray[np.uint8]],
    shot: CameraSampling,
    wanted: Bools,
    light: LightRecord,
    intensity: Array,
    views: Views,
    j: int,
) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Bits of the samples (3, n) of a view, and outcome (n,) for each surfel."""
    n = len(wanted)
    out = np.empty((3, n), np.uint16)
    outcome = np.empty(n, np.uint8)
    light_fraction = (
        np.zeros(0, np.float32)
        if views.light_fraction is None
        else views.light_fraction[:, j].astype(np.float32)
    )
    gather(
        *picture,
        wanted,
        light_fraction,
        shot.pixels,
        shot.spread,
        views.surfels.position,
        views.surfels.normal,
        light.position,
        light.axis,
        float(light.falloff),
        intensity,
        out,
        outcome,
    )
    return out, outcome


def _in_turn(pool: Executor, call: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Results in order, with a limited number of pending calls; no call is still
    running at the end.
    """
    waiting: deque[Future[R]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(call, item))
            if len(waiting) >= MAX_PENDING_VIEWS:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        for future in waiting:
            future.cancel()
        wait(waiting)


def noise_floor(dome: DomeRecord, intensity: Array, surfels: SurfelSet) -> float:
    """Reflectance [sr^-1] of one sigma of read noise and quantisation, at the median
    light and distance.
    """
    radiance = float(
        np.median(
            [radiance_floor(camera.sensor, dome.exposures) for camera in dome.cameras]
        )
    )
    floor = radiance * _reflectance_per_radiance(dome, intensity, surfels)
    return floor if floor > 0 else LINEAR_NOISE_FLOOR


def shot_noise(dome: DomeRecord, intensity: Array, surfels: SurfelSet) -> float:
    """Variance by photons over reflectance [sr^-1], at the median light and distance; 0
    if electrons are not known.

    For radiance L, the sensor counts L times the sum of the exposure times times the
    electrons of full exposure: the variance of merged radiance is L over this number
    per unit of radiance.
    """
    if not all(camera.sensor.noise_known for camera in dome.cameras):
        return 0.0
    electrons = float(
        np.median([camera.sensor.full_electrons for camera in dome.cameras])
    )
    per_second = 1 / (electrons * sum(dome.exposures.values()))
    return (
        BILINEAR_NOISE
        * per_second
        * _reflectance_per_radiance(dome, intensity, surfels)
    )


def _reflectance_per_radiance(
    dome: DomeRecord, intensity: Array, surfels: SurfelSet
) -> float:
    """Reflectance per radiance at the median light and distance."""
    middle = surfels.position.mean(axis=0)
    square = np.array(
        [light_falloff(light, middle[None])[0][0] for light in dome.lights]
    )
    return float(np.median(square[:, None] / intensity))


def choose_photographs(
    dome: DomeRecord, middle: Array, count: int
) -> list[tuple[int, int]]:
    """(light, camera) pairs of lights that are spread evenly in front of the face, with
    the most frontal camera.
    """
    if count < 1:
        return []
    centres = (
        np.array([camera_centre(camera.R, camera.t) for camera in dome.cameras])
        - middle
    )
    camera = int((centres[:, 2] / np.linalg.norm(centres, axis=1)).argmax())
    towards = np.array([light.position for light in dome.lights]) - middle
    direction = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    front = np.flatnonzero(direction[:, 2] > 0.5)
    front = front if len(front) >= count else np.argsort(-direction[:, 2])[:count]
    # farthest-point sampling: each next light is the one farthest from all chosen lights
    chosen = [int(front[direction[front, 2].argmax()])]
    while len(chosen) < min(count, len(front)):
        nearest = (direction[front] @ direction[chosen].T).max(axis=1)
        chosen.append(int(front[nearest.argmin()]))
    return [(light, camera) for light in sorted(chosen)]


def _frontal(camera: CameraRecord, surfels: SurfelSet) -> NDArray[np.bool_]:
    """Where (n,) a view is steep enough for a pixel to cover little of the surface."""
    way = camera_centre(camera.R, camera.t) - surfels.position
    cosine = np.einsum("ni,ni->n", way, surfels.normal) / np.linalg.norm(way, axis=1)
    width = pixel_width(camera, surfels.position.mean(axis=0))
    return np.asarray(cosine >= max(MIN_COSINE_CAMERA, width / MAX_SMEAR_MM))
