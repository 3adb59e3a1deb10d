"""Samples of every surfel under every light in every camera (Weyrich et al. 2005, eq. 3)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, wait
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

import numpy as np

from skindb.calibration._merge_kernels import OK, SATURATED
from skindb.calibration.frame_checks import highest_value, view_faults
from skindb.calibration.irradiance import light_falloff
from skindb.calibration.radiance import (
    FrameMerger,
    Image,
    radiance_floor,
    radiance_noise,
    read_view,
    vignette_gain,
)
from skindb.errors import Fault, InputError, attempt, require, require_none
from skindb.format.dome import CameraRecord, DomeRecord
from skindb.format.frames import Digests
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
from skindb.ingest.detail import CameraSampling, Detail
from skindb.ingest.faults import (
    MAX_SAMPLE,
    MIN_MEDIAN_SAMPLES,
    calibration_faults,
)
from skindb.ingest.spool import Spool
from skindb.ingest.surfels import SurfelSet
from skindb.types import (
    Bytes,
    Float32,
    Float64,
    Half,
    Index,
    Index32,
    Mask,
    Progress,
    Values16,
    silent,
    unit,
)

T = TypeVar("T")
R = TypeVar("R")
# views that are requested ahead of the one that is waited for: keeps eight threads busy
MAX_PENDING_VIEWS = 24
# visible fraction of a light's disc below which a surfel is in the penumbra
MIN_LIT_FRACTION = 0.999
MIN_COSINE_CAMERA = 0.1  # between the normal and the direction to the camera
# mm of surface covered by one pixel; beyond it, samples were measured 20 % too bright
MAX_SMEAR_MM = 12.0
LINEAR_NOISE_FLOOR = 1e-4  # sr^-1; for linear files, whose noise is unknown


@dataclass(frozen=True)
class ViewLevels:
    """Levels of each view (light, camera); NaN, or nothing to report, for views of an
    earlier run.
    """

    median: Float64  # sr^-1 of its samples; NaN for few samples
    bright: Float64  # fraction of its samples that are too large for a surface
    highest: Float64  # value of the longest exposure
    clipped: Mask  # whether the picture is cut off at its highest value


@dataclass(frozen=True)
class Lumitexels:
    """Samples, and the outcomes for all visible pairs of light and camera."""

    sample: Any  # (n, light, camera, 3) float16 sr^-1; lazy
    # (3, n) usable, saturated and dark
    counts: Index32
    view_count: Index  # (light, camera) samples of each view
    views: ViewLevels
    noise_floor: float  # sr^-1
    photographs: Mapping[tuple[int, int], Image]
    calibration: Calibration | None = None  # None: not checked
    noise: SampleNoise | None = None  # None: the electrons of a camera are unknown
    detail: Detail | None = None  # None: the photographs are not finer than the surfels


def fully_lit(
    surfels: SurfelSet,
    light_fraction: Half,
    cameras: Sequence[CameraRecord],
) -> Mask:
    """Where (n, light) the entire disc is visible from a surfel and from all neighbours
    that a pixel may cover.

    Pixels beside a shadow include a part of it: samples were measured 14 % too dark in
    the first ring of neighbours.
    """
    middle = surfels.position.mean(axis=0)
    pixel = max(camera.pixel_width(middle) for camera in cameras)
    rings = max(int(np.ceil(pixel / surfels.spacing())), 1)
    # the columns of lights are used one by one
    lit = np.empty_like(light_fraction, bool, order="F")
    for j in range(lit.shape[1]):
        shadow = light_fraction[:, j] < MIN_LIT_FRACTION
        for _ in range(rings):
            shadow = grown(surfels.faces, shadow)
        lit[:, j] = ~shadow
    return lit


@dataclass
class Sampler:
    """Decodes, merges and samples views, each once, into a spool.

    Parameters
    ----------
    check
        Cameras, lights and frames; what the lights reach and the cameras see.
    lit
        (n, light) surfels that get samples, see `fully_lit`.
    mergers
        Frame merger of every camera, by id.
    spool
        Receives the samples rho = L d^2 / (I falloff).
    pool, progress
        Threads that decode; callback with the stage, the number of views done, and
        their total number.
    kept
        (light, camera) pairs whose merged radiance is kept.
    faults
        Receives the faults of the views.
    """

    check: CalibrationCheck
    lit: Mask
    mergers: Mapping[str, FrameMerger]
    spool: Spool
    pool: Executor
    progress: Progress = silent
    kept: Collection[Pair] = ()
    faults: list[Fault] = field(default_factory=list)

    def __post_init__(self) -> None:
        unknown = np.full((2, *self.spool.done.shape), np.nan)
        none = np.zeros(self.spool.done.shape)
        self._levels = ViewLevels(unknown[0], none, unknown[1], none > 0)
        self._sampled = self.spool.done.copy()  # or found to be faulty
        surfels = self.check.surfels
        self._detail = Detail.of(surfels, self.check.dome.cameras)
        frontal = self.pool.map(
            lambda camera: _frontal(camera, surfels), self.check.dome.cameras
        )
        self._shots = [
            CameraSampling(clear & steep, np.ascontiguousarray(pixels))
            for clear, pixels, steep in zip(
                self.check.clear.T,
                self.check.pixels.transpose(1, 0, 2),
                frontal,
                strict=True,
            )
        ]

    def pictures(self, pairs: Collection[Pair]) -> dict[Pair, Float32]:
        """Downsampled photographs of these views, which are sampled unless they are in
        the spool.
        """
        kept = self._kept(pairs, self._picture_name)
        missing = frozenset(pairs) - kept.keys()
        self._sample(missing, pictures=True)
        return kept | self._kept(missing, self._picture_name)

    def _kept(
        self, pairs: Iterable[Pair], name: Callable[[Pair], str]
    ) -> dict[Pair, Image]:
        pictures = self.spool.pictures
        return {pair: pictures[name(pair)] for pair in pairs if name(pair) in pictures}

    def _picture_name(self, pair: Pair) -> str:
        j, c = pair
        return f"picture-{j}-{c}-{self.check.factor(c)}"

    def lumitexels(self, *, check: bool = True, refuse: bool = True) -> Lumitexels:
        """The samples and counts of all views.

        Parameters
        ----------
        check
            Whether the calibration is checked.
        refuse
            Whether a calibration that the photographs contradict is an error.

        Raises
        ------
        InputError
            With every frame that cannot be decoded, or for dark frames or a calibration
            that the photographs contradict.
        """
        calibration = None
        contradictions = []
        pictures = self.pictures(self.check.pairs if check else ())
        if check and not self.faults:
            calibration = self.check.evaluate(pictures)
        if calibration is not None and refuse:
            contradictions = calibration_faults(self.check.dome, calibration)
        # otherwise hours of sampling would end with the same faults
        if not contradictions:
            self._sample(np.ndindex(self._sampled.shape))
        if self.faults or contradictions:
            raise InputError(self.faults + contradictions)
        return self._lumitexels(calibration)

    def _sample(self, pairs: Iterable[Pair], *, pictures: bool = False) -> None:
        """Sample those of the views that are not sampled; optionally keep their
        downsampled photographs.
        """
        missing = sorted((j, c) for j, c in pairs if not self._sampled[j, c])
        call = partial(attempt, self.faults)
        sample = partial(self._sample_view, picture=pictures)
        ended = _in_turn(self.pool, lambda pair: call(partial(sample, *pair)), missing)
        for pair, texels in zip(missing, ended, strict=True):
            self._sampled[pair] = True
            # in order, as sums depend on it
            if texels is not None and self._detail is not None:
                j, c = pair
                dome = self.check.dome
                places = dome.lights[j].position, dome.cameras[c].centre
                self._detail.add(*texels, j, *places)
            self.progress("sample", int(self._sampled.sum()), self._sampled.size)

    def _lumitexels(self, calibration: Calibration | None) -> Lumitexels:
        check = self.check
        pixels = np.empty((len(self._shots), len(self.lit)), np.float32)
        for camera, shot, row in zip(
            check.dome.cameras, self._shots, pixels, strict=True
        ):
            pixel_counts(*shot, camera.height, camera.width, row)
        return Lumitexels(
            sample=self.spool.samples(),
            counts=self.spool.counts,
            view_count=self.spool.views,
            views=self._levels,
            noise_floor=noise_floor(check.dome, check.intensity, check.surfels),
            photographs=self._kept(self.kept, _photograph_name),
            calibration=calibration,
            noise=sample_noise(check.dome, check.pixels, pixels.T),
            detail=self._detail,
        )

    def _sample_view(
        self, j: int, c: int, *, picture: bool
    ) -> tuple[Values16, Bytes] | None:
        """Sample a view for the spool; the samples and outcomes of the points of the detail,
        unless the photograph is kept to judge them.
        """
        dome = self.check.dome
        light = dome.lights[j]
        merger = self.mergers[dome.cameras[c].id]
        shot = self._shots[c]
        digests: Digests = {}
        frames = read_view(dome, light.id, merger.camera, digests=digests)
        require_none(view_faults(dome, light.id, merger, frames))
        surfels = shot.surfels & self.lit[:, j]
        fine = None
        if self._detail is not None and (j, c) not in self.kept:
            fine = self._detail.shot(surfels, c)
        whole = picture or (j, c) in self.kept
        height, width, _ = frames[0].shape
        spans = None
        if not whole:
            shown = shot._replace(surfels=surfels) if fine is None else fine
            spans = pixel_spans(*shown, height, width)
        radiance, flag = merger.merge(frames, spans)
        merged = MergedView(radiance, flag)
        if whole:
            radiance[flag == SATURATED] = np.nan
        if picture:
            name = self._picture_name((j, c))
            self.spool.pictures[name] = self.check.reduce(c, radiance)
        if (j, c) in self.kept:
            self.spool.pictures[_photograph_name((j, c))] = radiance
        samples, outcome = self._gathered(
            merged, shot._replace(surfels=surfels), self.check.surfels, j
        )
        count, lit, median, bright = view_levels(samples, outcome, MAX_SAMPLE)
        levels = self._levels
        if count >= MIN_MEDIAN_SAMPLES:
            require(
                # samples of a strong light may be zero in half precision alone
                lit or bool((radiance[flag == OK] > 0).any()),
                f"{dome.file}[frames], camera {merger.camera.id}, light {light.id}",
                "a frame must be bright where its light reaches the face",
                f"none at {count} surfels",
                "copy the frame from the camera again",
            )
            levels.median[j, c] = median
            levels.bright[j, c] = bright
        levels.highest[j, c], levels.clipped[j, c] = highest_value(merger, frames)
        self.spool.put(j, c, samples, outcome, digests)
        if fine is None or self._detail is None:
            return None
        return self._gathered(merged, fine, self._detail, j)

    def _gathered(
        self,
        merged: MergedView,
        shot: CameraSampling,
        points: SurfelSet | Detail,
        j: int,
    ) -> tuple[Values16, Bytes]:
        """Bits of the samples (3, n) of a view, and outcome (n,) for each point."""
        check = self.check
        light = check.dome.lights[j]
        out = np.empty((3, len(shot.pixels)), np.uint16)
        outcome = np.empty(len(shot.pixels), np.uint8)
        gather(
            merged,
            shot.surfels,
            shot.pixels,
            points.position,
            points.normal,
            PointLight(
                light.position, light.axis, float(light.falloff), check.intensity[j]
            ),
            out,
            outcome,
        )
        return out, outcome


def _photograph_name(pair: Pair) -> str:
    return "photograph-{}-{}".format(*pair)


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
    middle = surfels.position.mean(axis=0)[None]
    square = np.array([light_falloff(light, middle)[0][0] for light in dome.lights])
    per_radiance = float(np.median(square[:, None] / intensity))
    return float(np.median(floors)) * per_radiance or LINEAR_NOISE_FLOOR


def choose_photographs(dome: DomeRecord, middle: Float64, count: int) -> list[Pair]:
    """(light, camera) pairs of lights that are spread evenly in front of the face, with
    the most frontal camera.
    """
    if count < 1:
        return []
    centres = np.array([camera.centre for camera in dome.cameras])
    places = np.array([light.position for light in dome.lights])
    camera = int(unit(centres - middle)[:, 2].argmax())
    direction = unit(places - middle)
    front = np.flatnonzero(direction[:, 2] > 0.5)
    if len(front) < count:
        front = np.argsort(-direction[:, 2])[:count]
    # farthest-point sampling: each next light is the one farthest from all chosen lights
    chosen = [int(front[direction[front, 2].argmax()])]
    while len(chosen) < min(count, len(front)):
        nearest = (direction[front] @ direction[chosen].T).max(axis=1)
        chosen.append(int(front[nearest.argmin()]))
    return [(light, camera) for light in sorted(chosen)]


def _frontal(camera: CameraRecord, surfels: SurfelSet) -> Mask:
    """Where (n,) a view is steep enough for a pixel to cover little of the surface."""
    cosine = surfels.cosine(camera)
    width = camera.pixel_width(surfels.position.mean(axis=0))
    return cosine >= max(MIN_COSINE_CAMERA, width / MAX_SMEAR_MM)


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
    effective_pixels: Float32


def sample_noise(
    dome: DomeRecord, pixels: Float32, effective_pixels: Float32
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
        seen = pixels[np.isfinite(effective_pixels[:, c]), c]
        gain = 1.0
        if camera.vignette.any() and len(seen):
            size = (camera.width, camera.height)
            column, row = np.clip(seen.astype(int), 0, np.array(size) - 1).T
            gain = float(vignette_gain(camera)[row, column, 0].mean())
        parts.append(radiance_noise(camera, seconds, gain))
    limit, read, shot = (np.stack(part) for part in zip(*parts, strict=True))
    return SampleNoise(limit, read, shot, effective_pixels)
