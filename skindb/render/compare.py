"""Error measures between a rendering and a photograph."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_erosion
from skimage.metrics import structural_similarity

from skindb.render.image import auto_exposure, encode_srgb
from skindb.types import Mask

# pixels, the default of Wang et al. 2004's uniform window in scikit-image
SSIM_WINDOW = 7
Float = NDArray[np.float64]


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
        `rmse` (radiance), `relative_rmse` (over the RMS of the photograph), `psnr` [dB,
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
    shown = [encode_srgb(image * gain) for image in (ours, theirs)]
    noise = np.mean((shown[0] - shown[1])[inside] ** 2)
    delta = delta_e(ours[inside] * gain, theirs[inside] * gain)
    return {
        "rmse": float(error),
        "relative_rmse": float(error / level) if level > 0 else float("nan"),
        "psnr": float(-10 * np.log10(noise)) if noise > 0 else float("inf"),
        "ssim": _ssim(shown[0], shown[1], inside),
        "delta_e_mean": float(delta.mean()),
        "delta_e_median": float(np.median(delta)),
        "delta_e_95": float(np.quantile(delta, 0.95)),
        "exposure": gain,
        "pixels": float(inside.sum()),
    }


def delta_e(first: ArrayLike, second: ArrayLike) -> Float:
    """CIEDE2000 differences of display-referred linear Rec. 709 colours (..., 3),
    clipped to [0, 1] (CIE 142-2001).
    """
    import colour  # takes longer to import than most commands of the package to run

    lab = []
    for values in (first, second):
        xyz = colour.RGB_to_XYZ(np.clip(np.asarray(values, np.float64), 0, 1), "sRGB")
        lab.append(colour.XYZ_to_Lab(xyz))
    return np.asarray(colour.delta_E(lab[0], lab[1], method="CIE 2000"), np.float64)


def _prepared(
    rendered: ArrayLike, photographed: ArrayLike, mask: Mask | None
) -> tuple[Float, Float, Mask]:
    ours = np.asarray(rendered, np.float64)
    theirs = np.asarray(photographed, np.float64)
    if ours.shape != theirs.shape or ours.ndim != 3 or ours.shape[2] != 3:
        raise ValueError(
            f"both images must have the shape (h, w, 3), found {ours.shape} and {theirs.shape}"
        )
    known = np.isfinite(ours).all(axis=-1) & np.isfinite(theirs).all(axis=-1)
    inside = np.asarray(known if mask is None else known & mask, np.bool_)
    if not inside.any():
        raise ValueError(
            "at least one pixel must be comparable: the mask is empty, or every pixel is NaN"
        )
    return (
        np.where(inside[..., None], ours, 0),
        np.where(inside[..., None], theirs, 0),
        inside,
    )


def _ssim(first: Float, second: Float, inside: Mask) -> float:
    if min(inside.shape) < SSIM_WINDOW:
        return float("nan")
    whole = binary_erosion(inside, np.ones((SSIM_WINDOW, SSIM_WINDOW), bool))
    if not whole.any():
        return float("nan")
    _, local = structural_similarity(
        first, second, win_size=SSIM_WINDOW, data_range=1.0, channel_axis=-1, full=True
    )
    return float(local[whole].mean())
