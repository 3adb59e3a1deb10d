"""Comparison of each kept photograph with the model rendered from the same camera under
the same light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.files import make_private
from skindb.geometry.rays import RayScene
from skindb.render.causes import Causes, find_causes
from skindb.render.compare import compare_images
from skindb.render.direct import View, shade_view, trace_view
from skindb.render.image import tone_map, write_png
from skindb.render.scene import cameras_from_dome, from_model, lights_from_dome
from skindb.render.subsurface import require_translucency
from skindb.render.texels import surfel_confidence
from skindb.schema import check
from skindb.schema.consent import honour_consent

MIN_REGION_PIXELS = 30  # below which a region is not compared
# fraction of a pixel's rays that must meet known surface, to exclude silhouettes
MIN_COVERAGE = 0.999


@dataclass(frozen=True)
class Comparison:
    """One photograph and the model's prediction of it."""

    light: str
    camera: str
    held_out: bool  # the fit did not see this light or this camera
    photographed: NDArray[np.float32]  # (h, w, 3) radiance
    rendered: NDArray[np.float32]  # (h, w, 3) radiance
    mask: NDArray[np.bool_]  # (h, w) pixels compared
    error: dict[str, float]  # from `compare_images`
    diffuse: NDArray[np.float32]  # (h, w, 3) diffuse part of the rendering
    regions: dict[str, dict[str, float]]  # the same errors for each region, by its name
    causes: Causes


def compare_photographs(
    model: xr.DataTree,
    capture: xr.DataTree,
    *,
    subsurface: bool = False,
    samples: int = 2,
) -> list[Comparison]:
    """Predict the photographs that ingest kept.

    Parameters
    ----------
    model, capture
        Versions of kinds "model" and "capture" of one take.
    subsurface
        Whether diffuse light travels through the skin (dipole); requires translucency in the model.
    samples
        Rays per pixel and axis.
    """
    honour_consent(model.attrs, "export")
    if "photographs" not in capture.children:
        cure = "ingest the capture again with --photographs 4"
        raise InputError(
            Fault("capture", "must contain kept photographs", "none", cure)
        )
    kept = capture["photographs"].to_dataset()
    dome = capture["dome"].to_dataset()
    check(
        kept,
        ("photograph_radiance", "photograph_light", "photograph_camera"),
        where="photographs",
    )
    surface = from_model(model)
    if subsurface:
        require_translucency(surface)
    scene = RayScene(surface.vertices, surface.faces)
    cameras = cameras_from_dome(dome)
    lights = lights_from_dome(dome)
    dark, away = (_held_out(model, what) for what in ("light", "camera"))
    regions = _regions(capture)
    doubtful = 1 - surfel_confidence(model["fitted"].to_dataset()).astype(np.float64)
    results = []
    for i in range(kept.sizes["photograph"]):
        at_light = int(kept["photograph_light"][i])
        at_camera = int(kept["photograph_camera"][i])
        camera = cameras[at_camera]
        view = trace_view(surface, camera, samples=samples, scene=scene)
        lamp = lights.select(at_light)
        diffuse = shade_view(
            view, surface, lamp, scene, subsurface=subsurface, terms=("diffuse",)
        )[0]
        gloss = shade_view(view, surface, lamp, scene, terms=("surface",))[0]
        rendered = diffuse + gloss
        photo = (
            kept["photograph_radiance"][i]
            .values[: camera.height, : camera.width]
            .astype(np.float32)
        )
        mask = (view.coverage >= MIN_COVERAGE) & np.isfinite(photo).all(axis=-1)
        if not mask.any():
            continue  # this camera sees no fitted surfel
        light = str(dome["light"].values[at_light])
        name = str(dome["camera"].values[at_camera])
        error = compare_images(rendered, photo, mask=mask)
        parts = _by_region(view, regions, rendered, photo, mask, error["exposure"])
        shown = view.image(view.interpolate(doubtful[:, None]))[..., 0]
        causes = find_causes(
            np.nan_to_num(photo), rendered, gloss, mask=mask, doubtful=shown
        )
        unseen = light in dark or name in away
        results.append(
            Comparison(
                light,
                name,
                unseen,
                photo,
                rendered,
                mask,
                error,
                diffuse,
                parts,
                causes,
            )
        )
    if not results:
        rule = "at least one must show fitted surfels"
        raise InputError(
            Fault(
                "photographs",
                rule,
                "none",
                "ingest the capture again with more --photographs",
            )
        )
    return results


def _regions(capture: xr.DataTree) -> dict[str, NDArray[np.float64]]:
    """Membership (surfel,) of the regions that the capture names."""
    found = (
        capture["surfels"].to_dataset()
        if "surfels" in capture.children
        else xr.Dataset()
    )
    if "region_mask" not in found:
        return {}
    mask = found["region_mask"].transpose("surfel", "region").values.astype(np.float64)
    return {str(name): mask[:, i] for i, name in enumerate(found["region"].values)}


def _by_region(
    view: View,
    regions: dict[str, NDArray[np.float64]],
    rendered: NDArray[np.float32],
    photo: NDArray[np.float32],
    mask: NDArray[np.bool_],
    exposure: float,
) -> dict[str, dict[str, float]]:
    """Differences in the pixels of each region, at the exposure of the whole picture."""
    if not regions:
        return {}
    shown = view.image(view.interpolate(np.stack(list(regions.values()), axis=1)))
    found = {}
    for i, name in enumerate(regions):
        inside = mask & (shown[..., i] > 0.5)
        if inside.sum() >= MIN_REGION_PIXELS:
            found[name] = compare_images(
                rendered, photo, mask=inside, exposure=exposure
            )
    return found


def _held_out(model: xr.DataTree, dim: str) -> set[str]:
    """Names of the lights or cameras that the fit did not see."""
    if "held_out" not in model.children:
        return set()
    held = model["held_out"].to_dataset()[f"{dim}_held_out"]
    return set(map(str, held[dim].values[held.values > 0]))


def write_comparisons(comparisons: Sequence[Comparison], folder: Path) -> list[Path]:
    """Write one picture per photograph.

    From left to right: photograph, rendering, diffuse part, surface part, and
    difference times ten (grey is zero).
    """
    make_private(folder)
    paths = []
    for one in comparisons:
        paths.append(folder / f"{one.light}_{one.camera}.png")
        write_png(paths[-1], side_by_side(one, components=True))
    return paths


def side_by_side(
    one: Comparison, *, components: bool = False, exposure: float | None = None
) -> NDArray[np.uint8]:
    """Photograph, rendering and difference (h, 3 w, 3) at one exposure, by default that
    of the photograph.

    With `components`, the diffuse and the surface part of the rendering stand before
    the difference (h, 5 w, 3).
    """
    exposure = one.error["exposure"] if exposure is None else exposure
    images = [
        one.photographed,
        one.rendered,
        *((one.diffuse, one.rendered - one.diffuse) if components else ()),
    ]
    shown = [tone_map(np.nan_to_num(image), exposure=exposure) for image in images]
    gap = np.where(
        one.mask[..., None],
        (one.rendered - np.nan_to_num(one.photographed)) * exposure,
        0.0,
    )
    difference = np.clip(127.5 + 10 * 127.5 * gap, 0, 255).astype(np.uint8)
    return np.concatenate([*shown, difference], axis=1)
