"""Plan of a picture: the computations it needs and those it skips, with a bound on the
resulting error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from skindb.geometry.camera import project
from skindb.geometry.rays import RayScene
from skindb.reflectance.model import Lamp, Points
from skindb.render.monte_carlo import Lighting
from skindb.render.scene import Camera, Lights, Surface
from skindb.render.shading import View, entering_light, trace_view, tree_opening
from skindb.schema.notes import Omission
from skindb.types import Array, Index, Mask, dots

Omissions = tuple[Omission, ...]
# rad, by which normals between the rays of a trace differ from those at the rays
NORMAL_MARGIN = 0.1
ERROR_PART = 0.1  # of the wanted error, which all skipped lights together may cost
POINTS = 2000  # visible points at which the light of each light is computed
# factor on the light at these points, because other points, and the discs of lights,
# differ from them
SAFETY = 2.0
KEPT = (  # with costs that benchmarks/omissions.py measured on a face of 23,393 surfels
    "not skipped: basis BRDFs of small weight, because four bases take only 8 % more time than one",
    (
        "not skipped: light of an environment from below all horizons, because the "
        "noise is the same without it"
    ),
)


@dataclass(frozen=True)
class RenderPlan:
    """The surfels that are computed; everything that is skipped is in `omissions`."""

    surfels: Mask  # (surfel,) surfels that receive subsurface light
    subsurface: bool
    omissions: Omissions


def plan_render(visible: Mask, *, subsurface: bool) -> RenderPlan:
    """Plan a picture in which the triangles of some surfels (surfel,) are visible.

    Subsurface light is computed at these surfels only. It comes from all surfels, and
    the picture is interpolated between the visible ones, so the picture stays the same.
    Subsurface transport is computed even if it reaches less than a pixel: it changes
    the diffuse term by 3 to 7 % RMS, and the bound from the range of irradiance around
    a surfel is ten times larger.
    """
    skipped: Omissions = ()
    if subsurface and not visible.all():
        hidden = int((~visible).sum())
        skipped = (
            Omission(
                "surfels that receive subsurface light",
                hidden,
                visible.size,
                "they are not visible",
            ),
        )
    return RenderPlan(visible, subsurface, skipped)


@dataclass(frozen=True)
class ScenePlan:
    """The parts of a scene that a picture needs; everything that is skipped is in `omissions`."""

    surface: Surface
    lighting: Lighting
    pixels: Mask  # (h, w) that may show the surface
    omissions: Omissions


def plan_scene(
    surface: Surface,
    camera: Camera,
    lighting: Lighting,
    scene: RayScene,
    *,
    subsurface: bool = False,
    error: float | None = None,
    terms: tuple[str, ...] = ("diffuse", "surface"),
) -> ScenePlan:
    """Plan a Monte Carlo picture; parameters as in `render_monte_carlo`.

    Without a wanted relative error, only what does not change the picture is skipped,
    and levels of the octree.

    Notes
    -----
    Measured by benchmarks/omissions.py on a face that covers 45 % of the picture:
    without the other pixels a picture takes 46 % less CPU time under one light, 26 %
    less under the 32 lights of a dome, and 15 % less in an environment. If one of the
    lights dominates, skipping the others halves what is left. In a dome of even lights
    none can be skipped, because each contributes 2 to 7 % of a picture. Planning takes
    0.1 s. `KEPT` lists what would not pay.
    """
    pixels, empty = covered_pixels(surface, camera)
    view = trace_view(surface, camera, scene=scene, pixels=pixels)
    skipped = [
        *empty,
        *plan_render(
            view.shown(len(surface.vertices)), subsurface=subsurface
        ).omissions,
    ]
    model, parameters, omissions = surface.model.simplified(surface.parameters)
    if omissions:
        surface = replace(surface, model=model, parameters=parameters)
    skipped += omissions
    lights = lighting.lights
    indirect = subsurface + surface.inter_reflection
    if lights is not None and not indirect:
        lights, omissions = lights_above_horizon(lights, view)
        skipped += omissions
    if lights is not None and error is not None:
        seen = _with_terms(surface, terms)
        lights, omissions = notable_lights(
            lights, seen, view, scene, error=error, indirect=indirect
        )
        skipped += omissions
    skipped += (plan_octree(error),) if subsurface else ()
    return ScenePlan(
        surface, Lighting(lights, lighting.environment), pixels, tuple(skipped)
    )


def _with_terms(surface: Surface, terms: tuple[str, ...]) -> Surface:
    """The surface with some terms of its BRDF."""
    diffuse = surface.diffuse * ("diffuse" in terms)
    parameters = surface.parameters[:, : None if "surface" in terms else 0]
    return replace(surface, diffuse=diffuse, parameters=parameters)


def plan_octree(error: float | None) -> Omission:
    """The levels of the octree for subsurface light that a picture with this relative
    error skips.
    """
    opening, bound = tree_opening(error)
    reason = f"nodes that appear smaller than {opening:.3g} are not opened"
    return Omission(
        "levels of the octree",
        reason=reason,
        bound=bound,
        bounded="values of subsurface light",
    )


def covered_pixels(surface: Surface, camera: Camera) -> tuple[Mask, Omissions]:
    """Pixels (h, w) that triangles may cover: those that the box around a projected
    triangle meets.
    """
    faces = np.asarray(surface.faces)
    view = (camera.K, camera.R, camera.t, camera.distortion)
    corner = project(surface.vertices, *view)[0][faces]
    middle = project(surface.vertices[faces].mean(axis=1), *view)[0]
    if not (np.isfinite(corner).all() and np.isfinite(middle).all()):
        # triangles behind the camera
        return np.ones((camera.height, camera.width), bool), ()
    # distortion curves edges by about as much as it moves the middle of a triangle
    margin = 1 + 4 * np.abs(middle - corner.mean(axis=1)).max()
    size = (camera.width, camera.height)
    low = np.clip(np.floor(corner.min(axis=1) - margin), 0, size).astype(np.int64)
    high = np.clip(np.ceil(corner.max(axis=1) + margin), 0, size).astype(np.int64)
    edges = np.zeros((camera.height + 1, camera.width + 1), np.int64)
    for x, y, sign in (
        (low, low, 1),
        (high, high, 1),
        (low, high, -1),
        (high, low, -1),
    ):
        np.add.at(edges, (y[:, 1], x[:, 0]), sign)
    mask = edges.cumsum(axis=0).cumsum(axis=1)[:-1, :-1] > 0
    empty = int((~mask).sum())
    return mask, (
        Omission("pixels", empty, mask.size, "no triangle covers them"),
    ) if empty else ()


def lights_above_horizon(lights: Lights, view: View) -> tuple[Lights, Omissions]:
    """The lights above the horizon of any visible point, with a margin for their discs
    and for pixels.
    """
    if not len(lights) or not len(view.pixel):
        return lights, ()
    margin = np.linalg.norm(np.ptp(view.position, axis=0)) / min(
        view.camera.width, view.camera.height
    )
    lit = np.zeros(len(lights), bool)
    for i in range(len(lights)):
        height = dots(lights.position[i] - view.position, view.normal)
        slack = (
            lights.disc_radius[i]
            + margin
            + NORMAL_MARGIN * np.linalg.norm(lights.position[i])
        )
        lit[i] = bool((height > -slack).any())
    if lit.all():
        return lights, ()
    dark = int((~lit).sum())
    return lights.select(lit), (
        Omission(
            "lights", dark, lit.size, "they are below the horizon of all visible points"
        ),
    )


def notable_lights(
    lights: Lights,
    surface: Surface,
    view: View,
    scene: RayScene,
    *,
    error: float,
    indirect: int = 0,
) -> tuple[Lights, Omissions]:
    """The lights without the dimmest ones, whose sum may cost a tenth of the wanted relative error.

    The light of each is computed at visible points without shadows, which cannot make
    it brighter. The picture is at least as bright as with the shadows at these points.
    Each of the `indirect` kinds of light, under the skin and from other parts of the face, is
    at most the largest irradiance of any surfel: the kernel under the skin is divided by its
    sum, and form factors do not exceed 1.
    """
    if len(lights) < 2 or not len(view.pixel):
        return lights, ()
    rows = np.linspace(0, len(view.pixel) - 1, min(len(view.pixel), POINTS)).astype(
        np.int64
    )
    light = _unshadowed(lights, surface, view, rows)
    level = _level(light, lights, view, scene, rows)
    dropped: list[int] = []
    total = np.zeros(light.shape[1:])
    entered = np.zeros((len(surface.vertices), 3))
    bound = 0.0
    for i in np.argsort((light**2).sum(axis=(1, 2))) if level > 0 else []:
        total = total + light[i]
        cost = SAFETY * float(np.sqrt(np.mean(total**2))) / level
        if indirect:
            entered = entered + _irradiance(lights.select(i), surface)
            cost += indirect * float(np.nanmax(entered)) / np.pi / level
        if cost > ERROR_PART * error:
            break
        dropped = [*dropped, int(i)]
        bound = cost
    if not dropped:
        return lights, ()
    bright = np.ones(len(lights), bool)
    bright[dropped] = False
    return lights.select(bright), (
        Omission(
            "lights",
            len(dropped),
            len(lights),
            f"together they contribute less than {ERROR_PART:g} of the wanted error",
            bound,
            "pictures (root mean square)",
        ),
    )


def _level(
    light: Array, lights: Lights, view: View, scene: RayScene, rows: Index
) -> float:
    """Root mean square over chosen hits of the light (l, m, 3) that is not in shadow."""
    position = view.position[rows]
    normal = view.normal[rows]
    visible = [
        ~scene.occluded(position, lights.position[i : i + 1], normal=normal)
        for i in range(len(lights))
    ]
    seen = (light * np.stack(visible)[..., None]).sum(axis=0)
    return float(np.sqrt(np.mean(seen**2)))


def _unshadowed(lights: Lights, surface: Surface, view: View, rows: Index) -> Array:
    """Radiance (l, m, 3) of chosen hits under each light, from its centre and without shadows."""
    diffuse = view.interpolate(surface.diffuse)[rows]
    parameters = view.interpolate(surface.parameters)[rows]
    points = Points(
        view.position[rows], view.normal[rows], view.towards[rows], diffuse, parameters
    )
    lit = np.ones((len(rows), 1), np.float32)
    radiance = []
    for i in range(len(lights)):
        place = np.broadcast_to(lights.position[i], (len(rows), 1, 3))
        lamp = Lamp(place, lit, lights.axis[i], float(lights.falloff[i]))
        shaded = surface.model.shade(points, lamp, eta=surface.eta)
        radiance.append(shaded * lights.intensity[i])
    return np.stack(radiance)


def _irradiance(light: Lights, surface: Surface) -> Array:
    """Irradiance (v, 3) under the boundary of one light, without shadows."""
    towards = light.position[0] - surface.vertices
    square = dots(towards, towards)
    cosine = np.clip(dots(towards, surface.normals) / np.sqrt(square), 0, 1)
    entering = entering_light(light, 0, towards, square, cosine, surface.eta)
    return np.asarray(entering[:, None] * light.intensity[0])
