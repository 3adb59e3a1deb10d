"""Frames of cameras: 8- and 16-bit PNG and TIFF, linear OpenEXR, whose content is checked
after every load; templates of their paths, which must stay inside the folder.
"""

import contextlib
import hashlib
import io
import logging
import math
import operator
import os
import stat
import struct
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import imagecodecs
import Imath
import numpy as np
import OpenEXR
import tifffile
from tifffile import PHOTOMETRIC

from skindb.elementwise import thread_count
from skindb.errors import Fault, InputError, attempt, input_error, require, require_none
from skindb.files import open_regular, private_file, read_regular
from skindb.format._frame_kernels import undo_filters, unpack_lines
from skindb.format.fields import IDENTIFIER, Fields, short
from skindb.limits import (
    MAX_EXPOSURES,
    MAX_FRAME_BYTES,
    MAX_FRAME_PIXELS,
    MAX_PNG_RATIO,
    MAX_RECHECKED_BYTES,
)
from skindb.render.image import write_exr, write_png
from skindb.types import AnyArray, Index, Values16

Frame = AnyArray  # (h, w, 3) uint8, uint16, float16 or float32
Header = tuple[int, int, int, np.dtype[Any]]  # width, height, channels, type
Codec = tuple[Callable[[BinaryIO], Header], Callable[[Path, bytes], Frame]]
Digests = dict[Path, str]  # sha256 of the bytes that were decoded
PNG_HEAD = b"\x89PNG\r\n\x1a\n"
PNG_TAIL = b"IEND\xaeB`\x82"
PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}  # colour type of IHDR
PNG_CRITICAL = {b"IHDR", b"IDAT", b"IEND"}
# lines per chunk, by compression
EXR_LINES = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
EXR_ZIPPED = (2, 3)  # compressions ZIPS and ZIP
EXR_HALF = 1  # type of a channel
# of a file; a count far above R, G, B, alpha and depth indicates damage
MAX_CHANNELS = 16
CURE = "copy the file from the camera again"
RGB_RULE = "a frame must have the channels R, G, B"
RGB_CURE = "write RGB frames"
# otherwise its messages on damage go to standard error
logging.getLogger("tifffile").addHandler(logging.NullHandler())
# errors of tifffile for damaged tags, found by changing bytes; MemoryError: an absurd
# size in the header
TIFF_DAMAGE = (
    ValueError,
    RuntimeError,
    LookupError,
    TypeError,
    ArithmeticError,
    MemoryError,
    struct.error,
)
FLOAT = Imath.PixelType(Imath.PixelType.FLOAT)
DAMAGED = "one that is cut off or damaged"
EXPOSURE = "exposure"
LIGHT = "light"
CAMERA = "camera"
SITE = "site"
PLACEMENT = "placement"
EXPOSURE_SECONDS = (1e-9, 1e5)  # s: from a laser pulse to a day


@dataclass(frozen=True)
class FrameKind:
    """Size and depth that the frames of a camera must have; `bits` is 0 for linear OpenEXR."""

    width: int
    height: int
    bits: int

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the pixels: uint8, uint16, or float32, which includes half floats."""
        return np.dtype(
            "float32" if self.bits == 0 else "uint8" if self.bits <= 8 else "uint16"
        )


class UnreadableError(ValueError):
    """A file that is not an image of the format that its name states, or that is incomplete."""


def is_linear(path: str | Path) -> bool:
    """Whether a file holds radiance (OpenEXR) instead of sensor values."""
    return Path(path).suffix.lower() == ".exr"


def header_faults(path: Path, kind: FrameKind, key: str) -> list[Fault]:
    """Faults of a frame according to its header, without decoding it.

    Parameters
    ----------
    path
        File of the frame.
    kind
        Declared size and depth.
    key
        Key of the JSON file that lists the frame, for the message.
    """
    place = f"{path} ({key})"
    faults = list[Fault]()
    header = attempt(faults, lambda: _file_header(path), where=place)
    if header is None:
        return faults
    width, height, channels, dtype = header
    if (width, height) != (kind.width, kind.height):
        rule = f"a frame must be {kind.width} x {kind.height} pixels, as declared for its camera"
        cure = "correct width and height, or the frames"
        faults.append(Fault(place, rule, f"{width} x {height}", cure))
    if channels != 3:
        faults.append(Fault(place, RGB_RULE, f"{channels} channels", RGB_CURE))
    if dtype != kind.dtype:
        rule = "OpenEXR holds half or float"
        if kind.bits:
            rule = f"bit_depth {kind.bits} means {kind.dtype}"
        cure = "correct bit_depth, or write frames of that depth"
        faults.append(Fault(place, rule, str(dtype), cure))
    return faults


def frame_size(path: Path) -> tuple[int, int] | None:
    """Width and height according to the header; None if there is none."""
    header = attempt([], lambda: _file_header(path))
    return None if header is None else header[:2]


def _file_header(path: Path) -> Header:
    """Header of a file, which must be regular and within the size limit."""
    try:
        with _whole_image(path), open_regular(path, MAX_FRAME_BYTES) as stream:
            return _header(path, stream)
    except OSError as error:
        finding = error.strerror or str(error)
        fault = Fault(
            str(path),
            "a frame must be readable",
            finding,
            "check its permissions and the disk",
        )
        raise InputError(fault) from None


def _header(path: Path, stream: BinaryIO) -> Header:
    """Width, height, channels and type of a frame."""
    place = str(path)
    width, height, channels, dtype = _codec(path)[0](stream)
    require(channels <= MAX_CHANNELS, place, RGB_RULE, f"{channels} channels", RGB_CURE)
    require(
        min(width, height) > 0 and width * height <= MAX_FRAME_PIXELS,
        place,
        f"a frame must have 1 to {MAX_FRAME_PIXELS:,} pixels",
        f"{width} x {height} in its header",
        CURE,
    )
    return width, height, channels, dtype


@contextmanager
def _whole_image(path: Path) -> Iterator[None]:
    """Context that raises an `UnreadableError` as an `InputError`."""
    try:
        yield
    except UnreadableError as error:
        raise input_error(
            str(path), "a frame must be a whole image file", str(error), CURE
        ) from None


def read_frame(
    path: Path, kind: FrameKind | None = None, digests: Digests | None = None
) -> Frame:
    """Decode a frame completely.

    Parameters
    ----------
    path
        PNG, TIFF or OpenEXR file.
    kind
        Required size and depth; default any.
    digests
        Receives the SHA-256 of the file.

    Returns
    -------
    ndarray
        (h, w, 3) uint8 or uint16 values of the file, or float16 or float32 radiance of
        OpenEXR.

    Raises
    ------
    InputError
        If the file is absent, incomplete, or not of this kind.
    """
    with _whole_image(path):
        decode = _codec(path)[1]
        content = read_regular(path, MAX_FRAME_BYTES)
        # checks the size before memory for it is allocated
        _header(path, io.BytesIO(content))
        frame = decode(path, content)
    shape = frame.shape[:2] if kind is None else (kind.height, kind.width)
    dtype = frame.dtype if kind is None else kind.dtype
    same_type = frame.dtype in (dtype, np.float16 if dtype == np.float32 else dtype)
    require(
        frame.shape == (*shape, 3) and same_type,
        str(path),
        f"a frame must be {shape[1]} x {shape[0]} with R, G, B of {dtype}",
        f"an array of {' x '.join(map(str, frame.shape))} {frame.dtype}",
        "correct the JSON file that describes it, or the frames",
    )
    if digests is not None:
        digests[path] = hashlib.sha256(content).hexdigest()
    return frame


def read_frames(
    paths: Iterable[Path], kind: FrameKind | None = None, digests: Digests | None = None
) -> list[Frame]:
    """Several frames; `InputError` with the faults of all of them."""
    faults = list[Fault]()
    frames = [
        attempt(faults, partial(read_frame, path, kind, digests)) for path in paths
    ]
    require_none(faults)
    return [frame for frame in frames if frame is not None]


def write_frame(path: Path, frame: Frame) -> None:
    """Write (h, w, 3): uint8 or uint16 values as PNG or TIFF, floats as OpenEXR, by the
    suffix of the path.
    """
    suffix = path.suffix.lower()
    if is_linear(path) != (frame.dtype.kind == "f"):
        raise ValueError(f"{suffix} does not hold {frame.dtype}")
    if suffix == ".exr":
        write_exr(path, frame)
    elif suffix == ".png":
        write_png(path, frame)
    elif suffix in (".tif", ".tiff"):
        tifffile.imwrite(
            private_file(path), frame, photometric="rgb", compression="zstd"
        )
    else:
        raise ValueError(f"frames are .png, .tif or .exr, not {suffix!r}")


def _png_header(stream: BinaryIO) -> Header:
    head = stream.read(33)
    size = stream.seek(0, io.SEEK_END)
    stream.seek(max(size - len(PNG_TAIL), 0))
    complete = stream.read() == PNG_TAIL or _png_ends(stream, size)
    if len(head) < 33 or head[:8] != PNG_HEAD:
        raise UnreadableError("not a PNG file")
    if not complete:
        raise UnreadableError(DAMAGED)
    width, height, bits, colour = struct.unpack(">IIBB", head[16:26])
    if width * height * PNG_CHANNELS.get(colour, 1) * bits > 8 * MAX_PNG_RATIO * size:
        raise UnreadableError(
            f"a PNG file of {size:,} bytes whose header states {width} x {height} pixels"
        )
    dtype = np.dtype("uint16" if bits == 16 else "uint8")
    return width, height, PNG_CHANNELS.get(colour, 0), dtype


def _png_ends(stream: BinaryIO, size: int) -> bool:
    """Whether the chunks end within the file; data after the end, such as padding to
    blocks, is allowed.
    """
    offset = len(PNG_HEAD)
    while offset + 12 <= size:
        stream.seek(offset)
        length, kind = struct.unpack(">I4s", stream.read(8))
        offset += 12 + length
        if kind == b"IEND":
            return bool(offset <= size)
    return False


def _tiff_header(stream: BinaryIO) -> Header:
    try:
        with tifffile.TiffFile(stream) as file:
            page = file.pages[0]
            # damaged tags are tuples or text
            height, width, *channels = (operator.index(side) for side in page.shape)
            if page.dtype is not None:
                count = 3 if _has_filters(page) else math.prod(channels)
                return width, height, count, np.dtype(page.dtype)
    except TIFF_DAMAGE:
        pass
    raise UnreadableError(DAMAGED)


def _has_filters(page: Any) -> bool:
    """Whether the pixels are those of a sensor with a colour filter array (TIFF/EP)."""
    return bool(page.photometric == PHOTOMETRIC.CFA and page.ndim == 2)


@dataclass(frozen=True)
class _ExrBlocks:
    """Blocks of lines of a scan-line OpenEXR file with one part."""

    lines: int  # of a block
    offsets: list[int]  # of the blocks in the file, from top to bottom
    # of compressed half floats, the channels in each line; otherwise empty
    channels: list[str]


def _exr_part(stream: BinaryIO) -> Any:
    """First part of a file, with its header alone."""
    try:
        file = OpenEXR.File(stream, separate_channels=True, header_only=True)
        return file.parts[0]
    except (ValueError, RuntimeError, IndexError):
        raise UnreadableError(DAMAGED) from None


def _exr_size(part: Any) -> tuple[int, int]:
    """Width and height of a part."""
    low, high = (np.asarray(corner) for corner in part.header["dataWindow"])
    width, height = (high - low + 1).tolist()
    return width, height


def _exr_header(stream: BinaryIO) -> Header:
    part = _exr_part(stream)
    width, height = _exr_size(part)
    try:
        _exr_blocks(stream, height)
        names = {channel.name for channel in part.header["channels"]}
    except (struct.error, ValueError, IndexError):
        # the library also opens incomplete headers
        raise UnreadableError(DAMAGED) from None
    if len(names) > MAX_CHANNELS:
        raise UnreadableError(f"an OpenEXR file of {len(names)} channels")
    channels = 3 if names.issuperset("RGB") else len(names)
    return width, height, channels, np.dtype("float32")


def _exr_blocks(stream: BinaryIO, height: int) -> _ExrBlocks | None:
    """Blocks of a file, of which the last must end inside it, because the library only
    prints a message; None for tiled, deep and multi-part files.
    """
    size = stream.seek(0, os.SEEK_END)

    def content(offset: int, count: int) -> bytes:
        stream.seek(min(offset, size))
        # a damaged file may contain any number
        return stream.read(min(max(count, 0), size))

    offset = 8
    lines = 0
    channels = b""
    zipped = False
    while (attribute := content(offset, 600))[:1] != b"\0":
        name, _, rest = attribute.partition(b"\0")
        kind = rest.partition(b"\0")[0]
        value = offset + len(name) + len(kind) + 6
        # unsigned: no step back
        length = int(struct.unpack("<I", content(value - 4, 4))[0])
        if name == b"compression":
            compression = content(value, 1)[0]
            lines = EXR_LINES.get(compression, 0)
            zipped = compression in EXR_ZIPPED
        elif name == b"channels":
            channels = content(value, min(length, MAX_CHANNELS * 300))
        offset = value + length
    flags = content(5, 1)[0]
    if not lines or flags & 0b11010:
        return None
    count = -(-height // lines)
    table = content(offset + 1, 8 * count)
    if not 0 < 8 * count == len(table):
        raise UnreadableError(DAMAGED)
    offsets = np.frombuffer(table, "<u8")
    end = int(offsets.max()) + 8
    if end <= size:
        end += int.from_bytes(content(end - 4, 4), "little")
    if end > size or int(offsets.min()) == 0:
        raise UnreadableError(DAMAGED)
    return _ExrBlocks(
        lines, offsets.tolist(), _half_channels(channels) if zipped else []
    )


def _half_channels(content: bytes) -> list[str]:
    """Names of channels of half floats in full resolution; empty if one is of another kind."""
    names = []
    while content[:1] not in (b"", b"\0"):
        name, _, rest = content.partition(b"\0")
        kind, _, *sampling = struct.unpack("<iIii", rest[:16])
        if kind != EXR_HALF or sampling != [1, 1]:
            return []
        names.append(name.decode())
        content = rest[16:]
    # in this order they are in a line
    return names if names == sorted(set(names)) else []


def _decode_png(_: Path, content: bytes) -> Frame:
    width, height, bits, colour, *kinds = struct.unpack_from(">IIBBBBB", content, 16)
    chunks = _png_chunks(content)
    names = {name for name, _ in chunks}
    # critical chunks begin with a capital
    plain = not any(name[:1].isupper() for name in names - PNG_CRITICAL)
    if bits < 8 or colour != 2 or any(kinds) or not plain or b"tRNS" in names:
        return _decode_any_png(content)
    dtype = np.dtype("uint16" if bits == 16 else "uint8")
    step = 3 * dtype.itemsize
    rows = np.empty((height, 1 + width * step), np.uint8)
    packed = b"".join(data for name, data in chunks if name == b"IDAT")
    try:
        size = len(imagecodecs.deflate_decode(packed, out=rows.reshape(-1).data))
    except RuntimeError:
        size = 0
    out = np.empty((height, width, 3), dtype)
    swap = int(bits == 16 and sys.byteorder == "little")
    values = out.view(np.uint8).reshape(height, -1)
    if size != rows.size or not undo_filters(rows, step, swap, values):
        return _decode_any_png(content)  # which ignores data after the last row
    return out


def _png_chunks(content: bytes) -> list[tuple[bytes, bytes]]:
    """Names and data of the chunks up to the end of the picture."""
    chunks = []
    offset = len(PNG_HEAD)
    name = b""
    while name != b"IEND":
        head = content[offset : offset + 8].ljust(8, b"\0")
        length, name = struct.unpack(">I4s", head)
        end = offset + 8 + length
        digest = imagecodecs.deflate_crc32(content[offset + 4 : end])
        if content[end : end + 4] != digest.to_bytes(4, "big"):
            raise UnreadableError(DAMAGED)
        chunks.append((name, content[offset + 8 : end]))
        offset = end + 4
    return chunks


def _decode_any_png(content: bytes) -> Frame:
    try:
        return imagecodecs.png_decode(content)
    except (ValueError, RuntimeError):  # the decoder raises RuntimeError
        raise UnreadableError(DAMAGED) from None


def _decode_tiff(path: Path, content: bytes) -> Frame:
    try:
        with tifffile.TiffFile(io.BytesIO(content)) as file:
            page = file.pages[0]
            values = np.asarray(page.asarray())
            if not _has_filters(page):
                return values
            pattern = "".join("RGB"[i] for i in page.tags["CFAPattern"].value)
            full = np.iinfo(values.dtype).max
            top = operator.index(page.tags.valueof("MaxSampleValue", full))
    except TIFF_DAMAGE:
        raise UnreadableError(DAMAGED) from None
    return _demosaiced(path, values, pattern, top)


def opencv(path: Path) -> Any:
    """OpenCV, which frames of a colour filter array and pictures of boards need."""
    try:
        import cv2
    except ImportError:
        raise input_error(
            str(path), "is read by OpenCV", "no OpenCV", "pip install 'skindb[cameras]'"
        ) from None
    return cv2


def _demosaiced(path: Path, values: AnyArray, pattern: str, top: int) -> Frame:
    """Bilinear interpolation (h, w, 3) of sensor values (h, w) behind colour filters.

    Pixels beside one that has the value `top` are saturated, too, as their mean would be
    too small.
    """
    cv2 = opencv(path)
    try:
        frame = cv2.demosaicing(values, getattr(cv2, f"COLOR_Bayer{pattern}2RGB"))
        near = cv2.dilate(np.asarray(values >= top, np.uint8), np.ones((3, 3)))
        frame[near > 0] = top
    except (AttributeError, OverflowError, cv2.error):
        raise UnreadableError(DAMAGED) from None  # of no such filters or values
    return np.asarray(frame)


def _decode_exr(path: Path, content: bytes) -> Frame:
    stream = io.BytesIO(content)
    part = _exr_part(stream)
    width, height = _exr_size(part)
    blocks = _exr_blocks(stream, height)
    if blocks is None or not set(blocks.channels).issuperset("RGB"):
        return _decode_any_exr(path)
    order = np.array([blocks.channels.index(name) for name in "RGB"])
    first = int(part.header["dataWindow"][0][1])
    out = np.empty((height, width, 3), np.uint16)
    buffer = np.empty((blocks.lines, len(blocks.channels), width), np.uint16)
    for offset, top in zip(blocks.offsets, range(0, height, blocks.lines), strict=True):
        lines = out[top : top + blocks.lines]
        line, size = struct.unpack_from("<iI", content, offset)
        block = content[offset + 8 : offset + 8 + size]
        if line != first + top or not _unpack(
            block, order, buffer[: len(lines)], lines
        ):
            raise UnreadableError(DAMAGED)
    return out.view(np.float16)


def _unpack(block: bytes, order: Index, buffer: Values16, out: Frame) -> bool:
    """Write the bits (lines, w, 3) of a zipped block of half floats, whose channels in
    this order are R, G, B; False if it is damaged.

    `buffer` (lines, channel, w) is overwritten.
    """
    if len(block) == buffer.nbytes:  # stored as it is, as it does not shrink
        values = np.frombuffer(block, "<u2").reshape(buffer.shape)
        out[:] = values[:, order].transpose(0, 2, 1)
        return True
    inflated = buffer.reshape(-1).view(np.uint8)
    try:
        size = len(imagecodecs.deflate_decode(block, out=inflated.data))
    except RuntimeError:
        return False
    unpack_lines(inflated, order, out)
    return bool(size == buffer.nbytes)


def _decode_any_exr(path: Path) -> Frame:
    """Channels of any OpenEXR file, by a function that keeps other threads waiting;
    `OpenEXR.File` prints a warning about damaged pixels.
    """
    try:
        file = OpenEXR.InputFile(str(path))
        window = file.header()["dataWindow"]
        planes = file.channels("RGB", FLOAT)
    except TypeError:
        raise UnreadableError("no channel R, G or B") from None
    except (OSError, ValueError, RuntimeError, LookupError):
        raise UnreadableError(DAMAGED) from None
    shape = (window.max.y - window.min.y + 1, window.max.x - window.min.x + 1)
    return np.stack(
        [np.frombuffer(plane, np.float32).reshape(shape) for plane in planes], axis=-1
    )


TIFF: Codec = (_tiff_header, _decode_tiff)
CODECS: dict[str, Codec] = {
    ".png": (_png_header, _decode_png),
    ".tif": TIFF,
    ".tiff": TIFF,
    ".exr": (_exr_header, _decode_exr),
}


def _codec(path: Path) -> Codec:
    """Functions that read the header and decode the content of a file."""
    if path.suffix.lower() not in CODECS:
        raise UnreadableError(f"frames are .png, .tif or .exr, not {path.suffix!r}")
    return CODECS[path.suffix.lower()]


def filled(template: str, **names: str) -> str:
    """The template with its placeholders replaced."""
    for name, value in names.items():
        template = template.replace(f"{{{name}}}", value)
    return template


def read_exposures(fields: Fields) -> dict[str, float]:
    """Exposure times in s by id, in the order of the file."""
    items = fields.items("exposures", maximum=MAX_EXPOSURES)
    shortest, longest = EXPOSURE_SECONDS
    return {
        item.text("id", rule=IDENTIFIER): item.number(
            "seconds", minimum=shortest, maximum=longest
        )
        for item in items
    }


def require_merged(fields: Fields, exposures: Mapping[str, float]) -> None:
    """Require one exposure of one second: merged radiance is per second, and another
    time would scale it again.
    """
    if exposures and [*exposures.values()] != [1.0]:
        finding = ", ".join(f"{seconds:g} s" for seconds in exposures.values())
        fields.fault(
            "exposures",
            "OpenEXR frames are merged radiance: one exposure of 1 second",
            finding,
            "merge them, divide by their seconds, and give one exposure of 1 second",
        )


def require_own_files(
    fields: Fields, views: Iterable[tuple[str, str, dict[str, str]]]
) -> None:
    """Require a separate file for every view: ids such as a_b and a with c and b_c can
    form the same path.

    `views` are the key of the template, the path, and the names in it.
    """
    owners = dict[Path, dict[str, str]]()
    shared = []
    for key, name, names in views:
        owner = owners.setdefault(Path(name), names)
        if owner != names:
            pair = (
                ", ".join(f"{k} {v}" for k, v in view.items() if owner[k] != names[k])
                for view in (owner, names)
            )
            shared.append((key, f"{Path(name).name} of {' and of '.join(pair)}"))
    if shared:
        key, pair_text = shared[0]
        fields.fault(
            key,
            "every view must have its own file",
            f"{len(shared)} shared, {pair_text}",
            "rename the ids, or separate them by folders in the template",
        )


def inside(
    folder: Path,
    name: str,
    where: str,
    faults: list[Fault],
    parents: dict[Path, bool] | None = None,
) -> Path | None:
    """The file `name` of the folder; None and a fault if it lies outside, directly or
    through a link.

    `parents` caches which folders lie inside; it is updated.
    """
    path = folder / name
    try:
        within = _within(path, folder, {} if parents is None else parents)
    except (OSError, ValueError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        rule = "must be a path that this system can follow"
        faults.append(
            Fault(
                where,
                rule,
                f"{short(name)}: {reason}",
                "rename the file, and correct the path",
            )
        )
        return None
    relative = Path(name)
    if within and not relative.is_absolute() and ".." not in relative.parts:
        return path
    rule = "every path must stay inside the capture folder"
    finding = short(name) + ("" if within else ", which leads out of it")
    faults.append(Fault(where, rule, finding, "copy the file into the folder"))
    return None


def _within(path: Path, folder: Path, parents: dict[Path, bool]) -> bool:
    """Whether a path stays inside a folder with every link followed; the parent folders
    are checked once.
    """
    missing = contextlib.suppress(FileNotFoundError, NotADirectoryError)
    with missing:
        if stat.S_ISLNK(path.lstat().st_mode):
            with missing:
                # fails for cyclic links and names that are too long, which `resolve` of
                # Python 3.13 ignores
                path.stat()
            return path.resolve().is_relative_to(folder.resolve())
    parent = path.parent
    if parent not in parents:
        parents[parent] = parent.resolve().is_relative_to(folder.resolve())
    return parents[parent]


def decoding_faults(paths: Iterable[Path], known: Iterable[Fault]) -> list[Fault]:
    """Faults of frames with valid headers, within the first `MAX_RECHECKED_BYTES` of files.

    They are reported together with those of a folder that is refused.

    Parameters
    ----------
    paths
        Frames of the dome and of the probe, as far as these could be read.
    known
        Faults of the folder; the frames that they name are not decoded.
    """
    named = {fault.where.partition(" (")[0] for fault in known}
    total = 0
    chosen = []
    for path in dict.fromkeys(paths):
        if str(path) in named:
            continue
        with contextlib.suppress(OSError, ValueError):
            total += path.stat().st_size
            if total > MAX_RECHECKED_BYTES:
                break
            chosen.append(path)

    def frame_faults(path: Path) -> list[Fault]:
        faults = list[Fault]()
        attempt(faults, lambda: read_frame(path))
        return faults

    with ThreadPoolExecutor(thread_count()) as pool:
        return [fault for faults in pool.map(frame_faults, chosen) for fault in faults]
