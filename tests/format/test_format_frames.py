from __future__ import annotations

import contextlib
import io
import struct
import sys
import tracemalloc
import zlib

import imagecodecs
import numpy as np
import OpenEXR
import pytest
import tifffile

from skindb.errors import InputError
from skindb.format.frames import (
    FrameKind,
    UnreadableError,
    _exr_blocks,
    frame_size,
    header_faults,
    read_frame,
    write_frame,
)
from skindb.hw.aravis import tiff_head

RNG = np.random.default_rng(0)
FRAMES = {
    "a8.png": (RNG.integers(0, 256, (5, 7, 3), np.uint8), 8),
    "a16.png": (RNG.integers(0, 65536, (5, 7, 3), np.uint16), 16),
    "a12.tif": (RNG.integers(0, 4096, (5, 7, 3), np.uint16), 12),
    "b8.tif": (RNG.integers(0, 256, (5, 7, 3), np.uint8), 8),
    "half.exr": (RNG.random((40, 7, 3)).astype(np.float16), 0),
    "float.exr": (RNG.random((40, 7, 3)).astype(np.float32), 0),
}


@pytest.mark.parametrize("name", FRAMES)
def test_read_frame__returns_what_was_written(tmp_path, name):
    frame, bits = FRAMES[name]
    kind = FrameKind(7, len(frame), bits)
    write_frame(tmp_path / name, frame)
    found = read_frame(tmp_path / name, kind)
    assert found.dtype == frame.dtype
    np.testing.assert_array_equal(found, frame)
    assert header_faults(tmp_path / name, kind, "frames") == []
    assert frame_size(tmp_path / name) == (7, len(frame))


HALF = RNG.normal(0, 2, (37, 11, 3)).astype(np.float16)
BITS = RNG.integers(0, 1 << 16, HALF.shape, np.uint16).view(np.float16)
CHANNELS = {
    "RGB": {"RGB": HALF},
    "RGB that does not shrink": {"RGB": BITS},
    "RGB that is constant": {"RGB": np.zeros_like(HALF)},
    "RGBA": {"RGBA": np.concatenate([HALF, HALF[..., :1]], axis=-1)},
    "depth of another type": {"RGB": HALF, "Z": np.ones((37, 11), np.float32)},
    "depth": {"RGB": HALF, "Z": HALF[..., 0].copy()},
    "green of another type": {
        "R": HALF[..., 0].copy(),
        "G": HALF[..., 1].astype(np.float32),
        "B": HALF[..., 2].copy(),
    },
}


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_read_frame__png_of_every_filter(tmp_path, dtype):
    ramp = np.add.outer(np.arange(23), np.arange(31))[..., None] * [3, 50, 700]
    noise = RNG.integers(0, np.iinfo(dtype).max + 1, ramp.shape)
    for kind in imagecodecs.PNG.FILTER:
        for frame in (ramp, noise, 0 * ramp):
            content = imagecodecs.png_encode(frame.astype(dtype), filter=kind)
            (tmp_path / "a.png").write_bytes(content)
            found = read_frame(tmp_path / "a.png")
            assert found.dtype == dtype
            np.testing.assert_array_equal(found, frame.astype(dtype))


def png_chunk(name, data):
    checked = name + data
    return len(data).to_bytes(4) + checked + zlib.crc32(checked).to_bytes(4)


def test_read_frame__data_after_the_last_row_of_a_png_are_ignored(tmp_path):
    frame, _ = FRAMES["a16.png"]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in frame)
    head = struct.pack(">IIBBBBB", 7, 5, 16, 2, 0, 0, 0)
    begin = b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", head)
    end = png_chunk(b"IEND", b"")
    for name, data, whole in (
        ("rows", rows, True),
        ("more", rows + bytes(9), True),
        ("filter", b"\5" + rows[1:], False),
        ("fewer", rows[:-9], False),
    ):
        path = tmp_path / f"{name}.png"
        path.write_bytes(begin + png_chunk(b"IDAT", zlib.compress(data)) + end)
        if whole:
            np.testing.assert_array_equal(read_frame(path), frame)
        else:
            with pytest.raises(InputError, match="cut off or damaged"):
                read_frame(path)
    path.write_bytes(
        begin + png_chunk(b"IDAT", zlib.compress(rows)) + b"IEND\xaeB`\x82"
    )
    with pytest.raises(InputError, match="cut off or damaged"):
        read_frame(path)


def test_read_frame__every_changed_byte_of_a_png_is_damage_or_no_pixel(tmp_path):
    frame, _ = FRAMES["a16.png"]
    content = imagecodecs.png_encode(frame)
    for place in range(8, len(content)):
        changed = bytearray(content)
        changed[place] ^= 4
        (tmp_path / "a.png").write_bytes(changed)
        with pytest.raises(InputError):
            read_frame(tmp_path / "a.png")


@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "DWAA"])
def test_read_frame__openexr_as_its_library(tmp_path, compression):
    """Zipped half floats are decoded here, so that other threads go on."""
    path = tmp_path / "a.exr"
    kind = getattr(OpenEXR, f"{compression}_COMPRESSION")
    for channels in CHANNELS.values():
        header = {"compression": kind, "type": OpenEXR.scanlineimage}
        header["dataWindow"] = tuple(np.array([[3, -5], [13, 31]], np.int32))
        OpenEXR.File(header, channels).write(str(path))
        planes = OpenEXR.File(str(path), separate_channels=True).channels()
        expected = np.stack([planes[name].pixels for name in "RGB"], axis=-1)
        frame = read_frame(path)
        np.testing.assert_array_equal(frame, expected)
        halves = all(plane.pixels.dtype == np.float16 for plane in planes.values())
        assert (frame.dtype == np.float16) == (halves and "ZIP" in compression)


def test_read_frame__exchanged_lines_of_an_openexr_file_are_damage(tmp_path):
    write_frame(tmp_path / "a.exr", HALF)
    content = (tmp_path / "a.exr").read_bytes()
    offsets = np.array(_exr_blocks(io.BytesIO(content), 37).offsets, "<u8")
    exchanged = content.replace(offsets.tobytes(), offsets[[1, 0, 2]].tobytes())
    assert exchanged != content
    (tmp_path / "a.exr").write_bytes(exchanged)
    with pytest.raises(InputError, match="cut off or damaged"):
        read_frame(tmp_path / "a.exr")


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("share", [0.3, 0.95])
def test_read_frame__refuses_a_file_that_is_cut_off(tmp_path, name, share, capfd):
    frame = np.repeat(np.repeat(FRAMES[name][0], 9, axis=0), 9, axis=1)
    write_frame(tmp_path / name, frame)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match="must be a whole image file"):
        read_frame(tmp_path / name)


@pytest.mark.parametrize("name", ["a16.png", "half.exr"])
def test_header_faults__sees_a_cut_without_decoding(tmp_path, name):
    frame, bits = FRAMES[name]
    write_frame(tmp_path / name, frame)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[:-3])
    (fault,) = header_faults(tmp_path / name, FrameKind(7, len(frame), bits), "frames")
    assert "cut off" in fault.found


@pytest.mark.parametrize("tail", [b"\n", bytes(4096), b"IEND\xaeB`"])
def test_header_faults__bytes_after_the_end_of_a_png_are_no_fault(tmp_path, tail):
    """As decoders do: some writers fill the last block of a file. The end itself must
    still be there.
    """
    frame, bits = FRAMES["a16.png"]
    write_frame(tmp_path / "a.png", frame)
    content = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(content + tail)
    assert header_faults(tmp_path / "a.png", FrameKind(7, 5, bits), "frames") == []
    np.testing.assert_array_equal(read_frame(tmp_path / "a.png"), frame)
    (tmp_path / "a.png").write_bytes(content[:-12] + tail)
    (fault,) = header_faults(tmp_path / "a.png", FrameKind(7, 5, bits), "frames")
    assert "cut off" in fault.found


def test_header_faults__reads_little_of_a_large_file(tmp_path):
    # random bits: it does not compress
    frame = np.random.default_rng(2).random((900, 700, 3)).astype(np.float32)
    write_frame(tmp_path / "a.exr", frame)
    assert (tmp_path / "a.exr").stat().st_size > 4e6
    header_faults(tmp_path / "a.exr", FrameKind(700, 900, 0), "frames")  # imports
    tracemalloc.start()
    try:
        assert header_faults(tmp_path / "a.exr", FrameKind(700, 900, 0), "frames") == []
        assert tracemalloc.get_traced_memory()[1] < 3e5
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("height", [2**31 - 2, -5])
def test_header_faults__a_damaged_height_asks_for_no_table_larger_than_the_file(
    tmp_path, height
):
    write_frame(tmp_path / "a.exr", FRAMES["half.exr"][0])
    with pytest.raises(UnreadableError, match="cut off"):
        _exr_blocks(io.BytesIO((tmp_path / "a.exr").read_bytes()), height)


COLOURS = {"RG": "RGGB", "GR": "GRBG", "GB": "GBRG", "BG": "BGGR"}


def _raw(path, scene, pattern, bits=12):
    """A scene (h, w, 3) as a sensor with a colour filter array sees it."""
    values = np.zeros(scene.shape[:2], np.uint8 if bits == 8 else np.uint16)
    for i, colour in enumerate(COLOURS[pattern]):
        part = (slice(i // 2, None, 2), slice(i % 2, None, 2))
        values[part] = scene[..., "RGB".index(colour)][part]
    height, width = values.shape
    head = tiff_head(width, height, f"Bayer{pattern}{bits}")
    path.write_bytes(head + values.tobytes())
    return values


@pytest.mark.parametrize("bits", [8, 12])
@pytest.mark.parametrize("pattern", list(COLOURS))
def test_read_frame__interpolates_a_colour_filter_array(tmp_path, pattern, bits):
    y, x = np.mgrid[:12, :16]
    # linear functions are interpolated without an error
    scene = np.stack([20 + 2 * x + 2 * y, 60 + 4 * x, 90 - 2 * y + 2 * x], axis=2)
    _raw(tmp_path / "a.tif", scene, pattern, bits)
    kind = FrameKind(16, 12, bits)
    assert header_faults(tmp_path / "a.tif", kind, "frames") == []
    frame = read_frame(tmp_path / "a.tif", kind)
    np.testing.assert_array_equal(frame[2:-2, 2:-2], scene[2:-2, 2:-2])


def test_read_frame__beside_a_saturated_pixel_no_channel_is_too_dark(tmp_path):
    scene = np.full((9, 9, 3), 1000)
    scene[4, 4] = 4095
    values = _raw(tmp_path / "a.tif", scene, "RG")
    frame = read_frame(tmp_path / "a.tif")
    assert values[4, 4] == 4095
    assert (frame[3:6, 3:6] == 4095).all()
    assert (frame == 4095).sum() == 27


def test_read_frame__of_a_colour_filter_array_needs_opencv(tmp_path, monkeypatch):
    _raw(tmp_path / "a.tif", np.full((8, 8, 3), 9), "RG")
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(InputError, match=r"pip install 'skindb\[cameras\]'"):
        read_frame(tmp_path / "a.tif")


@pytest.mark.slow
@pytest.mark.parametrize("compression", ["zstd", "zlib", None, "raw"])
def test_read_frame__no_change_of_a_tiff_header_is_an_internal_error(
    tmp_path, compression
):
    """Nor does the message contain one of the library, whose text depends on the damage."""
    if compression == "raw":
        _raw(tmp_path / "a.tif", FRAMES["a16.png"][0], "RG")
    else:
        tifffile.imwrite(
            tmp_path / "a.tif",
            FRAMES["a16.png"][0],
            photometric="rgb",
            compression=compression,
        )
    content = (tmp_path / "a.tif").read_bytes()
    said = set()
    for place in range(len(content)):
        for value in (0, 1, 2, 255):
            damaged = bytearray(content)
            damaged[place] = value
            (tmp_path / "a.tif").write_bytes(damaged)
            faults = header_faults(tmp_path / "a.tif", FrameKind(7, 5, 16), "frames")
            try:
                read_frame(tmp_path / "a.tif")
            except InputError as error:
                faults += error.faults
            said |= {
                fault.found
                for fault in faults
                if fault.rule == "a frame must be a whole image file"
            }
    assert said == {"one that is cut off or damaged"}


def test_read_frame__damaged_pixels_of_an_openexr_file_print_nothing_in_python(
    tmp_path, capsys
):
    write_frame(
        tmp_path / "a.exr",
        np.linspace(0, 1, 64 * 48 * 3).reshape(64, 48, 3).astype(np.float32),
    )
    content = bytearray((tmp_path / "a.exr").read_bytes())
    content[-2000:-1000] = bytes(1000)
    (tmp_path / "a.exr").write_bytes(content)
    with pytest.raises(InputError, match="found one that is cut off or damaged"):
        read_frame(tmp_path / "a.exr")
    assert capsys.readouterr().out == ""


def test_read_frame__refuses_another_depth(tmp_path):
    write_frame(tmp_path / "a.png", FRAMES["a8.png"][0])
    with pytest.raises(InputError, match=r"uint16; found .* uint8"):
        read_frame(tmp_path / "a.png", FrameKind(7, 5, 16))


def test_read_frame__refuses_an_absent_file_and_an_unknown_suffix(tmp_path):
    for name, message in (
        ("a.png", "must exist"),
        ("a.exr", "must exist"),
        ("a.bmp", "not '.bmp'"),
    ):
        with pytest.raises(InputError, match=message):
            read_frame(tmp_path / name)


def test_write_frame__refuses_floats_in_a_png(tmp_path):
    with pytest.raises(ValueError, match="does not hold float32"):
        write_frame(tmp_path / "a.png", np.zeros((2, 2, 3), np.float32))


@pytest.mark.parametrize("name", ["a16.png", "a12.tif", "half.exr"])
def test_header_faults__damaged_bytes_are_a_fault_and_never_a_crash(
    tmp_path, name, capfd
):
    """Bytes of the header changed at random: whole by luck, or said to be damaged; what
    passes decodes or says so.
    """
    rng = np.random.default_rng(4)
    frame, bits = FRAMES[name]
    kind = FrameKind(7, len(frame), bits)
    write_frame(tmp_path / name, frame)
    whole = np.frombuffer((tmp_path / name).read_bytes(), np.uint8)
    refused = 0
    for _ in range(150):
        content = whole.copy()
        content[rng.integers(0, min(len(whole), 400), 4)] = rng.integers(0, 256, 4)
        (tmp_path / name).write_bytes(content.tobytes())
        faults = header_faults(tmp_path / name, kind, "frames")
        refused += bool(faults)
        if not faults:
            with contextlib.suppress(InputError):
                assert read_frame(tmp_path / name, kind).shape == frame.shape
    assert refused > 0
