"""Monte Carlo rendering with the variance of every pixel (Weyrich et al. 2005, eq. 1 to
4, 8 and 9), and its random numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.geometry.rays import RayScene
from skindb.reflectance.model import Lamp, Points
from skindb.reflectance.sampling import TableSampler
from skindb.render.scene import Camera, Environment, Lighting, Lights, Surface
from skindb.render.shading import (
    View,
    bounced_exitance,
    escape_factor,
    points_on_discs,
    seen_points,
    trace_view,
)
from skindb.render.subsurface import (
    FAR,
    MIN_PASSES,
    SAMPLES_PER_PASS,
    Image,
    RunningMean,
    received_irradiance,
    subsurface_light,
)
from skindb.types import Array, Index, Mask, Progress, dots, float64, lengths, silent

# rays per pixel and axis in one batch; random numbers are stratified over the rays of a
# pixel. Environments need more
RAYS_PER_AXIS = 2
RAYS_PER_AXIS_ENVIRONMENT = 4
# for an estimate of the variance that can be compared with the target error
MIN_BATCHES = 4
MAX_RAYS = 2_000_000  # that are shaded together, with 500 bytes each
LIGHTS_PER_RAY = 4  # lights drawn for each ray; with fewer lights, all are used
CELLS = 16  # of normals along each axis
# in probabilities, because normals of a cell differ by up to 0.1, and for the discs of
# lights
MIN_COSINE = 0.02


@dataclass(frozen=True)
class Quality:
    """Number of rays of a picture, and the light that it includes.

    `samples` is the number of rays per pixel, at least eight. With `error`, rendering
    ends earlier, as soon as the relative standard error (root of the mean variance over
    the root mean square of the visible surface) is at most this value.
    `tolerance` is the opening of the octree for subsurface light.
    """

    samples: int = 64
    error: float | None = None
    subsurface: bool = False
    terms: tuple[str, ...] = ("diffuse", "surface")
    tolerance: float = 0.1


@dataclass(frozen=True)
class Rendering:
    """Mean radiance (h, w, 3) of the batches, the variance of that mean, and the
    fraction of rays that hit (h, w).
    """

    radiance: Image
    variance: Image
    coverage: Image
    samples: int
    relative_error: float
    seconds: float


def render_monte_carlo(
    surface: Surface,
    camera: Camera,
    lighting: Lighting,
    quality: Quality,
    *,
    rng: np.random.Generator,
    scene: RayScene | None = None,
    pixels: Mask | None = None,
    progress: Progress = silent,
) -> Rendering:
    """Render a surface as the mean of independent batches of rays.

    Light that parts of the face send to each other is added if the surface asks for it.

    Parameters
    ----------
    surface, camera, lighting
        The surface, the camera that sees it, and the light.
    quality
        Number of rays or target error, and the terms to include.
    rng
        Random generator.
    scene
        Ray tracer of this surface, if already built.
    pixels
        (h, w) pixels that may show the surface; default all.
    progress
        Called after every pass of light under the skin and every batch of rays with the
        stage, and the passes, or rays per pixel, that are done and that there are at most.

    Returns
    -------
    Rendering
        Radiance in the unit of the lights' intensity per mm2, or in that of the environment.
    """
    rays = RayScene(surface.vertices, surface.faces) if scene is None else scene
    sums = RunningMean()
    painter = _Painter.of(surface, rays, lighting, quality, rng)
    parts = partial(_parts, surface, camera, rays, pixels)
    if quality.subsurface and "diffuse" in quality.terms:
        centres = partial(parts, RAYS_PER_AXIS)
        painter, sums.more = painter.with_subsurface_light(centres, rng, progress)
    axis = RAYS_PER_AXIS
    enough = quality.samples >= 2 * RAYS_PER_AXIS_ENVIRONMENT**2
    if lighting.environment is not None and enough:
        axis = RAYS_PER_AXIS_ENVIRONMENT
    per_batch = axis**2
    # at least two batches, for the variance
    limit = max(quality.samples, 2 * per_batch)
    while sums.count * per_batch < limit and (
        quality.error is None
        or sums.count < MIN_BATCHES
        or sums.relative_error() > quality.error
    ):
        images = [
            (painter.batch(view, rng), view.coverage) for view in parts(axis, rng)
        ]
        sums.add(*map(np.concatenate, zip(*images, strict=True)))
        progress("render", min(sums.count * per_batch, limit), limit)
    return Rendering(
        np.asarray(sums.mean, np.float32),
        np.asarray(sums.variance(), np.float32),
        np.asarray(sums.coverage, np.float32),
        sums.count * per_batch,
        sums.relative_error(),
        perf_counter() - sums.started,
    )


def _parts(
    surface: Surface,
    camera: Camera,
    scene: RayScene,
    pixels: Mask | None,
    samples: int,
    rng: np.random.Generator | None = None,
) -> Iterator[View]:
    """Views of as many rows of the picture as memory allows, from top to bottom."""
    step = max(MAX_RAYS // (camera.width * samples**2), 1)
    for low in range(0, camera.height, step):
        high = min(low + step, camera.height)
        yield trace_view(
            surface,
            camera.rows(low, high),
            samples=samples,
            scene=scene,
            rng=rng,
            pixels=None if pixels is None else pixels[low:high],
        )


@dataclass(frozen=True)
class _Painter:
    """Shades one batch of hits."""

    surface: Surface
    scene: RayScene
    lighting: Lighting
    quality: Quality
    lobes: TableSampler
    weights: Array  # (v, k) of the lobes
    choice: LightChoice | None  # None without lights
    # (v, 3) under the boundary, which is interpolated: subsurface light and `bounced_exitance`
    exitance: Array | None

    @classmethod
    def of(
        cls,
        surface: Surface,
        scene: RayScene,
        lighting: Lighting,
        quality: Quality,
        rng: np.random.Generator,
    ) -> _Painter:
        lights = lighting.lights
        choice = None
        if lights is not None and len(lights):
            middle = surface.vertices.mean(axis=0)
            choice = LightChoice.of_lights(lights, middle)
        bounced = None
        if surface.inter_reflection and "diffuse" in quality.terms:
            received = received_irradiance(
                surface.vertices,
                surface.normals,
                lighting,
                scene,
                eta=surface.eta,
                rng=rng,
            )
            bounced = bounced_exitance(surface, received)
        tables, weights = surface.model.resample(surface.parameters)
        lobes = TableSampler.of_tables(tables)
        return cls(surface, scene, lighting, quality, lobes, weights, choice, bounced)

    def with_subsurface_light(
        self,
        views: Callable[[], Iterator[View]],
        rng: np.random.Generator,
        progress: Progress,
    ) -> tuple[_Painter, Image]:
        """A painter with subsurface light where the views show the surface, and the variance
        (h, w, 3) that it adds to the picture.
        """
        error = self.quality.error
        count = MIN_PASSES
        if error is None:
            count = max(count, self.quality.samples // SAMPLES_PER_PASS)
        light, spread = subsurface_light(
            self.surface,
            self.lighting,
            self.scene,
            np.any(
                [view.shown(len(self.surface.vertices)) for view in views()], axis=0
            ),
            tolerance=self.quality.tolerance,
            count=count,
            error=np.inf if error is None else error / 2,
            rng=rng,
            progress=progress,
        )
        if self.exitance is not None:
            light = light + self.exitance
        # errors of neighbours go together, so that the mean over a pixel does not reduce them
        images = [
            view.image(escape_factor(view, self.surface.eta) * view.interpolate(spread))
            for view in views()
        ]
        return replace(self, exitance=light), np.square(np.concatenate(images))

    def batch(self, view: View, rng: np.random.Generator) -> Image:
        """One independent estimate of the picture (h, w, 3)."""
        surface = self.surface
        terms = self.quality.terms
        values = np.zeros((len(view.pixel), 3))
        local = float("diffuse" in terms and not self.quality.subsurface)
        diffuse = view.interpolate(surface.diffuse) * local
        with_surface = "surface" in terms
        points = seen_points(view, surface, diffuse, with_surface=with_surface)
        hits = _Hits(view, points, surface)
        if self.choice is not None:
            values += self._by_lights(hits, self.choice, rng)
        if self.lighting.environment is not None:
            values += self._by_environment(hits, self.lighting.environment, rng)
        if self.exitance is not None:
            values += escape_factor(view, surface.eta) * view.interpolate(self.exitance)
        return view.image(values)

    def _by_lights(
        self, hits: _Hits, choice: LightChoice, rng: np.random.Generator
    ) -> Array:
        """Radiance (n, 3) from a few lights per hit, which are drawn in proportion to
        the power that arrives there.
        """
        view = hits.view
        surface = self.surface
        lights = choice.lights
        values = np.zeros((len(view.pixel), 3))
        for chosen, weight in choice.draw(view, rng):
            points = points_on_discs(lights, chosen, rng)
            above = dots(points - view.position, view.normal) > 0
            rows = np.flatnonzero(above)
            hidden = self.scene.occluded(
                view.position[rows], points[rows], normal=view.normal[rows]
            )
            rows = rows[~hidden]
            # tables that are averaged over the disc are evaluated at its centre; the
            # shadow is that of the point
            disc_included = surface.model.disc_included
            lamp = lights.position[chosen] if disc_included else points
            for light in np.unique(chosen[rows]):
                lit = rows[chosen[rows] == light]
                shaded = hits.shade(
                    lit,
                    lamp[lit],
                    weight[lit],
                    lights.axis[light],
                    lights.falloff[light],
                )
                values[lit] += shaded * lights.intensity[light]
        return values

    def _by_environment(
        self, hits: _Hits, environment: Environment, rng: np.random.Generator
    ) -> Array:
        """Radiance (n, 3) from the environment: one direction drawn by luminance, one
        by the BRDF (Veach 1997).
        """
        view = hits.view
        values = np.zeros((len(view.pixel), 3))
        weights = hits.points.parameters
        if weights.shape[1] > 0:
            weights = view.interpolate(self.weights)
        mix = self.lobes.mix(weights)
        lobe = np.concatenate(
            [stratified(view, rng)[:, :1], stratified(view, rng)], axis=1
        )
        drawn = (
            environment.sample(stratified(view, rng)),
            self.lobes.sample(mix, view.normal, view.towards, lobe),
        )
        for sampler, towards in enumerate(drawn):
            above = np.flatnonzero(dots(towards, view.normal) > 0)
            target = view.position[above] + FAR * towards[above]
            rows = above[
                ~self.scene.occluded(
                    view.position[above], target, normal=view.normal[above]
                )
            ]
            by_light = environment.pdf(towards[rows])
            by_lobe = self.lobes.pdf(
                mix[rows], view.normal[rows], view.towards[rows], towards[rows]
            )
            density = (by_light, by_lobe)[sampler]
            # power heuristic, divided by the density with which the direction was drawn
            weight = np.where(
                density > 0, density / np.maximum(by_light**2 + by_lobe**2, 1e-300), 0.0
            )
            shaded = hits.shade(rows, view.position[rows] + towards[rows], weight)
            values[rows] += shaded * environment.along(towards[rows])
        return values


@dataclass(frozen=True)
class _Hits:
    """Hits and their reflectance."""

    view: View
    points: Points
    surface: Surface

    def shade(
        self,
        rows: Index,
        lamp: Array,
        weight: Array,
        axis: Any = (0.0, 0.0, 1.0),
        falloff: Any = 0.0,
    ) -> Array:
        """Radiance (m, 3) of chosen hits, each under a point light (m, 3) of its own
        with intensity `weight` (m,).
        """
        points = Points(*(values[rows] for values in self.points))
        lit = np.ones((len(rows), 1), np.float32)
        light = Lamp(lamp[:, None], lit, float64(axis), float(falloff))
        shaded = self.surface.model.shade(points, light, eta=self.surface.eta)
        return shaded * float64(weight)[:, None]


@dataclass(frozen=True)
class LightChoice:
    """Probabilities of lights for each cell of normals: the power that arrives on a
    surface with the cell's normal.

    Lights below the horizon of a place are therefore rarely drawn there, and never have
    a probability of zero.
    """

    lights: Lights
    probability: Array  # (cells, l)
    # (cells * l,) cumulative probability within a cell, plus the index of the cell
    rising: Array

    @classmethod
    def of_lights(cls, lights: Lights, centre: Array) -> LightChoice:
        """Probabilities for surfaces near `centre` (3,) [mm]."""
        towards = lights.position - centre
        distance = lengths(towards)
        axis = (np.arange(CELLS) + 0.5) * 2 / CELLS - 1
        normal = np.stack(
            np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1
        ).reshape(-1, 3)
        cosine = normal @ (towards / distance[:, None]).T / lengths(normal)[..., None]
        power = (
            lights.intensity.sum(axis=1)
            / distance**2
            * (np.maximum(cosine, 0) + MIN_COSINE)
        )
        power[:, :] += power.sum() == 0  # lights that are all off
        probability = power / power.sum(axis=1, keepdims=True)
        rising = np.cumsum(probability, axis=1)
        rising /= rising[:, -1:]
        return cls(
            lights,
            probability,
            np.ravel(rising + np.arange(float(len(rising)))[:, None]),
        )

    def draw(self, view: View, rng: np.random.Generator) -> list[tuple[Index, Array]]:
        """Indices (n,) and inverse probabilities (n,) of the lights of each hit;
        LIGHTS_PER_RAY such pairs.
        """
        n = len(view.pixel)
        count = self.probability.shape[1]
        if count <= LIGHTS_PER_RAY:
            return [(np.full(n, i), np.ones(n)) for i in range(count)]
        x, y, z = np.clip((view.normal.T + 1) * (CELLS / 2), 0, CELLS - 1).astype(
            np.int64
        )
        cell = (x * CELLS + y) * CELLS + z
        # one offset for the lights of a hit, which spreads them over the sum
        start = stratified(view, rng)[:, 0]
        drawn = []
        for i in range(LIGHTS_PER_RAY):
            place = cell + (start + i) / LIGHTS_PER_RAY
            light = np.clip(
                np.searchsorted(self.rising, place, side="right") - cell * count,
                0,
                count - 1,
            )
            drawn.append((light, 1 / (LIGHTS_PER_RAY * self.probability[cell, light])))
        return drawn


def stratified(view: View, rng: np.random.Generator) -> Array:
    """Uniform numbers (n, 2), stratified over the rays of each pixel: in cells of the
    square, and in rows and columns of as many as there are rays (Chiu et al. 1994).
    """
    side = view.samples
    which, row = np.unique(view.pixel, return_inverse=True)
    shape = (len(which), side, side)
    order = _shuffled((len(which), side**2), rng)[row, view.ray]
    across, down = np.divmod(order, side)
    # within the cells, each row and column of which gets one ray
    columns = across * side + _shuffled(shape, rng)[row, across, down]
    rows = down * side + _shuffled(shape, rng)[row, down, across]
    place = np.stack([columns, rows], axis=1)
    return (place + rng.random(place.shape)) / side**2


def _shuffled(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.intp]:
    """Random orders along the last axis."""
    return rng.random(shape, np.float32).argsort(axis=-1)
