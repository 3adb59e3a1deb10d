"""Small rotations of the cameras that align the photographs with the scan: `ingest --refine`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skindb.format.devices import CameraRecord, DomeRecord
from skindb.geometry.camera import project
from skindb.ingest.consistency import CalibrationCheck, Pair
from skindb.ingest.photo_offsets import Offset

Array = NDArray[np.float64]
ROUNDS = 2  # a third round shifted the photographs of four captures by at most 0.06 mm
SMALL_TURN = 1e-4  # rad; step of the finite differences


def refine_cameras(
    check: CalibrationCheck, pictures: Mapping[Pair, NDArray[np.float32]]
) -> DomeRecord:
    """The dome with every camera rotated about its centre so that its photographs show
    the face at the scan.

    A face is nearly flat as seen from a dome: shifts and rolls of its picture also
    compensate for errors of the principal point, of the position of the camera and of
    the pose of the scan. Cameras whose photographs show the face more than 10 mm away
    from the scan are not rotated.

    Parameters
    ----------
    check
        Check of the dome as calibrated.
    pictures
        The downsampled photographs of `check.pairs`.
    """
    for _ in range(ROUNDS):
        turns = {
            c: _turn(check, c, offset)
            for c, offset in check.good_offsets(pictures).items()
        }
        cameras = tuple(
            _turned(camera, turns[c]) if c in turns else camera
            for c, camera in enumerate(check.dome.cameras)
        )
        pixels = check.pixels.copy()
        for c in turns:
            camera = cameras[c]
            pixels[:, c] = project(
                check.surfels.position, camera.K, camera.R, camera.t, camera.distortion
            )[0]
        check = replace(check, dome=replace(check.dome, cameras=cameras), pixels=pixels)
    return check.dome


def applied_rotations(before: DomeRecord, after: DomeRecord) -> Array:
    """Rotation vectors (camera, 3) [degrees] about the axes of each camera, from
    `before` to `after`.
    """
    pairs = zip(after.cameras, before.cameras, strict=True)
    return np.array(
        [
            Rotation.from_matrix(new.R @ old.R.T).as_rotvec(degrees=True)
            for new, old in pairs
        ]
    )


def _turn(check: CalibrationCheck, c: int, offset: Offset) -> Array:
    """Rotation vector (3,) [rad] in the frame of camera c that compensates for its offset."""
    at = np.flatnonzero(check.clear[check.compared, c])
    points = check.surfels.position[check.compared][at]
    camera = check.dome.cameras[c]

    def pixels(turn: Array) -> Array:
        turned = _turned(camera, turn)
        return project(points, turned.K, turned.R, turned.t, turned.distortion)[
            0
        ] / check.factor(c)

    moves = offset.moves(pixels(np.zeros(3)))
    slopes = [
        (pixels(SMALL_TURN * axis) - pixels(-SMALL_TURN * axis)).ravel()
        / (2 * SMALL_TURN)
        for axis in np.eye(3)
    ]
    return np.asarray(
        np.linalg.lstsq(np.stack(slopes, axis=1), moves.ravel(), rcond=None)[0]
    )


def _turned(camera: CameraRecord, turn: Array) -> CameraRecord:
    """The camera rotated about its centre by a rotation vector [rad] in its own frame."""
    rotation = Rotation.from_rotvec(turn).as_matrix()
    return replace(camera, R=rotation @ camera.R, t=rotation @ camera.t)
