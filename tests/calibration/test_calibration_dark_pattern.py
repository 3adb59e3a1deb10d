"""Dark frames are compared with the dark parts of photographs, by the pattern of the sensor."""

from __future__ import annotations

import numpy as np
import pytest
from sphere import BLACK, CAMERAS, HEIGHT, LIGHTS, SECONDS, WIDTH, save
from spoil import D, put

from skindb.calibration.frame_checks import dark_pattern_fault
from skindb.calibration.radiance import frame_mergers
from skindb.errors import InputError
from skindb.format.frames import read_frame
from skindb.ingest import read_capture
from skindb.store import Database
from skindb.workflow import ingest_take

RULE = "dark frames must show the pattern of the sensor where the photographs show it"


def pattern(rng, kind):
    """Offsets (h, w, 3) of the pixels of one sensor."""
    if kind == "columns":
        return np.broadcast_to(rng.normal(0, 12, (1, WIDTH, 1)), (HEIGHT, WIDTH, 3))
    offset = (
        rng.normal(0, 12, (HEIGHT, WIDTH, 1))
        if kind == "grey"
        else rng.normal(0, 12, (HEIGHT, WIDTH, 3))
    )
    if kind == "hot pixels":
        offset[rng.random((HEIGHT, WIDTH)) < 0.002] = 5_000
    return offset + np.zeros(3)


def write_dark(
    folder, *, kind="pixels", change=lambda frame: frame, names=None, seed=1
):
    """Add a pattern to the photographs, and write dark frames that have the same one, changed."""
    rng = np.random.default_rng(seed)
    offsets = {camera: pattern(rng, kind) for camera in CAMERAS}
    for camera, offset in offsets.items():
        for exposure in SECONDS:
            for light in LIGHTS:
                path = folder / f"dome/frames/{exposure}/{light}_{camera}.png"
                save(
                    path,
                    np.clip(np.rint(read_frame(path) + offset), 0, 65535).astype(
                        np.uint16
                    ),
                )
            of = (names or {}).get(camera, camera)
            dark = np.rint(BLACK + offsets[of] + rng.normal(0, 3, offset.shape)).astype(
                np.uint16
            )
            save(
                folder / f"dome/dark/{exposure}_{camera}.png",
                np.ascontiguousarray(change(dark)),
            )
    put(D, "dark", value="dome/dark/{exposure}_{camera}.png")(folder)


def found(folder):
    dome = read_capture(folder).dome
    faults = []
    mergers = frame_mergers(dome, faults)
    assert faults == []
    return [
        fault
        for name in mergers
        if (fault := dark_pattern_fault(dome, name, mergers)) is not None
    ]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda frame: frame[::-1, ::-1], "they look upside down"),
        (lambda frame: frame[:, ::-1], "they look mirrored"),
        (lambda frame: frame[::-1], "they look mirrored top to bottom"),
    ],
)
@pytest.mark.parametrize("kind", ["pixels", "grey", "hot pixels"])
def test_dark_pattern_fault__turned_and_mirrored_dark_frames(
    capture_folder, kind, change, said
):
    write_dark(capture_folder, kind=kind, change=change)
    faults = found(capture_folder)
    assert [fault.rule for fault in faults] == [RULE] * 2
    assert [fault.found for fault in faults] == [
        f"camera {camera}: {said}" for camera in CAMERAS
    ]


def test_dark_pattern_fault__dark_frames_of_another_camera(capture_folder):
    write_dark(capture_folder, names={"c0": "c1", "c1": "c0"})
    assert [fault.found for fault in found(capture_folder)] == [
        "camera c0: those of camera c1 match its photographs",
        "camera c1: those of camera c0 match its photographs",
    ]


@pytest.mark.parametrize("kind", ["pixels", "grey", "columns", "hot pixels"])
def test_dark_pattern_fault__true_dark_frames_have_none(capture_folder, kind):
    write_dark(capture_folder, kind=kind)
    assert found(capture_folder) == []


def test_dark_pattern_fault__one_frame_for_all_cameras_and_unrelated_ones_have_none(
    capture_folder,
):
    write_dark(capture_folder, names={"c0": "c1"})
    rng = np.random.default_rng(2)
    for path in (capture_folder / "dome/dark").rglob("*.png"):
        save(
            path,
            np.rint(BLACK + rng.normal(0, 12, (HEIGHT, WIDTH, 1)) + np.zeros(3)).astype(
                np.uint16
            ),
        )
    assert found(capture_folder) == []


def test_ingest_capture__dark_frames_upside_down_are_refused(capture_folder, tmp_path):

    write_dark(capture_folder, change=lambda frame: frame[::-1, ::-1])
    with pytest.raises(
        InputError,
        match=r"dome\.json\[dark\]: dark frames must .*; found camera c0: they look upside",
    ):
        ingest_take(
            Database(tmp_path / "db"), capture_folder, spacing_mm=8.0, photographs=0
        )
