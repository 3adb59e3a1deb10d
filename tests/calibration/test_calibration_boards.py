"""Cameras from a board: planted cameras, and pictures that OpenCV draws."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from skindb.calibration.boards import (
    Boards,
    _pinhole,
    calibrate_cameras,
    read_boards,
    with_cameras,
)
from skindb.cli import cli
from skindb.errors import InputError
from skindb.format.frames import write_frame

cv2 = pytest.importorskip("cv2")
NOISE_PX = 0.15
SIZE = (1280, 1000)
POSES = 7
BOARD = {"squares": [5, 7], "square": 20.0, "marker": 15.0}
ANGLES = (-25, 0, 25)  # degrees, of the cameras around the board


def camera(angle, focal=1800.0, centre=(640.0, 500.0), distance=900.0, bent=-0.1):
    turn = Rotation.from_euler("x", 180, degrees=True)
    turn *= Rotation.from_euler("y", angle, degrees=True)
    lens = [bent, 0.0, 0.001 * (bent != 0), 0.0, 0.0]
    shift = [5.0, -3.0, distance]
    return np.array([focal, focal, *centre, *lens, *turn.as_rotvec(), *shift])


TRUTH = {f"c{i}": camera(angle) for i, angle in enumerate(ANGLES)}


def placed(vector, points):
    return Rotation.from_rotvec(vector[:3]).apply(points) + vector[3:]


def board_poses(rng):
    poses = {1: np.zeros(6)}
    for pose in range(2, POSES + 1):
        poses[pose] = np.concatenate([rng.normal(0, 0.35, 3), rng.normal(0, 25, 3)])
    return poses


def planted(seed):
    rng = np.random.default_rng(seed)
    grid = np.mgrid[:5, :7].reshape(2, -1).T * 25.0
    corners = np.column_stack([grid - grid.mean(axis=0), np.zeros(len(grid))])
    views = {}
    for pose, vector in board_poses(rng).items():
        for name, numbers in TRUTH.items():
            pixels = _pinhole(numbers).project(placed(vector, corners))
            seen = np.flatnonzero(((pixels > 0) & (pixels < SIZE)).all(axis=1))
            noise = rng.normal(0, NOISE_PX, (len(seen), 2))
            views[name, pose] = (seen, pixels[seen] + noise)
    return Boards(corners, views, dict.fromkeys(TRUTH, SIZE))


def numbers_of(found, truth):
    """Numbers of a camera; of the two vectors of a rotation by 180 degrees, that of the truth."""
    K = found.K
    turn = Rotation.from_matrix(found.R).as_rotvec()
    if turn @ truth[9:12] < 0:
        turn *= 1 - 2 * np.pi / np.linalg.norm(turn)
    inner = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    return np.array([*inner, *found.distortion, *turn, *found.t])


@pytest.mark.slow
def test_calibrate_cameras__planted_cameras_lie_within_their_errors():
    """Errors over standard errors have the variance 1; three cameras share poses, so that
    their numbers are correlated: 45 scores are about 15 independent ones.
    """
    scores = []
    for seed in (1,):
        found = calibrate_cameras(planted(seed))
        for name, truth in TRUTH.items():
            # two of 2 x 35 x 7 x 3 residuals' degrees of freedom are lost to fits
            assert found[name].rms == pytest.approx(np.sqrt(2) * NOISE_PX, rel=0.15)
            scores += list(
                (numbers_of(found[name], truth) - truth) / found[name].errors
            )
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.6


@pytest.mark.slow
def test_calibrate_cameras__shared_poses_improve_on_one_camera_alone():
    """OpenCV calibrates each camera by itself, from the same corners."""
    boards = planted(4)
    found = calibrate_cameras(boards)
    ours, theirs = [], []
    for name, truth in TRUTH.items():
        views = [view for (camera, _), view in boards.views.items() if camera == name]
        K = cv2.calibrateCamera(
            [np.float32(boards.corners[ids]) for ids, _ in views],
            [np.float32(pixels) for _, pixels in views],
            SIZE,
            None,
            None,
        )[1]
        ours.append(found[name].K[0, 0] - truth[0])
        theirs.append(K[0, 0] - truth[0])
    assert np.linalg.norm(ours) < np.linalg.norm(theirs)


def test_calibrate_cameras__names_what_is_missing():
    boards = planted(5)
    few = {
        view: seen
        for view, seen in boards.views.items()
        if view[1] < 4 or view[0] == "c1"
    }
    with pytest.raises(
        InputError, match=r"camera c0: must see 4 poses .* found 3"
    ) as error:
        calibrate_cameras(replace(boards, views=few))
    assert len(error.value.faults) == 2


def test_calibrate_cameras__the_first_pose_must_be_seen():
    boards = planted(5)
    later = {view: seen for view, seen in boards.views.items() if view[1] > 1}
    with pytest.raises(InputError, match="must see the first pose"):
        calibrate_cameras(replace(boards, views=later))


def test_with_cameras__refuses_cameras_that_stay_in_another_frame():
    record = {"cameras": [{"id": "c0"}, {"id": "c9"}]}
    with pytest.raises(InputError, match="found no pictures of c9"):
        with_cameras(record, planted(5), dict.fromkeys(TRUTH))


def _draw(folder):
    """Pictures of a board by three cameras without distortion, as homographies of the board."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    squares, square = BOARD["squares"], BOARD["square"]
    board = cv2.aruco.CharucoBoard(squares, square, BOARD["marker"], dictionary)
    scale = 8  # pixels per mm
    width, height = (round(side * square * scale) for side in squares)
    drawn = board.generateImage((width, height), marginSize=0)
    cameras = {
        f"c{i}": camera(angle, 1000, (330.0, 245.0), 480, bent=0.0)
        for i, angle in enumerate(ANGLES)
    }
    for pose, vector in board_poses(np.random.default_rng(3)).items():
        for name, numbers in cameras.items():
            corner = np.array([[0, 0], [width, 0], [width, height], [0, height]])
            place = np.column_stack(
                [
                    (corner[:, 0] - width / 2) / scale,
                    (height / 2 - corner[:, 1]) / scale,
                ]
            )
            points = np.column_stack([place, np.zeros(4)])
            pixels = _pinhole(numbers).project(placed(vector, points))
            # warpPerspective has the centres of pixels at integers
            matrix = cv2.getPerspectiveTransform(
                np.float32(corner - 0.5), np.float32(pixels - 0.5)
            )
            picture = cv2.warpPerspective(
                drawn, matrix, (660, 490), flags=cv2.INTER_AREA, borderValue=128
            )
            write_frame(
                folder / f"board_{pose}_{name}.png", np.repeat(picture[..., None], 3, 2)
            )
    return cameras


@pytest.mark.slow
def test_calibrate_cameras__from_pictures_to_a_dome(tmp_path):
    (tmp_path / "dome").mkdir()
    cameras = _draw(tmp_path)
    record = {
        "frames": "board_{pose}_{camera}.png",
        "poses": POSES,
        "cameras": list(cameras),
        **BOARD,
    }
    (tmp_path / "dome/boards.json").write_text(json.dumps(record))
    before = {"lights": [1], "cameras": [{"id": "c1", "vignette": [0, 0, 0]}]}
    (tmp_path / "dome/dome.json").write_text(json.dumps(before))
    out = tmp_path / "found.json"
    command = ["calibrate-cameras", str(tmp_path), "--out", str(out), "--json"]
    done = CliRunner().invoke(cli, command)
    assert done.exit_code == 0, done.exception
    report = json.loads(done.output)
    written = json.loads(out.read_text())
    assert written["lights"] == [1]
    assert written["cameras"][1]["vignette"] == [0, 0, 0]
    for item in written["cameras"]:
        truth = _pinhole(cameras[item["id"]])
        stated = report[item["id"]]
        # OpenCV finds corners of drawn pictures to 0.15 px in each direction
        assert stated["rms_px"] < 0.3
        turn = Rotation.from_matrix(np.array(item["R"]) @ truth.R.T).magnitude()
        place = -np.array(item["R"]).T @ item["t"]
        # one of 9 values is beyond 4 standard errors in 2,000 runs
        assert abs(item["K"][0][0] - 1000) < 4 * stated["focal_error_px"]
        assert np.degrees(turn) < 4 * np.sqrt(3) * stated["turn_error_degrees"]
        assert np.linalg.norm(place - truth.centre) < 4 * stated["position_error_mm"]
    again = CliRunner().invoke(cli, command)
    assert "must be a new file" in str(again.exception)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"square": -1}, "square"),
        ({"marker": 30}, "smaller markers"),
        ({"dictionary": "DICT_9"}, "must be one of OpenCV; found DICT_9"),
        ({"frames": "board.png"}, "must name {camera} and {pose}"),
        ({"cameras": []}, "at least one name"),
        ({}, "must have pictures of c0; found none"),
    ],
)
def test_read_boards__wrong_values_are_one_line(tmp_path, changed, said):
    (tmp_path / "dome").mkdir()
    record = {
        "frames": "board_{pose}_{camera}.png",
        "poses": POSES,
        "cameras": ["c0"],
        **BOARD,
    }
    (tmp_path / "dome/boards.json").write_text(json.dumps(record | changed))
    with pytest.raises(InputError, match=said):
        read_boards(tmp_path)
