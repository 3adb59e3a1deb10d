"""Frames that cannot be photographs of this dome are refused."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from dataclasses import replace

import imagecodecs
import numpy as np
import pytest
from sphere import (
    BLACK,
    CAMERAS,
    HEIGHT,
    LIGHTS,
    PROBE_SECONDS,
    SECONDS,
    WHITE,
    WIDTH,
    face_radiance,
    save,
    target_radiance,
)
from spoil import D, P, edit, put

from skindb.calibration.frame_checks import (
    highest_value,
    level_notes,
    view_faults,
)
from skindb.calibration.irradiance import unevenness
from skindb.calibration.radiance import FrameMerger, read_view
from skindb.errors import InputError
from skindb.format.frames import write_frame
from skindb.ingest import read_capture
from skindb.store import Database
from skindb.workflow import ingest_take

FRAME = "dome/frames/long/l1_c1.png"
SHORT = "dome/frames/short/l1_c1.png"


def exchange(one, two):
    def change(folder):
        shutil.move(folder / one, folder / "x")
        shutil.move(folder / two, folder / one)
        shutil.move(folder / "x", folder / two)

    return change


def copied(name, other):
    return lambda folder: shutil.copy(folder / other, folder / name)


def filled(name, value):
    """A frame of one value, of the size it has."""

    def write(folder):
        frame = imagecodecs.png_decode((folder / name).read_bytes())
        save(folder / name, np.full_like(frame, value))

    return write


def brackets(site, value):
    return together(
        *(filled(f"contact/{site}/{bracket}.png", value) for bracket in PROBE_SECONDS)
    )


def together(*changes):
    return lambda folder: [change(folder) for change in changes]


def scaled(name, factor):
    def write(folder):
        frame = imagecodecs.png_decode((folder / name).read_bytes()).astype(float)
        save(
            folder / name,
            np.clip(np.rint(BLACK + factor * (frame - BLACK)), 0, WHITE).astype(
                np.uint16
            ),
        )

    return write


def darks(value, *, black=BLACK):
    """Dark frames of one value for every exposure and camera."""

    def write(folder):
        for exposure in SECONDS:
            for camera in CAMERAS:
                save(
                    folder / f"dome/dark/{exposure}_{camera}.png",
                    np.full((HEIGHT, WIDTH, 3), value, np.uint16),
                )
        put(D, "dark", value="dome/dark/{exposure}_{camera}.png")(folder)
        for i in range(len(CAMERAS)):
            put(D, "cameras", i, "black_level", value=black)(folder)

    return write


def mirrored(name):
    def write(folder):
        save(
            folder / name,
            np.ascontiguousarray(
                imagecodecs.png_decode((folder / name).read_bytes())[:, ::-1]
            ),
        )

    return write


def moved(name, pixels):
    """A frame shifted to the right, as of a head that moved."""

    def write(folder):
        save(
            folder / name,
            np.roll(
                imagecodecs.png_decode((folder / name).read_bytes()), pixels, axis=1
            ),
        )

    return write


def white_of_the_face(folder):
    """Copied to the names of the white target's frames."""
    for path in (folder / "dome/white").rglob("*.png"):
        shutil.copy(
            folder / "dome/frames" / path.relative_to(folder / "dome/white"), path
        )


def merged(change):
    """OpenEXR frames of the sphere; one of them, l1 of c1, is changed."""

    def write(folder):
        for part, radiance in (("frames", face_radiance), ("white", target_radiance)):
            for camera, eye in CAMERAS.items():
                for light, place in LIGHTS.items():
                    image = np.asarray(radiance(eye, place), np.float32)
                    image = (
                        np.asarray(change(image), np.float32)
                        if (part, light, camera) == CHANGED
                        else image
                    )
                    write_frame(folder / f"dome/{part}/{light}_{camera}.exr", image)

        def record(dome):
            dome |= {
                "frames": "dome/frames/{light}_{camera}.exr",
                "exposures": [{"id": "one", "seconds": 1}],
            }
            dome["white"]["frames"] = "dome/white/{light}_{camera}.exr"

        edit(folder / D, record)

    return write


def spotted(image, value):
    """The picture with one value in a square of a quarter of its width."""
    image[HEIGHT * 3 // 8 : HEIGHT * 5 // 8, WIDTH * 3 // 8 : WIDTH * 5 // 8] = value
    return image


CHANGED = ("frames", "l1", "c1")
BOTH = r"dome\.json\[frames\]: exposures of one view must have the same radiance: .*"
HOSTILE = {
    "exchanged exposures of a view": (
        exchange(FRAME, SHORT),
        BOTH
        + (
            r"found camera c1, light l1: exposure short \(0\.1 s\) has [\d.]+ times "
            r"the radiance of long \(1 s\)"
        ),
    ),
    "exchanged exposures of the target": (
        exchange("dome/white/long/l2_c0.png", "dome/white/short/l2_c0.png"),
        (
            r"dome\.json\[white\]\[frames\]: exposures of one view .*; found camera "
            r"c0, light l2: exposure short"
        ),
    ),
    "black short exposure": (
        filled(SHORT, BLACK),
        BOTH + r"l1: exposure short \(0\.1 s\) has 0 times",
    ),
    "white short exposure": (
        filled(SHORT, WHITE),
        BOTH + r"l1: exposure short \(0\.1 s\) has \d+",
    ),
    "black long exposure": (
        filled(FRAME, BLACK),
        BOTH + r"l1: exposure short \(0\.1 s\) has [\de+.]+ times",
    ),
    "white long exposure": (
        filled(FRAME, WHITE),
        BOTH + r"l1: exposure short \(0\.1 s\) has 0\.\d+ times",
    ),
    "half a stop more light": (scaled(SHORT, 1.5), BOTH + r"has 1\.5 times"),
    "mirrored exposure": (
        mirrored("dome/frames/short/l2_c1.png"),
        BOTH
        + (
            r"camera c1, light l2: exposure short and long differ in \d\d% of the "
            r"values that both must contain"
        ),
    ),
    "frames of a light are those of another": (
        together(
            *(
                copied(f"dome/frames/{e}/l1_c0.png", f"dome/frames/{e}/l2_c0.png")
                for e in SECONDS
            )
        ),
        (
            r"frame must have been taken by itself; found dome/frames/long/l1_c0\.png "
            r"is a copy of dome/frames/long/l2_c0"
        ),
    ),
    "white frame of another light": (
        together(
            *(
                copied(f"dome/white/{e}/l1_c0.png", f"dome/white/{e}/l2_c0.png")
                for e in SECONDS
            )
        ),
        (
            r"must have been taken by itself; found dome/white/short/l1_c0\.png is a "
            r"copy|the white target must be evenly"
        ),
    ),
    "frames of a site are those of another": (
        together(
            *(
                copied(f"contact/neck/{bracket}.png", f"contact/cheek/{bracket}.png")
                for bracket in PROBE_SECONDS
            )
        ),
        r"taken by itself; found contact/cheek/b0\.png is a copy of contact/neck/b0\.png",
    ),
    "exposures of two lights": (
        exchange(SHORT, "dome/frames/short/l2_c1.png"),
        BOTH
        + r"camera c1, light l1: exposure short .*(.|\n)*camera c1, light l2: exposure short",
    ),
    "white in every exposure": (
        together(filled(FRAME, WHITE), filled(SHORT, WHITE)),
        (
            r"\[frames\]: a photograph must not be saturated everywhere; found camera "
            r"c1, light l1: no value below white_l"
        ),
    ),
    "black level above black": (
        put(D, "cameras", 1, "black_level", value=1500),
        (
            r"\[frames\]: at most 5% of a frame may be darker than black_level, .*; "
            r"found camera c1, light l\d: \d\d%"
        ),
    ),
    "white dark frames": (
        darks(60_000),
        r"\[dark\]: dark frames and black_level must differ by .* \+91\.5%",
    ),
    "black dark frames": (
        darks(0),
        r"\[dark\]: dark frames must hold the values of black; found 0 every.*level 256",
    ),
    "black level of other dark frames": (
        darks(BLACK, black=5000),
        r"\[dark\]: .* -7\.8%, exp.*, black_level 5000",
    ),
    "dark frames lighter than the frames": (
        darks(BLACK + 1000),
        (
            r"\[frames\]: at most 5% of a frame may be darker than the dark frame, .* "
            r"take the dark frames again"
        ),
    ),
    "white frames of the face": (
        white_of_the_face,
        (
            r"dome\.json\[white\]: the white target must be evenly bright: .*; found "
            r"camera c0, light l\d: by \d\d%;"
        ),
    ),
    "OpenEXR of -1": (
        merged(lambda x: x * 0 - 1),
        r"\[frames\]: an OpenEXR frame .* camera c1, .* -1 everywhere",
    ),
    "OpenEXR of 3e38": (
        merged(lambda x: x * 0 + 3e38),
        r"\[frames\]: radiance must be at most 1e\+30; found cam",
    ),
    "OpenEXR that is huge in a square": (
        merged(lambda x: spotted(x, 3e38)),
        (
            r"\[frames\]: radiance must be at most 1e\+30; found camera c1, light l1: "
            r"0 to 3e\+38; merge the exposures"
        ),
    ),
    "OpenEXR that is bright in a square": (
        merged(lambda x: spotted(x, 1e9)),
        (
            r"\[frames\]: at most 5% of the samples of a view may be above 1000 .*; "
            r"found camera c1, light l1: \d+%; copy"
        ),
    ),
    "negative OpenEXR": (
        merged(lambda x: -x),
        r"\[frames\]: an OpenEXR frame must hold .*, nearly all negative",
    ),
    "OpenEXR of no number": (
        merged(lambda x: x * np.nan),
        r"\[frames\]: an OpenEXR frame must .* no finite value",
    ),
    "exchanged brackets": (
        exchange("contact/cheek/b0.png", "contact/cheek/b1.png"),
        (
            r"probe\.json\[exposures\]: .*; found site cheek: bracket b\d \([\d.]+ s\) "
            r"has [\d.e+]+ times the radiance"
        ),
    ),
    "black bracket": (
        filled("contact/neck/b1.png", BLACK),
        r"probe\.json\[exposures\]: .* found site neck: bracket b",
    ),
    "black frames of a site": (
        brackets("cheek", BLACK),
        (
            r"probe\.json\[frames\]: at least 3 fibres must show light, .* found site "
            r"cheek: 0 of 4, 0 saturated; place"
        ),
    ),
    "white frames of a site": (
        brackets("neck", WHITE),
        r"\[frames\]: at least 3 .* site neck: 0 of 4, 4 saturated;",
    ),
    "seconds of a bracket": (
        put(P, "exposures", 1, "seconds", value=1.5),
        r"probe\.json\[exposures\]: .* bracket b2 ",
    ),
}


def ingested(folder, root):
    return ingest_take(
        Database(root), folder, spacing_mm=8.0, photographs=0
    ).provenance["summary"]["notes"]


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE)
def test_ingest_capture__frames_that_contradict_are_refused(
    capture_folder, tmp_path, name
):
    spoil, message = HOSTILE[name]
    spoil(capture_folder)
    with pytest.raises(InputError, match=message) as caught:
        ingested(capture_folder, tmp_path / "db")
    assert all(
        fault.cure and str(capture_folder) in fault.where
        for fault in caught.value.faults
    )


def test_ingest_capture__probe_frames_of_a_rehearsal_may_be_copies(
    capture_folder, tmp_path
):
    """The emulated probe delivers the same frames at every placement."""
    spoil, _ = HOSTILE["frames of a site are those of another"]
    spoil(capture_folder)
    edit(capture_folder / "capture.json", lambda capture: capture.update(virtual=True))
    assert ingested(capture_folder, tmp_path / "db") == []


@pytest.mark.slow
def test_ingest_command__a_damaged_openexr_frame_is_one_line_without_those_of_its_library(
    capture_folder, tmp_path
):
    merged(lambda x: x)(capture_folder)
    path = capture_folder / "dome/frames/l1_c1.exr"
    content = bytearray(path.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 200] = bytes(200)
    path.write_bytes(content)
    command = "from skindb.cli import main; main()"
    arguments = [
        "ingest",
        str(tmp_path / "db"),
        str(capture_folder),
        "--progress",
        "none",
    ]
    done = subprocess.run(
        [sys.executable, "-c", command, *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    cure = "copy the file from the camera again"
    said = (
        f"skindb: {path}: a frame must be a whole image file; found one that is cut "
        f"off or damaged; {cure}\n"
    )
    assert (done.returncode, done.stdout, done.stderr) == (1, "", said)


def test_ingest_capture__seconds_that_do_not_fit_are_two_lines(
    capture_folder, tmp_path
):
    """One of the face and one of the white target, whatever the number of views."""
    edit(
        capture_folder / D,
        lambda dome: [e.update(seconds=1.1 - e["seconds"]) for e in dome["exposures"]],
    )
    with pytest.raises(InputError) as caught:
        ingested(capture_folder, tmp_path / "db")
    assert len(caught.value.faults) == 2
    pattern = r"long \(0\.1 s\) has ([\d.]+) times the radiance of short \(1 s\), and (\d) more"
    found = re.findall(pattern, str(caught.value))
    assert [count for _, count in found] == ["3", "7"]
    # 100, where long exposures are not saturated
    assert all(float(ratio) > 60 for ratio, _ in found)


LEGAL = {
    "a third of a stop": (put(D, "exposures", 1, "seconds", value=0.13), 0),
    "a head that moved by a pixel, 2.5 mm": (moved(SHORT, 1), 0),
    "a third of a stop of a bracket": (put(P, "exposures", 1, "seconds", value=0.8), 0),
    "dark frames": (darks(BLACK), 0),
    "dark frames 1.6 % below": (darks(BLACK, black=BLACK + 1000), 2),
    "no black level": (darks(BLACK, black=0), 0),
    "dark frames of a sensor that clips": (darks(0, black=0), 0),
    "noise about a light from behind": (
        merged(lambda x: x * 0 + np.random.default_rng(0).normal(-1e-4, 1e-3, x.shape)),
        0,
    ),
    "highlights beyond half floats": (
        merged(lambda x: np.where(x > np.quantile(x, 0.99), 1e6, x)),
        0,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LEGAL)
def test_ingest_capture__what_cameras_do_passes(capture_folder, tmp_path, name):
    spoil, notes = LEGAL[name]
    spoil(capture_folder)
    found = ingested(capture_folder, tmp_path / "db")
    assert len(found) == notes
    assert all(
        "differ from its black_level by -1.6% of the range" in note for note in found
    )


@pytest.mark.parametrize("view", [(light, c) for light in LIGHTS for c in range(2)])
def test_view_faults__of_large_frames_some_pixels_are_judged(
    pristine, view, monkeypatch
):
    light, c = view
    dome = read_capture(pristine).dome
    merger = FrameMerger(dome.cameras[c], tuple(dome.exposures.values()))
    frames = [
        np.tile(frame, (10, 10, 1)) for frame in read_view(dome, light, dome.cameras[c])
    ]
    assert view_faults(dome, light, merger, frames) == []
    (fault,) = view_faults(dome, light, merger, frames[::-1])
    assert "must have the same radiance" in fault.rule


def _highest(dome, change):
    """Results of `highest_value` (light, camera) of all views, whose longest exposures
    are changed.
    """
    found = np.zeros((len(dome.lights), len(dome.cameras), 2))
    for c, camera in enumerate(dome.cameras):
        merger = FrameMerger(camera, tuple(dome.exposures.values()))
        for j, light in enumerate(dome.lights):
            found[j, c] = highest_value(
                merger, [change(frame) for frame in read_view(dome, light.id, camera)]
            )
    return found[..., 0], found[..., 1].astype(bool)


@pytest.mark.parametrize(
    ("white", "change", "said"),
    [
        (WHITE, lambda frame: frame, ""),
        (60_000, lambda frame: frame, ""),
        (
            20_000,
            lambda frame: frame,
            r"values up to \d+, above white_level 20000, from which pixels count as saturated",
        ),
        (
            WHITE,
            lambda frame: np.minimum(frame, 20_000),
            r"values up to 20000 and are cut off there; set white_level to",
        ),
        (20_000, lambda frame: np.minimum(frame, 20_000), ""),
        (
            WHITE,
            lambda frame: frame // 256 + BLACK,
            r"values up to \d+, 0\.\d% of the range to white_level 65535; correct",
        ),
    ],
)
def test_level_notes__white_levels_that_the_photographs_contradict(
    pristine, white, change, said
):
    dome = read_capture(pristine).dome
    cameras = tuple(
        replace(one, sensor=replace(one.sensor, white=float(white)))
        for one in dome.cameras
    )
    notes = level_notes(replace(dome, cameras=cameras), *_highest(dome, change))
    assert len(notes) == (2 if said else 0)
    assert all(
        re.match(rf"camera c\d: its photographs have {said}", note) for note in notes
    )


def test_unevenness__is_of_the_picture_and_not_of_its_noise():
    rng = np.random.default_rng(1)
    even = rng.normal(1, 0.3, (2000, 3))
    assert unevenness(even) < 0.12
    assert unevenness(even * np.linspace(0.5, 1.5, 2000)[:, None]) > 0.3
    assert unevenness(even[:100]) == 0


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_view_faults__of_merged_radiance(pristine, dtype):
    dome = read_capture(pristine).dome
    camera = dome.cameras[0]
    kind = replace(camera.sensor.kind, bits=0)
    merger = FrameMerger(
        replace(camera, sensor=replace(camera.sensor, kind=kind)), (1.0,)
    )
    noise = np.random.default_rng(1).normal(0, 1, (400, 300, 3)).astype(dtype)
    noise[0, 0] = np.nan, np.inf, -np.inf
    for frame, finding in (
        (noise, None),
        (np.full_like(noise, 3), "3 everywhere"),
        (np.zeros_like(noise), None),
        (-abs(noise), "nearly all negative"),
        (np.full_like(noise, np.nan), "no finite value"),
    ):
        faults = view_faults(dome, next(iter(LIGHTS)), merger, [frame])
        assert len(faults) == (finding is not None)
        assert all(finding in fault.found for fault in faults)
