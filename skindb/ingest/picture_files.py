"""Picture files of cameras that are no sensors of a dome: PNG, TIFF, JPEG, BMP, OpenEXR."""

import io
import struct
import warnings
from pathlib import Path

import imagecodecs
import numpy as np
import tifffile
from PIL import ExifTags, Image, ImageOps

from skindb.errors import input_error
from skindb.files import read_regular
from skindb.format.fields import short
from skindb.format.frames import read_frame
from skindb.limits import MAX_FRAME_BYTES, MAX_FRAME_PIXELS
from skindb.types import AnyArray

Picture = AnyArray  # (h, w, 3) uint8, uint16, or float radiance
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".exr")
FORMATS = "PNG, TIFF, JPEG, BMP or OpenEXR"


def read_picture(path: Path) -> Picture:
    """A picture (h, w, 3) as it is looked at: uint8, uint16 or float radiance; grey is
    repeated, what is transparent is black, and the orientation of JPEG files applied.

    Raises
    ------
    InputError
        If it is not a whole picture of a known format.
    """
    if path.suffix.lower() == ".exr":
        return read_frame(path)
    content = read_regular(path, MAX_FRAME_BYTES)
    try:
        # by its content, as names may be wrong
        if content.startswith(b"\x89PNG"):
            picture = _png(content)
        elif content[:4] in (b"II*\0", b"MM\0*"):
            picture = _tiff(content)
        else:
            with Image.open(io.BytesIO(content), formats=("JPEG", "BMP")) as image:
                picture = np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
        if picture.ndim == 2:
            picture = picture[..., None]
        height, width, _ = picture.shape
        if height * width > MAX_FRAME_PIXELS:
            raise ValueError(
                f"{width} x {height} pixels, more than {MAX_FRAME_PIXELS:,}"
            )
        if picture.dtype not in (np.uint8, np.uint16):
            raise ValueError(f"values of {picture.dtype}, not of 8 or 16 bits")
    except (ValueError, RuntimeError, OSError, Image.DecompressionBombError) as error:
        raise input_error(
            str(path),
            f"a picture must be a whole {FORMATS} file",
            # libraries name what only they know
            short(str(error))
            if type(error) is ValueError
            else "what cannot be decoded",
            "export it as PNG, JPEG or plain TIFF; raw and HEIC files have to be converted",
        ) from None
    colour = picture[..., : 3 if picture.shape[2] > 2 else 1]
    if picture.shape[2] in (2, 4):  # what has no opacity has any colour
        colour = np.where(picture[..., -1:] > 0, colour, 0)
    return np.array(np.broadcast_to(colour, (height, width, 3)))


def exif_exposure(path: Path) -> tuple[float, bool]:
    """Exposure by EXIF, seconds x ISO / (100 x f-number^2), 0 if it is not stated; and
    whether the camera chose the white balance.
    """
    base = ExifTags.Base
    try:
        with (
            warnings.catch_warnings(action="ignore"),
            Image.open(path, formats=("JPEG", "PNG", "TIFF")) as image,
        ):
            tags = image.getexif().get_ifd(ExifTags.IFD.Exif)
        exposure = (
            float(tags.get(base.ExposureTime, 0))
            * float(tags.get(base.ISOSpeedRatings, 100) or 100)
            / (100 * float(tags.get(base.FNumber, 1) or 1) ** 2)
        )
    except (OSError, ValueError, TypeError, SyntaxError, ArithmeticError, struct.error):
        return 0.0, False  # faulty tags are no faults of the picture
    return (exposure if 0 < exposure < np.inf else 0.0), tags.get(
        base.WhiteBalance
    ) == 0


def _png(content: bytes) -> Picture:
    """A PNG file; `ValueError` if its EXIF turns it."""
    if b"eXIf" in content:
        with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
            if image.getexif().get(ExifTags.Base.Orientation, 1) != 1:
                raise ValueError("a turned picture")
    return imagecodecs.png_decode(content)


def _tiff(content: bytes) -> Picture:
    """The only page of a TIFF; `ValueError` for what would be read wrongly."""
    with tifffile.TiffFile(io.BytesIO(content)) as file:
        page = file.pages[0]
        orientation = page.tags.get("Orientation")
        wrong = {
            "several pages": len(file.pages) > 1,
            "a palette or inverted values": page.photometric
            not in (tifffile.PHOTOMETRIC.RGB, tifffile.PHOTOMETRIC.MINISBLACK),
            f"{page.bitspersample} bits": page.bitspersample not in (8, 16),
            "a channel that is no opacity": not {1, 2}.issuperset(page.extrasamples),
            "separate planes": page.ndim > 2 and page.planarconfig != 1,
            "a turned picture": orientation is not None and orientation.value != 1,
        }
        if found := [what for what, is_so in wrong.items() if is_so]:
            raise ValueError(", ".join(found))
        return page.asarray()
