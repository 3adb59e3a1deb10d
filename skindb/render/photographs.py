"""Comparison of kept photographs with the model rendered from the same camera under the
same light.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.ndimage import binary_erosion, gaussian_filter
from skimage.metrics import structural_similarity

from skindb.errors import input_error, require
from skindb.files import make_private
from skindb.geometry.rays import RayScene
from skindb.render.image import auto_exposure, encode_srgb, tone_map, write_png
from skindb.render.scene import (
    Lights,
    Surface,
    cameras_from_dome,
    from_model,
    lights_from_dome,
)
from skindb.render.shading import (
    View,
    polariser_factor,
    require_translucency,
    shade_view,
    trace_view,
)
from skindb.render.surfels import surfel_confidence
from skindb.schema import check, fitted_of, variables
from skindb.schema.consent import honour_consent
from skindb.types import Array, Bytes, Float32, Float64, Mask, finite_rows, float64

# pixels, the default of Wang et al. 2004's uniform window in scikit-image
SSIM_WINDOW = 7
Float = Float64
Image = Array
# fraction of a pixel's rays that must meet the surface, to exclude silhouettes
MIN_COVERAGE = 0.999
# standard deviation of the Gaussian whose result is not fine, at least a pixel
FINE_MM = 1.0
MIN_FINE_LEVEL = 0.1  # of the 95 % quantile; darker pixels show noise


def compare_images(
    rendered: ArrayLike,
    photographed: ArrayLike,
    *,
    mask: Mask | None = None,
    exposure: float | None = None,
) -> dict[str, float]:
    """Differences of two linear Rec. 709 images at one common exposure.

    Parameters
    ----------
    rendered, photographed
        (h, w, 3) radiance in the same unit; pixels with NaN in either are excluded.
    mask
        (h, w) pixels to compare; default all.
    exposure
        Factor from radiance to display values for PSNR, SSIM and colour. By default,
        the 99.5 % quantile of the photograph is display white.

    Returns
    -------
    dict
        `rmse` (radiance), `relative_rmse` (over the RMS of the photograph),
        `relative_median` (of the differences over the radiance of each pixel), `psnr` [dB,
        peak 1] and `ssim` of the sRGB images, `delta_e_mean`, `delta_e_median`,
        `delta_e_95` (CIEDE2000, D65), `exposure`, `pixels`. SSIM is the mean over
        windows that lie entirely inside the mask, or NaN if there are none. Values
        above display white are clipped in both images, except for the two linear
        errors.
    """
    ours, theirs, inside = _prepared(rendered, photographed, mask)
    gain = auto_exposure(theirs, mask=inside) if exposure is None else exposure
    error = np.sqrt(np.mean((ours - theirs)[inside] ** 2))
    level = np.sqrt(np.mean(theirs[inside] ** 2))
    shown = inside & (theirs.sum(axis=2) > 0)
    of_pixels = np.abs(ours - theirs)[shown].sum(axis=1) / theirs[shown].sum(axis=1)
    encoded = [encode_srgb(image * gain) for image in (ours, theirs)]
    noise = np.mean((encoded[0] - encoded[1])[inside] ** 2)
    delta = delta_e(ours[inside] * gain, theirs[inside] * gain)
    return {
        "rmse": float(error),
        "relative_rmse": float(error / level) if level > 0 else float("nan"),
        "relative_median": float(np.median(of_pixels)) if shown.any() else float("nan"),
        "psnr": float(-10 * np.log10(noise)) if noise > 0 else float("inf"),
        "ssim": _ssim(encoded[0], encoded[1], inside),
        "delta_e_mean": float(delta.mean()),
        "delta_e_median": float(np.median(delta)),
        "delta_e_95": float(np.quantile(delta, 0.95)),
        "exposure": gain,
        "pixels": float(inside.sum()),
    }


def delta_e(colours: ArrayLike, references: ArrayLike) -> Float:
    """CIEDE2000 differences of display-referred linear Rec. 709 colours (..., 3),
    clipped to [0, 1] (CIE 142-2001).
    """
    import colour  # takes longer to import than most commands of the package to run

    lab = []
    for values in (colours, references):
        xyz = colour.RGB_to_XYZ(np.clip(float64(values), 0, 1), "sRGB")
        lab.append(colour.XYZ_to_Lab(xyz))
    return float64(colour.delta_E(lab[0], lab[1], method="CIE 2000"))


def _prepared(
    rendered: ArrayLike, photographed: ArrayLike, mask: Mask | None
) -> tuple[Float, Float, Mask]:
    ours = float64(rendered)
    theirs = float64(photographed)
    if ours.shape != theirs.shape or ours.ndim != 3 or ours.shape[2] != 3:
        raise ValueError(
            f"both images must have the shape (h, w, 3), found {ours.shape} and {theirs.shape}"
        )
    finite = finite_rows(ours) & finite_rows(theirs)
    inside = np.asarray(finite if mask is None else finite & mask, np.bool_)
    if not inside.any():
        raise ValueError(
            "at least one pixel must be comparable: the mask is empty, or every pixel is NaN"
        )
    return (
        np.where(inside[..., None], ours, 0),
        np.where(inside[..., None], theirs, 0),
        inside,
    )


def _ssim(rendered: Float, photographed: Float, inside: Mask) -> float:
    if min(inside.shape) < SSIM_WINDOW:
        return float("nan")
    centres = binary_erosion(inside, np.ones((SSIM_WINDOW, SSIM_WINDOW), bool))
    if not centres.any():
        return float("nan")
    _, local = structural_similarity(
        rendered,
        photographed,
        win_size=SSIM_WINDOW,
        data_range=1.0,
        channel_axis=-1,
        full=True,
    )
    return float(local[centres].mean())


def fine_contrast(
    rendered: Image,
    photographed: Image,
    mask: Mask,
    variance: Image,
    sigma: float,
) -> dict[str, float]:
    """How much of a photograph's fine contrast a rendering has: of what a Gaussian removes
    from the mean channel, relative to the smoothed photograph.

    Parameters
    ----------
    rendered, photographed
        (h, w, 3) radiance.
    mask
        (h, w) pixels to compare; those near its edge and in shadows are excluded.
    variance
        (h, w) [radiance^2] of the noise of the photograph's mean channel.
    sigma
        Standard deviation of the Gaussian [pixel].

    Returns
    -------
    dict
        `fine_contrast`, the standard deviation of the rendering over that of the photograph
        without its noise, and `fine_gain`, their covariance over the variance of the latter:
        the part that is in the right place. NaN if there is only noise.
    """
    blurred = partial(gaussian_filter, sigma=sigma)
    weight = blurred(mask.astype(np.float64))
    ours, theirs = (
        np.where(mask, np.nan_to_num(image.mean(axis=2, dtype=np.float64)), 0)
        for image in (rendered, photographed)
    )
    covered = np.maximum(weight, 1e-9)
    level = blurred(theirs) / covered
    inside = weight > MIN_COVERAGE
    if not inside.any():
        return {"fine_contrast": np.nan, "fine_gain": np.nan}
    inside &= level > MIN_FINE_LEVEL * np.quantile(level[inside], 0.95)
    fine = [
        ((image - blurred(image) / covered)[inside] / level[inside])
        for image in (ours, theirs)
    ]
    # of white noise behind the filter: 1 - 2 g(0) + sum of g^2
    passed = max(1 - 3 / (4 * np.pi * sigma**2), 0.0)
    noise = passed * (variance[inside] / level[inside] ** 2).mean()
    (own, common), (_, seen) = np.cov(fine)
    signal = seen - noise if seen > noise else np.nan
    return {
        "fine_contrast": float(np.sqrt(own / signal)),
        "fine_gain": float(common / signal),
    }


@dataclass(frozen=True)
class Comparison:
    """One photograph and the model's prediction of it."""

    light: str
    camera: str
    held_out: bool  # the fit did not see this light or this camera
    photographed: Float32  # (h, w, 3) radiance
    rendered: Float32  # (h, w, 3) radiance
    mask: Mask  # (h, w) pixels compared
    # part of these pixels that shows unfitted surfels, with the values of the nearest fitted
    # ones
    filled: float
    error: dict[str, float]  # from `compare_images` and `fine_contrast`
    diffuse: Float32  # (h, w, 3) diffuse part of the rendering


def compare_photographs(
    model: xr.DataTree,
    capture: xr.DataTree,
    *,
    subsurface: bool = False,
    samples: int = 2,
) -> list[Comparison]:
    """Predict the photographs that ingest kept, by the whole face: surfels without a fit take
    the values of the nearest fitted one, as in pictures.

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
    compared = _compared(model, capture, subsurface=subsurface, samples=samples)
    if not (comparisons := [*compared]):
        raise input_error(
            "photographs",
            "at least one must show the face",
            "none",
            "ingest the capture again with more --photographs",
        )
    return comparisons


def _compared(
    model: xr.DataTree, capture: xr.DataTree, *, subsurface: bool, samples: int
) -> Iterator[Comparison]:
    """Comparisons of the photographs whose cameras see the face."""
    photographs = kept_photographs(capture)
    dome = capture["dome"].to_dataset()
    surface = from_model(model)
    if subsurface:
        require_translucency(surface)
    scene = RayScene(surface.vertices, surface.faces)
    cameras = cameras_from_dome(dome)
    # of the model, as its intensities contain the estimated gains
    lights = lights_from_dome(model["dome"].to_dataset())
    unseen_lights, unseen_cameras = (
        held_out_names(model, d) for d in ("light", "camera")
    )
    is_filled = surfel_confidence(fitted_of(model)) == 0
    for photograph in photographs:
        at_light = int(photograph[variables.PHOTOGRAPH_LIGHT])
        at_camera = int(photograph[variables.PHOTOGRAPH_CAMERA])
        camera = cameras[at_camera]
        view = trace_view(surface, camera, samples=samples, scene=scene)
        lamp = lights.select(at_light)
        diffuse, gloss = _shaded(view, surface, lamp, scene, subsurface=subsurface)
        if variables.LIGHT_POLARISATION in dome:
            of_light = dome[variables.LIGHT_POLARISATION].values[at_light]
            both = float(of_light * dome[variables.CAMERA_POLARISATION][at_camera])
            gloss *= polariser_factor(view, lamp.position[0], both, surface.eta)
        rendered = diffuse + gloss
        radiance = photograph[variables.PHOTOGRAPH_RADIANCE].values
        photo = radiance[: camera.height, : camera.width].astype(np.float32)
        mask = (view.coverage >= MIN_COVERAGE) & finite_rows(photo)
        if not mask.any():
            continue
        light = str(dome["light"].values[at_light])
        name = str(dome["camera"].values[at_camera])
        is_unseen = light in unseen_lights or name in unseen_cameras
        error = compare_images(rendered, photo, mask=mask)
        noise = _photograph_variance(photo, capture, at_camera)
        width = camera.pixel_width(view.position.mean(axis=0))
        error |= fine_contrast(rendered, photo, mask, noise, max(FINE_MM / width, 1))
        filled = view.image(view.interpolate(is_filled[:, None]))[..., 0]
        yield Comparison(
            light,
            name,
            is_unseen,
            photo,
            rendered,
            mask,
            float(filled[mask].mean()),
            error,
            diffuse,
        )


def _shaded(
    view: View, surface: Surface, lamp: Lights, scene: RayScene, *, subsurface: bool
) -> tuple[Float32, Float32]:
    """Diffuse and surface part (h, w, 3) of a view under one light."""
    diffuse = shade_view(
        view, surface, lamp, scene, subsurface=subsurface, terms=("diffuse",)
    )
    return diffuse[0], shade_view(view, surface, lamp, scene, terms=("surface",))[0]


def _photograph_variance(photo: Image, capture: xr.DataTree, camera: int) -> Image:
    """Variance (h, w) of the mean channel [radiance^2]; 0 where the noise is not known."""
    noise = xr.Dataset()
    if "samples" in capture.children:
        noise = capture["samples"].to_dataset()
    names = (
        variables.RADIANCE_LIMIT,
        variables.RADIANCE_READ_VARIANCE,
        variables.RADIANCE_SHOT_VARIANCE,
    )
    variance = np.zeros(photo.shape[:2])
    if not all(name in noise for name in names):
        return variance
    limit, read, shot = (noise[name].values[camera] for name in names)
    for c, radiance in enumerate(np.maximum(np.moveaxis(photo, 2, 0), 0)):
        # the longest exposure whose limit is not exceeded
        exposure = np.minimum(np.searchsorted(limit[c], radiance), len(limit[c]) - 1)
        variance += (read[c][exposure] + shot[c][exposure] * radiance) / 9
    return variance


def kept_photographs(capture: xr.DataTree) -> list[xr.Dataset]:
    """The photographs of a capture, one by one.

    Raises
    ------
    InputError
        If ingest kept none.
    """
    require(
        "photographs" in capture.children,
        "capture",
        "must contain kept photographs",
        "none",
        "ingest the capture again with --photographs 4",
    )
    photographs = capture["photographs"].to_dataset()
    needed = (
        variables.PHOTOGRAPH_RADIANCE,
        variables.PHOTOGRAPH_LIGHT,
        variables.PHOTOGRAPH_CAMERA,
    )
    check(photographs, needed, where="photographs")
    return [
        photographs.isel(photograph=i) for i in range(photographs.sizes["photograph"])
    ]


def held_out_names(model: xr.DataTree, dim: str) -> set[str]:
    """Names of the lights or cameras that the fit did not see."""
    if "held_out" not in model.children:
        return set()
    held = model["held_out"].dataset[f"{dim}_held_out"]
    return set(map(str, held[dim].values[held.values > 0]))


def write_comparisons(comparisons: Sequence[Comparison], folder: Path) -> list[Path]:
    """Write one picture per photograph.

    From left to right: photograph, rendering, diffuse part, surface part, and
    difference times ten (grey is zero).
    """
    make_private(folder)
    paths = []
    for comparison in comparisons:
        paths.append(folder / f"{comparison.light}_{comparison.camera}.png")
        write_png(paths[-1], side_by_side(comparison, components=True))
    return paths


def side_by_side(
    comparison: Comparison, *, components: bool = False, exposure: float | None = None
) -> Bytes:
    """Photograph, rendering and difference (h, 3 w, 3) at one exposure, by default that
    of the photograph.

    With `components`, the diffuse and the surface part of the rendering stand before
    the difference (h, 5 w, 3).
    """
    exposure = comparison.error["exposure"] if exposure is None else exposure
    images = [
        comparison.photographed,
        comparison.rendered,
        *(
            (comparison.diffuse, comparison.rendered - comparison.diffuse)
            if components
            else ()
        ),
    ]
    panels = [tone_map(np.nan_to_num(image), exposure=exposure) for image in images]
    gap = np.where(
        comparison.mask[..., None],
        (comparison.rendered - np.nan_to_num(comparison.photographed)) * exposure,
        0.0,
    )
    difference = np.clip(127.5 + 10 * 127.5 * gap, 0, 255).astype(np.uint8)
    return np.concatenate([*panels, difference], axis=1)
