"""The model rendered from the camera and under the light of every kept photograph, and how far it is from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.geometry.rays import RayScene
from skindb.render.compare import compare_images
from skindb.render.direct import shade_view, trace_view
from skindb.render.image import tone_map, write_png
from skindb.render.scene import cameras_from_dome, from_model, lights_from_dome
from skindb.render.subsurface import require_translucency
from skindb.schema import check
from skindb.schema.consent import honour_consent

COVERED = 0.999  # of a pixel's rays must meet known surface: silhouettes compare background


@dataclass(frozen=True)
class Comparison:
    """One photograph and the model's prediction of it."""

    light: str
    camera: str
    held_out: bool  # the fit did not see this light or this camera
    photographed: NDArray[np.float32]  # (h, w, 3) radiance
    rendered: NDArray[np.float32]  # (h, w, 3) radiance
    mask: NDArray[np.bool_]  # (h, w) pixels compared
    error: dict[str, float]  # of `compare_images`


def compare_photographs(
    model: xr.DataTree, capture: xr.DataTree, *, subsurface: bool = False, samples: int = 2
) -> list[Comparison]:
    """Predict the photographs that ingest kept.

    Parameters
    ----------
    model, capture
        Versions of kinds "model" and "capture" of one take.
    subsurface
        Diffuse light through the skin by the dipole; needs translucency.
    samples
        Rays per pixel and axis.
    """
    honour_consent(model.attrs, "export")
    if "photographs" not in capture.children:
        raise InputError(
            Fault("capture", "a comparison needs kept photographs", "none", "ingest again with --photographs 4")
        )
    kept, dome = capture["photographs"].to_dataset(), capture["dome"].to_dataset()
    check(kept, ("photograph_radiance", "photograph_light", "photograph_camera"), where="photographs")
    surface = from_model(model)
    if subsurface:
        require_translucency(surface)
    scene = RayScene(surface.vertices, surface.faces)
    cameras, lights = cameras_from_dome(dome), lights_from_dome(dome)
    dark, away = (_held_out(model, what) for what in ("light", "camera"))
    results = []
    for i in range(kept.sizes["photograph"]):
        at_light, at_camera = int(kept["photograph_light"][i]), int(kept["photograph_camera"][i])
        camera = cameras[at_camera]
        view = trace_view(surface, camera, samples=samples, scene=scene)
        rendered = shade_view(view, surface, lights.select(at_light), scene, subsurface=subsurface)[0]
        photo = kept["photograph_radiance"][i].values[: camera.height, : camera.width].astype(np.float32)
        mask = (view.coverage >= COVERED) & np.isfinite(photo).all(axis=-1)
        if not mask.any():
            continue  # this camera sees nothing that was fitted
        light, name = str(dome["light"].values[at_light]), str(dome["camera"].values[at_camera])
        error = compare_images(rendered, photo, mask=mask)
        results.append(Comparison(light, name, light in dark or name in away, photo, rendered, mask, error))
    if not results:
        rule = "a comparison needs pixels that show fitted surfels"
        raise InputError(Fault("photographs", rule, "none", "ingest again with more --photographs"))
    return results


def _held_out(model: xr.DataTree, dim: str) -> set[str]:
    """Names of the lights or cameras that the fit did not see."""
    if "held_out" not in model.children:
        return set()
    held = model["held_out"].to_dataset()[f"{dim}_held_out"]
    return set(map(str, held[dim].values[held.values > 0]))


def write_comparisons(comparisons: Sequence[Comparison], folder: Path) -> list[Path]:
    """One picture a photograph: as taken, as rendered, and their difference (grey is none, ten times enlarged)."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for one in comparisons:
        paths.append(folder / f"{one.light}_{one.camera}.png")
        write_png(paths[-1], side_by_side(one))
    return paths


def side_by_side(one: Comparison) -> NDArray[np.uint8]:
    """Photograph, rendering and difference at one exposure, (h, 3 w, 3)."""
    exposure = one.error["exposure"]
    shown = [tone_map(np.nan_to_num(image), exposure=exposure) for image in (one.photographed, one.rendered)]
    gap = np.where(one.mask[..., None], (one.rendered - np.nan_to_num(one.photographed)) * exposure, 0.0)
    difference = np.clip(127.5 + 10 * 127.5 * gap, 0, 255).astype(np.uint8)
    return np.concatenate([*shown, difference], axis=1)
