"""Samples of every surfel under every light in every camera (Weyrich et al. 2005, eq. 3)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, wait
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from skindb._types import Progress
from skindb.errors import Fault, InputError
from skindb.geometry._ring_kernels import grown
from skindb.geometry.camera import camera_centre, project
from skindb.ingest._sample_kernels import gather, touched
from skindb.ingest.calibration import Calibration, CalibrationCheck, pixel_width
from skindb.ingest.devices import CameraRecord, DomeRecord, LightRecord
from skindb.ingest.frames import Digests, Frame
from skindb.ingest.irradiance import light_falloff
from skindb.ingest.pixel_flags import OK, SATURATED
from skindb.ingest.plausible_calibration import calibration_faults
from skindb.ingest.plausible_frames import view_faults
from skindb.ingest.plausible_samples import unlit_fault, view_median
from skindb.ingest.radiance import Darkroom, Image, radiance_floor, read_view
from skindb.ingest.spool import Spool
from skindb.ingest.surfels import SurfelSet

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
T = TypeVar("T")
R = TypeVar("R")
AHEAD = 24  # views between the one that is waited for and the last one asked for: of eight threads none is ever idle
MAX_CLEAR_FOOTPRINT_PX = 0.75  # px; footprints wider than this reach beyond the pixels that `clear` looks at
PIXEL_VARIANCE_PX2 = 0.2  # px^2; of the mean between four pixels, nearly: more only blurs (3 % at 1 px^2, measured)
MIN_SPLAT_VARIANCE_PX2 = 0.25  # px^2: a splat of one pixel radius
Soft = Literal["leave_out", "keep"]  # samples at the soft edges of shadows
MIN_LIT_FRACTION = 0.999  # of a light's disc: no sample in the penumbra
FULL_SHADOW = 1e-3
MIN_COSINE_CAMERA = 0.1  # towards the camera
MAX_SMEAR_MM = 12.0  # mm of surface under one pixel; measured: beyond it samples are 20 % too bright
LINEAR_FLOOR = 1e-4  # sr^-1; of linear files, whose noise nobody told


@dataclass(frozen=True)
class Views:
    """What is seen where."""

    surfels: SurfelSet
    lit: NDArray[np.bool_]  # (n, light) where samples are taken, see `fully_lit`
    clear: NDArray[np.bool_]  # (n, camera)
    pixels: NDArray[np.float32]  # (n, camera, 2)
    share: NDArray[np.float16] | None = None  # (n, light) of the disc, which samples are divided by
    footprint: bool = False  # samples are means over the surfel's splat, else between the nearest pixels


@dataclass(frozen=True)
class Shot:
    """What one camera contributes, whatever the light."""

    wanted: NDArray[np.bool_]  # (n,)
    pixels: NDArray[np.float32]  # (n, 2)
    spread: NDArray[np.float32]  # (n, 3) px^2, or (0, 3)


@dataclass(frozen=True)
class Lumitexels:
    """Samples and what became of the visible pairs."""

    sample: Any  # (n, light, camera, 3) float16 sr^-1; lazy
    sample_count: NDArray[np.int32]
    saturated_count: NDArray[np.int32]
    dark_count: NDArray[np.int32]
    view_count: NDArray[np.int64]  # (light, camera) samples of each view
    view_median: Array  # (light, camera) sr^-1; NaN of few samples, and of views that an earlier run had made
    noise_floor: float  # sr^-1
    photographs: Mapping[tuple[int, int], Image]
    calibration: Calibration | None = None  # None: it was not checked


def fully_lit(
    surfels: SurfelSet, light_share: NDArray[np.float16], cameras: Sequence[CameraRecord], *, soft: Soft = "leave_out"
) -> NDArray[np.bool_]:
    """Where (n, light) the whole disc is visible, also from the neighbours that a pixel of any camera may cover.

    Samples beside a shadow mix it in: measured 14 % too dark in the first ring of neighbours. With `soft` "keep", any
    part of the disc is enough, for surfel and neighbours: only the full shadow keeps its distance.
    """
    least = MIN_LIT_FRACTION if soft == "leave_out" else FULL_SHADOW
    pixel = max(pixel_width(camera, surfels.position.mean(axis=0)) for camera in cameras)
    rings = max(int(np.ceil(pixel / surfels.spacing())), 1)
    lit = np.empty_like(light_share, bool, order="F")  # lights outermost: they are used one by one
    for j in range(lit.shape[1]):
        shadow = light_share[:, j] < least
        for _ in range(rings):
            shadow = grown(surfels.faces, shadow)
        lit[:, j] = ~shadow
    return lit


def sample_lumitexels(
    dome: DomeRecord,
    intensity: Array,
    views: Views,
    rooms: Mapping[str, Darkroom],
    spool: Spool,
    *,
    kept: Collection[tuple[int, int]] = (),
    check: CalibrationCheck | None = None,
    refuse: bool = True,
    pool: Executor,
    progress: Progress | None = None,
) -> Lumitexels:
    """Decode, develop and sample every view once that the spool does not hold yet.

    Parameters
    ----------
    dome
        Cameras, lights and frames.
    intensity
        (light, 3) radiant intensity.
    views
        Visibility and projections.
    rooms
        Of every camera by id.
    spool
        Filled here: rho = L d^2 / (I falloff).
    kept
        (light, camera) pairs whose merged radiance is kept.
    check
        Views of its pairs come first, and the calibration is judged by them.
    refuse
        A calibration that the photographs contradict is an error.
    pool, progress
        Threads that decode; called with stage, views done and views in all.

    Raises
    ------
    InputError
        Every frame that cannot be decoded; a calibration that the photographs contradict.
    """
    checked = frozenset[tuple[int, int]]() if check is None else check.pairs
    shots = list(pool.map(lambda c: _shot(views, dome.cameras[c], c), range(len(dome.cameras))))

    def one(pair: tuple[int, int]) -> list[Fault]:
        j, c = pair
        digests: Digests = {}
        try:
            frames = read_view(dome, dome.lights[j].id, dome.cameras[c], digests=digests)
        except InputError as error:
            return list(error.faults)
        room = rooms[dome.cameras[c].id]
        if found := view_faults(dome, dome.lights[j].id, room, frames):
            return found
        wanted = shots[c].wanted & views.lit[:, j]
        radiance, flag = _developed(room, frames, shots[c], wanted, whole=pair in kept or pair in checked)
        if pair in kept:
            spool.keep(f"photograph-{j}-{c}", _without_saturated(radiance, flag))
        if check is not None and pair in checked:
            spool.keep(f"calibration-{j}-{c}", check.reduce(c, _without_saturated(radiance, flag)))
        samples, became = _sampled(radiance, flag, shots[c], wanted, dome.lights[j], intensity[j], views, j)
        usable = samples[:, became == OK].view(np.float16)
        where = f"{dome.file}[frames], camera {room.camera.id}, light {dome.lights[j].id}"
        if fault := unlit_fault(where, radiance[flag == OK], usable.shape[1]):
            return [fault]
        middle[j, c] = view_median(usable)
        spool.put(j, c, samples, became, {str(path): digest for path, digest in digests.items()})
        return []

    faults, middle = list[Fault](), np.full(spool.done.shape, np.nan)
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
    calibration = None if check is None or faults else _judged(check, spool)
    wrong = [] if calibration is None or not refuse else calibration_faults(dome, calibration)
    if not wrong:  # else hours of sampling would end in the same lines
        sample(pair for pair in missing if pair not in checked)
    faults += wrong
    if faults:
        raise InputError(faults)
    usable, saturated, dark = spool.counts
    photographs = {(j, c): image for j, c in kept if (image := spool.kept(f"photograph-{j}-{c}")) is not None}
    floor = noise_floor(dome, intensity, views.surfels)
    return Lumitexels(spool.samples(), usable, saturated, dark, spool.views, middle, floor, photographs, calibration)


def checked_pictures(
    check: CalibrationCheck, rooms: Mapping[str, Darkroom], *, pool: Executor
) -> dict[tuple[int, int], NDArray[np.float32]]:
    """The reduced photographs of the pairs of a check, before anything is sampled.

    Raises
    ------
    InputError
        Every frame that cannot be decoded.
    """
    faults, dome = list[Fault](), check.dome

    def one(pair: tuple[int, int]) -> NDArray[np.float32] | None:
        light, camera = dome.lights[pair[0]].id, dome.cameras[pair[1]]
        try:
            frames = read_view(dome, light, camera, digests={})
        except InputError as error:
            faults.extend(error.faults)
            return None
        radiance, flag = rooms[camera.id].merge(frames)
        return check.reduce(pair[1], _without_saturated(radiance, flag))

    pairs = sorted(check.pairs)
    found = dict(zip(pairs, _in_turn(pool, one, pairs), strict=True))
    if faults:
        raise InputError(faults)
    return {pair: image for pair, image in found.items() if image is not None}


def _without_saturated(radiance: Image, flag: NDArray[np.uint8]) -> Image:
    """The radiance, NaN where it is not known how bright it was."""
    return np.where((flag == SATURATED)[..., None], np.float32(np.nan), radiance)


def _judged(check: CalibrationCheck, spool: Spool) -> Calibration:
    """What the kept pictures of this run, or of one that was killed, say of the calibration."""
    pictures = {(j, c): spool.kept(f"calibration-{j}-{c}") for j, c in check.pairs}
    return check.judge({pair: image for pair, image in pictures.items() if image is not None})


def footprints(surfels: SurfelSet, camera: CameraRecord) -> NDArray[np.float32]:
    """Variances xx, xy, yy (n, 3) px^2 of the splats in a picture, and of a pixel (Heckbert 1989, section 3).

    A disc has a quarter of its square radius as variance in each direction. Its diameters are projected, lens and all.
    NaN where it is no larger than what lies between four pixels anyway.
    """
    helper = np.eye(3)[np.abs(surfels.normal).argmin(axis=1)]
    first = np.cross(surfels.normal, helper)
    first *= (surfels.radius / 2 / np.maximum(np.linalg.norm(first, axis=1), 1e-30))[:, None]
    spread = np.zeros((len(first), 3))
    for arm in (first, np.cross(surfels.normal, first)):
        ahead, _ = project(surfels.position + arm, camera.K, camera.R, camera.t, camera.distortion)
        behind, _ = project(surfels.position - arm, camera.K, camera.R, camera.t, camera.distortion)
        x, y = ((ahead - behind) / 2).T
        spread += np.stack([x * x, x * y, y * y], axis=1)
    spread[spread[:, [0, 2]].max(axis=1) < MIN_SPLAT_VARIANCE_PX2] = np.nan
    return np.asarray(spread + np.array([PIXEL_VARIANCE_PX2, 0, PIXEL_VARIANCE_PX2]), np.float32)


def _shot(views: Views, camera: CameraRecord, c: int) -> Shot:
    wanted, spread = views.clear[:, c] & _frontal(camera, views.surfels), np.zeros((0, 3), np.float32)
    if views.footprint:
        spread = footprints(views.surfels, camera)
        wide = spread[:, [0, 2]].max(axis=1) > MAX_CLEAR_FOOTPRINT_PX**2
        wanted &= ~(wide & grown(views.surfels.faces, ~views.clear[:, c]))
    return Shot(wanted, np.ascontiguousarray(views.pixels[:, c]), spread)


def _developed(
    room: Darkroom, frames: list[Frame], shot: Shot, wanted: Bools, *, whole: bool
) -> tuple[Image, NDArray[np.uint8]]:
    """Radiance (h, w, 3) and flags (h, w) of a view, of all of it or of what the wanted surfels (n,) touch."""
    spans = None if whole else touched(wanted, shot.pixels, shot.spread, *frames[0].shape[:2])
    return room.merge(frames, spans)


def _sampled(
    radiance: Image,
    flag: NDArray[np.uint8],
    shot: Shot,
    wanted: Bools,
    light: LightRecord,
    intensity: Array,
    views: Views,
    j: int,
) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Bits of the samples (3, n) of a view, and what became of each surfel."""
    n = len(wanted)
    out, became = np.empty((3, n), np.uint16), np.empty(n, np.uint8)
    share = np.zeros(0, np.float32) if views.share is None else views.share[:, j].astype(np.float32)
    gather(
        radiance, flag, wanted, share, shot.pixels, shot.spread, views.surfels.position,
        views.surfels.normal, light.position, light.axis, float(light.falloff), intensity, out, became,
    )  # fmt: skip
    return out, became


def _in_turn(pool: Executor, call: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Results in order, with few calls ahead of the one that is waited for; none is left running at the end."""
    waiting: deque[Future[R]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(call, item))
            if len(waiting) >= AHEAD:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        for future in waiting:
            future.cancel()
        wait(waiting)


def noise_floor(dome: DomeRecord, intensity: Array, surfels: SurfelSet) -> float:
    """Reflectance [sr^-1] of one sigma of read noise and quantisation, at the median light and distance."""
    radiance = float(np.median([radiance_floor(camera.sensor, dome.exposures) for camera in dome.cameras]))
    middle = surfels.position.mean(axis=0)
    square = np.array([light_falloff(light, middle[None])[0][0] for light in dome.lights])
    floor = radiance * float(np.median(square[:, None] / intensity))
    return floor if floor > 0 else LINEAR_FLOOR


def choose_photographs(dome: DomeRecord, middle: Array, count: int) -> list[tuple[int, int]]:
    """(light, camera) pairs: lights spread evenly over those in front of the face, by the most frontal camera."""
    if count < 1:
        return []
    centres = np.array([camera_centre(camera.R, camera.t) for camera in dome.cameras]) - middle
    camera = int((centres[:, 2] / np.linalg.norm(centres, axis=1)).argmax())
    towards = np.array([light.position for light in dome.lights]) - middle
    direction = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    front = np.flatnonzero(direction[:, 2] > 0.5)
    front = front if len(front) >= count else np.argsort(-direction[:, 2])[:count]
    # farthest first: each next light is the one farthest from all chosen
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
