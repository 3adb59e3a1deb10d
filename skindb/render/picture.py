"""One picture of a model by lights and a camera of its dome."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.geometry.rays import RayScene
from skindb.render.direct import TERMS, glow_image, shade_view, trace_view
from skindb.render.image import tone_map, write_exr, write_png
from skindb.render.scene import Surface, cameras_from_dome, from_model, lights_from_dome
from skindb.render.subsurface import require_translucency, total_exitance


def render_picture(
    model: xr.DataTree,
    out: Path,
    *,
    lights: Sequence[str] = (),
    camera: str | None = None,
    samples: int = 2,
    scale: float = 1.0,
    subsurface: bool = False,
) -> dict[str, Any]:
    """Render a model and write it as linear EXR or tone-mapped PNG, by the ending of `out`.

    Parameters
    ----------
    model
        Version of kind "model" or "edit".
    out
        Picture to write.
    lights
        Names of lights of the dome, summed; none means all.
    camera
        Name; default the camera that looks most straight at the face.
    samples, scale
        Rays per pixel and axis; size of the picture in units of the camera's.
    subsurface
        Diffuse light through the skin by the dipole.

    Returns
    -------
    dict
        path, camera, lights.
    """
    if out.suffix not in (".exr", ".png"):
        raise InputError(Fault(str(out), "a picture ends in .exr or .png", out.suffix or "no ending", "rename it"))
    dome = model["dome"].to_dataset().load()
    names = {"light": [str(n) for n in dome["light"].values], "camera": [str(n) for n in dome["camera"].values]}
    chosen = [_index(names["light"], name, "light") for name in lights] or list(range(len(names["light"])))
    view = frontal_camera(dome) if camera is None else _index(names["camera"], camera, "camera")
    surface = from_model(model, fill=True)
    if subsurface:
        require_translucency(surface)
    image = picture(
        surface=surface, dome=dome, camera=view, lights=chosen, samples=samples, scale=scale, subsurface=subsurface
    )
    if out.suffix == ".exr":
        write_exr(out, image)
    else:
        write_png(out, tone_map(image))
    return {"path": str(out), "camera": names["camera"][view], "lights": [names["light"][i] for i in chosen]}


def picture(
    *,
    surface: Surface,
    dome: xr.Dataset,
    camera: int,
    lights: Sequence[int],
    samples: int,
    scale: float,
    subsurface: bool,
) -> NDArray[np.float32]:
    """Linear picture (h, w, 3) of a surface by a camera and some lights of a dome."""
    lamps = lights_from_dome(dome).select(list(lights))
    seen_by = cameras_from_dome(dome)[camera]
    scene = RayScene(surface.vertices, surface.faces)
    view = trace_view(surface, seen_by if scale == 1 else seen_by.scaled(scale), samples=samples, scene=scene)
    direct = shade_view(view, surface, lamps, scene, terms=("surface",) if subsurface else TERMS).sum(axis=0)
    if subsurface:
        direct += glow_image(view, surface, total_exitance(surface, lamps, scene))
    return np.asarray(direct, np.float32)


def frontal_camera(dome: xr.Dataset) -> int:
    """The camera that stands most in front of the face (+z)."""
    place = dome["camera_position"].values
    return int(np.argmax(place[:, 2] / np.linalg.norm(place, axis=1)))


def _index(names: list[str], name: str, what: str) -> int:
    if name not in names:
        raise InputError(
            Fault(
                f"{what} {name}", f"must be a {what} of the dome", "none of that name", f"there are {', '.join(names)}"
            )
        )
    return names.index(name)
