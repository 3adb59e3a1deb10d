"""Position of a scan in the frame of a dome, from points that are known on the scan and
seen in photographs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from skindb.errors import few_names, require
from skindb.geometry.camera import Pinhole
from skindb.geometry.landmarks import determine_rotation, similarity
from skindb.types import Array, Float64, float64

UNITS = {"mm": 1.0, "cm": 10.0, "inch": 25.4, "m": 1000.0}
# Relative difference of a measured scale from that of a unit. Points that are set to 1 mm
# on a face of 150 mm give 1 %; units differ by 150 % and more.
MAX_SCALE_ERROR = 0.1
Pixels = Mapping[tuple[str, str], Array]  # camera, name of the point -> (2,) px


@dataclass(frozen=True)
class ScanPose:
    """Where a scan lies in a dome."""

    unit: str  # of the scan
    # (4, 4), `[x_dome, 1] = matrix @ [x_scan, 1]`, with mm in the dome
    matrix: Float64
    residuals: Mapping[tuple[str, str], float]  # px, by camera and point


def rigid(turn: Rotation, shift: Array, *, scale: float = 1.0) -> Float64:
    """Matrix (4, 4) that scales, turns and shifts (3,) points."""
    matrix = np.eye(4)
    matrix[:3, :3] = scale * turn.as_matrix()
    matrix[:3, 3] = shift
    return matrix


def moved(matrix: Array, points: Array) -> Float64:
    """Points (..., 3) moved by a matrix (4, 4)."""
    return float64(points) @ matrix[:3, :3].T + matrix[:3, 3]


def scan_pose(
    points: Mapping[str, Array], seen: Pixels, cameras: Mapping[str, Pinhole]
) -> ScanPose:
    """Pose of a scan for which its points appear where they are seen, by least squares
    (Triggs et al. 2000, resection of several calibrated cameras).

    Parameters
    ----------
    points
        Positions (3,) on the scan by name, in mm, cm, inch or m, in any frame.
    seen
        Pixels (column, row) at which cameras show points.
    cameras
        Calibrated cameras of the dome.

    Raises
    ------
    InputError
        If the points that two cameras see are fewer than three or in a line, or the scan
        would have no known unit.
    """
    by_point = dict[str, list[str]]()
    for camera, name in seen:
        by_point.setdefault(name, []).append(camera)
    common = [name for name, by in by_point.items() if len(by) > 1 and name in points]
    require(
        determine_rotation({name: points[name] for name in common}),
        "points in photographs",
        "three points of the scan that are not in a line must be seen by two cameras each",
        few_names(common) or "none",
        "mark more points",
    )
    source = np.array([points[name] for name in common])
    target = np.array(
        [
            _nearest([(cameras[c], seen[c, name]) for c in by_point[name]])
            for name in common
        ]
    )
    matrix, _ = similarity(source, target)
    scale = float(np.cbrt(np.linalg.det(matrix)))
    unit = min(UNITS, key=lambda name: abs(np.log(UNITS[name] / scale)))
    require(
        abs(np.log(UNITS[unit] / scale)) < MAX_SCALE_ERROR,
        "scan",
        f"must be in {', '.join(UNITS)}",
        f"a unit of {scale:.3g} mm",
        "check the names of the points, and the calibration of the cameras",
    )
    source = source * UNITS[unit]
    start = Rotation.from_matrix((matrix / scale).T)
    shift = target.mean(axis=0) - start.apply(source).mean(axis=0)
    keys = [key for key in seen if key[1] in points]

    def differences(x: Float64) -> Float64:
        turn = Rotation.from_rotvec(x[:3]) * start
        pose = rigid(turn, x[3:], scale=UNITS[unit])
        return np.concatenate(
            [
                cameras[c].project(moved(pose, points[name])) - seen[c, name]
                for c, name in keys
            ]
        )

    fit = least_squares(differences, np.concatenate([np.zeros(3), shift]))
    turn = Rotation.from_rotvec(fit.x[:3]) * start
    lengths = np.hypot(*fit.fun.reshape(-1, 2).T).tolist()
    matrix = rigid(turn, fit.x[3:], scale=UNITS[unit])
    return ScanPose(unit, matrix, dict(zip(keys, lengths, strict=True)))


def _nearest(views: list[tuple[Pinhole, Array]]) -> Float64:
    """Point (3,) nearest to the rays through pixels of several cameras."""
    normal = np.zeros((3, 3))
    right = np.zeros(3)
    for camera, pixel in views:
        ray = camera.rays(pixel)
        across = np.eye(3) - np.outer(ray, ray)
        normal += across
        right += across @ camera.centre
    return float64(np.linalg.solve(normal, right))
