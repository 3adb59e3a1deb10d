"""Pictures of all subjects at one exposure and one scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from skindb.render.image import auto_exposure, encode_srgb, shown_part, tone_map
from skindb.render.photographs import Comparison, side_by_side
from skindb.render.rendering import chosen_camera, render
from skindb.render.scene import from_model
from skindb.render.shading import trace_view
from skindb.schema import variables
from skindb.types import Array, Bytes, Mask, unit

Image = Array
Picture = Bytes
ERRORS = (  # maps of residuals, black where they are unknown
    (variables.HELD_OUT_ERROR, 0.2, "error under lights the fit did not see"),
    (variables.OUTLIER_FRACTION, 0.1, "samples the model does not explain"),
)
# directions of the two lights of a portrait
KEY_LIGHTS = ((-0.5, 0.35, 0.8), (0.55, 0.25, 0.8))
SAMPLES = 16  # rays per pixel of a portrait
MARGIN = 6  # pixels around a face


@dataclass(frozen=True)
class Portraits:
    """Linear portraits of all takes, and their common exposure on the page."""

    images: Mapping[str, Image]
    exposure: float

    def cut(self, images: Mapping[str, Image]) -> dict[str, Picture]:
        """Portraits at the exposure of the page, cropped to one scale."""
        drawn = [tone_map(image, exposure=self.exposure) for image in images.values()]
        cut = crop_alike(drawn, [image.sum(axis=2) > 0 for image in images.values()])
        return dict(zip(images, cut, strict=True))


def draw_portraits(models: Mapping[str, xr.DataTree]) -> Portraits:
    """Portraits with a common exposure that does not clip the brightest skin, so that
    skin tones are comparable.
    """
    images = {take: portrait(model) for take, model in models.items()}
    return Portraits(images, min(auto_exposure(image) for image in images.values()))


def portrait(model: xr.DataTree) -> Image:
    """Linear radiance (h, w, 3) of the model from the front under two lights of the dome,
    one from each side.
    """
    dome = model["dome"].dataset.load()
    towards = unit(dome[variables.LIGHT_POSITION].values)
    nearest = np.argmax(unit(np.array(KEY_LIGHTS)) @ towards.T, axis=1)
    names = [str(dome["light"].values[i]) for i in nearest]
    seen = render(model, lights=names, scale=1.6, samples=SAMPLES)
    return np.asarray(seen["radiance"].values)


def map_pictures(
    models: Mapping[str, xr.DataTree],
) -> dict[str, list[tuple[Picture, str]]]:
    """Maps of each model from the front, at one scale.

    Returns
    -------
    dict
        For each take normal, albedo, surface reflection, translucency and errors, each
        with its caption.
    """
    drawn = {take: _maps(model) for take, model in models.items()}
    flat = [image for maps in drawn.values() for image in maps]
    cut = iter(
        crop_alike([image for image, _, _ in flat], [mask for _, mask, _ in flat])
    )
    return {
        take: [(next(cut), text) for _, _, text in maps] for take, maps in drawn.items()
    }


def _maps(model: xr.DataTree) -> list[tuple[Picture, Mask, str]]:
    surface = from_model(model)
    camera, _ = chosen_camera(model["dome"].dataset.load(), None)
    view = trace_view(surface, camera.scaled(1.2), samples=2)
    shine, _ = surface.model.normal_reflectance(view.interpolate(surface.parameters))
    pictures = [
        ((view.interpolate(surface.normals) + 1) / 2, "normal"),
        (encode_srgb(view.interpolate(surface.diffuse)), "diffuse albedo"),
        (_scaled(shine, 0.12), "surface reflection at normal incidence, 0 to 0.12"),
    ]
    if surface.sigma_tr is not None:
        depth = np.clip(1 / view.interpolate(surface.sigma_tr) / 3, 0, 1)
        pictures.append((encode_srgb(depth), "translucency 1/sigma_tr, 0 to 3 mm"))
    fitted = model["fitted"].dataset
    for name, top, text in ERRORS:
        if name in fitted:
            values = view.interpolate(np.nan_to_num(fitted[name].values)[:, None])[:, 0]
            pictures.append((_scaled(values, top), f"{text}, 0 to {100 * top:g} %"))
    return [
        (_byte(view.image(values)), view.coverage > 0.5, text)
        for values, text in pictures
    ]


def crop_alike(pictures: Sequence[Picture], masks: Sequence[Mask]) -> list[Picture]:
    """Pictures (h, w, 3) cropped to the pixels that show a face in any of the `masks`
    (h, w), so that equal widths on the page correspond to equal scale. Without any face,
    pictures are not cropped.
    """
    part = shown_part(masks, MARGIN)
    return [image[part] for image in pictures]


def predictions(comparisons: Sequence[Comparison], exposure: float) -> list[Picture]:
    """Photograph, prediction and difference of each comparison side by side, all at one
    exposure and one scale.
    """
    part = shown_part([comparison.mask for comparison in comparisons], MARGIN)
    strips = [side_by_side(comparison, exposure=exposure) for comparison in comparisons]
    return [
        np.concatenate([panel[part] for panel in np.split(strip, 3, axis=1)], axis=1)
        for strip in strips
    ]


def _scaled(values: Image, top: float) -> Image:
    return np.repeat(np.clip(values / top, 0, 1)[:, None], 3, axis=1)


def _byte(image: Image) -> Picture:
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
