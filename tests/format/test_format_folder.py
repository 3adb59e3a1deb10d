"""Every fault of a capture folder is named with its file and key, all at once."""

from __future__ import annotations

import json
import os
import re
import struct
import zlib
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import trimesh
from spoil import C, D, P, drop, edit, edited, put

from skindb.errors import InputError
from skindb.format import contact_probe, dome, folder, frames, sensor
from skindb.ingest import read_capture


def save_png(name, shape, dtype):
    return lambda folder: (folder / name).write_bytes(
        imagecodecs.png_encode(np.zeros(shape, dtype))
    )


def cut(name, size):
    return lambda folder: (folder / name).write_bytes(
        (folder / name).read_bytes()[:size]
    )


def mesh(vertices, faces):
    def write(folder):
        trimesh.Trimesh(vertices, faces, process=False).export(folder / "scan.ply")

    return write


def text_mesh(folder):
    (folder / "scan.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\n"
        "property float z\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
    )


def soup(folder):
    corners = np.random.default_rng(0).uniform(-50, 50, (90, 3))
    mesh(corners, np.arange(90).reshape(-1, 3))(folder)


def link_out(name):
    def link(folder):
        outside = folder.parent / Path(name).name
        outside.write_bytes((folder / name).read_bytes())
        (folder / name).unlink()
        (folder / name).symlink_to(outside)

    return link


def folder_out(name):
    def link(folder):
        (folder / name).rename(folder.parent / "elsewhere")
        (folder / name).symlink_to(folder.parent / "elsewhere")

    return link


def circle(folder):
    (folder / "scan.ply").unlink()
    (folder / "scan.ply").symlink_to("again.ply")
    (folder / "again.ply").symlink_to("scan.ply")


def exr(file, *exposures):
    """Frames of OpenEXR with these exposures; the files need not exist for the rule about them."""

    def change(record):
        record["frames"] = record["frames"].replace(".png", ".exr")
        record["exposures"] = [
            {"id": f"e{i}", "seconds": s} for i, s in enumerate(exposures)
        ]

    return edited(file, change)


def response(low, high, first, last):
    """A table for the first camera, between these values and exposures."""

    def write(folder):
        dn = np.linspace(low, high, 9)
        exposure = np.linspace(first, last, 9)
        table = np.column_stack([dn, exposure, exposure, exposure])
        np.savetxt(
            folder / "dome/r.csv", table, delimiter=",", header="dn,r,g,b", comments=""
        )
        put(D, "cameras", 0, "response", value="dome/r.csv")(folder)

    return write


def one_corner(folder):
    """A principal point in the corner: the opposite one is twice as far away as any of
    a usual picture.
    """
    put(D, "cameras", 1, "K", value=[[160, 0, 0], [0, 160, 0], [0, 0, 1]])(folder)
    put(D, "cameras", 1, "vignette", value=[-0.3, 0, 0])(folder)


def lights_run_together(folder):
    """Light a of camera b_c and light a_b of camera c; the file itself exists."""
    put(D, "lights", 0, "id", value="a")(folder)
    put(D, "lights", 1, "id", value="a_b")(folder)
    put(D, "cameras", 0, "id", value="b_c")(folder)
    put(D, "cameras", 1, "id", value="c")(folder)
    put(D, "white", "cameras", value=["b_c"])(folder)


def sites_run_together(folder):
    put(P, "sites", value=["a", "a_b"])(folder)
    put(P, "exposures", value=[{"id": name, "seconds": 1} for name in ("b_c", "c")])(
        folder
    )
    put(P, "frames", value="contact/{site}_{exposure}.png")(folder)


FRAME = "dome/frames/long/l1_c0.png"
FAULTS = {
    "no capture.json": (
        lambda f: (f / C).unlink(),
        r"capture\.json: the file must exist",
    ),
    "broken JSON": (lambda f: (f / D).write_text("{"), r"dome\.json: must be JSON"),
    "not an object": (
        lambda f: (f / D).write_text("[]"),
        r"dome\.json: must be a JSON object",
    ),
    "unknown version": (
        put(C, "version", value=3),
        r"\[version\]: must be 1 or 2, which this skindb reads; found 3;",
    ),
    "other format": (put(C, "format", value="dome"), r"capture\.json\[format\]"),
    "missing consent": (
        drop(C, "consent"),
        r"capture\.json\[consent\]: this key is required",
    ),
    "empty scope": (
        put(C, "consent", "scope", value=["sell"]),
        r"\[consent\]\[scope\]: must be from fit",
    ),
    "subject with a slash": (
        put(C, "subject", value="a/b"),
        r"capture\.json\[subject\]",
    ),
    "session without zone": (
        put(C, "session", value="2005-01-10T09:00:00"),
        r"capture\.json\[session\]",
    ),
    "session no time": (put(C, "session", value="monday"), r"capture\.json\[session\]"),
    "long trait": (
        put(C, "traits", "hair", value="x" * 257),
        r"\[traits\]\[hair\]: a text must be at most 256 char",
    ),
    "trait with an escape": (
        put(C, "traits", "hair", value="red\x1b[2J"),
        r"; found 7 characters, 1 of which can",
    ),
    "trait of two lines": (
        put(C, "traits", "hair", value="red\nS01: intact"),
        r"\[hair\]: a text .* can be printed",
    ),
    "trait to the left": (
        put(C, "traits", "hair", value="\u202ered"),
        r"\[hair\]: a text .* can be printed",
    ),
    "reference with an escape": (
        put(C, "consent", "reference", value="\x07"),
        r"\[reference\]: a text .* can be",
    ),
    "nested trait": (put(C, "traits", "age", value=[30]), r"\[traits\]\[age\]"),
    "missing frame": (
        lambda f: (f / FRAME).unlink(),
        r"l1_c0\.png.*\[frames\].*no such file",
    ),
    "truncated PNG": (cut(FRAME, 900), r"l1_c0\.png.*\[frames\].*cut off"),
    "not a PNG": (
        lambda f: (f / FRAME).write_bytes(b"x" * 99),
        r"l1_c0\.png.*not a PNG",
    ),
    "8 bit": (
        save_png(FRAME, (64, 72, 3), np.uint8),
        r"l1_c0\.png.*bit_depth 16 means uint16; found uint8",
    ),
    "wrong size": (
        save_png(FRAME, (60, 72, 3), np.uint16),
        r"l1_c0\.png.*72 x 64.*found 72 x 60",
    ),
    "grey": (
        save_png(FRAME, (64, 72), np.uint16),
        r"l1_c0\.png.*R, G, B; found 1 channels",
    ),
    "folder of frames that leads out": (
        folder_out("dome/frames/long"),
        r"\[frames\]: every path must stay inside",
    ),
    "missing white frame": (
        lambda f: (f / "dome/white/long/l1_c0.png").unlink(),
        r"\[white\]",
    ),
    "NaN light": (
        put(D, "lights", 1, "position", value=[0, float("nan"), 1]),
        r"\[lights\]\[1\]\[position\]",
    ),
    "not a rotation": (
        put(D, "cameras", 0, "R", value=[[2, 0, 0], [0, 1, 0], [0, 0, 1]]),
        r"\[cameras\]\[0\]\[R\]",
    ),
    "mirrored R": (
        put(D, "cameras", 0, "R", value=[[-1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        r"\[0\]\[R\]: .*rotation",
    ),
    "rotation of ones": (
        put(D, "cameras", 0, "R", value=[[1, 1, 1]] * 3),
        r"\[0\]\[R\]: .*rotation",
    ),
    "K upside down": (
        put(D, "cameras", 0, "K", value=[[-9, 0, 1], [0, 9, 1], [0, 0, 1]]),
        r"\[0\]\[K\]",
    ),
    "wrong length": (
        put(D, "cameras", 0, "t", value=[1, 2]),
        r"\[cameras\]\[0\]\[t\]: must be 3 numbers",
    ),
    "text for numbers": (
        put(D, "cameras", 0, "t", value="here"),
        r"\[cameras\]\[0\]\[t\]: must be 3 numbers",
    ),
    "half a pixel": (
        put(D, "cameras", 0, "width", value=72.5),
        r"\[width\]: must be a whole number",
    ),
    "black above white": (
        put(D, "cameras", 0, "white_level", value=100),
        r"\[white_level\]: must be above",
    ),
    "duplicate camera": (
        put(D, "cameras", 1, "id", value="c0"),
        r"\[cameras\]: ids must differ; found c0",
    ),
    "a camera named as a folder": (
        put(D, "cameras", 1, "id", value=".."),
        r"\[cameras\]\[1\]\[id\]: must be 1 to 64 letters",
    ),
    "duplicate light": (
        put(D, "lights", 1, "id", value="l0"),
        r"\[lights\]: ids must differ; found l0",
    ),
    "duplicate exposure": (
        put(D, "exposures", 1, "id", value="long"),
        r"\[exposures\]: ids must differ",
    ),
    "no time": (
        put(D, "exposures", 1, "seconds", value=0),
        r"\[exposures\]\[1\]\[seconds\]",
    ),
    "no cameras": (
        put(D, "cameras", value=[]),
        r"\[cameras\]: must be a list of at least one",
    ),
    "template without light": (
        put(D, "frames", value="{exposure}_{camera}.png"),
        r"\[frames\]: must name",
    ),
    "template with attribute": (
        put(D, "frames", value="{light.x}{camera}{exposure}"),
        r"\[frames\]: must name",
    ),
    "white of a stranger": (
        put(D, "white", "cameras", value=["c7"]),
        r"\[white\]\[cameras\]: .*found c7",
    ),
    "response table": (
        put(D, "cameras", 0, "response", value="nothing.csv"),
        r"\[response\]\): the file must exist",
    ),
    "path up": (
        put(C, "mesh", value="../scan.ply"),
        r"capture\.json\[mesh\]: every path must stay inside",
    ),
    "absolute path": (
        put(C, "dome", value="/etc/hostname"),
        r"capture\.json\[dome\]: every path must stay inside",
    ),
    "link out": (
        link_out("scan.ply"),
        r"capture\.json\[mesh\]: every path must stay inside",
    ),
    "frame link out": (
        link_out(FRAME),
        r"dome\.json\[frames\]: every path must stay inside",
    ),
    "template up": (
        put(D, "frames", value="../{exposure}/{light}_{camera}.png"),
        r"\[frames\]: .*stay inside",
    ),
    "no mesh file": (lambda f: (f / "scan.ply").unlink(), r"scan\.ply \(mesh\)"),
    "empty mesh": (text_mesh, r"scan\.ply \(mesh\): a scan must have triangles"),
    "no shared edges": (
        soup,
        r"scan\.ply \(mesh\): the triangles of a scan must share edges",
    ),
    "landmark off the face": (
        put("landmarks.json", "nose_tip", value=[0, 0, 180]),
        r"\[nose_tip\]: .*100\.0 mm",
    ),
    "landmark in metres": (
        put("landmarks.json", "nose_tip", value=[0, 0, 0.08]),
        r"\[nose_tip\]: a landmark must lie",
    ),
    "landmark of two numbers": (
        put("landmarks.json", "nose_tip", value=[0, 0]),
        r"\[nose_tip\]: must be 3 numbers",
    ),
    "region of the whole surface": (
        put("regions.json", "all", value=[[1]]),
        r"regions\.json\[all\]: `all` is the",
    ),
    "region beyond": (
        put("regions.json", "nose", value=[[10**6]]),
        r"regions\.json\[nose\]: vertex numbers",
    ),
    "region of words": (
        put("regions.json", "nose", value=[["a"]]),
        r"regions\.json\[nose\]: must be lists",
    ),
    "probe frame missing": (
        lambda f: (f / "contact/neck/b1.png").unlink(),
        r"b1\.png.*probe\.json\[frames\]",
    ),
    "probe gain": (
        put(P, "gain", value=[1, 1]),
        r"probe\.json\[gain\]: must be 4 or 4 x 3 numbers",
    ),
    "fibre at zero": (
        put(P, "fibres", 0, "distance", value=0),
        r"\[fibres\]\[0\]\[distance\]",
    ),
    "duplicate fibre": (
        put(P, "fibres", 0, "id", value="f1"),
        r"\[fibres\]: ids must differ",
    ),
    "null": (
        lambda f: (f / C).write_text("null"),
        r"capture\.json: must be a JSON object .*; found null",
    ),
    "bottomless JSON": (
        lambda f: (f / D).write_text("[" * 100_000),
        r"dome\.json: must have at most 32 levels",
    ),
    "number of 5000 digits": (
        lambda f: (f / D).write_text("9" * 5000),
        r"dome\.json: must be JSON",
    ),
    "zero byte in a path": (
        put(C, "mesh", value="a\0b"),
        r"capture\.json\[mesh\]: a text must be .* that can be pri",
    ),
    "half a surrogate": (
        put(C, "mesh", value="\ud800"),
        r"capture\.json\[mesh\]: must be text that UTF-8",
    ),
    "endless name": (
        put(D, "frames", value="x" * 300 + "{exposure}{light}{camera}"),
        r"\[frames\]: a text must be at",
    ),
    "links in a circle": (circle, r"capture\.json\[mesh\]"),
    "depth of 1e300": (
        put(D, "cameras", 0, "bit_depth", value=1e300),
        r"\[0\]\[bit_depth\]: must be a finite number",
    ),
    "depth of 32": (
        put(D, "cameras", 0, "bit_depth", value=32),
        r"\[0\]\[bit_depth\]: must be at most 16",
    ),
    "width of 400 digits": (
        put(D, "cameras", 0, "width", value=10**400),
        r"\[0\]\[width\]: must be a finite",
    ),
    "R of 1e300": (
        put(D, "cameras", 0, "R", value=[[1e300] * 3] * 3),
        r"\[0\]\[R\]: must be finite numbers, at most",
    ),
    "K of 400 digits": (
        put(D, "cameras", 0, "K", value=10**400),
        r"\[0\]\[K\]: must be 3 x 3 numbers",
    ),
    "region of depth three": (
        put("regions.json", "nose", value=[[[]]]),
        r"\[nose\]: must be lists of vertex",
    ),
    "region of fractions": (
        put("regions.json", "nose", value=[[1.5]]),
        r"\[nose\]: must be lists.*found 1\.5",
    ),
    "no site": (
        put(P, "sites", value=[]),
        r"probe\.json\[sites\]: must be a list of at least one name; found \[\]",
    ),
    "white without camera": (
        put(D, "white", "cameras", value=[]),
        r"\[white\]\[cameras\]: must be a list of at least",
    ),
    "read noise alone": (
        drop(D, "cameras", 0, "electrons_per_dn"),
        r"\[0\]\[electrons_per_dn\]: .* given together",
    ),
    "electrons alone": (
        drop(P, "read_noise_e"),
        r"probe\.json\[read_noise_e\]: .* given together.*found nothing",
    ),
    "EXR of two times": (
        exr(D, 1.0, 1.0),
        r"dome\.json\[exposures\]: .*one exposure of 1 second; found 1 s, 1 s;",
    ),
    "EXR of 0.1 s": (
        exr(D, 0.1),
        r"dome\.json\[exposures\]: OpenEXR frames are merged.*; found 0\.1 s",
    ),
    "probe EXR of 2 s": (
        exr(P, 2),
        r"probe\.json\[exposures\]: OpenEXR frames are merged.*; found 2 s",
    ),
    "reflectance in per cent": (
        put(D, "white", "reflectance", value=99),
        r"\[reflectance\]: must be a .*99\.0;",
    ),
    "target without direction": (
        put(D, "white", "normal", value=[0, 0, 0]),
        r"\[white\]\[normal\]: must have a dir",
    ),
    "white beyond 16 bits": (
        put(D, "cameras", 0, "white_level", value=65536),
        r"\[white_level\]: .*at most 65535",
    ),
    "16 bit white of 12 bits": (
        put(D, "cameras", 1, "bit_depth", value=12),
        r"\[white_level\]: .*4095, .*found 65535",
    ),
    "vignette through zero": (
        put(D, "cameras", 0, "vignette", value=[-3, 0, 0]),
        r"\[vignette\]: .*found -2 at r = 1",
    ),
    "vignette that dips": (
        put(D, "cameras", 0, "vignette", value=[-3.8, 3.7, 0]),
        r"\[vignette\]: .*found 0\.0243 at",
    ),
    "colours without green": (
        put(D, "cameras", 0, "colour_matrix", value=[[1, 0, 0], [0, 0, 0], [0, 0, 1]]),
        r"\[0\]\[colour_matrix\]: must give white a positive R, G and B",
    ),
    "vignette of one corner": (
        one_corner,
        r"\[1\]\[vignette\]: .*found -0\.2 at r = 2;",
    ),
    "K singular": (
        put(D, "cameras", 0, "K", value=[[9, 9, 1], [9, 9, 1], [0, 0, 1]]),
        r"\[0\]\[K\]: must be \[\[fx",
    ),
    "response to 255": (
        response(256, 65535, 0, 255),
        r"\[0\]\[response\]: must run from 0 at black_level 256 to 1 at",
    ),
    "response of a part": (
        response(256, 60000, 0, 1),
        r"\[response\]: must run .*found .*: 0 at 256 to 1 at 60000",
    ),
    "response from 0.02": (
        response(256, 65535, 0.02, 1),
        r"\[0\]\[response\]: must run .*found .*: 0\.02 at 256",
    ),
    "ids that run together": (
        lights_run_together,
        r"dome\.json\[frames\]: every view .*; found 2 shared, a_b_c",
    ),
    "sites that run together": (
        sites_run_together,
        r"\[frames\]: .*; found 1 shared, a_b_c\.png of site a, expo",
    ),
    "duplicate site": (
        put(P, "sites", value=["cheek", "cheek"]),
        r"\[sites\]: ids must differ",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_read_capture__names_the_fault_with_file_and_key(capture_folder, name):
    spoil, message = FAULTS[name]
    spoil(capture_folder)
    with pytest.raises(InputError, match=message):
        read_capture(capture_folder)


def test_read_capture__intensities_of_all_lights_or_of_none(capture_folder):
    put(D, "white", value=None)(capture_folder)
    assert read_capture(capture_folder).dome.relative
    put(D, "lights", 0, "intensity", value=[1, 1, 1])(capture_folder)
    with pytest.raises(InputError, match="all lights need an intensity"):
        read_capture(capture_folder)


def test_read_capture__refuses_attributes_that_imitate_columns(capture_folder):
    names = [
        "subject",
        "Take",
        "CONDITION",
        "session ",
        "consent",
        "outdated",
        "fit_k",
        "status_fitted",
        "generation",
    ]
    names += [
        "model generation",
        "capture-created",
        "\uff54ake",
        "attribute_take",
        "created",
    ]
    record = json.loads((capture_folder / C).read_text())
    record["traits"] = dict.fromkeys(
        [*names, "skin_condition", "age_group", "fitness", "sessions"], "x"
    )
    (capture_folder / C).write_text(json.dumps(record))
    with pytest.raises(
        InputError,
        match=r"\[traits\]\[subject\]: an attribute must not have the name of ano",
    ) as refused:
        read_capture(capture_folder)
    assert len(refused.value.faults) == len(names)


def test_read_capture__one_fault_is_one_line(capture_folder):
    """A faulty value must not drag others after it."""
    for name in (
        "missing frame",
        "NaN light",
        "wrong length",
        "landmark off the face",
        "probe gain",
    ):
        FAULTS[name][0](capture_folder)
    with pytest.raises(InputError) as caught:
        read_capture(capture_folder)
    assert len(caught.value.faults) == 5
    assert len(str(caught.value).splitlines()) == 5


VALUES = (
    "reflectance in per cent",
    "target without direction",
    "white beyond 16 bits",
    "16 bit white of 12 bits",
    "vignette through zero",
    "K singular",
    "response to 255",
    "response of a part",
)


@pytest.mark.parametrize("name", VALUES)
def test_read_capture__a_faulty_value_of_the_dome_is_one_line(capture_folder, name):
    FAULTS[name][0](capture_folder)
    with pytest.raises(InputError) as caught:
        read_capture(capture_folder)
    assert len(str(caught.value).splitlines()) == 1


LEGAL = {
    "vignette of a wide lens": put(
        D, "cameras", 0, "vignette", value=[-0.9, -0.02, 0.0]
    ),
    "principal point beside the picture": put(
        D, "cameras", 0, "K", value=[[160, 0, -9], [0, 160, 32], [0, 0, 1]]
    ),
    "skewed pixels": put(
        D, "cameras", 0, "K", value=[[160, 0.5, 36], [0, 160, 32], [0, 0, 1]]
    ),
    "white of a converter of 12 bits": put(D, "cameras", 0, "white_level", value=65520),
    "response that ends below white": response(256, 65534, 0, 0.9999),
    "response of all values": response(0, 65535, -256 / 65279, 1),
    "perfect white": put(D, "white", "reflectance", value=1),
    "empty region of no site": put("regions.json", "nose", value=[]),
    "empty region of a site with a landmark": put("regions.json", "forehead", value=[]),
    "target that looks aside": put(D, "white", "normal", value=[0, 3, 4]),
}


@pytest.mark.parametrize("name", LEGAL)
def test_read_capture__what_is_legal_passes(capture_folder, name):
    LEGAL[name](capture_folder)
    assert read_capture(capture_folder).folder == capture_folder


def test_read_capture__a_sensor_of_unknown_noise_is_fine(capture_folder):
    for key in ("read_noise_e", "electrons_per_dn"):
        drop(P, key)(capture_folder)
    assert read_capture(capture_folder).probe.sensor.read_noise == 0


def test_read_capture__consent_to_nothing_is_an_answer(capture_folder):
    put(C, "consent", "scope", value=[])(capture_folder)
    assert read_capture(capture_folder).consent_scope == ()


def test_capture_format__lists_every_key_that_is_read():
    page = (Path(__file__).parents[2] / "docs/capture_format.md").read_text(
        encoding="utf-8"
    )
    source = "".join(
        Path(module.__file__).read_text(encoding="utf-8")
        for module in (contact_probe, dome, folder, frames, sensor)
    )
    keys = set(
        re.findall(
            r'\.(?:get|has|object|text|number|integer|array|gains|names|items|template)\(\s*"(\w+)"',
            source,
        )
    )
    assert {"adc_bits", "pressure", "gain_error", "fibre_radius"} <= keys
    assert [key for key in sorted(keys) if not re.search(rf"\b{key}\b", page)] == []


def test_read_capture__keeps_what_it_does_not_know(pristine):
    capture = read_capture(pristine)
    assert dict(capture.attributes) == {"studio": "by hand"}
    assert capture.take == "T001"
    assert capture.skipped == (
        "site neck: no region or landmark of that name; its position is unknown",
    )


def test_read_capture__says_what_is_left_out(capture_folder):
    edit(
        capture_folder / C,
        lambda r: [r.pop(key) for key in ("landmarks", "regions", "contact", "dome")],
    )
    put(C, "condition", value="sweat")(capture_folder)
    capture = read_capture(capture_folder)
    assert [line.partition(":")[0] for line in capture.skipped] == [
        "landmarks",
        "regions",
        "dome",
        "contact",
    ]
    assert capture.take == "T001.sweat"


def test_read_capture__says_that_intensities_are_taken_as_given(capture_folder):
    def known(dome):
        dome["white"] = None
        for light in dome["lights"]:
            light["intensity"] = [1.0, 1.0, 1.0]

    edit(capture_folder / D, known)
    line, _ = read_capture(capture_folder).skipped
    assert (
        line == "white: not in dome.json; intensities of the lights are taken as given"
    )


def test_read_capture__says_that_frames_of_a_missing_light_are_not_read(capture_folder):
    edit(capture_folder / D, lambda dome: dome["lights"].pop())
    assert (
        "frames: not read, as dome.json lacks their light, camera or exposure: "
        "dome/frames/long/l3_c0.png and 3 more"
    ) in read_capture(capture_folder).skipped


def test_read_capture__says_that_an_age_is_a_text(capture_folder):
    put(C, "traits", "age", value="31 years")(capture_folder)
    capture = read_capture(capture_folder)
    assert capture.traits["age"] == "31 years"
    assert any(
        "31 years" in line and "no number of years" in line for line in capture.skipped
    )


def test_read_capture__links_inside_the_folder_are_fine(capture_folder):
    (capture_folder / "real.ply").write_bytes(
        (capture_folder / "scan.ply").read_bytes()
    )
    (capture_folder / "scan.ply").unlink()
    (capture_folder / "scan.ply").symlink_to("real.ply")
    assert len(read_capture(capture_folder).scan.faces) > 100


def damage_pixels(name):
    """A byte of the compressed pixels: only decoding tells."""

    def spoil(folder):
        content = bytearray((folder / name).read_bytes())
        content[len(content) // 2] ^= 0xFF
        (folder / name).write_bytes(content)

    return spoil


def test_read_capture__frames_are_decoded_when_something_else_is_wrong(capture_folder):
    damage_pixels(FRAME)(capture_folder)
    read_capture(capture_folder)  # headers are sound: decoding is left to the ingest
    damage_pixels("contact/neck/b1.png")(capture_folder)
    put(P, "gain", value=[1, 1])(capture_folder)
    (capture_folder / "dome/frames/short/l0_c0.png").unlink()
    with pytest.raises(InputError) as caught:
        read_capture(capture_folder)
    places = sorted(
        Path(fault.where.partition(" (")[0]).name for fault in caught.value.faults
    )
    assert places == ["b1.png", "l0_c0.png", "l1_c0.png", "probe.json[gain]"]


def fifo(name):
    def replace(folder):
        (folder / name).unlink()
        os.mkfifo(folder / name)

    return replace


def link_to_zero(name):
    def replace(folder):
        (folder / name).unlink()
        (folder / name).symlink_to("/dev/zero")

    return replace


def promised(name, width, height):
    """A PNG file whose header promises another size; its checksum is right."""

    def write(folder):
        content = bytearray((folder / name).read_bytes())
        content[16:24] = struct.pack(">II", width, height)
        content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
        (folder / name).write_bytes(content)

    return write


def many(file, key, count):
    """The first object of a list, many times with its own ids."""
    return edited(
        file,
        lambda r: r.update({key: [r[key][0] | {"id": f"i{i}"} for i in range(count)]}),
    )


HOSTILE = {
    "empty capture": (
        lambda f: (f / C).write_text("{}"),
        r"capture\.json\[format\]: this key is required",
    ),
    "empty dome": (
        lambda f: (f / D).write_text("{}"),
        r"dome\.json\[cameras\]: this key is required",
    ),
    "empty probe": (
        lambda f: (f / P).write_text("{}"),
        r"probe\.json\[fibres\]: this key is required",
    ),
    "deep region": (
        lambda f: (f / "regions.json").write_text(
            '{"a": ' + "[" * 900 + "]" * 900 + "}"
        ),
        r"regions\.json: must have at most 32 levels of nested brackets; found 901;",
    ),
    "surrogate as region": (
        lambda f: (f / "regions.json").write_text('{"a\\ud800": [[1]]}'),
        r"\[a\\ud800\]: .*UTF-8",
    ),
    "key twice": (
        lambda f: (f / "regions.json").write_text('{"a": [[1]], "a": [[2]]}'),
        r"\[a\]: .*each key once",
    ),
    "control characters": (
        lambda f: (f / "regions.json").write_text('{"a\\u001b[1m": [[1]]}'),
        r"\[a\\x1b\[1m\]: a",
    ),
    "many regions": (
        lambda f: (f / "regions.json").write_text(
            json.dumps({str(i): [] for i in range(200)})
        ),
        r"128",
    ),
    "many keys": (
        lambda f: (f / C).write_text(json.dumps({str(i): i for i in range(10**5)})),
        r"at most 1000 keys",
    ),
    "many lights": (
        many(D, "lights", 30_000),
        r"\[lights\]: must be a list of at most 2048; found 30000;",
    ),
    "many sites": (
        put(P, "sites", value=[f"s{i}" for i in range(30_000)]),
        r"\[sites\]: .* at most 256",
    ),
    "pipe as capture.json": (
        fifo(C),
        r"capture\.json: must be a regular file; found a named pipe",
    ),
    "pipe as dome.json": (
        fifo(D),
        r"dome\.json: must be a regular file; found a named pipe",
    ),
    "pipe as scan": (
        fifo("scan.ply"),
        r"scan\.ply \(mesh\): must be a regular file; found a named pipe",
    ),
    "pipe as frame": (
        fifo(FRAME),
        r"l1_c0\.png .*: must be a regular file; found a named pipe",
    ),
    "zeros as capture.json": (
        link_to_zero(C),
        r"capture\.json: every path must stay inside",
    ),
    "folder as landmarks": (
        lambda f: ((f / "landmarks.json").unlink(), (f / "landmarks.json").mkdir()),
        r"landmarks\.json: must be a regular file; found a folder",
    ),
    "14,000 pixels": (
        promised(FRAME, 14_000, 14_000),
        r"l1_c0\.png .*states 14000 x 14000 pixels",
    ),
    "60,000 pixels in a probe": (
        promised("contact/neck/b1.png", 60_000, 60_000),
        r"b1\.png .*60000 x 60000",
    ),
    "camera of 9e8 pixels": (
        lambda f: (
            put(D, "cameras", 0, "width", value=30_000)(f),
            put(D, "cameras", 0, "height", value=30_000)(f),
        ),
        r"\[cameras\]\[0\]\[width\]: a picture must have at most 64,000,000 pixels",
    ),
    "true for a number": (
        put(D, "lights", 0, "position", value=[True, 1, 500]),
        r"\[position\]: must be 3 numbers",
    ),
    "text for a number": (
        put(D, "lights", 0, "position", value=["1.0", 1, 500]),
        r"\[position\]: must be 3 numbers",
    ),
    "empty region of a site": (
        put("regions.json", "cheek", value=[[]]),
        r"regions\.json\[cheek\]: a region that",
    ),
    "version as text": (
        put(C, "version", value="1"),
        r'\[version\]: must be 1 or 2, .*; found the text "1";',
    ),
}


def test_read_capture__a_region_without_vertices_is_told(capture_folder):
    put("regions.json", "nose", value=[[]])(capture_folder)
    assert "region nose: it has no vertices" in read_capture(capture_folder).skipped


def test_read_capture__a_site_without_a_place_is_told(capture_folder):
    put(P, "sites", value=["cheek", "forehaed", "neck"])(capture_folder)
    (capture_folder / "contact/forehead").rename(capture_folder / "contact/forehaed")
    told = read_capture(capture_folder).skipped
    assert told[0] == (
        "site forehaed: no region or landmark of that name (did you mean "
        "forehead?); its position is unknown"
    )
    assert len(told) == 2


@pytest.mark.parametrize("name", HOSTILE)
def test_read_capture__hostile_files_end_in_lines_with_a_cure(capture_folder, name):
    spoil, message = HOSTILE[name]
    spoil(capture_folder)
    with pytest.raises(InputError, match=message) as caught:
        read_capture(capture_folder)
    for fault in caught.value.faults:
        assert fault.cure
        assert str(capture_folder) in fault.where
        assert str(fault).isprintable()


def test_read_capture__a_line_lost_from_a_text_scan_is_found(capture_folder):
    scan = trimesh.load(capture_folder / "scan.ply", process=False)
    scan.export(capture_folder / "scan.ply", encoding="ascii")
    read_capture(capture_folder)
    lines = (capture_folder / "scan.ply").read_text().splitlines()
    (capture_folder / "scan.ply").write_text("\n".join(lines[:20] + lines[21:]))
    with pytest.raises(
        InputError,
        match=r"scan\.ply \(mesh\): the scan must be a complete mesh file; found .* lines for",
    ):
        read_capture(capture_folder)


def test_read_capture__an_image_of_regions_must_exist(capture_folder):
    put(C, "regions", value="regions.png")(capture_folder)
    with pytest.raises(InputError, match=r"\[regions\]: the file must exist"):
        read_capture(capture_folder)
