"""Cameras from a board by skindb and by OpenCV, from the same corners, beside planted cameras
(docs/results/calibration.md).

    python -m benchmarks boards [--seeds N] [--cameras N] [--poses N] [--noise PX...]

A virtual dome of every seed has its own cameras with lenses. With noise of 0, frames are
drawn by the virtual laboratory and OpenCV finds the corners; otherwise normal noise in each
direction is added to exact corners. OpenCV calibrates in three ways: each camera alone
(`calibrateCamera`) and then its pose beside the first camera (`stereoCalibrate` with fixed
intrinsics, its advice); the same with refined intrinsics, if there are two cameras; and all
cameras at once (`calibrateMultiview`, of OpenCV 5).
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from skindb.calibration.boards import (
    MIN_CORNERS,
    Boards,
    board_corners,
    calibrate_cameras,
    printed_board,
)
from skindb.geometry.camera import Pinhole, project
from skindb.virtual.dome import Dome, Sensor, build_dome
from skindb.virtual.targets import BOARD, TargetScene, board_pose

SIZE = (1280, 1600)  # px
FRAME_SIZE = (640, 800)  # of drawn frames
POINTS = 300
EXTENT = np.array(
    [70.0, 95.0, 45.0]
)  # mm, half axes of an ellipsoid of points, as a face
FRAME_LIGHTS = 4
REFINED = "OpenCV, pair refined"
UNIT = 200.0  # mm
Cameras = Mapping[str, Pinhole]
HEADS = (
    "calibrated by",
    "focal [px]",
    "centre [px]",
    "lens [px]",
    "turn [mdeg]",
    "position [mm]",
    "corners [px]",
    "reprojection [px]",
    "points [mm]",
    "s",
)


def corners() -> np.ndarray:
    """Corners (n, 3) mm of the board of the virtual laboratory, as `read_boards` has them."""
    found = np.asarray(printed_board(**BOARD).getChessboardCorners(), float)
    middle = np.array(BOARD["squares"]) * BOARD["square"] / 2
    return np.column_stack(
        [found[:, 0] - middle[0], middle[1] - found[:, 1], 0 * found[:, 2]]
    )


def planted(dome: Dome, poses: int, noise: float, rng: np.random.Generator) -> Boards:
    """Corners of the board with noise [px], or found in drawn frames if it is 0."""
    board = corners()
    views = {}
    for camera in dome.cameras:
        alone = Dome((camera,), dome.lights)
        scene = TargetScene(alone, Sensor(), "board", {"e": 0.015}, rng=rng)
        for pose in range(1, poses + 1):
            turn, shift = board_pose(pose)
            pixels = camera.project(board @ turn.T + shift)
            edge = (camera.width, camera.height)
            ids = np.flatnonzero(((pixels > 0) & (pixels < edge)).all(axis=1))
            pixels = pixels[ids] + noise * rng.normal(size=(len(ids), 2))
            if not noise:
                scene.number = pose
                lit = {light.name: 1.0 for light in dome.lights}
                ids, pixels = board_corners(BOARD, scene.frame(camera.name, "e", lit))
            if len(ids) >= MIN_CORNERS:
                views[camera.name, pose] = ids, pixels
    sizes = {camera.name: (camera.width, camera.height) for camera in dome.cameras}
    return Boards(board, views, sizes)


def _seen(boards: Boards, name: str) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    return {pose: view for (one, pose), view in boards.views.items() if one == name}


def _singles(boards: Boards) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Matrix and distortion of each camera alone."""
    singles = {}
    for name, size in boards.sizes.items():
        views = _seen(boards, name).values()
        places = [np.float32(boards.corners[ids]) for ids, _ in views]
        pixels = [np.float32(seen) for _, seen in views]
        singles[name] = cv2.calibrateCamera(places, pixels, size, None, None)[1:3]
    return singles


def stereo(boards: Boards, flags: int) -> Cameras:
    """`calibrateCamera`, then `stereoCalibrate` with the first camera."""
    singles = _singles(boards)
    first, *others = boards.sizes
    K, bent = singles[first]
    cameras = dict[str, Pinhole]()
    one = _seen(boards, first)
    for name in others:
        two = _seen(boards, name)
        views = []
        for pose in sorted(set(one) & set(two)):
            ids, a, b = np.intersect1d(one[pose][0], two[pose][0], return_indices=True)
            if len(ids) >= MIN_CORNERS:
                places = np.float32(boards.corners[ids])
                pixels = (np.float32(v[pose][1][i]) for v, i in ((one, a), (two, b)))
                views.append((places, *pixels))
        places, left, right = map(list, zip(*views, strict=True))
        _, near, curved, own, lens, turn, shift, *_ = cv2.stereoCalibrate(
            places,
            left,
            right,
            *(np.copy(values) for values in (K, bent, *singles[name])),
            boards.sizes[first],
            flags=flags,
        )
        cameras[first] = Pinhole(near, np.eye(3), np.zeros(3), np.ravel(curved)[:5])
        cameras[name] = Pinhole(own, turn, np.ravel(shift), np.ravel(lens)[:5])
    return cameras


def multiview(boards: Boards) -> Cameras:
    """`calibrateMultiview` of all cameras; corners that were not found are -1.

    It takes boards of about one unit: it divides by the square of their size (OpenCV 5.0.0),
    after which those of 200 mm count as collinear.
    """
    names = list(boards.sizes)
    poses = sorted({pose for _, pose in boards.views})
    pixels, mask = [], np.zeros((len(names), len(poses)), np.uint8)
    for i, name in enumerate(names):
        frames = []
        for j, pose in enumerate(poses):
            frame = np.full((len(boards.corners), 2), -1, np.float32)
            if (name, pose) in boards.views:
                ids, seen = boards.views[name, pose]
                frame[ids] = seen
                mask[i, j] = 1
            frames.append(frame)
        pixels.append(frames)
    singles = _singles(boards)
    _, Ks, lenses, turns, shifts = cv2.calibrateMultiview(
        [np.float32(boards.corners / UNIT)] * len(poses),
        pixels,
        list(boards.sizes.values()),
        mask,
        np.full(len(names), cv2.CALIB_MODEL_PINHOLE, np.uint8),
        [np.copy(singles[name][0]) for name in names],
        [np.ravel(singles[name][1])[:5].copy() for name in names],
        None,
        None,
        flagsForIntrinsics=np.zeros(len(names), np.int32),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
    )
    turns = [
        np.asarray(t)
        if np.shape(t) == (3, 3)
        else Rotation.from_rotvec(np.ravel(t)).as_matrix()
        for t in turns
    ]
    return {
        name: Pinhole(K, turn, UNIT * np.ravel(shift), np.ravel(lens)[:5])
        for name, K, turn, shift, lens in zip(
            names, Ks, turns, shifts, lenses, strict=True
        )
    }


METHODS: dict[str, Callable[[Boards], Cameras]] = {
    "skindb": calibrate_cameras,
    "OpenCV, pairs": lambda boards: stereo(boards, cv2.CALIB_FIX_INTRINSIC),
    REFINED: lambda boards: stereo(boards, cv2.CALIB_USE_INTRINSIC_GUESS),
    "OpenCV, all at once": multiview,
}


def triangulated(cameras: Cameras, pixels: Mapping[str, np.ndarray]) -> np.ndarray:
    """Points (n, 3) that are nearest to their rays in all cameras."""
    matrix, side = 0.0, 0.0
    for name, camera in cameras.items():
        ray = camera.rays(pixels[name])
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        matrix = matrix + across
        side = side + across @ camera.centre
    return np.linalg.solve(matrix, side[..., None])[..., 0]


def errors(truth: Cameras, cameras: Cameras, boards: Boards) -> dict[str, float]:
    """RMS errors of cameras whose frame is moved to that of the truth by triangulated points."""
    points = np.random.default_rng(0).normal(size=(POINTS, 3))
    points *= EXTENT / np.linalg.norm(points, axis=1, keepdims=True)
    pixels = {name: camera.project(points) for name, camera in truth.items()}
    found = triangulated(cameras, pixels)
    turn = Rotation.align_vectors(points - points.mean(0), found - found.mean(0))[0]
    shift = points.mean(0) - turn.apply(found.mean(0))
    squares = defaultdict[str, list[float]](list)
    squares["points"] = list(((turn.apply(found) + shift - points) ** 2).sum(1))
    for name, right in truth.items():
        one = cameras[name]
        squares["focal"] += list((np.diag(one.K)[:2] - np.diag(right.K)[:2]) ** 2)
        squares["centre"] += list((one.K[:2, 2] - right.K[:2, 2]) ** 2)
        local = points @ right.R.T + right.t  # the same rays through both lenses
        ideal = (right.K, np.eye(3), np.zeros(3))
        bent = [project(local, *ideal, lens.distortion)[0] for lens in (one, right)]
        squares["lens"] += list(((bent[0] - bent[1]) ** 2).sum(1))
        moved = one.R @ turn.as_matrix().T
        apart = Rotation.from_matrix(moved @ right.R.T).magnitude()
        squares["turn"].append(float(np.degrees(apart) * 1e3) ** 2)
        centre = turn.apply(one.centre) + shift
        squares["position"].append(float(((centre - right.centre) ** 2).sum()))
        back = turn.inv().apply(points - shift)
        squares["reprojection"] += list(
            ((one.project(back) - pixels[name]) ** 2).sum(1)
        )
        for pose, (ids, seen) in _seen(boards, name).items():
            matrix, place = board_pose(pose)
            board = turn.inv().apply(boards.corners[ids] @ matrix.T + place - shift)
            squares["corners"] += list(((one.project(board) - seen) ** 2).sum(1))
    return {key: float(np.sqrt(np.mean(values))) for key, values in squares.items()}


def main(
    *,
    seeds: int = 8,
    cameras: int = 6,
    poses: int = 12,
    noise: Sequence[float] = (0.05, 0.15, 0.4),
) -> None:
    """Print a table for each noise: medians over the seeds of RMS errors."""
    for pixel in noise:
        results = defaultdict[str, list[list[float]]](list)
        for seed in range(seeds):
            width, height = SIZE if pixel else FRAME_SIZE
            dome = build_dome(
                FRAME_LIGHTS,
                cameras,
                width=width,
                height=height,
                rng=np.random.default_rng(seed),
            )
            rng = np.random.default_rng([seed, 1])
            boards = planted(dome, poses, pixel, rng)
            truth = {camera.name: camera for camera in dome.cameras}
            for name, method in METHODS.items():
                if name == REFINED and cameras > 2:
                    continue  # each pair would have another first camera
                begin = time.perf_counter()
                found = method(boards)
                seconds = time.perf_counter() - begin
                values = errors(truth, found, boards)
                order = ("focal", "centre", "lens", "turn", "position", "corners")
                order += ("reprojection", "points")
                results[name].append([*(values[key] for key in order), seconds])
        what = f"noise of {pixel:g} px" if pixel else "drawn frames"
        print(f"\n{what}, {width} x {height}, {cameras} cameras, {poses} poses\n")
        print("| " + " | ".join(HEADS) + " |\n" + "|---" * len(HEADS) + "|")
        for name, rows in results.items():
            cells = [f"{value:.3g}" for value in np.median(rows, axis=0)]
            print(f"| {name} | " + " | ".join(cells) + " |")
