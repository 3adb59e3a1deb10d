"""Sequences, safety, folders of cameras."""

from __future__ import annotations

from pathlib import Path

import imagecodecs
import numpy as np
import pytest

from skindb.clock import SimulatedClock
from skindb.errors import InputError
from skindb.hw.cameras import FolderCameras
from skindb.hw.probe import brackets
from skindb.hw.sequence import (
    DARK,
    MAX_FLASHES,
    Measured,
    Override,
    Schedule,
    Step,
    assess,
    partial_schedule,
    plan_schedule,
    require_safe,
    sequence_entry,
    slowed_schedule,
    slower_alternative,
)
from skindb.hw.session import with_dark_frames

LIGHTS = [f"l{i:03d}" for i in range(150)]
PAPER = plan_schedule(LIGHTS, {"long": 0.04, "short": 0.005}, seconds=25.0)


def test_plan_schedule__the_paper_s_capture():
    """150 lights, two exposures, 25 s: twelve flashes in a second (Weyrich et al. 2005,
    section 5).
    """
    assert len(PAPER.steps) == 300
    assert PAPER.seconds == pytest.approx(25.0, abs=0.1)
    # the short exposures follow each other faster
    assert 11 <= assess(PAPER).flashes_per_second <= 17
    assert all(
        a.off_us < b.on_us for a, b in zip(PAPER.steps, PAPER.steps[1:], strict=False)
    )


def test_brackets__the_paper_s_probe():
    """23 exposures 2/3 of a stop apart span 14.7 stops, which is four decades and a half."""
    found = brackets(32.0)
    values = list(found.values())
    assert len(values) == 23
    np.testing.assert_allclose(np.diff(np.log2(values)), -2 / 3)
    assert sum(values) == pytest.approx(88, abs=5)  # s at each site


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"lights": [], "exposures": {"e": 1.0}}, "must have lights and exposures"),
        ({"lights": ["a"], "exposures": {}}, "must have lights and exposures"),
        (
            {"lights": ["a"], "exposures": {"e": 0.0}},
            "an exposure must last 1e-6 to 60 s",
        ),
        (
            {"lights": ["a"], "exposures": {"e": float("nan")}},
            "an exposure must last 1e-6 to 60 s",
        ),
        (
            {"lights": ["a", "b"], "exposures": {"e": 1.0}, "seconds": 1.0},
            r"must last at least 2\.004 s",
        ),
    ],
)
def test_plan_schedule__mistakes(given, said):
    with pytest.raises(InputError, match=said):
        plan_schedule(given["lights"], given["exposures"], seconds=given.get("seconds"))


def test_assess__is_the_count_in_any_second():
    for seed in range(50):
        _check_assess__is_the_count_in_any_second(seed)


def _check_assess__is_the_count_in_any_second(seed):
    rng = np.random.default_rng(seed)
    starts = np.cumsum(rng.integers(20_000, 900_000, 40))
    schedule = Schedule(tuple(Step("l", "e", int(t), int(t) + 10_000) for t in starts))
    begins = np.arange(0, starts[-1], 1_000)[:, None]
    naive = ((starts >= begins) & (starts < begins + 1_000_000)).sum(axis=1).max()
    found = assess(schedule).flashes_per_second
    assert naive <= found <= naive + 1  # windows that begin between two milliseconds
    assert found == max(
        int(((starts >= t) & (starts < t + 1_000_000)).sum()) for t in starts
    )


def test_slower_alternative__needs_no_override():
    assert assess(slowed_schedule(PAPER)).flashes_per_second <= MAX_FLASHES
    assert require_safe(slowed_schedule(PAPER), None).safe
    assert "74.7 s longer" in slower_alternative(PAPER)
    assert assess(slowed_schedule(with_dark_frames(PAPER))).safe
    assert assess(Schedule(())).safe
    assert assess(Schedule((Step(DARK, "e", 0, 10),))).flashes_per_second == 0


@pytest.mark.parametrize("lacks", ["screened", "consented", "eyes_closed", "operator"])
def test_require_safe__an_incomplete_confirmation_is_none(lacks):
    given = {"operator": "OP-1", "time": "now"} | (
        {"operator": ""} if lacks == "operator" else {lacks: False}
    )
    with pytest.raises(
        InputError,
        match="confirm screening, consent and closed eyes for more than 3 flashes",
    ):
        require_safe(PAPER, Override(**given))
    assert require_safe(PAPER, Override("OP-1", "now")).flashes_per_second > MAX_FLASHES


def test_sequence_entry__measured_times_count():
    entry = sequence_entry(Step("a", "e", 100, 200), Measured(103, 204, 1, 1.0, 0.0))
    assert (entry["t_on"], entry["t_off"], entry["trigger_count"]) == (
        103e-6,
        204e-6,
        1,
    )
    assert (entry["planned_on"], entry["planned_off"]) == (100e-6, 200e-6)


def test_partial_schedule__flashes_no_faster_than_the_whole():
    """Any steps of any schedule, fast or slow, with dark frames or without: a
    repetition needs no new confirmation.
    """
    for seed in range(60):
        _check_partial_schedule__flashes_no_faster_than_the_whole(seed)


def _check_partial_schedule__flashes_no_faster_than_the_whole(seed):
    rng = np.random.default_rng(seed)
    exposures = {
        f"e{i}": float(t)
        for i, t in enumerate(10 ** rng.uniform(-3, -1, rng.integers(1, 4)))
    }
    planned = plan_schedule(LIGHTS[: rng.integers(3, 30)], exposures)
    whole = slowed_schedule(planned) if rng.random() < 0.5 else planned
    whole = with_dark_frames(whole) if rng.random() < 0.7 else whole
    steps = rng.choice(
        len(whole.steps), rng.integers(1, len(whole.steps)), replace=False
    )
    part = partial_schedule(whole, steps)
    assert [(s.light, s.exposure) for s in part.steps] == [
        (whole.steps[i].light, whole.steps[i].exposure) for i in sorted(steps)
    ]
    assert assess(part).flashes_per_second <= assess(whole).flashes_per_second
    assert all(
        a.off_us < b.on_us for a, b in zip(part.steps, part.steps[1:], strict=False)
    )


def test_folder_cameras__need_their_folders(tmp_path):
    (tmp_path / "c0").mkdir()
    with pytest.raises(InputError, match="no subfolder c1; set the folders"):
        FolderCameras(tmp_path, ["c0", "c1"])
    cameras = FolderCameras(tmp_path, ["c0"], clock=SimulatedClock())
    cameras.start()
    (tmp_path / "c0/half.png").write_bytes(b"\x89PNG")  # not complete yet
    (tmp_path / "c0/notes.txt").write_text("no frame")
    assert cameras.collect(1) == {"c0": []}


def test_folder_cameras__files_may_be_renamed_while_they_are_listed(
    tmp_path, monkeypatch
):
    (tmp_path / "c0").mkdir()
    cameras = FolderCameras(tmp_path, ["c0"], clock=SimulatedClock())
    cameras.start()
    # listed by the folder, but renamed before its size is read
    gone = tmp_path / "c0/temporary.png"
    taken = tmp_path / "c0/0001.png"
    taken.write_bytes(imagecodecs.png_encode(np.zeros((2, 2, 3), np.uint16)))
    listed = Path.iterdir
    monkeypatch.setattr(Path, "iterdir", lambda path: iter([gone, *listed(path)]))
    assert [shot.path for shot in cameras.collect(1)["c0"]] == [taken]
