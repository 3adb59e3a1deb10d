"""Noise-free picture of a model from a camera and lights of its dome."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.geometry.rays import RayScene
from skindb.render.direct import TERMS, View, glow_image, shade_view, trace_view
from skindb.render.plan import RenderPlan, plan_render
from skindb.render.scene import (
    Camera,
    Lights,
    Surface,
    cameras_from_dome,
    from_model,
    lights_from_dome,
)
from skindb.render.subsurface import require_translucency, total_exitance
from skindb.schema.consent import honour_consent


@dataclass(frozen=True)
class Shot:
    """The view of a camera, traced but not yet shaded, with its surface and lights."""

    surface: Surface
    lamps: Lights
    scene: RayScene
    view: View
    plan: RenderPlan


@dataclass(frozen=True)
class Picture:
    """Radiance that a camera sees, and what was skipped to compute it."""

    # (h, w, 3) linear; empty if the picture is only planned
    radiance: NDArray[np.float32]
    camera: str
    lights: list[str]
    skipped: list[str]


def radiance_of(
    model: xr.DataTree,
    *,
    lights: Sequence[str] = (),
    camera: str | None = None,
    samples: int = 2,
    scale: float = 1.0,
    subsurface: bool = False,
    explain: bool = False,
) -> Picture:
    """Render a model from a camera of its dome.

    Parameters
    ----------
    model
        Version of kind "model" or "edit".
    lights
        Names of lights of the dome, whose light is summed; default all.
    camera
        Name of a camera of the dome; default the most frontal one.
    samples
        Rays per pixel and axis.
    scale
        Size of the picture relative to that of the camera.
    subsurface
        Whether diffuse light travels through the skin (dipole).
    explain
        Only plan the picture.
    """
    honour_consent(model.attrs, "export")
    dome = model["dome"].to_dataset().load()
    surface = from_model(model, fill=True)
    if subsurface:
        require_translucency(surface)
    (lamps, light_names), (seen_by, camera_name) = (
        chosen_lights(dome, lights),
        chosen_camera(dome, camera),
    )
    sized = seen_by if scale == 1 else seen_by.scaled(scale)
    shot = trace_shot(surface, lamps, sized, samples=samples, subsurface=subsurface)
    seen = np.empty((0, 0, 3), np.float32) if explain else picture(shot)
    skipped = [str(omission) for omission in shot.plan.omissions]
    return Picture(seen, camera_name, light_names, skipped)


def chosen_lights(dome: xr.Dataset, lights: Sequence[str]) -> tuple[Lights, list[str]]:
    """Lights of a dome by their names, or all if no name is given, and their names."""
    names = [str(name) for name in dome["light"].values]
    chosen = [_index(names, name, "light") for name in lights] or list(
        range(len(names))
    )
    return lights_from_dome(dome).select(chosen), [names[i] for i in chosen]


def chosen_camera(dome: xr.Dataset, camera: str | None) -> tuple[Camera, str]:
    """Camera of a dome by its name, or the most frontal one for None, and its name."""
    names = [str(name) for name in dome["camera"].values]
    at = frontal_camera(dome) if camera is None else _index(names, camera, "camera")
    return cameras_from_dome(dome)[at], names[at]


def trace_shot(
    surface: Surface, lamps: Lights, camera: Camera, *, samples: int, subsurface: bool
) -> Shot:
    """Trace the rays of a camera and plan the shading."""
    scene = RayScene(surface.vertices, surface.faces)
    view = trace_view(surface, camera, samples=samples, scene=scene)
    plan = plan_render(view.shown(len(surface.vertices)), subsurface=subsurface)
    return Shot(surface, lamps, scene, view, plan)


def picture(shot: Shot) -> NDArray[np.float32]:
    """Linear picture (h, w, 3), the sum over the lights."""
    surface = shot.surface
    lamps = shot.lamps
    plan = shot.plan
    terms = ("surface",) if plan.subsurface else TERMS
    direct = shade_view(shot.view, surface, lamps, shot.scene, terms=terms).sum(axis=0)
    if plan.subsurface:
        direct += glow_image(
            shot.view,
            surface,
            total_exitance(surface, lamps, shot.scene, wanted=plan.surfels),
        )
    return np.asarray(direct, np.float32)


def frontal_camera(dome: xr.Dataset) -> int:
    """Index of the camera closest to the frontal direction (+z)."""
    place = dome["camera_position"].values
    return int(np.argmax(place[:, 2] / np.linalg.norm(place, axis=1)))


def _index(names: list[str], name: str, what: str) -> int:
    if name not in names:
        cure = f"choose {', '.join(names)}"
        raise InputError(
            Fault(
                f"{what} {name}", f"must be a {what} of the dome", "no such name", cure
            )
        )
    return names.index(name)
