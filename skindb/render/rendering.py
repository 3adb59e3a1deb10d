"""Pictures of a model: by Monte Carlo integration, into labelled arrays or image files, and
without noise from the lights of its dome.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from skindb.errors import require
from skindb.geometry.rays import RayScene
from skindb.parameters import RenderParameters
from skindb.render.image import (
    auto_exposure,
    tone_map,
    write_exr,
    write_png,
    write_webp,
)
from skindb.render.monte_carlo import Quality, Rendering, render_monte_carlo
from skindb.render.plan import KEPT, ScenePlan, plan_scene
from skindb.render.scene import (
    Camera,
    Environment,
    Lighting,
    Lights,
    cameras_from_dome,
    from_model,
    lights_from_dome,
)
from skindb.render.shading import (
    require_translucency,
    tree_opening,
)
from skindb.render.subsurface import refined_surface
from skindb.render.views import (
    VIEW_PX,
    VIEWS,
    camera_around,
    light_from,
    turntable_azimuths,
)
from skindb.schema.consent import honour_consent
from skindb.types import Array, Bytes, Float32, Progress, dots, lengths, silent, unit

UNITS = "radiance"  # in the unit of the photographs, or of the environment
NO_LIGHTS = Lights(
    np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros(0)
)


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
    index = frontal_camera(dome) if camera is None else _index(names, camera, "camera")
    return cameras_from_dome(dome)[index], names[index]


def frontal_camera(dome: xr.Dataset) -> int:
    """Index of the camera closest to the frontal direction (+z)."""
    place = dome["camera_position"].values
    return int(np.argmax(place[:, 2] / lengths(place)))


def _index(names: list[str], name: str, device: str) -> int:
    require(
        name in names,
        f"{device} {name}",
        f"must be a {device} of the dome",
        "no such name",
        f"choose {', '.join(names)}",
    )
    return names.index(name)


@dataclass(frozen=True)
class RenderInputs:
    """Camera, light and surface of a picture, and the plan of the parts that it needs."""

    plan: ScenePlan
    camera: Camera
    scene: RayScene
    names: dict[str, Any]  # names of camera, lights and environment
    # with the lights that do not reach the visible part, which count for exposures
    given: Lighting


def render(
    model: xr.DataTree,
    *,
    lights: Sequence[str] | Lights = (),
    environment: Environment | str | Path | None = None,
    camera: str | Camera | None = None,
    samples: int = 64,
    error: float | None = None,
    subsurface: bool = False,
    bounces: int = 0,
    terms: Sequence[str] = ("diffuse", "surface"),
    scale: float = 1.0,
    seed: int = 0,
    progress: Progress = silent,
) -> xr.Dataset:
    """Render a model under lights of its dome, other lights or an environment (Weyrich
    et al. 2005, eq. 1-4, 8, 9).

    Parameters
    ----------
    model
        Version of kind "model" or "edit".
    lights
        Names of lights of the dome, whose light is summed, or disc lights. By default
        all lights of the dome are used, or none of them if an environment is given.
    environment
        Light from all directions, or its OpenEXR file; see `skindb.render.Environment`
        for its orientation.
    camera
        Name of a camera of the dome, or any other camera; default the most frontal
        camera of the dome.
    samples
        Number of rays per pixel, or the largest one with `error`.
    error
        Target relative standard error of the picture, at which sampling stops.
    subsurface
        Whether diffuse light travels through the skin (dipole); requires translucency in the model.
    bounces
        Number of diffuse bounces of light between parts of the face, 0 or 1. Models whose
        fits subtracted such light always have one.
    terms
        Terms of the BRDF to include: "diffuse", "surface" or both.
    scale
        Size of the picture relative to that of the camera.
    seed
        Random seed.
    progress
        See `skindb.render.monte_carlo.render_monte_carlo`.

    Returns
    -------
    Dataset
        `radiance` (image_row, image_col, channel), linear Rec. 709, in the unit of the
        photographs or of the environment; `radiance_variance`, the variance of this
        mean; `coverage` (image_row, image_col), the fraction of rays that meet
        skin. Attributes: camera, lights, samples, relative_error (relative standard
        error of the picture), seconds, skipped.

    Raises
    ------
    InputError
        If a light or camera is not in the dome, the environment cannot be read, the
        subject does not consent to exports, or subsurface transport is requested and
        the model has no translucency.
    """
    inputs = render_inputs(
        model,
        lights,
        environment,
        camera,
        subsurface=subsurface,
        bounces=bounces,
        scale=scale,
        error=error,
    )
    quality = Quality(samples, error, subsurface, tuple(terms), tree_opening(error)[0])
    rendering = render_monte_carlo(
        inputs.plan.surface,
        inputs.camera,
        inputs.plan.lighting,
        quality,
        rng=np.random.default_rng(seed),
        scene=inputs.scene,
        pixels=inputs.plan.pixels,
        progress=progress,
    )
    attrs = inputs.names | {
        "samples": rendering.samples,
        "relative_error": rendering.relative_error,
        "seconds": rendering.seconds,
        "skipped": [str(omission) for omission in inputs.plan.omissions],
    }
    return _labelled(rendering).assign_attrs(attrs)


def _labelled(rendering: Rendering) -> xr.Dataset:
    """Radiance, variance and coverage with their dims and units."""
    space = ("image_row", "image_col")
    colour = (*space, "channel")
    named = {"units": UNITS, "long_name": "radiance, linear Rec. 709"}
    return xr.Dataset(
        {
            "radiance": (colour, rendering.radiance, named),
            "radiance_variance": (colour, rendering.variance, {"units": f"{UNITS}2"}),
            "coverage": (space, rendering.coverage, {"units": "1"}),
        },
        coords={"channel": ["R", "G", "B"]},
    )


def render_inputs(
    model: xr.DataTree,
    lights: Sequence[str] | Lights,
    environment: Environment | str | Path | None,
    camera: str | Camera | None,
    *,
    subsurface: bool,
    bounces: int = 0,
    scale: float,
    error: float | None = None,
) -> RenderInputs:
    """Surface, camera and lights of a picture, without the parts that it does not need
    for this relative error.
    """
    honour_consent(model.attrs, "export")
    dome = model["dome"].to_dataset().load()
    lighting, names = _chosen_lighting(dome, lights, environment)
    if isinstance(camera, Camera):
        seen_by, names["camera"] = camera, "given"
    else:
        seen_by, names["camera"] = chosen_camera(dome, camera)
    surface = from_model(model)
    if bounces:
        surface = replace(surface, inter_reflection=True)
    if subsurface:
        require_translucency(surface)
    sized = seen_by.scaled(scale)
    scene = RayScene(surface.vertices, surface.faces)
    if subsurface:
        surface = refined_surface(surface, sized, lighting, scene)
        scene = RayScene(surface.vertices, surface.faces)
    plan = plan_scene(
        surface, sized, lighting, scene, subsurface=subsurface, error=error
    )
    return RenderInputs(plan, sized, scene, names, lighting)


def _chosen_lighting(
    dome: xr.Dataset,
    lights: Sequence[str] | Lights,
    environment: Environment | str | Path | None,
) -> tuple[Lighting, dict[str, Any]]:
    """Lights and environment, and their names; without both, all lights of the dome."""
    if isinstance(environment, str | Path):
        surroundings: Environment | None = Environment.read(environment)
        name = str(environment)
    else:
        surroundings = environment
        name = "given"
    if isinstance(lights, Lights):
        lamps, light_names = lights, [f"{len(lights)} given lights"]
    elif surroundings is not None and not lights:
        lamps, light_names = NO_LIGHTS, []
    else:
        lamps, light_names = chosen_lights(dome, lights)
    names = {
        "lights": light_names,
        "environment": "" if surroundings is None else name,
    }
    return Lighting(lamps if len(lamps) else None, surroundings), names


def render_picture(
    model: xr.DataTree,
    out: Path,
    *,
    explain: bool = False,
    progress: Progress = silent,
    **options: Any,
) -> dict[str, Any]:
    """Render a model and write it as linear EXR or tone-mapped PNG, depending on the
    suffix of `out`.

    Parameters
    ----------
    model
        Version of kind "model" or "edit".
    out
        Picture to write. An EXR has the channels R, G, B, A (coverage) and variance.R,
        variance.G, variance.B. A WebP is animated: the view swings around the face.
    explain
        Only plan the picture and write nothing.
    progress
        As in `render`.
    **options
        Of `skindb.parameters.RenderParameters`: lights, environment, camera, samples,
        error, seed, subsurface and bounces as in `render`; view and light_from, a camera and a
        light beside the dome; size, the width in pixels; alpha, whether the background is
        transparent; and exposure, a factor on the radiance. The exposure "fixed" shows a
        white matte surface, which stands in the place of the face and faces the camera (the
        front for a view), as display white, or if the light comes from elsewhere, one with
        half of the light that any surface receives, so that pictures under the same light
        are comparable. "auto" shows the brightest skin as display white.

    Returns
    -------
    dict
        path, camera, lights, environment and skipped; with `explain` kept, which lists
        what is computed because skipping it does not pay, and otherwise samples,
        relative_error, seconds, and for a PNG exposure.

    Raises
    ------
    InputError
        If an option is out of its limits, and as `render`.
    """
    endings = (".exr", ".png", ".webp")
    require(
        out.suffix in endings,
        str(out),
        f"the name of a picture must end in {', '.join(endings)}",
        out.suffix or "no suffix",
        "change the name",
    )
    parameters = RenderParameters(**options)
    shots = _shots(model, parameters, turning=out.suffix == ".webp")
    error = parameters.error
    if explain:
        inputs = render_inputs(
            model, **shots[0], subsurface=parameters.subsurface, error=error
        )
        skipped = [str(omission) for omission in inputs.plan.omissions]
        return {"path": str(out), **inputs.names, "skipped": skipped, "kept": KEPT}
    names = ("samples", "error", "subsurface", "bounces", "seed")
    settings = {name: getattr(parameters, name) for name in names}
    frames = [render(model, **shot, **settings, progress=progress) for shot in shots]
    seen = frames[0]
    summary = {"path": str(out)} | {
        key: value for key, value in seen.attrs.items() if key != "seconds"
    }
    summary["seconds"] = sum(frame.attrs["seconds"] for frame in frames)
    if out.suffix == ".exr":
        _write_exr(out, seen)
        return summary
    if parameters.exposure == "fixed":
        shot = shots[0]
        if parameters.view in VIEWS:  # the same for all of them
            front = camera_around(from_model(model), VIEWS["front"], VIEW_PX)
            shot = shot | {"camera": front}
        inputs = render_inputs(model, **shot, subsurface=False)
        gain = fixed_exposure(inputs.given, inputs.camera)
    elif parameters.exposure == "auto":
        gain = auto_exposure(seen["radiance"].values)
    else:
        gain = parameters.exposure
    pictures = [_displayed(frame, gain, alpha=parameters.alpha) for frame in frames]
    if out.suffix == ".webp":
        write_webp(out, pictures)
    else:
        write_png(out, pictures[0])
    return summary | {"exposure": gain}


def _shots(
    model: xr.DataTree, parameters: RenderParameters, *, turning: bool
) -> list[dict[str, Any]]:
    """Lights, environment, camera and scale of each frame; one, or those of a turntable."""
    chosen = {
        "camera": parameters.camera is not None,
        "view": parameters.view in VIEWS,
        "turntable": turning,
        "light": len(parameters.lights) > 0,
        "light_from": parameters.light_from is not None,
    }
    for names in (("camera", "view", "turntable"), ("light", "light_from")):
        given = [name for name in names if chosen[name]]
        rule = "only one of them may be given"
        require(len(given) < 2, " and ".join(given), rule, "both", "omit one")
    surface = from_model(model)
    shot: dict[str, Any] = {
        "lights": parameters.lights,
        "environment": parameters.environment,
        "camera": parameters.camera,
        "scale": 1.0,
    }
    if parameters.light_from is not None:
        shot["lights"] = light_from(surface, parameters.light_from)
    size = parameters.size
    if not chosen["view"] and not turning:
        if size is not None:
            dome = model["dome"].to_dataset().load()
            shot["scale"] = size / chosen_camera(dome, parameters.camera)[0].width
        return [shot]
    azimuths = turntable_azimuths() if turning else [VIEWS[parameters.view]]
    width = size or VIEW_PX
    return [
        shot | {"camera": camera_around(surface, azimuth, width)}
        for azimuth in azimuths
    ]


def _displayed(seen: xr.Dataset, exposure: float, *, alpha: bool) -> Bytes:
    """The picture as sRGB (h, w, 3), or (h, w, 4) with its coverage."""
    radiance = seen["radiance"].values
    if not alpha:
        return tone_map(radiance, exposure=exposure)
    coverage = seen["coverage"].values[..., None]
    colour = radiance / np.maximum(coverage, 1e-6)
    opacity = np.round(255 * coverage).astype(np.uint8)
    return np.concatenate([tone_map(colour, exposure=exposure), opacity], axis=-1)


def fixed_exposure(lighting: Lighting, camera: Camera) -> float:
    """Exposure at which a white matte surface at the origin that faces the camera is
    shown as display white.

    It depends on the light and the camera only. The irradiance of this surface is taken
    to be at least half of that of the surface which receives the most, which counts if
    the light comes from the side or from behind.
    """
    towards: list[Array] = [np.zeros((0, 3))]
    power: list[Array] = [np.zeros(0)]
    if lighting.lights is not None:
        lights = lighting.lights
        distance = lengths(lights.position)
        towards.append(lights.position / distance[:, None])
        along = np.maximum(-dots(towards[-1], lights.axis), 0) ** lights.falloff
        power.append(lights.intensity.mean(axis=1) * along / distance**2)
    if lighting.environment is not None:
        direction, energy = lighting.environment.texels()
        towards.append(direction)
        power.append(energy.mean(axis=1))
    # one of them is within 28 degrees of the surface that receives the most
    sides = np.stack(np.meshgrid(*3 * [[-1.0, 0, 1]]), axis=-1).reshape(-1, 3)
    normals = unit(np.concatenate([camera.centre[None], sides[sides.any(axis=1)]]))
    directions = np.concatenate(towards)
    energies = np.concatenate(power)
    # one by one, as an environment may have millions of texels
    irradiance = [energies @ np.maximum(directions @ normal, 0) for normal in normals]
    level = max(irradiance[0], max(irradiance) / 2)
    return float(np.pi / level) if level > 0 else 1.0


def _write_exr(path: Path, seen: xr.Dataset) -> None:
    planes: dict[str, Float32] = {}
    for i, name in enumerate("RGB"):
        planes[name] = seen["radiance"].values[..., i]
        planes[f"variance.{name}"] = seen["radiance_variance"].values[..., i]
    planes["A"] = seen["coverage"].values
    keys = ("camera", "samples", "relative_error")
    attributes = {f"skindb.{key}": str(seen.attrs[key]) for key in keys}
    attributes |= {
        "skindb.units": "R, G, B: radiance, linear Rec. 709; variance: of their means; A: coverage"
    }
    write_exr(path, planes, attributes=attributes)
