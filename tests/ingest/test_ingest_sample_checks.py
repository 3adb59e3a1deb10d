"""Intensities and samples that no dome and no skin have are refused; unusual ones are noted."""

from __future__ import annotations

import numpy as np
import pytest
from sphere import CAMERAS, INTENSITY, LIGHTS, face_radiance
from spoil import D, edit

from skindb.errors import InputError
from skindb.format.frames import write_frame
from skindb.store import Database
from skindb.workflow import ingest_take


def given(*factors):
    """Intensities in place of the white target, each times a factor of its own."""

    def change(dome):
        dome["white"] = None
        for light, factor in zip(dome["lights"], factors, strict=True):
            light["intensity"] = (INTENSITY * factor).tolist()

    return lambda folder: edit(folder / D, change)


def linear(light, factor, *factors):
    """OpenEXR frames; those of one light times a factor."""

    def write(folder):
        for camera, eye in CAMERAS.items():
            for name, place in LIGHTS.items():
                image = np.asarray(face_radiance(eye, place), np.float32) * (
                    factor if name == light else 1
                )
                write_frame(
                    folder / f"dome/frames/{name}_{camera}.exr",
                    np.asarray(image, np.float32),
                )
        given(*(factors or (1, 1, 1, 1)))(folder)
        record = {
            "frames": "dome/frames/{light}_{camera}.exr",
            "exposures": [{"id": "one", "seconds": 1}],
        }
        edit(folder / D, lambda dome: dome.update(record))

    return write


HOSTILE = {
    "one light 1e6 times brighter": (
        given(1, 1e6, 1, 1),
        (
            r"\[lights\]\[1\]\[intensity\]: .* 1,000 times .*; found 1e\+06 times, of "
            r"light l1; correct it"
        ),
    ),
    "one light 1e6 times darker": (
        given(1, 1, 1e-6, 1),
        r"\[lights\]\[2\]\[intensity\]: .* found 1e-06 times, of",
    ),
    "one channel of a light": (
        given(1, 1, np.array([1, 1, 1e5]), 1),
        r"\[2\]\[intensity\]: .* found 1e\+05 times",
    ),
    "all samples overflow": (
        given(*[1e-9] * 4),
        (
            r"dome\.json\[lights\]: the median reflectance sample of a face must be "
            r".*; found samples beyond 65504"
        ),
    ),
    "all samples vanish": (
        given(*[1e9] * 4),
        r"dome\.json\[lights\]: the median reflectance sample .*; found 0;",
    ),
    "intensities of another unit": (
        given(*[1e3] * 4),
        r"the median .* must be 0\.0003 to 3 sr\^-1; found [\d.e-]+;",
    ),
    "intensity of another unit": (
        given(1, 1, 1, 100),
        (
            r"\[lights\]\[3\]: the median sample of a light must be at most 50 times "
            r".*; found 0\.0\d* times, of light l3"
        ),
    ),
    "frames of a light of 1e6": (
        linear("l1", 1e6),
        r"\[lights\], light l1: its photographs must be as bright",
    ),
    "black frames of a light": (
        linear("l1", 0),
        (
            r"\[frames\], camera c0, light l1: a frame must be bright where .*; found "
            r"none at \d+ surfels; copy the frame"
        ),
    ),
}


def ingested(folder, root, **options):
    record = ingest_take(
        Database(root), folder, spacing_mm=8.0, photographs=0, **options
    )
    return record.provenance["summary"]["notes"]


@pytest.mark.parametrize("name", HOSTILE)
def test_ingest_capture__intensities_and_samples_of_no_dome_are_refused(
    capture_folder, tmp_path, name
):
    spoil, message = HOSTILE[name]
    spoil(capture_folder)
    with pytest.raises(InputError, match=message) as caught:
        ingested(capture_folder, tmp_path / "db")
    assert all(fault.cure for fault in caught.value.faults)
    assert Database(tmp_path / "db").takes() == []


LEGAL = {
    "as they are": (given(1, 1, 1, 1), []),
    "lights of two kinds": (linear("l3", 5, 1, 1, 1, 5), []),
    "a sitter too dark for skin": (
        given(*[30] * 4),
        ["the face reflects 2% of red light, and skin 10% to 90%"],
    ),
    "one light that may be wrong": (
        given(1, 1, 1, 1.7),
        ["light l3: the face is 0.59 times as bright under it as"],
    ),
    "frames of a light that may be wrong": (
        linear("l1", 1.7),
        ["light l1: the face is 1.7 times as bright under it"],
    ),
}
NOTED = {
    "one light": (
        given(1, 1, 1, 30),
        ["light l3: its intensity is 30 times", "light l3: its samples are 0.03"],
    ),
    "frames of a light": (linear("l1", 12), ["light l1: its samples are 1"]),
}


@pytest.mark.parametrize("name", NOTED)
def test_ingest_capture__lights_that_are_wrong_are_noted_on_request(
    capture_folder, tmp_path, name
):
    spoil, expected = NOTED[name]
    spoil(capture_folder)
    notes = ingested(capture_folder, tmp_path / "db", calibration="note")
    assert [
        note.startswith(start) for note, start in zip(notes, expected, strict=False)
    ] == [True] * len(expected)
    assert any(
        "its photographs must be as bright as those of the others" in note
        for note in notes
    )


@pytest.mark.parametrize("name", LEGAL)
def test_ingest_capture__unusual_lights_pass_and_are_noted(
    capture_folder, tmp_path, name
):
    spoil, expected = LEGAL[name]
    spoil(capture_folder)
    notes = ingested(capture_folder, tmp_path / "db")
    assert [
        note.startswith(start) for note, start in zip(notes, expected, strict=True)
    ] == [True] * len(expected)
