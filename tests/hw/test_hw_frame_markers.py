"""Which frame belongs to which step: pictures of a made-up camera that drops, repeats and
delays frames, with noise. The camera knows what it delivered.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import imagecodecs
import numpy as np
import pytest

from skindb.hw.cameras import Shot, _ordered
from skindb.hw.frame_markers import (
    INTERVAL,
    MARKER,
    exposures_problem,
    identify_frames,
    with_markers,
)
from skindb.hw.sequence import DARK, assess, plan_schedule, slowed_schedule
from skindb.hw.session import with_dark_frames

LIGHTS = [f"l{i:03d}" for i in range(40)]
EXPOSURES = {"long": 0.04, "short": 0.005}
MARKER_LIGHT = "l007"


def _pictures(rng):
    """Picture (8, 12) of every light and exposure; every fourth light is behind the
    subject and leaves nothing but the black level.
    """
    pictures = {}
    for i, light in enumerate(LIGHTS):
        shade = rng.uniform(0, 8000, (8, 12)) * (i % 4 != 1)
        for name, seconds in EXPOSURES.items():
            pictures[light, name] = 512 + shade * seconds / 0.04
            pictures[DARK, name] = np.full((8, 12), 512.0)
    return pictures


class _Camera:
    """Writes a file for every frame that it delivers; `taken` has the step of each."""

    def __init__(self, folder, pictures, rng):
        self.folder, self.pictures, self.rng = folder, pictures, rng
        self.shots, self.taken = [], []

    def expose(self, step, index):
        value = self.pictures[step.light, step.exposure]
        self.last = np.rint(value + self.rng.normal(0, 3, value.shape)).astype("u2")
        self.deliver(index)

    def deliver(self, index):
        path = self.folder / f"{len(self.shots)}.png"
        path.write_bytes(imagecodecs.png_encode(np.repeat(self.last[..., None], 3, 2)))
        self.shots.append(Shot(path))
        self.taken.append(index)

    def run(self, schedule, dropped=(), repeated=()):
        for i, step in enumerate(schedule.steps):
            if i not in dropped:
                self.expose(step, i)
            if i in repeated and self.shots:
                self.deliver(i)


def _parts(schedule):
    """Indices of the steps between two markers, with those of the markers around them."""
    edges = [i for i, step in enumerate(schedule.steps) if step.marker]
    first = edges[::MARKER]
    return [range(a, b + MARKER) for a, b in pairwise(first)]


def _require_right(frames, camera, damaged, schedule):
    """Every frame is that of its step, and every part without damage has all of them."""
    names = [step.name for step in schedule.steps] + ["of another run"]
    taken = dict(zip([shot.path for shot in camera.shots], camera.taken, strict=True))
    assert all(names[taken[path]] == names[i] for i, path in frames.items())
    for part in _parts(schedule):
        if not damaged & set(part):
            steps = {i for i in part if not schedule.steps[i].marker} & {*camera.taken}
            assert steps <= frames.keys()


def test_identify_frames__drops_and_repetitions_anywhere(tmp_path):
    """As many frames as triggers, of which some are dropped and others delivered twice."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        folder = tmp_path / str(seed)
        folder.mkdir()
        lights = LIGHTS[: int(rng.integers(8, 40))]
        schedule = with_dark_frames(plan_schedule(lights, EXPOSURES))
        marked = with_markers(schedule, MARKER_LIGHT, first=int(rng.integers(40)))
        camera = _Camera(folder, _pictures(rng), rng)
        count = int(rng.integers(0, 4))
        dropped, repeated = rng.integers(0, len(marked.steps), (2, count)).tolist()
        camera.run(marked, dropped, repeated)
        frames, problems = identify_frames(camera.shots, marked.steps)
        _require_right(frames, camera, {*dropped, *repeated}, marked)
        missing = len(schedule.steps) - len(frames)
        assert bool(problems) == bool(missing)


def test_identify_frames__a_drop_and_a_repetition_side_by_side(tmp_path):
    """At every place of a part, the last flash of its marker included."""
    schedule = plan_schedule(LIGHTS[:10], {"long": 0.04})
    marked = with_markers(schedule, MARKER_LIGHT)
    for place in range(MARKER - 1, MARKER + 10):
        rng = np.random.default_rng(place)
        folder = tmp_path / str(place)
        folder.mkdir()
        camera = _Camera(folder, _pictures(rng), rng)
        camera.run(marked, [place + 1], [place])
        frames, problems = identify_frames(camera.shots, marked.steps)
        assert frames == {}
        assert "same picture" in problems[0] or "not seen" in problems[0]


def test_identify_frames__a_light_that_is_photographed_twice(tmp_path):
    """As if a camera was triggered twice, and lost a trigger before."""
    rng = np.random.default_rng(4)
    marked = with_markers(plan_schedule(LIGHTS[:10], {"long": 0.04}), MARKER_LIGHT)
    camera = _Camera(tmp_path, _pictures(rng), rng)
    for i, step in enumerate(marked.steps):
        for _ in range({9: 0, 14: 2}.get(i, 1)):
            camera.expose(step, i)
    frames, [problem] = identify_frames(camera.shots, marked.steps)
    assert (frames, problem[-30:]) == (
        {},
        "13.png and 14.png show the same light"[-30:],
    )


def test_identify_frames__late_frames_of_the_run_before(tmp_path):
    rng = np.random.default_rng(5)
    camera = _Camera(tmp_path, _pictures(rng), rng)
    schedule = plan_schedule(LIGHTS[:30], {"long": 0.04})
    before = with_markers(schedule, MARKER_LIGHT)
    camera.run(before)
    del camera.shots[:20], camera.taken[:20]
    camera.taken = [-1] * len(camera.taken)
    again = with_markers(schedule, MARKER_LIGHT, first=before.markers)
    camera.run(again)
    frames, problems = identify_frames(camera.shots, again.steps)
    _require_right(frames, camera, set(), again)
    assert problems == []


def test_identify_frames__lost_triggers(tmp_path):
    """The controller names the step, its neighbour, or none."""
    rng = np.random.default_rng(6)
    marked = with_markers(plan_schedule(LIGHTS[:30], {"long": 0.04}), MARKER_LIGHT)
    for index in (9, MARKER + INTERVAL):  # a step, a flash of the second marker
        for reported in ([index], [index - 1], []):
            camera = _Camera(tmp_path, _pictures(rng), rng)
            camera.run(marked, [index])
            frames, problems = identify_frames(camera.shots, marked.steps, reported)
            _require_right(frames, camera, {index}, marked)
            assert problems
    camera = _Camera(tmp_path, _pictures(rng), rng)
    camera.run(marked)  # as many frames as steps, of which the controller lost one
    frames, [problem] = identify_frames(camera.shots, marked.steps, [9])
    assert "lost triggers" in problem
    assert 9 not in frames


def test_identify_frames__a_run_that_was_stopped(tmp_path):
    """At every step: what lies between two markers is kept."""
    rng = np.random.default_rng(9)
    marked = with_markers(plan_schedule(LIGHTS[:30], {"long": 0.04}), MARKER_LIGHT)
    for end in range(1, len(marked.steps), 3):
        camera = _Camera(tmp_path, _pictures(rng), rng)
        camera.run(marked, range(end, len(marked.steps)))
        frames, _ = identify_frames(camera.shots, marked.steps[:end])
        _require_right(frames, camera, {*range(end, len(marked.steps))}, marked)


def test_identify_frames__no_frames_and_no_flashes(tmp_path):
    rng = np.random.default_rng(7)
    marked = with_markers(plan_schedule(LIGHTS[:4], {"long": 0.04}), MARKER_LIGHT)
    assert identify_frames([], marked.steps) == ({}, ["no frames"])
    camera = _Camera(
        tmp_path, dict.fromkeys(_pictures(rng), np.full((8, 12), 9.0)), rng
    )
    camera.run(marked)
    frames, problems = identify_frames(camera.shots, marked.steps)
    assert (frames, problems) == (
        {},
        [f"no flashes of the marker light {MARKER_LIGHT}"],
    )


@pytest.mark.parametrize("slow", [False, True])
def test_with_markers__keeps_the_steps_and_the_flash_rate(slow):
    schedule = with_dark_frames(plan_schedule(LIGHTS, EXPOSURES, seconds=9.0))
    schedule = slowed_schedule(schedule) if slow else schedule
    marked = with_markers(schedule, MARKER_LIGHT)
    kept = [step for step in marked.steps if not step.marker]
    assert [(s.light, s.exposure, s.off_us - s.on_us) for s in kept] == [
        (s.light, s.exposure, s.off_us - s.on_us) for s in schedule.steps
    ]
    # those of the lights, and before and after the dark frames
    assert marked.markers == 1 + -(-2 * len(LIGHTS) // INTERVAL) + 2
    assert assess(marked).flashes_per_second <= max(
        assess(schedule).flashes_per_second, 3
    )
    ends = zip(marked.steps, marked.steps[1:], strict=False)
    assert all(a.off_us < b.on_us for a, b in ends)


def test_with_markers__the_numbers_of_a_run_differ():
    long = plan_schedule(LIGHTS, {f"e{i}": 0.01 for i in range(20)})
    assert with_markers(long, MARKER_LIGHT).markers <= 16


def _order(arrivals):
    shots = _ordered({Path(name): at for name, at in arrivals.items()})
    return [shot.path.name for shot in shots], [shot.is_doubtful for shot in shots]


def test_ordered__counted_names_overrule_arrivals():
    """Files that several threads write overtake each other."""
    arrivals = {f"DSC_{i}.png": 10 * i + 3 * (i % 2) for i in range(7, 30)}
    assert _order(arrivals) == ([*arrivals], [False] * 23)


def test_ordered__names_with_times_of_a_clock_that_steps_back():
    """Twelve frames in a second; the clock of the camera steps back by 0.12 s at the
    tenth, and the arrivals tell the order of all but that one.
    """
    stamps = [i / 12 - 0.12 * (i >= 10) for i in range(20)]
    arrivals = {f"20260101-10{i:07.3f}.png": n / 12 for n, i in enumerate(stamps)}
    names, doubtful = _order(arrivals)
    assert names == [*arrivals]
    assert np.flatnonzero(doubtful).tolist() == [10]


def test_ordered__names_that_tell_nothing():
    rng = np.random.default_rng(0)
    arrivals = {f"{rng.integers(2**60):x}.png": i / 12 for i in range(30)}
    assert _order(arrivals) == ([*arrivals], [False] * 30)
    together = {f"{rng.integers(2**60):x}.png": i / 100 for i in range(30)}
    assert all(_order(together)[1][1:])


def test_exposures_problem__a_repeated_frame(tmp_path):
    rng = np.random.default_rng(8)
    camera = _Camera(tmp_path, _pictures(rng), rng)
    camera.run(plan_schedule(LIGHTS[:5], {"long": 0.04}))
    names = ["a", "b", "c", "d", "e"]
    assert exposures_problem(camera.shots, names) == ""
    twice = [camera.shots[i] for i in (0, 1, 1, 3, 4)]
    assert exposures_problem(twice, names) == "1.png and 1.png are the same picture"
