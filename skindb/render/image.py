"""Image files: linear OpenEXR, display-referred PNG, and the tone curve between them."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path

import imagecodecs
import numpy as np
import OpenEXR
import PIL.Image
from numpy.typing import ArrayLike

from skindb.errors import input_error
from skindb.files import open_regular, private_file
from skindb.limits import MAX_FRAME_BYTES
from skindb.types import AnyArray, Bytes, Float32, Float64, Mask, float64

Image = Float32
DAMAGED = "a file that is cut off, damaged or of another format"
FRAME_MS = 80  # of an animation
WHITE_QUANTILE = 0.995  # fraction of the lit pixels that a display image does not clip


def encode_srgb(linear: ArrayLike) -> Float64:
    """Encode linear values as sRGB display values, clipped to [0, 1] (IEC 61966-2-1)."""
    x = np.clip(float64(linear), 0, 1)
    return np.where(
        x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-12) ** (1 / 2.4) - 0.055
    )


def auto_exposure(radiance: ArrayLike, *, mask: Mask | None = None) -> float:
    """Exposure that maps the brightest lit pixels (99.5 % quantile of the largest
    channel) to display white.

    Parameters
    ----------
    radiance
        (..., 3) in any linear unit; 0 in the background, NaN where unknown.
    mask
        (...) pixels to include; default all. Pixels that are zero in all channels are
        always excluded.

    Returns
    -------
    float
        The factor, or 1 if no pixel is lit.
    """
    peak = float64(radiance).max(axis=-1)
    chosen = np.isfinite(peak) & (peak > 0)
    values = peak[chosen & mask] if mask is not None else peak[chosen]
    return float(1 / np.quantile(values, WHITE_QUANTILE)) if values.size else 1.0


def tone_map(radiance: ArrayLike, *, exposure: float | None = None) -> Bytes:
    """Convert linear Rec. 709 radiance to an 8-bit sRGB picture.

    The only curve is that of sRGB, so that pictures with equal exposures are comparable.

    Parameters
    ----------
    radiance
        (..., 3); NaN becomes black.
    exposure
        Factor before encoding; default `auto_exposure`.
    """
    values = np.nan_to_num(float64(radiance), nan=0.0, posinf=np.inf, neginf=0.0)
    gain = auto_exposure(radiance) if exposure is None else exposure
    with np.errstate(over="ignore"):
        return np.round(encode_srgb(values * gain) * 255).astype(np.uint8)


def write_png(path: str | Path, picture: AnyArray) -> None:
    """Write (h, w), (h, w, 3) or (h, w, 4) uint8 or uint16 values as PNG."""
    if picture.dtype not in (np.uint8, np.uint16):
        raise ValueError(
            f"the picture must be uint8 or uint16 for PNG, found {picture.dtype}"
        )
    private_file(path).write_bytes(
        imagecodecs.png_encode(np.ascontiguousarray(picture))
    )


def write_webp(path: str | Path, frames: Sequence[Bytes]) -> None:
    """Write an endless animation of sRGB pictures (h, w, 3) or (h, w, 4) as WebP."""
    first, *others = map(PIL.Image.fromarray, frames)
    options = {"append_images": others, "duration": FRAME_MS, "loop": 0, "quality": 90}
    first.save(private_file(path), "WEBP", save_all=True, **options)


def image_url(picture: Bytes, *, quality: int | None = None) -> str:
    """An sRGB picture (h, w, 3) or (h, w, 4) as an address that contains it: PNG, or
    WebP of a quality from 1 to 100.
    """
    values = np.ascontiguousarray(picture)
    if quality is None:
        kind, data = "png", imagecodecs.png_encode(values)
    else:
        kind, data = "webp", imagecodecs.webp_encode(values, level=quality)
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def shown_part(masks: Sequence[Mask], margin: int) -> tuple[slice, slice]:
    """Rows and columns around the pixels of any mask (h, w); all if no mask has one."""
    places = np.argwhere(np.any(masks, axis=0))
    if not len(places):
        return slice(None), slice(None)
    top, left = np.maximum(places.min(axis=0) - margin, 0).tolist()
    bottom, right = (places.max(axis=0) + margin + 1).tolist()
    return slice(top, bottom), slice(left, right)


def write_exr(
    path: str | Path,
    channels: AnyArray | Mapping[str, AnyArray],
    *,
    attributes: Mapping[str, str] | None = None,
) -> None:
    """Write an OpenEXR image with ZIP compression, as float32 unless the array is float16.

    Parameters
    ----------
    path
        File to write; an existing file is replaced.
    channels
        (h, w), (h, w, 3) or (h, w, 4) array, or a mapping from channel names to (h, w) arrays.
    attributes
        Text attributes of the header, such as units.
    """
    header = dict(attributes or {}) | {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
    }
    planes = {
        name: np.ascontiguousarray(plane) for name, plane in _planes(channels).items()
    }
    OpenEXR.File(header, planes).write(str(private_file(path)))


def read_exr(path: str | Path) -> tuple[Image, tuple[str, ...]]:
    """Read the channels of an OpenEXR file (h, w, c) as float32, and their names; R, G,
    B, A come first.
    """
    # of a missing file, the library only prints a line
    with open_regular(Path(path), MAX_FRAME_BYTES):
        pass
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            planes = {
                name: np.array(plane.pixels, np.float32)
                for name, plane in file.channels().items()
            }
    except (RuntimeError, ValueError, UserWarning):
        raise input_error(
            str(path),
            "must be a complete OpenEXR image",
            DAMAGED,
            "convert other formats to OpenEXR; write a damaged file again",
        ) from None
    colour = [name for name in "RGBA" if name in planes]
    names = (*colour, *sorted(set(planes) - set(colour)))
    return np.stack([planes[name] for name in names], axis=-1), names


def _planes(
    channels: AnyArray | Mapping[str, AnyArray],
) -> dict[str, AnyArray]:
    if isinstance(channels, Mapping):
        planes = dict(channels)
    elif channels.ndim == 2:
        planes = {"Y": channels}
    else:
        planes = dict(
            zip("RGBA"[: channels.shape[2]], np.moveaxis(channels, -1, 0), strict=True)
        )
    return {
        name: plane if plane.dtype == np.float16 else plane.astype(np.float32)
        for name, plane in planes.items()
    }
