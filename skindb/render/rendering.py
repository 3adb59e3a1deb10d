"""Rendering of a model by Monte Carlo integration, into labelled arrays or image files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb._types import Progress
from skindb.errors import Fault, InputError
from skindb.geometry.rays import RayScene
from skindb.render.direct import View, trace_view
from skindb.render.environment import Environment
from skindb.render.image import auto_exposure, tone_map, write_exr, write_png
from skindb.render.monte_carlo import Lighting, Quality, render_monte_carlo
from skindb.render.picture import chosen_camera, chosen_lights
from skindb.render.plan import plan_render
from skindb.render.refine import subdivide_surface
from skindb.render.scene import Camera, Lights, Surface, from_model
from skindb.render.subsurface import require_translucency, tree_opening
from skindb.schema.consent import honour_consent
from skindb.schema.omission import Omission

UNITS = "radiance"  # in the unit of the photographs, or of the environment
NO_LIGHTS = Lights(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros(0))
DIRECTIONS = 512  # directions over the sphere, for the irradiance of the white surface that defines exposures


@dataclass(frozen=True)
class RenderInputs:
    """Surface, camera and light of a picture, without the parts that do not change it, and a list of these parts."""

    surface: Surface
    camera: Camera
    lighting: Lighting
    scene: RayScene
    names: dict[str, Any]  # names of camera, lights and environment
    omissions: tuple[Omission, ...]


def render(
    model: xr.DataTree,
    *,
    lights: Sequence[str] | Lights = (),
    environment: Environment | str | Path | None = None,
    camera: str | Camera | None = None,
    samples: int = 64,
    error: float | None = None,
    subsurface: bool = False,
    terms: Sequence[str] = ("diffuse", "surface"),
    scale: float = 1.0,
    spacing: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> xr.Dataset:
    """Render a model under lights of its dome, other lights or an environment (Weyrich et al. 2005, eq. 1-4, 8, 9).

    Parameters
    ----------
    model
        Version of kind "model" or "edit".
    lights
        Names of lights of the dome, whose light is summed, or disc lights. By default all lights of the dome are used,
        or none of them if an environment is given.
    environment
        Light from all directions, or its OpenEXR file; see `skindb.render.Environment` for its orientation.
    camera
        Name of a camera of the dome, or any other camera; default the most frontal camera of the dome.
    samples
        Number of rays per pixel.
    error
        Target relative standard error of the picture. If given, it determines the number of rays, at most 4,096 per
        pixel, and `samples` is not used.
    subsurface
        Whether diffuse light travels through the skin (dipole); requires translucency in the model.
    terms
        Terms of the BRDF to include: "diffuse", "surface" or both.
    scale
        Size of the picture relative to that of the camera.
    spacing
        Longest edge [mm] of the triangles on which subsurface light is interpolated; default the mesh of the surfels.
        A third of the diffusion length makes the edges of shadows smooth in a close-up.
    seed
        Random seed.
    progress
        Called with the stage, the rays per pixel done, and the rays per pixel in all.

    Returns
    -------
    Dataset
        `radiance` (image_row, image_col, channel), linear Rec. 709, in the unit of the photographs or of the
        environment; `radiance_variance`, the variance of this mean; `coverage` (image_row, image_col), the fraction
        of rays that meet known skin. Attributes: camera, lights, samples, relative_error (relative standard error of
        the picture), seconds, skipped.

    Raises
    ------
    InputError
        If a light or camera is not in the dome, the environment cannot be read, the subject does not consent to
        exports, or subsurface transport is requested and the model has no translucency.
    """
    inputs = render_inputs(model, lights, environment, camera, subsurface=subsurface, scale=scale, spacing=spacing)
    quality = Quality(samples, error, subsurface, tuple(terms), tree_opening(error)[0])
    found = render_monte_carlo(
        inputs.surface,
        inputs.camera,
        inputs.lighting,
        quality,
        rng=np.random.default_rng(seed),
        scene=inputs.scene,
        progress=progress,
    )
    space = ("image_row", "image_col")
    attrs = {"units": UNITS, "long_name": "radiance, linear Rec. 709"}
    return xr.Dataset(
        {
            "radiance": ((*space, "channel"), found.radiance, attrs),
            "radiance_variance": ((*space, "channel"), found.variance, {"units": f"{UNITS}2"}),
            "coverage": (space, found.coverage, {"units": "1"}),
        },
        coords={"channel": ["R", "G", "B"]},
        attrs=inputs.names
        | {
            "samples": found.samples,
            "relative_error": found.relative_error,
            "seconds": found.seconds,
            "skipped": omission_lines(inputs, error, subsurface=subsurface),
        },
    )


def omission_lines(inputs: RenderInputs, error: float | None, *, subsurface: bool) -> list[str]:
    """One line for each thing that a picture with this relative error skips, with the bound on its effect."""
    lines = [str(one) for one in inputs.omissions]
    if subsurface:
        opening, bound = tree_opening(error)
        lines.append(
            f"levels of the octree: nodes that appear smaller than {opening:.3g} are not opened; subsurface light "
            f"differs by at most {bound:.2%}"
        )
    return lines


def render_inputs(
    model: xr.DataTree,
    lights: Sequence[str] | Lights,
    environment: Environment | str | Path | None,
    camera: str | Camera | None,
    *,
    subsurface: bool,
    scale: float,
    spacing: float | None = None,
) -> RenderInputs:
    """Surface, camera and lights of a picture, without the parts that do not change it."""
    honour_consent(model.attrs, "export")
    dome = model["dome"].to_dataset().load()
    surroundings = environment if isinstance(environment, Environment | None) else Environment.read(environment)
    names: dict[str, Any] = {}
    if isinstance(lights, Lights):
        lamps, names["lights"] = lights, [f"{len(lights)} given lights"]
    elif surroundings is not None and not lights:
        lamps, names["lights"] = NO_LIGHTS, []
    else:
        lamps, names["lights"] = chosen_lights(dome, lights)
    if isinstance(camera, Camera):
        seen_by, names["camera"] = camera, "given"
    else:
        seen_by, names["camera"] = chosen_camera(dome, camera)
    names["environment"] = (
        "" if surroundings is None else str(environment if isinstance(environment, str | Path) else "given")
    )
    surface = from_model(model, fill=True)
    if subsurface:
        require_translucency(surface)
    sized = seen_by if scale == 1 else seen_by.scaled(scale)
    scene = RayScene(surface.vertices, surface.faces)
    view = trace_view(surface, sized, scene=scene)
    if subsurface and spacing is not None:
        surface = subdivide_surface(surface, spacing, view.shown(len(surface.vertices)))
        scene = RayScene(surface.vertices, surface.faces)
        view = trace_view(surface, sized, scene=scene)
    plan = plan_render(view.shown(len(surface.vertices)), subsurface=subsurface)
    surface, bases = without_unused_bases(surface)
    lamps, dark = (lamps, ()) if subsurface else _above_the_horizon(lamps, view)
    lighting = Lighting(lamps if len(lamps) else None, surroundings)
    return RenderInputs(surface, sized, lighting, scene, names, (*plan.omissions, *bases, *dark))


def render_picture(
    model: xr.DataTree,
    out: Path,
    *,
    exposure: float | str = "fixed",
    explain: bool = False,
    **options: Any,
) -> dict[str, Any]:
    """Render a model and write it as linear EXR or tone-mapped PNG, depending on the suffix of `out`.

    Parameters
    ----------
    model
        Version of kind "model" or "edit".
    out
        Picture to write. An EXR has the channels R, G, B, A (coverage) and variance.R, variance.G, variance.B.
    exposure
        Factor on the radiance of a PNG. "fixed" shows a white matte surface, which stands in the place of the face and
        faces the camera, as display white, so that pictures under the same light are comparable. "auto" shows the
        brightest skin as display white.
    explain
        Only plan the picture and write nothing.
    **options
        Options of `render`.

    Returns
    -------
    dict
        path, camera, lights, environment and skipped; unless `explain`, also samples, relative_error, seconds, and for
        a PNG exposure.
    """
    if out.suffix not in (".exr", ".png"):
        rule = "the name of a picture must end in .exr or .png"
        raise InputError(Fault(str(out), rule, out.suffix or "no suffix", "change the name"))
    keys = ("lights", "environment", "camera")
    where = {"lights": (), "environment": None, "camera": None} | {k: options[k] for k in keys if k in options}
    subsurface, scale = bool(options.get("subsurface", False)), float(options.get("scale", 1.0))
    if explain:
        inputs = render_inputs(model, **where, subsurface=subsurface, scale=scale, spacing=options.get("spacing"))
        return (
            {"path": str(out)}
            | inputs.names
            | {"skipped": omission_lines(inputs, options.get("error"), subsurface=subsurface)}
        )
    seen = render(model, **options)
    summary = {"path": str(out)} | {key: seen.attrs[key] for key in ("camera", "lights", "environment", "skipped")}
    summary |= {key: seen.attrs[key] for key in ("samples", "relative_error", "seconds")}
    radiance = seen["radiance"].values
    if out.suffix == ".exr":
        _write_exr(out, seen)
        return summary
    if exposure == "fixed":
        inputs = render_inputs(model, **where, subsurface=False, scale=scale)
        gain = fixed_exposure(inputs.lighting, inputs.camera)
    else:
        gain = auto_exposure(radiance) if exposure == "auto" else float(exposure)
    write_png(out, tone_map(radiance, exposure=gain))
    return summary | {"exposure": gain}


def fixed_exposure(lighting: Lighting, camera: Camera) -> float:
    """Exposure at which a white matte surface at the origin that faces the camera is shown as display white.

    It depends on the light and the camera only. The irradiance of this surface is taken to be at least a fifth of its
    mean over all orientations, which counts if the light comes from behind.
    """
    normal = camera.centre / np.linalg.norm(camera.centre)
    facing, mean = 0.0, 0.0
    if lighting.lights is not None:
        lights = lighting.lights
        square = np.square(lights.position).sum(axis=1)
        along = np.maximum(np.einsum("lc,lc->l", -lights.position, lights.axis) / np.sqrt(square), 0) ** lights.falloff
        power = lights.intensity.mean(axis=1) * along / square
        facing += float((power * np.maximum(lights.position @ normal, 0) / np.sqrt(square)).sum())
        mean += float(power.sum()) / 4
    if lighting.environment is not None:
        k = np.arange(DIRECTIONS) + 0.5
        height, turn = 1 - 2 * k / DIRECTIONS, k * np.pi * (3 - 5**0.5)
        sine = np.sqrt(1 - height**2)
        way = np.stack([sine * np.cos(turn), height, sine * np.sin(turn)], axis=1)
        level = lighting.environment.along(way).mean(axis=1)
        facing += float((level * np.maximum(way @ normal, 0)).mean()) * 4 * np.pi
        mean += float(level.mean()) * np.pi
    irradiance = max(facing, 0.2 * mean)
    return float(np.pi / irradiance) if irradiance > 0 else 1.0


def _write_exr(path: Path, seen: xr.Dataset) -> None:
    planes: dict[str, NDArray[np.float32]] = {}
    for i, name in enumerate("RGB"):
        planes[name] = seen["radiance"].values[..., i]
        planes[f"variance.{name}"] = seen["radiance_variance"].values[..., i]
    planes["A"] = seen["coverage"].values
    keys = ("camera", "samples", "relative_error")
    about = {f"skindb.{key}": str(seen.attrs[key]) for key in keys}
    about |= {"skindb.units": "R, G, B: radiance, linear Rec. 709; variance: of their means; A: coverage"}
    write_exr(path, planes, attributes=about)


def without_unused_bases(surface: Surface) -> tuple[Surface, tuple[Omission, ...]]:
    """The surface without tables whose weight is zero everywhere, and the omission of these tables."""
    used = (surface.weights != 0).any(axis=0)
    if used.all():
        return surface, ()
    kept = replace(surface, weights=surface.weights[:, used], tables=np.ascontiguousarray(surface.tables[..., used]))
    return kept, (Omission("basis BRDFs", int((~used).sum()), used.size, "their weight is zero everywhere"),)


def _above_the_horizon(lights: Lights, view: View) -> tuple[Lights, tuple[Omission, ...]]:
    """The lights above the horizon of any visible point, with a margin for their discs and for pixels."""
    if not len(lights) or not len(view.pixel):
        return lights, ()
    margin = np.linalg.norm(np.ptp(view.position, axis=0)) / min(view.camera.width, view.camera.height)
    lit = np.zeros(len(lights), bool)
    for i in range(len(lights)):
        height = np.einsum("nc,nc->n", lights.position[i] - view.position, view.normal)
        # normals between the rays of this trace differ from those at the rays by less than 0.1
        lit[i] = bool((height > -lights.disc_radius[i] - margin - 0.1 * np.linalg.norm(lights.position[i])).any())
    if lit.all():
        return lights, ()
    left = int((~lit).sum())
    return lights.select(lit), (Omission("lights", left, lit.size, "they are below the horizon of all visible points"),)
