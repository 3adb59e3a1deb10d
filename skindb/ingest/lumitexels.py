"""Samples of every surfel under every light in every camera (Weyrich et al. 2005, eq. 3)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, wait
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from skindb.calibration._merge_kernels import OK, SATURATED
from skindb.calibration.frame_checks import checked_view, highest_value
from skindb.calibration.irradiance import light_falloff
from skindb.calibration.radiance import (
    FrameMerger,
    Image,
    radiance_floor,
    radiance_noise,
    vignette_gain,
)
from skindb.errors import Fault, InputError, attempt, require
from skindb.format.dome import CameraRecord, DomeRecord
from skindb.format.frames import Digests, Frame
from skindb.geometry._mesh_kernels import grown
from skindb.ingest._sample_kernels import (
    MergedView,
    PointLight,
    gather,
    pixel_counts,
    pixel_spans,
    view_levels,
)
from skindb.ingest.consistency import Calibration, CalibrationCheck, Pair
from skindb.ingest.faults import (
    MAX_SAMPLE,
    MIN_MEDIAN_SAMPLES,
    calibration_faults,
)
from skindb.ingest.spool import Spool
from skindb.ingest.surfels import SurfelSet
from skindb.types import Float64, Index, Mask, Progress, silent

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
    lit: Mask  # (n, light) surfels that get samples, see `fully_lit`
    clear: Mask  # (n, camera)
    pixels: NDArray[np.float32]  # (n, camera, 2)
    # (n, light) visible fraction of the disc; divides samples
    light_fraction: NDArray[np.float16] | None = None
    # samples are means over the surfel's splat; otherwise interpolated bilinearly
    footprint: bool = False


@dataclass(frozen=True)
class CameraSampling:
    """Where and how one camera samples the surfels, the same under every light."""

    surfels: Mask  # (n,) those that it samples
    pixels: NDArray[np.float32]  # (n, 2)
    spread: NDArray[np.float32]  # (n, 3) px^2, or (0, 3)


@dataclass(frozen=True)
class ViewLevels:
    """Levels of each view (light, camera); NaN, or nothing to report, for views of an
    earlier run.
    """

    median: Float64  # sr^-1 of its samples; NaN for few samples
    bright: Float64  # fraction of its samples that are too large for a surface
    highest: Float64  # value of the longest exposure
    clipped: Mask  # whether the picture is cut off at its highest value

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> ViewLevels:
        """Levels before any view was read."""
        return cls(
            np.full(shape, np.nan),
            np.zeros(shape),
            np.full(shape, np.nan),
            np.zeros(shape, bool),
        )


@dataclass(frozen=True)
class Lumitexels:
    """Samples, and the outcomes for all visible pairs of light and camera."""

    sample: Any  # (n, light, camera, 3) float16 sr^-1; lazy
    sample_count: NDArray[np.int32]
    saturated_count: NDArray[np.int32]
    dark_count: NDArray[np.int32]
    single_count: NDArray[np.int32]  # samples from a single exposure
    view_count: Index  # (light, camera) samples of each view
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
) -> Mask:
    """Where (n, light) the entire disc is visible from a surfel and from all neighbours
    that a pixel may cover.

    Pixels beside a shadow include a part of it: samples were measured 14 % too dark in
    the first ring of neighbours. With `soft` "keep", any visible part of the disc is
    enough, for a surfel and for its neighbours.
    """
    minimum = MIN_LIT_FRACTION if soft == "exclude" else FULL_SHADOW
    middle = surfels.position.mean(axis=0)
    pixel = max(camera.pixel_width(middle) for camera in cameras)
    rings = max(int(np.ceil(pixel / surfels.spacing())), 1)
    # the columns of lights are used one by one
    lit = np.empty_like(light_fraction, bool, order="F")
    for j in range(lit.shape[1]):
        shadow = light_fraction[:, j] < minimum
        for _ in range(rings):
            shadow = grown(surfels.faces, shadow)
        lit[:, j] = ~shadow
    return lit


def sample_lumitexels(
    dome: DomeRecord,
    intensity: Float64,
    views: Views,
    mergers: Mapping[str, FrameMerger],
    spool: Spool,
    *,
    kept: Collection[Pair] = (),
    check: CalibrationCheck | None = None,
    refuse: bool = True,
    pool: Executor,
    progress: Progress = silent,
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
    checked = frozenset[Pair]() if check is None else check.pairs
    cameras = range(len(dome.cameras))
    shots = list(
        pool.map(lambda c: _camera_sampling(views, dome.cameras[c], c), cameras)
    )
    levels = ViewLevels.empty(spool.done.shape)
    sampler = _Sampler(
        dome, intensity, views, mergers, spool, frozenset(kept), check, shots, levels
    )
    faults = list[Fault]()
    missing = [(int(j), int(c)) for j, c in np.argwhere(~spool.done)]
    count = spool.done.size - len(missing)

    def sample(pairs: Iterable[Pair]) -> None:
        nonlocal count
        for view_faults in _in_turn(pool, sampler.faults, pairs):
            faults.extend(view_faults)
            count += 1
            progress("sample", count, spool.done.size)

    sample(pair for pair in missing if pair in checked)
    calibration = None if check is None or faults else _evaluated(check, spool)
    contradictions = []
    if calibration is not None and refuse:
        contradictions = calibration_faults(dome, calibration)
    if not contradictions:  # otherwise hours of sampling would end with the same faults
        sample(pair for pair in missing if pair not in checked)
    if faults or contradictions:
        raise InputError(faults + contradictions)
    return sampler.lumitexels(calibration)


@dataclass(frozen=True)
class _Sampler:
    """Samples single views into the spool; the arguments of `sample_lumitexels`."""

    dome: DomeRecord
    intensity: Float64
    views: Views
    mergers: Mapping[str, FrameMerger]
    spool: Spool
    kept: frozenset[Pair]
    check: CalibrationCheck | None
    shots: list[CameraSampling]  # by camera
    levels: ViewLevels

    def faults(self, pair: Pair) -> list[Fault]:
        """Sample a view; its faults, if it has any."""
        faults = list[Fault]()
        attempt(faults, lambda: self._sample(*pair))
        return faults

    def lumitexels(self, calibration: Calibration | None) -> Lumitexels:
        """The samples and counts of all views in the spool."""
        surfels = self.views.surfels
        usable, saturated, dark, single = self.spool.counts
        photographs = {}
        for j, c in self.kept:
            image = self.spool.kept(f"photograph-{j}-{c}")
            if image is not None:
                photographs[j, c] = image
        pixels = _effective_pixels(self.dome, self.shots)
        return Lumitexels(
            sample=self.spool.samples(),
            sample_count=usable,
            saturated_count=saturated,
            dark_count=dark,
            single_count=single,
            view_count=self.spool.views,
            views=self.levels,
            noise_floor=noise_floor(self.dome, self.intensity, surfels),
            shot_noise=shot_noise(self.dome, self.intensity, surfels),
            photographs=photographs,
            calibration=calibration,
            noise=sample_noise(self.dome, self.views.pixels, pixels),
        )

    def _sample(self, j: int, c: int) -> None:
        light = self.dome.lights[j]
        merger = self.mergers[self.dome.cameras[c].id]
        shot = self.shots[c]
        check = self.check if self.check and (j, c) in self.check.pairs else None
        digests: Digests = {}
        frames = checked_view(self.dome, light.id, merger, digests=digests)
        surfels = shot.surfels & self.views.lit[:, j]
        is_kept = (j, c) in self.kept
        merged = _merged(
            merger, frames, shot, surfels, whole=is_kept or check is not None
        )
        radiance, flag, _ = merged
        if is_kept:
            _lose_saturated(radiance, flag)
            self.spool.keep(f"photograph-{j}-{c}", radiance)
        if check is not None:
            _lose_saturated(radiance, flag)
            self.spool.keep(f"calibration-{j}-{c}", check.reduce(c, radiance))
        samples, outcome = self._gathered(merged, shot, surfels, j)
        count, lit, median, bright = view_levels(samples, outcome, MAX_SAMPLE)
        levels = self.levels
        if count >= MIN_MEDIAN_SAMPLES:
            require(
                # samples of a strong light may be zero in half precision alone
                lit or bool((radiance[flag == OK] > 0).any()),
                f"{self.dome.file}[frames], camera {merger.camera.id}, light {light.id}",
                "a frame must be bright where its light reaches the face",
                f"none at {count} surfels",
                "copy the frame from the camera again",
            )
            levels.median[j, c] = median
            levels.bright[j, c] = bright
        levels.highest[j, c], levels.clipped[j, c] = highest_value(merger, frames)
        names = {str(path): digest for path, digest in digests.items()}
        self.spool.put(j, c, samples, outcome, names)

    def _gathered(
        self, merged: MergedView, shot: CameraSampling, surfels: Mask, j: int
    ) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        """Bits of the samples (3, n) of a view, and outcome (n,) for each surfel."""
        views = self.views
        light = self.dome.lights[j]
        out = np.empty((3, len(surfels)), np.uint16)
        outcome = np.empty(len(surfels), np.uint8)
        light_fraction = np.zeros(0, np.float32)
        if views.light_fraction is not None:
            light_fraction = views.light_fraction[:, j].astype(np.float32)
        gather(
            merged,
            surfels,
            light_fraction,
            shot.pixels,
            shot.spread,
            views.surfels.position,
            views.surfels.normal,
            PointLight(
                light.position, light.axis, float(light.falloff), self.intensity[j]
            ),
            out,
            outcome,
        )
        return out, outcome


def checked_pictures(
    check: CalibrationCheck,
    pairs: Collection[Pair],
    mergers: Mapping[str, FrameMerger],
    *,
    pool: Executor,
) -> dict[Pair, NDArray[np.float32]]:
    """The downsampled photographs of these views, before anything is sampled.

    Raises
    ------
    InputError
        With every frame that cannot be decoded or that cannot be a photograph.
    """
    dome = check.dome
    faults = list[Fault]()

    def picture(pair: Pair) -> NDArray[np.float32]:
        j, c = pair
        merger = mergers[dome.cameras[c].id]
        frames = checked_view(dome, dome.lights[j].id, merger)
        radiance, flag = merger.merge(frames)
        _lose_saturated(radiance, flag)
        return check.reduce(c, radiance)

    ordered = sorted(pairs)
    call = partial(attempt, faults)
    pictures = list(_in_turn(pool, lambda pair: call(partial(picture, pair)), ordered))
    if faults:
        raise InputError(faults)
    return {
        pair: image
        for pair, image in zip(ordered, pictures, strict=True)
        if image is not None
    }


def _lose_saturated(radiance: Image, flag: NDArray[np.uint8]) -> None:
    """Set saturated pixels to NaN."""
    radiance[flag == SATURATED] = np.nan


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
    arm = np.cross(surfels.normal, helper)
    length = np.maximum(np.linalg.norm(arm, axis=1), 1e-30)
    arm *= (surfels.radius / 2 / length)[:, None]
    spread = np.zeros((len(arm), 3))
    for half in (arm, np.cross(surfels.normal, arm)):
        ahead = camera.project(surfels.position + half)
        behind = camera.project(surfels.position - half)
        x, y = ((ahead - behind) / 2).T
        spread += np.stack([x * x, x * y, y * y], axis=1)
    spread[spread[:, [0, 2]].max(axis=1) < MIN_SPLAT_VARIANCE_PX2] = np.nan
    pixel = np.array([PIXEL_VARIANCE_PX2, 0, PIXEL_VARIANCE_PX2])
    return np.asarray(spread + pixel, np.float32)


def _camera_sampling(views: Views, camera: CameraRecord, c: int) -> CameraSampling:
    surfels = views.clear[:, c] & _frontal(camera, views.surfels)
    spread = np.zeros((0, 3), np.float32)
    if views.footprint:
        spread = footprints(views.surfels, camera)
        wide = spread[:, [0, 2]].max(axis=1) > MAX_CLEAR_FOOTPRINT_PX**2
        surfels &= ~(wide & grown(views.surfels.faces, ~views.clear[:, c]))
    return CameraSampling(surfels, np.ascontiguousarray(views.pixels[:, c]), spread)


def _effective_pixels(
    dome: DomeRecord, shots: Sequence[CameraSampling]
) -> NDArray[np.float32]:
    """Effective number of pixels (n, camera) that a sample averages; NaN where a camera
    takes no sample.
    """
    out = np.empty((len(shots), len(shots[0].surfels)), np.float32)
    for camera, shot, row in zip(dome.cameras, shots, out, strict=True):
        pixel_counts(
            shot.surfels, shot.pixels, shot.spread, camera.height, camera.width, row
        )
    return np.ascontiguousarray(out.T)


def _merged(
    merger: FrameMerger,
    frames: list[Frame],
    shot: CameraSampling,
    surfels: Mask,
    *,
    whole: bool,
) -> MergedView:
    """Radiance, flags and usable exposures of a view, or of the pixels that surfels need."""
    height, width, _ = frames[0].shape
    spans = None
    if not whole:
        spans = pixel_spans(surfels, shot.pixels, shot.spread, height, width)
    usable = np.zeros((height, width), np.uint8)
    radiance, flag = merger.merge(frames, spans, usable=usable)
    return MergedView(radiance, flag, usable)


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


def noise_floor(dome: DomeRecord, intensity: Float64, surfels: SurfelSet) -> float:
    """Reflectance [sr^-1] of one sigma of read noise and quantisation, at the median
    light and distance.
    """
    floors = [radiance_floor(camera.sensor, dome.exposures) for camera in dome.cameras]
    per_radiance = _reflectance_per_radiance(dome, intensity, surfels)
    return float(np.median(floors)) * per_radiance or LINEAR_NOISE_FLOOR


def shot_noise(dome: DomeRecord, intensity: Float64, surfels: SurfelSet) -> float:
    """Variance by photons over reflectance [sr^-1], at the median light and distance; 0
    if electrons are not known.

    For radiance L, the sensor counts L times the sum of the exposure times times the
    electrons of full exposure: the variance of merged radiance is L over this number
    per unit of radiance.
    """
    sensors = [camera.sensor for camera in dome.cameras]
    if not all(sensor.noise_known for sensor in sensors):
        return 0.0
    electrons = float(np.median([sensor.full_electrons for sensor in sensors]))
    per_second = 1 / (electrons * sum(dome.exposures.values()))
    per_radiance = _reflectance_per_radiance(dome, intensity, surfels)
    return BILINEAR_NOISE * per_second * per_radiance


def _reflectance_per_radiance(
    dome: DomeRecord, intensity: Float64, surfels: SurfelSet
) -> float:
    """Reflectance per radiance at the median light and distance."""
    middle = surfels.position.mean(axis=0)[None]
    square = np.array([light_falloff(light, middle)[0][0] for light in dome.lights])
    return float(np.median(square[:, None] / intensity))


def choose_photographs(dome: DomeRecord, middle: Float64, count: int) -> list[Pair]:
    """(light, camera) pairs of lights that are spread evenly in front of the face, with
    the most frontal camera.
    """
    if count < 1:
        return []

    def directions(positions: list[Float64]) -> Float64:
        way = np.array(positions) - middle
        return np.asarray(way / np.linalg.norm(way, axis=1, keepdims=True))

    camera = directions([camera.centre for camera in dome.cameras])[:, 2].argmax()
    direction = directions([light.position for light in dome.lights])
    front = np.flatnonzero(direction[:, 2] > 0.5)
    if len(front) < count:
        front = np.argsort(-direction[:, 2])[:count]
    # farthest-point sampling: each next light is the one farthest from all chosen lights
    chosen = [int(front[direction[front, 2].argmax()])]
    while len(chosen) < min(count, len(front)):
        nearest = (direction[front] @ direction[chosen].T).max(axis=1)
        chosen.append(int(front[nearest.argmin()]))
    return [(light, int(camera)) for light in sorted(chosen)]


def _frontal(camera: CameraRecord, surfels: SurfelSet) -> Mask:
    """Where (n,) a view is steep enough for a pixel to cover little of the surface."""
    way = camera.centre - surfels.position
    cosine = np.einsum("ni,ni->n", way, surfels.normal) / np.linalg.norm(way, axis=1)
    width = camera.pixel_width(surfels.position.mean(axis=0))
    return np.asarray(cosine >= max(MIN_COSINE_CAMERA, width / MAX_SMEAR_MM))


@dataclass(frozen=True)
class SampleNoise:
    """Noise model of the samples; exposures are ordered from the longest to the shortest.

    Radiance up to `limit` is below the white level in an exposure and in all shorter
    ones. The radiance of a pixel that is merged from them has the variance
    read_variance + shot_variance * radiance, and a sample has that variance over its
    effective pixels.
    """

    limit: Float64  # (camera, 3, exposure) radiance
    read_variance: Float64  # (camera, 3, exposure) radiance^2
    shot_variance: Float64  # (camera, 3, exposure) radiance
    # (n, camera); NaN where the camera takes no sample
    effective_pixels: NDArray[np.float32]


def sample_noise(
    dome: DomeRecord, pixels: NDArray[np.float32], effective_pixels: NDArray[np.float32]
) -> SampleNoise | None:
    """The noise of all samples from the sensors' electrons; None if those of a camera are unknown.

    Parameters
    ----------
    dome
        Cameras and exposures.
    pixels
        (n, camera, 2) projections of the surfels.
    effective_pixels
        (n, camera) from `pixel_counts`; NaN where no sample is taken.
    """
    if not all(camera.sensor.noise_known for camera in dome.cameras):
        return None
    seconds = np.sort(np.fromiter(dome.exposures.values(), float))[::-1]
    parts = []
    for c, camera in enumerate(dome.cameras):
        seen = np.isfinite(effective_pixels[:, c])
        parts.append(
            radiance_noise(camera, seconds, _mean_gain(camera, pixels[seen, c]))
        )
    limit, read, shot = (np.stack(part) for part in zip(*parts, strict=True))
    return SampleNoise(limit, read, shot, effective_pixels)


def _mean_gain(camera: CameraRecord, pixels: NDArray[np.float32]) -> float:
    """Mean vignette at projections (n, 2)."""
    if not camera.vignette.any() or not len(pixels):
        return 1.0
    column = np.clip(pixels[:, 0].astype(int), 0, camera.width - 1)
    row = np.clip(pixels[:, 1].astype(int), 0, camera.height - 1)
    return float(vignette_gain(camera)[row, column, 0].mean())
