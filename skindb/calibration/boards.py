"""Cameras from photographs of a ChArUco board: detection by OpenCV, and bundle adjustment."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from skindb.errors import Fault, few_names, require, require_none
from skindb.files import Attributes, Json
from skindb.format.fields import Fields, read_json
from skindb.format.frames import CAMERA, Frame, filled, opencv, read_frame
from skindb.geometry.camera import Pinhole
from skindb.limits import MAX_BALL_PLACES, MAX_CAMERAS
from skindb.types import Array, Float64, Index, float64

FILE = "dome/boards.json"
PAGE = "docs/howto/calibrate.md"
POSE = "pose"
DICTIONARY = "DICT_5X5_100"
MIN_CORNERS = 8  # in a picture
MIN_POSES = 4  # of a camera; three determine it without a check
# rms of a camera; OpenCV finds corners to 0.1 px in sharp pictures
MAX_REPROJECTION_PX = 1.0
CORNER_PX = 0.2  # typical error of a corner in a sharp picture
# fraction of the radius by which k2 and k3 usually bend the edge of a picture
MAX_BEND = 0.01
FAR_PX = 1e4  # for points behind a camera, or beyond its distortion
STEP = 1e-7  # of the finite differences: root of the precision, of at least 1
OF_CAMERA, OF_POSE = 15, 6  # numbers: fx fy cx cy, distortion, rotation vector, t
Views = dict[tuple[str, int], tuple[Index, Float64]]  # camera, pose -> corners, pixels


@dataclass(frozen=True)
class Boards:
    """Pixels of the corners of a board."""

    corners: Float64  # (corner, 3) mm on the board: x right, y up, z to the viewer
    views: Views
    sizes: Mapping[str, tuple[int, int]]  # of the pictures of a camera: width, height


@dataclass(frozen=True)
class CalibratedCamera(Pinhole):
    """A camera with the standard errors of its numbers."""

    errors: Float64  # (15,) of fx fy cx cy [px], distortion, rotation [rad], t [mm]
    rms: float  # px, of its corners
    poses: int


def read_boards(folder: Path) -> Boards:
    """Find the corners of the board in the pictures that `dome/boards.json` names.

    Raises
    ------
    InputError
        If the file is faulty, OpenCV is missing, or a picture cannot be read.
    """
    path = folder / FILE
    cv2 = opencv(path)
    faults = list[Fault]()
    fields = Fields(read_json(path, faults), str(path), faults, PAGE)
    template = fields.template("frames", {CAMERA, POSE})
    count = fields.integer("poses", minimum=MIN_POSES, maximum=MAX_BALL_PLACES)
    squares = fields.array("squares", (2,)).astype(int)
    square, marker = (fields.number(n, minimum=0.1) for n in ("square", "marker"))
    name = fields.text("dictionary", default=DICTIONARY)
    cameras = fields.names("cameras", maximum=MAX_CAMERAS)
    if not hasattr(cv2.aruco, name):
        fields.fault("dictionary", "must be one of OpenCV", name)
    if (squares < 3).any() or not 0 < marker < square:
        fields.fault(
            "squares",
            "a board has 3 or more squares a side, and smaller markers",
            "others",
        )
    require_none(faults)
    board = printed_board(squares.tolist(), square, marker, name)
    detector = cv2.aruco.CharucoDetector(board)
    views = {}
    sizes = dict[str, tuple[int, int]]()
    for camera in cameras:
        for pose in range(1, count + 1):
            file = folder / filled(template, camera=camera, pose=str(pose))
            if not file.is_file():
                continue  # not every camera sees every pose
            frame = read_frame(file)
            size = (frame.shape[1], frame.shape[0])
            if sizes.setdefault(camera, size) != size:
                rule = "pictures of a camera must have one size"
                side = f"{size[0]} x {size[1]}"
                fields.faults.append(Fault(str(file), rule, side, "take it again"))
                continue
            ids, pixels = _found(detector, frame)
            if len(ids) >= MIN_CORNERS:
                views[camera, pose] = ids, pixels
    for camera in set(cameras) - set(sizes):
        fields.fault("frames", f"must have pictures of {camera}", "none")
    require_none(faults)
    middle = squares * square / 2
    corners = float64(board.getChessboardCorners())
    corners = (corners - [*middle, 0]) * [1, -1, 0]
    return Boards(corners, views, sizes)


def board_corners(board: Attributes, frame: Frame) -> tuple[Index, Float64]:
    """Corners, and their pixels (n, 2), of the board of a boards.json in a picture."""
    names = ("squares", "square", "marker")
    described = {name: board[name] for name in names}
    dictionary = str(board.get("dictionary", DICTIONARY))
    printed = printed_board(**described, dictionary=dictionary)
    return _found(opencv(Path(FILE)).aruco.CharucoDetector(printed), frame)


def _found(detector: Any, frame: Frame) -> tuple[Index, Float64]:
    grey = float64(frame).mean(axis=2)
    values = np.rint(255 * grey / max(grey.max(), 1)).astype(np.uint8)
    pixels, ids = detector.detectBoard(values)[:2]
    if ids is None:
        return np.empty(0, int), np.empty((0, 2))
    # its pixels have their centres at integers
    return np.ravel(ids), float64(pixels).reshape(-1, 2) + 0.5


def printed_board(
    squares: Sequence[int], square: float, marker: float, dictionary: str
) -> Any:
    """The ChArUco board of OpenCV with these numbers of squares, sizes in mm."""
    aruco = opencv(Path("board")).aruco
    markers = aruco.getPredefinedDictionary(getattr(aruco, dictionary))
    return aruco.CharucoBoard(tuple(squares), square, marker, markers)


def calibrate_cameras(boards: Boards) -> dict[str, CalibratedCamera]:
    """Intrinsics, distortion and poses of all cameras by bundle adjustment (Triggs et al.
    2000): least squares over cameras and poses of the board, from those of single cameras
    (Zhang 2000, by OpenCV).

    The frame is that of the board in the first pose: origin in its middle, x to its right,
    y up, z to the viewer. Standard errors follow from the residuals.

    Raises
    ------
    InputError
        If a camera sees too few poses, shares none with the others, or its corners are more
        than 1 px (rms) from where the result projects them.
    """
    poses_of = defaultdict[str, list[int]](list)
    for camera, pose in boards.views:
        poses_of[camera].append(pose)
    require_none(
        [
            Fault(
                f"camera {camera}",
                f"must see {MIN_POSES} poses of the board with {MIN_CORNERS} corners each",
                f"{len(poses_of[camera])}",
                "take more pictures, sharp and without saturation",
            )
            for camera in boards.sizes
            if len(poses_of[camera]) < MIN_POSES
        ]
    )
    cameras, poses = _start(boards, poses_of)
    # rows of a camera follow each other; the first pose is the frame, and has no numbers
    names, numbers = sorted(cameras), list(poses)
    views = sorted(boards.views)
    points = [len(boards.views[view][0]) for view in views]
    of_camera = np.repeat([names.index(name) for name, _ in views], points)
    of_pose = np.repeat([numbers.index(pose) for _, pose in views], points)
    indices, seen = zip(*(boards.views[view] for view in views), strict=True)
    corners = boards.corners[np.concatenate(indices)]
    pixels = np.concatenate(seen)
    x = np.concatenate([*map(cameras.get, names), *[*poses.values()][1:]])
    first = OF_CAMERA * len(names)
    # how far k2 and k3 of each camera may bend its picture before they cost as much as
    # corners: otherwise noise bends a corner that no board has reached
    reach = np.array(
        [np.hypot(*boards.sizes[name]) / 2 / cameras[name][0] for name in names]
    )
    bends = CORNER_PX / MAX_BEND * np.stack([reach**4, reach**6], axis=1)
    of_bend = np.arange(bends.size)
    # of each difference; -1 for the frame and for bends, which depend on no pose
    owners = (
        np.concatenate([np.repeat(of_camera, 2), of_bend // 2]),
        np.concatenate([np.repeat(of_pose, 2) - 1, np.full(bends.size, -1)]),
    )

    def differences(x: Float64) -> Float64:
        lenses = x[:first].reshape(-1, OF_CAMERA)
        turn, shift = np.split(
            np.pad(x[first:], (OF_POSE, 0)).reshape(-1, OF_POSE)[of_pose], 2, axis=1
        )
        places = Rotation.from_rotvec(turn).apply(corners) + shift
        projected = [
            _pinhole(lens).project(places[of_camera == i])
            for i, lens in enumerate(lenses)
        ]
        apart = np.concatenate(projected) - pixels
        apart = np.where(np.isfinite(apart), apart, FAR_PX)
        return np.concatenate([apart.ravel(), (bends * lenses[:, [5, 8]]).ravel()])

    def slopes(x: Float64) -> Float64:
        """Finite differences; a row depends on one camera and one pose, so that numbers of
        different cameras, or poses, are changed at once.
        """
        here = differences(x)
        matrix = np.zeros((len(here), len(x)))
        step = STEP * np.maximum(np.abs(x), 1.0)
        parts = ((0, first, OF_CAMERA), (first, len(x), OF_POSE))
        for owner, (begin, end, count) in zip(owners, parts, strict=True):
            rows = np.flatnonzero(owner >= 0)
            for i in range(begin, begin + count):
                changed = np.zeros(len(x))
                changed[i:end:count] = step[i:end:count]
                change = differences(x + changed) - here
                columns = i + count * owner[rows]
                matrix[rows, columns] = change[rows] / step[columns]
        return matrix

    fit = least_squares(differences, x, slopes, method="lm", x_scale="jac")
    apart = fit.fun[: pixels.size]
    square = (apart**2).reshape(-1, 2).sum(axis=1)
    rms = {
        name: float(np.sqrt(square[of_camera == i].mean()))
        for i, name in enumerate(names)
    }
    require_none(
        [
            Fault(
                f"camera {name}",
                f"corners must be {MAX_REPROJECTION_PX:g} px (rms) or less from projections",
                f"{value:.2f} px",
                "take pictures of a flat board that stands still, and give its true sizes",
            )
            for name, value in rms.items()
            if not value <= MAX_REPROJECTION_PX
        ]
    )
    variance = float(square.sum()) / (len(apart) - len(x))
    error = np.sqrt(variance * np.diagonal(np.linalg.inv(fit.jac.T @ fit.jac)))
    lenses, errors = (
        dict(zip(names, values[:first].reshape(-1, OF_CAMERA), strict=True))
        for values in (fit.x, error)
    )
    return {
        name: CalibratedCamera(
            **vars(_pinhole(lenses[name])),
            errors=errors[name],
            rms=rms[name],
            poses=len(poses_of[name]),
        )
        for name in cameras
    }


def _start(
    boards: Boards, poses_of: Mapping[str, list[int]]
) -> tuple[dict[str, Float64], dict[int, Float64]]:
    """Numbers of the cameras and poses of the board, by chaining those that share most corners."""
    import cv2

    single = {}
    seen = {}  # (4, 4), from the board to a camera
    for camera, poses in poses_of.items():
        views = [boards.views[camera, pose] for pose in poses]
        _, K, bent, turns, shifts = cv2.calibrateCamera(
            [boards.corners[corners].astype(np.float32) for corners, _ in views],
            [pixels.astype(np.float32) for _, pixels in views],
            boards.sizes[camera],
            None,
            None,
            flags=cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3,
        )
        single[camera] = np.array(
            [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.ravel(bent)[:5]]
        )
        for pose, *vectors in zip(poses, turns, shifts, strict=True):
            seen[camera, pose] = _matrix(np.ravel(vectors))
    poses_at = {1: np.eye(4)}  # from the board to the frame of the first pose
    cameras_at = {}  # from that frame to the camera
    order = sorted(seen, key=lambda view: -len(boards.views[view][0]))
    while edges := [v for v in order if (v[0] in cameras_at) != (v[1] in poses_at)]:
        camera, pose = edges[0]
        if pose in poses_at:
            cameras_at[camera] = seen[edges[0]] @ np.linalg.inv(poses_at[pose])
        else:
            poses_at[pose] = np.linalg.inv(cameras_at[camera]) @ seen[edges[0]]
    lost = sorted(set(single) - set(cameras_at))
    require(
        not lost,
        "cameras",
        "must see the first pose of the board, or share poses with cameras that do",
        ", ".join(lost),
        "take pictures that two cameras see at once",
    )
    cameras = {
        name: np.concatenate([lens, _vector(cameras_at[name])])
        for name, lens in single.items()
    }
    return cameras, {pose: _vector(matrix) for pose, matrix in sorted(poses_at.items())}


def _matrix(vector: Array) -> Float64:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(vector[:3]).as_matrix()
    matrix[:3, 3] = vector[3:]
    return matrix


def _vector(matrix: Array) -> Float64:
    turn = Rotation.from_matrix(matrix[:3, :3]).as_rotvec()
    return np.concatenate([turn, matrix[:3, 3]])


def _pinhole(numbers: Array) -> Pinhole:
    """The camera of 15 numbers."""
    fx, fy, cx, cy = numbers[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    R = Rotation.from_rotvec(numbers[9:12]).as_matrix()
    return Pinhole(K, R, float64(numbers[12:]), float64(numbers[4:9]))


def with_cameras(
    record: Attributes, boards: Boards, cameras: Mapping[str, CalibratedCamera]
) -> Json:
    """The content of a dome.json with these cameras: those of the same id keep their other keys."""
    before = {item.get("id"): item for item in record.get("cameras", [])}
    require(
        not (others := sorted(set(before) - set(cameras))),
        "dome.json",
        "its cameras must all be calibrated, as the result has another frame",
        f"no pictures of {few_names(others)}",
        f"add them to {FILE}, or remove them",
    )
    found = [
        before.get(name, {})
        | {
            "id": name,
            "width": boards.sizes[name][0],
            "height": boards.sizes[name][1],
            "K": one.K.tolist(),
            "R": one.R.tolist(),
            "t": one.t.tolist(),
            "distortion": one.distortion.tolist(),
        }
        for name, one in cameras.items()
    ]
    return {**record, "cameras": found}
