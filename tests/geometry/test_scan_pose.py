"""The pose of a scan from landmarks in photographs, with planted poses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skindb.errors import InputError
from skindb.geometry.camera import Pinhole
from skindb.geometry.scan_pose import UNITS, moved, scan_pose

POINTS = {
    "nose_tip": (0.0, 8.0, 125.0),
    "nasion": (0.0, 42.0, 103.0),
    "chin": (0.0, -71.0, 98.0),
    "eye_outer_right": (-44.0, 35.0, 82.0),
    "mouth_corner_left": (25.0, -30.0, 100.0),
}


def camera(side, distortion=0.0):
    """At 1 m from the face, which it sees from a side [mm] of the middle."""
    turn = Rotation.from_euler("xyz", [180, side / 20, 0], degrees=True)
    K = np.array([[2400.0, 0, 650], [0, 2400.0, 515], [0, 0, 1]])
    bent = np.array([distortion, 0.01 * distortion, 0, 0, 0])
    return Pinhole(K, turn.as_matrix(), np.array([0.0, 0.0, 1100.0]), bent)


CAMERAS = {"c0": camera(-300, 0.05), "c1": camera(300, -0.02), "c2": camera(0)}


def planted(unit, *, noise=0.0, seed=0):
    """Points of a scan, their pixels, and the matrix from scan to dome."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = UNITS[unit] * Rotation.random(random_state=seed).as_matrix()
    matrix[:3, 3] = rng.normal(0, 300, 3)
    back = np.linalg.inv(matrix)
    scan = {name: moved(back, np.array(point)) for name, point in POINTS.items()}
    seen = {
        (name, point): one.project(np.array(POINTS[point])) + rng.normal(0, noise, 2)
        for name, one in CAMERAS.items()
        for point in POINTS
    }
    return scan, seen, matrix


@pytest.mark.parametrize("unit", list(UNITS))
def test_scan_pose__exact_pixels_give_the_planted_pose(unit):
    scan, seen, _ = planted(unit, seed=3)
    pose = scan_pose(scan, seen, CAMERAS)
    assert pose.unit == unit
    for name, point in scan.items():
        # the solver stops at relative steps of 1e-8 of 300 mm
        np.testing.assert_allclose(moved(pose.matrix, point), POINTS[name], atol=1e-4)
    assert max(pose.residuals.values()) < 1e-3


def test_scan_pose__residuals_are_the_noise_of_the_clicks():
    """30 pixels determine 6 numbers: the residuals have (30 - 6) / 30 of the variance."""
    squares = []
    for seed in range(20):
        scan, seen, _ = planted("m", noise=2.0, seed=seed)
        pose = scan_pose(scan, seen, CAMERAS)
        assert pose.unit == "m"
        squares += [distance**2 for distance in pose.residuals.values()]
    # 300 squares: the standard error of their mean is 6 %
    assert np.mean(squares) == pytest.approx(2 * 2.0**2 * 24 / 30, rel=0.18)


def test_scan_pose__refuses_what_does_not_determine_it():
    scan, seen, _ = planted("mm")
    two = {name: scan[name] for name in ("chin", "nasion")}
    with pytest.raises(InputError, match="must be seen by two cameras each; found "):
        scan_pose(two, seen, CAMERAS)
    line = {"a": (0.0, 0.0, 0.0), "b": (0.0, 50.0, 1.0), "c": (0.0, 99.0, 2.0)}
    on_line = {
        (name, point): one.project(np.array(line[point]))
        for name, one in CAMERAS.items()
        for point in line
    }
    with pytest.raises(InputError, match="not in a line"):
        scan_pose({name: np.array(p) for name, p in line.items()}, on_line, CAMERAS)
    alone = {key: pixel for key, pixel in seen.items() if key[0] == "c0"}
    with pytest.raises(InputError, match="found none; mark more points"):
        scan_pose(scan, alone, CAMERAS)
    tripled = {name: 3 * point for name, point in scan.items()}
    with pytest.raises(
        InputError, match=r"must be in mm, cm, inch, m; found a unit of 0\.33"
    ):
        scan_pose(tripled, seen, CAMERAS)
