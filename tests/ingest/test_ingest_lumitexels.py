from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Barrier

import numpy as np
import pytest
from sphere import BLACK, INTENSITY, WHITE, save

from skindb.calibration.radiance import frame_merger
from skindb.format.folder import read_capture
from skindb.geometry.mesh import vertex_areas
from skindb.geometry.rays import RayScene
from skindb.ingest.capture import MAX_THREADS
from skindb.ingest.consistency import CalibrationCheck
from skindb.ingest.lumitexels import (
    LINEAR_NOISE_FLOOR,
    Sampler,
    _in_turn,
    choose_photographs,
    fully_lit,
    noise_floor,
)
from skindb.ingest.report import (
    cleaning_lines,
    describe_samples,
    sample_lines,
    sample_table,
)
from skindb.ingest.spool import Spool
from skindb.ingest.surfels import SurfelSet, build_surfels, camera_visibility


def test_fully_lit__leaves_out_the_neighbours_of_a_shadow(surfels, capture):
    """A pixel of these cameras is 2.5 mm wide and the spacing 3 mm or more: one ring."""
    share = np.ones((len(surfels.position), 1), np.float16)
    share[100] = 0.9
    dark = set(np.flatnonzero(~fully_lit(surfels, share, capture.dome.cameras)[:, 0]))
    ring = set(surfels.faces[(surfels.faces == 100).any(axis=1)].ravel())
    assert dark == ring
    coarse = [
        replace(camera, K=camera.K * [[0.5], [0.5], [1]])
        for camera in capture.dome.cameras
    ]
    assert len(np.flatnonzero(~fully_lit(surfels, share, coarse)[:, 0])) > 2 * len(ring)


def test_fully_lit__keeps_a_pixel_of_the_widest_camera_away_from_a_shadow(capture):
    """A plane lit where x > 0, surfels 0.25 mm apart, pixels of 2 mm in one camera of three.

    A pixel is the mean over itself, a sample lies between two of them: at the nearest
    kept surfel it may be an eighth of half a pixel too dark at the worst place of the
    grid of pixels, which is 6 %, and 2 % on average (by hand).
    """
    count = 81
    step = 0.25
    x, y = (axis.ravel() * step for axis in np.mgrid[:count, :count] - count // 2)
    at = np.arange(count * count).reshape(count, count)
    (a, b), (c, d) = (
        (row[:, :-1].ravel(), row[:, 1:].ravel()) for row in (at[:-1], at[1:])
    )
    place = np.stack([x, y, 0 * x], axis=1)
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    up = np.tile([0.0, 0, 1], (len(place), 1))
    area = vertex_areas(place, faces)
    uv = place[:, :2].astype(np.float32)
    none = np.zeros((len(place), 0), bool)
    plane = SurfelSet(place, up, area, uv, faces, (), none)
    one = capture.dome.cameras[0]
    fine, coarse = (
        replace(
            one,
            K=np.diag([f, f, 1.0]),
            R=np.diag([1.0, -1, -1]),
            t=np.array([0, 0, 1000.0]),
        )
        for f in (4e3, 500.0)
    )
    share = (place[:, :1] > 0).astype(np.float16)
    assert place[fully_lit(plane, share, [fine, fine])[:, 0], 0].min() <= 3 * step
    nearest = place[fully_lit(plane, share, [fine, fine, coarse])[:, 0], 0].min()
    assert 2.0 <= nearest <= 2.0 + 3 * step
    phases = np.linspace(0, 2, 400, endpoint=False)
    centres = np.arange(-20, 20, 2.0) + 1 + phases[:, None]
    taken = [np.interp(nearest, row, np.clip((row + 1) / 2, 0, 1)) for row in centres]
    assert min(taken) > 0.93
    assert np.mean(taken) > 0.98


def test_in_turn__as_many_views_are_begun_as_there_may_be_threads():
    """Every thread waits for all others: the barrier breaks if fewer calls are asked
    for than there are threads.
    """
    together = Barrier(MAX_THREADS, timeout=120)
    with ThreadPoolExecutor(MAX_THREADS) as pool:
        assert sorted(
            _in_turn(pool, lambda _: together.wait(), range(2 * MAX_THREADS))
        ) == sorted([*range(MAX_THREADS)] * 2)


def test_choose_photographs__frontal_camera_and_lights_apart(capture):
    middle = np.array([0.0, 0, 40])
    chosen = choose_photographs(capture.dome, middle, 3)
    assert {camera for _, camera in chosen} == {0}
    assert len({light for light, _ in chosen}) == 3
    assert 0 in {light for light, _ in chosen}  # the light in front
    assert choose_photographs(capture.dome, middle, 0) == []
    assert len(choose_photographs(capture.dome, middle, 99)) <= 4


def test_noise_floor__by_hand(surfels, capture):
    """Sigma of one value 10.0 (5 e / 0.5), a step of 1, 65,279 values, 1.005 s in all,
    times d^2 / I.
    """
    sigma = np.hypot(10.0, 1 / np.sqrt(12)) / (WHITE - BLACK) / np.hypot(1.0, 0.1)
    middle = surfels.position.mean(axis=0)
    square = [((light.position - middle) ** 2).sum() for light in capture.dome.lights]
    expected = sigma * np.median(np.divide.outer(square, INTENSITY))
    assert noise_floor(
        capture.dome, np.tile(INTENSITY, (4, 1)), surfels
    ) == pytest.approx(expected, rel=1e-4)


def test_noise_floor__of_linear_files(surfels, capture):
    sensor = replace(
        capture.dome.cameras[0].sensor,
        kind=replace(capture.dome.cameras[0].sensor.kind, bits=0),
    )
    dome = replace(
        capture.dome, cameras=(replace(capture.dome.cameras[0], sensor=sensor),)
    )
    assert noise_floor(dome, np.tile(INTENSITY, (4, 1)), surfels) == LINEAR_NOISE_FLOOR


def sampled(dome, surfels, folder, *, lit=None):
    """Every view of a dome, by rays that say what is clear; samples in memory."""
    mergers = {camera.id: frame_merger(dome, camera) for camera in dome.cameras}
    shape = (len(dome.lights), len(dome.cameras))
    n = len(surfels.position)
    lit = np.ones((n, shape[0]), bool) if lit is None else lit
    with (
        ThreadPoolExecutor(2) as pool,
        Spool(folder, (*shape, n)) as spool,
    ):
        _, clear, pixels = camera_visibility(
            surfels, dome.cameras, RayScene(surfels.position, surfels.faces), pool
        )
        soft = np.ones(lit.shape, np.float16)
        intensity = np.tile(INTENSITY, (shape[0], 1))
        check = CalibrationCheck(dome, surfels, soft, clear, pixels, intensity)
        sampler = Sampler(
            check,
            lit,
            mergers,
            spool,
            pool,
        )
        found = sampler.lumitexels(check=False)
        return clear, replace(found, sample=found.sample.compute())


def test_describe_samples__one_camera_one_light_and_none(capture, surfels, tmp_path):
    dome = replace(
        capture.dome, lights=capture.dome.lights[:1], cameras=capture.dome.cameras[:1]
    )
    _, found = sampled(dome, surfels, tmp_path / "a")
    said = describe_samples(found, surfels, dome)
    assert (said["of"], said["parts"]["all"]["max"], said["lights_without"]) == (
        1,
        1,
        [],
    )
    assert said["cameras"] == {"c0": found.counts[0].sum()}
    assert said["parts"]["all"]["seen"] == pytest.approx(
        (found.counts[0] > 0).mean(), abs=1e-4
    )
    _, found = sampled(
        dome, surfels, tmp_path / "b", lit=np.zeros((len(surfels.position), 1), bool)
    )
    said = describe_samples(found, surfels, dome)
    assert sample_lines(said)[1:] == ["camera c0: no sample", "light l0: no sample"]
    assert said["parts"]["nose"]["mean"] == 0
    assert [row[0] for row in sample_table(said)] == [
        "samples of",
        "all",
        "forehead",
        "cheek",
        "nose",
    ]


def test_sampler__counts_what_is_lost(capture_folder, tmp_path):
    """All exposures of one view at the white level except for a corner, and those of
    another at black.
    """
    white = np.full((64, 72, 3), WHITE, np.uint16)
    white[0, 0] = BLACK
    for exposure in ("long", "short"):
        save(capture_folder / f"dome/frames/{exposure}/l1_c0.png", white)
        save(
            capture_folder / f"dome/frames/{exposure}/l0_c1.png",
            np.full((64, 72, 3), BLACK, np.uint16),
        )
    capture = read_capture(capture_folder)
    dome = capture.dome
    surfels = build_surfels(capture, spacing_mm=8.0)
    clear, found = sampled(dome, surfels, tmp_path / "spool")
    store = found.sample
    assert np.isnan(store[:, 1, 0]).all()
    assert np.isnan(store[:, 0, 1]).all()
    both = clear.all(axis=1) & (surfels.normal[:, 2] > 0.8)
    assert both.any()
    assert (found.counts[1][both] == 1).all()
    assert (found.counts[2][both] >= 1).all()
    np.testing.assert_array_equal(
        found.counts[0], np.isfinite(store).all(-1).sum((1, 2))
    )


def test_cleaning_lines__with_places_say_where():
    kept = {
        "cleaning": {"slivers": 3, "bow_ties": 0},
        "cleaning_places": {"slivers": [[1, -2, 3.25], [4, 5, 6]]},
    }
    assert cleaning_lines(kept, places=False) == ["slivers: 3", "bow_ties: 0"]
    told = [
        "slivers: 3",
        "  at 1.00 -2.00 3.25",
        "  at 4.00 5.00 6.00",
        "  and 1 more",
        "bow_ties: 0",
    ]
    assert cleaning_lines(kept, places=True) == told
    kept.pop("cleaning_places")  # ingested before they were kept
    assert cleaning_lines(kept, places=True) == ["slivers: 3", "bow_ties: 0"]
