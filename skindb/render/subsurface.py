"""Subsurface light of Monte Carlo pictures: irradiance at random points of the surface, which
the dipole carries to the vertices (Jensen and Buhler 2002; Weyrich et al. 2005, eq. 9).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from skindb.geometry.mesh import face_crosses
from skindb.geometry.rays import RayScene
from skindb.optics.dipole_tree import subsurface_exitance
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.sampling import tangents
from skindb.render.scene import (
    Camera,
    Environment,
    Lighting,
    Surface,
    subdivide_surface,
)
from skindb.render.shading import points_on_discs, received_light, trace_view
from skindb.types import (
    Array,
    Float32,
    Mask,
    Progress,
    dots,
    finite_rows,
    lengths,
    silent,
    unit,
)

Image = Float32
FAR = 1e5  # mm, length of shadow rays towards an environment
# of an environment at each point, by luminance and as many by the cosine
DIRECTIONS = 32
MIN_DIRECTIONS = 2
# of all points of a pass, above which points have fewer directions: a receiver averages the
# light of more points the denser they are
MAX_DIRECTIONS = 4_000_000
# steps of an additive recurrence that fills the unit square evenly (Roberts 2018)
STEPS = np.array([0.7548776662466927, 0.5698402909980532])
MIN_PASSES = (
    8  # for an estimate of the variance that can be compared with a target error
)
MAX_PASSES = 64
SAMPLES_PER_PASS = 16  # rays per pixel for each pass of pictures without a target error
# relative to the light at its corners: of the change over a triangle, above which it is
# divided. Linear interpolation is then wrong by an eighth of it at most
MAX_CHANGE = 0.1
# of the depth of the dipole's source, over which its light changes
SPACING = 0.5


@dataclass
class RunningMean:
    """Mean and sum of squared deviations over passes (Welford 1962)."""

    count: int = 0
    mean: Any = 0.0
    square: Any = 0.0
    coverage: Any = 0.0
    more: Any = 0.0  # variance that all passes share
    started: float = field(default_factory=perf_counter)

    def add(self, values: Array, coverage: Array) -> None:
        """Include the values (..., c) of a pass, and where they cover anything (...)."""
        self.count += 1
        apart = values - self.mean
        self.mean = self.mean + apart / self.count
        self.square = self.square + apart * (values - self.mean)
        self.coverage = self.coverage + (coverage - self.coverage) / self.count

    def variance(self) -> Any:
        """Variance of the mean."""
        return self.square / (self.count * (self.count - 1)) + self.more

    def relative_error(self) -> float:
        """Root of the mean variance over the root mean square, where there is coverage."""
        seen = np.asarray(self.coverage) > 0
        if self.count < 2 or not seen.any():
            return np.inf if self.count < 2 else 0.0
        level = float(np.mean(np.square(self.mean[seen])))
        spread = float(np.mean(self.variance()[seen]))
        return float(np.sqrt(spread / level)) if level > 0 else 0.0


def subsurface_light(
    surface: Surface,
    lighting: Lighting,
    scene: RayScene,
    receivers: Mask,
    *,
    tolerance: float,
    count: int,
    error: float = np.inf,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> tuple[Array, Array]:
    """Radiant exitance (v, 3) under the boundary and its standard error, as the mean of
    independent passes; vertices that are no receivers (v,) have that of the nearest one.

    Each pass has other points of the surface, which receive light, so that the edges of
    shadows do not follow the triangles. There are `count` of them, and up to MAX_PASSES until
    this relative error.
    """
    passes = RunningMean()
    while passes.count < count or (
        passes.count < MAX_PASSES and passes.relative_error() > error
    ):
        light = _light_of_pass(surface, lighting, scene, receivers, tolerance, rng)
        passes.add(light, receivers.astype(float))
        most = count if error == np.inf else MAX_PASSES
        progress("light under the skin", passes.count, most)
    reached = np.flatnonzero(receivers)
    if not len(reached):
        return passes.mean, passes.mean
    _, nearest = cKDTree(surface.vertices[reached]).query(surface.vertices)
    at = reached[nearest]
    return passes.mean[at], np.sqrt(passes.variance())[at]


def _light_of_pass(
    surface: Surface,
    lighting: Lighting,
    scene: RayScene,
    receivers: Mask,
    tolerance: float,
    rng: np.random.Generator,
) -> Array:
    """One independent estimate of the exitance (v, 3), from one point in each triangle."""
    if surface.s is None or surface.sigma_tr is None:
        raise ValueError("subsurface light needs s and sigma_tr, found None")
    known = finite_rows(surface.s) & finite_rows(surface.sigma_tr)
    faces = surface.faces[known[surface.faces].all(axis=1)]
    draw = rng.random((len(faces), 2))
    draw = np.where(draw.sum(axis=1, keepdims=True) > 1, 1 - draw, draw)
    weight = np.column_stack([1 - draw.sum(axis=1), draw])[..., None]
    points = (weight * surface.vertices[faces]).sum(axis=1)
    normals = unit((weight * surface.normals[faces]).sum(axis=1))
    received = received_irradiance(
        points, normals, lighting, scene, eta=surface.eta, rng=rng
    )
    areas = lengths(face_crosses(surface.vertices, faces)) / 2
    # the receivers are further points, which send no light
    reached = np.flatnonzero(receivers & known)
    n = len(points)
    count = n + len(reached)
    s = np.ones((count, 3))
    sigma_tr = np.full((count, 3), np.nanmax(surface.sigma_tr))
    s[n:] = surface.s[reached]
    sigma_tr[n:] = surface.sigma_tr[reached]
    exitance = subsurface_exitance(
        np.concatenate([points, surface.vertices[reached]]),
        np.pad(areas, (0, len(reached))),
        np.pad(received, ((0, len(reached)), (0, 0))),
        s,
        sigma_tr,
        eta=surface.eta,
        tolerance=tolerance,
        receivers=np.arange(count) >= n,
    )
    light = np.zeros_like(surface.vertices)
    # each column is the light of one channel, so only this channel of its result is used
    for channel in range(3):
        light[reached, channel] = exitance[channel, n:, channel]
    return light


def received_irradiance(
    points: Array,
    normals: Array,
    lighting: Lighting,
    scene: RayScene,
    *,
    eta: float,
    rng: np.random.Generator,
) -> Array:
    """Irradiance (n, 3) under the boundary, F_t(w_i) E, at points (n, 3); one estimate."""
    received = np.zeros((len(points), 3))
    if (lights := lighting.lights) is not None:
        for i in range(len(lights)):
            place = points_on_discs(lights, np.full(len(points), i), rng)
            light = received_light(lights, i, place, points, normals, scene, eta)
            received += light[:, None] * lights.intensity[i]
    if lighting.environment is not None:
        received += _from_environment(
            points, normals, lighting.environment, scene, eta, rng
        )
    return received


def _from_environment(
    points: Array,
    normals: Array,
    environment: Environment,
    scene: RayScene,
    eta: float,
    rng: np.random.Generator,
) -> Array:
    """Half of the directions are drawn by luminance, half by the cosine (balance heuristic,
    Veach 1997).
    """
    received = np.zeros((len(points), 3))
    tangent, second = tangents(normals)
    start = rng.random((len(points), 2))
    most = MAX_DIRECTIONS // max(len(points), 1)
    directions = int(np.clip(most, MIN_DIRECTIONS, DIRECTIONS))
    for i in range(directions):
        draw = (start + i * STEPS) % 1
        height = np.sqrt(draw[:, :1])
        sine = np.sqrt(1 - height**2)
        turn = 2 * np.pi * draw[:, 1:]
        about = sine * (np.cos(turn) * tangent + np.sin(turn) * second)
        for towards in (environment.sample(draw), about + height * normals):
            cosine = dots(towards, normals)
            front = np.flatnonzero(cosine > 0)
            target = points[front] + FAR * towards[front]
            hidden = scene.occluded(points[front], target, normal=normals[front])
            lit = front[~hidden]
            # per direction, of both ways to draw
            density = environment.pdf(towards[lit]) + cosine[lit] / np.pi
            passed = fresnel_transmittance(np.minimum(cosine[lit], 1), eta)
            weight = cosine[lit] * passed / density
            received[lit] += weight[:, None] * environment.along(towards[lit])
    return received / directions


def refined_surface(
    surface: Surface, camera: Camera, lighting: Lighting, scene: RayScene
) -> Surface:
    """The surface, with the visible triangles divided over which subsurface light changes,
    down to a pixel or to the depth of the dipole's source.
    """
    if surface.s is None or surface.sigma_tr is None:
        raise ValueError("subsurface light needs s and sigma_tr, found None")
    visible = trace_view(surface, camera, scene=scene).shown(len(surface.vertices))
    if not visible.any():
        return surface
    rng = np.random.default_rng(0)
    near = np.zeros_like(visible)
    near[surface.faces[visible[surface.faces].any(axis=1)]] = True
    light = _light_of_pass(surface, lighting, scene, near, 1.0, rng)
    depth = np.nanmedian(surface.s / surface.sigma_tr, axis=0).min()
    pixel = camera.pixel_width(surface.vertices[visible].mean(axis=0))
    spacing = max(pixel, SPACING * float(depth))
    level = light + MAX_CHANGE * light.max(axis=0, initial=1e-300)
    change = np.where(near[:, None], np.log(level), np.nan) / MAX_CHANGE
    return subdivide_surface(surface, spacing, change)
