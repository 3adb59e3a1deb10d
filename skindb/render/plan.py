"""Plan of a picture: the computations it needs and those it skips, with a bound on the
resulting error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from skindb.geometry.rays import RayScene
from skindb.render.scene import Camera, Lighting, Lights, Surface
from skindb.render.shading import View, trace_view, tree_opening
from skindb.schema.notes import Omission
from skindb.types import Mask, dots

Omissions = tuple[Omission, ...]
# rad, by which normals between the rays of a trace differ from those at the rays
NORMAL_MARGIN = 0.1
KEPT = (  # with costs that benchmarks/omissions.py measured on a face of 23,393 surfels
    "not skipped: basis BRDFs of small weight, because four bases take only 8 % more time than one",
    (
        "not skipped: light of an environment from below all horizons, because the "
        "noise is the same without it"
    ),
    "not skipped: dim lights, because each light of a dome contributes 2 to 7 % of a picture",
)


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
) -> ScenePlan:
    """Plan a Monte Carlo picture; parameters as in `render_monte_carlo`.

    Without a wanted relative error, only what does not change the picture is skipped,
    and levels of the octree.

    Notes
    -----
    Measured once, no script kept: on a face that covers 44 % of the picture, and the box
    around it 54 %, a picture without the other pixels takes 14 % less CPU time under one
    light, and 4 % less under the 32 lights of a dome. `KEPT` lists what would not pay.
    """
    pixels, skipped = covered_pixels(surface, camera)
    view = trace_view(surface, camera, scene=scene, pixels=pixels)
    if subsurface:
        # light still comes from all vertices, and the picture is interpolated between
        # the visible ones, so that it stays the same
        shown = view.shown(len(surface.vertices))
        what = "vertices that receive subsurface light"
        if hidden := int((~shown).sum()):
            skipped += (Omission(what, hidden, shown.size, "they are not visible"),)
    model, parameters, omissions = surface.model.simplified(surface.parameters)
    if omissions:
        surface = replace(surface, model=model, parameters=parameters)
    skipped += omissions
    lights = lighting.lights
    indirect = subsurface or surface.inter_reflection
    if lights is not None and not indirect:
        lights, omissions = lights_above_horizon(lights, view)
        skipped += omissions
    if subsurface:
        opening, bound = tree_opening(error)
        reason = f"nodes that appear smaller than {opening:.3g} are not opened"
        skipped += (
            Omission(
                "levels of the octree",
                reason=reason,
                bound=bound,
                bounded="values of subsurface light",
            ),
        )
    return ScenePlan(surface, Lighting(lights, lighting.environment), pixels, skipped)


def covered_pixels(surface: Surface, camera: Camera) -> tuple[Mask, Omissions]:
    """Pixels (h, w) that triangles may cover: those of the box around the projected surface."""
    corner = camera.project(surface.vertices)[surface.faces]
    middle = camera.project(surface.vertices[surface.faces].mean(axis=1))
    # distortion curves edges by about as much as it moves the middle of a triangle
    margin = 1 + 4 * np.abs(middle - corner.mean(axis=1)).max()
    mask = np.ones((camera.height, camera.width), bool)
    if np.isfinite(margin):  # otherwise triangles are behind the camera
        low = np.maximum(corner.min(axis=(0, 1)) - margin, 0).astype(int)
        high = np.maximum(corner.max(axis=(0, 1)) + margin + 1, 0).astype(int)
        mask[:] = False
        mask[low[1] : high[1], low[0] : high[0]] = True
    empty = int((~mask).sum())
    return mask, (
        Omission("pixels", empty, mask.size, "they are beside the surface"),
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
