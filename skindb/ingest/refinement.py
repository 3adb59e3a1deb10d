"""Refinement of a calibration: rotations that align the cameras with the scan, and whether
the photographs are explained better with them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from skindb.format.dome import CameraRecord, DomeRecord
from skindb.ingest._sample_kernels import FLOOR
from skindb.ingest.consistency import (
    MIN_SEEN_FRACTION,
    MIN_SURFELS,
    CalibrationCheck,
    Pair,
)
from skindb.ingest.photo_offsets import Offset, ReducedView, bilinear
from skindb.types import Float32, Float64, float64

ROUNDS = 2  # a third round shifted the photographs of four captures by at most 0.06 mm
SMALL_TURN = 1e-4  # rad; step of the finite differences
# Lights whose photographs judge the refinement and contribute nothing to it. With four,
# every second of the eight that show most, offsets of 0.2 mm remain on captures without
# errors, as they do when all lights contribute.
HELD_OUT_LIGHTS = 4
MIN_LIGHTS = 8  # half of them contribute
MIN_CAMERAS = 3  # two can be compared four times
MIN_COMPARISONS = 8  # of two cameras under a light, for a standard error
MIN_COSINE = 0.3  # between normal and camera; a pixel covers three times the surface
MIN_IRRADIANCE = 0.15  # of the largest under a light
# Fraction of the differences between cameras that a refinement must remove. On captures
# with known truth they change by -2.0 to 3.1 % without errors (four captures), and by -10
# and -12 % with those of a usual dome (two); planted offsets of 0.3 mm, from which a
# refinement gains, change them by -3.5 to -6 %, and of 0.7 mm by -11 to -32 %.
MIN_IMPROVEMENT = 0.06


def refine_cameras(check: CalibrationCheck, views: Sequence[ReducedView]) -> DomeRecord:
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
    views
        Views of the check, several of every camera.
    """
    offsets = dict[int, Offset]()
    for _ in range(ROUNDS):
        offsets = check.good_offsets(check.projected(views), start=offsets)
        turns = {c: _turn(check, c, offset) for c, offset in offsets.items()}
        cameras = tuple(
            _turned(camera, turns[c]) if c in turns else camera
            for c, camera in enumerate(check.dome.cameras)
        )
        check = _with_cameras(check, replace(check.dome, cameras=cameras))
    return check.dome


def reason_to_skip(check: CalibrationCheck) -> str:
    """Why no refinement can be judged; empty if it can be tried."""
    cameras, lights = len(check.dome.cameras), len(check.dome.lights)
    if not check.pairs:
        return "off: skipped, as the photographs show too little of a face"
    if cameras < MIN_CAMERAS or lights < MIN_LIGHTS:
        return (
            f"off: skipped, as cameras are compared with {MIN_CAMERAS} or more cameras "
            f"and {MIN_LIGHTS} or more lights, not {cameras} and {lights}"
        )
    return ""


def held_out_lights(check: CalibrationCheck) -> frozenset[int]:
    """Lights that are held out to judge a refinement."""
    order = np.argsort(-check.seen_area.sum(axis=1), kind="stable")
    return frozenset(order[: 2 * HELD_OUT_LIGHTS : 2].tolist())


def pictures_to_judge(
    check: CalibrationCheck, held_out: frozenset[int]
) -> frozenset[Pair]:
    """Views that `choose_refinement` needs."""
    seen = check.seen_area > MIN_SEEN_FRACTION * check.seen_area.max()
    views = {(j, int(c)) for j in held_out for c in np.flatnonzero(seen[j])}
    return check.pairs | views


def choose_refinement(
    check: CalibrationCheck,
    pictures: Mapping[Pair, Float32],
    held_out: frozenset[int],
) -> tuple[DomeRecord, str]:
    """Refine the cameras, and keep this if photographs under held-out lights agree better.

    Two cameras see the same light leave a surfel, except for gloss, whatever its normal
    and reflectance are. Where a camera is misplaced, its pixels belong to other surfels.

    Parameters
    ----------
    check
        Check of the dome as calibrated.
    pictures
        Downsampled photographs, see `pictures_to_judge`.
    held_out
        Lights, see `held_out_lights`.

    Returns
    -------
    dome, reason
        The refined dome, or that of the check; and a sentence with the reason.
    """
    views = check.views(pictures)
    judged = [view for view in views if view.light in held_out]
    before = camera_differences(check, judged)
    if len(before) < MIN_COMPARISONS:
        reason = "off: skipped, as too few cameras see the same part of the face"
        return check.dome, reason
    dome = refine_cameras(check, [view for view in views if view.light not in held_out])
    refined = _with_cameras(check, dome)
    after = camera_differences(refined, refined.projected(judged))
    changes = np.array([np.log(after[key] / before[key]) for key in before])
    change = float(changes.mean())
    error = float(changes.std(ddof=1) / np.sqrt(changes.size))
    better = change < -max(MIN_IMPROVEMENT, 2 * error)
    reason = (
        f"{'on' if better else 'off: not needed'}, as it changes differences between "
        f"cameras by {100 * change:+.1f} +- {100 * error:.1f} %; offsets up to "
        f"{_largest_move(check, refined):.1f} mm"
    )
    if not better:
        return check.dome, reason
    # once it is chosen, all views of the check contribute
    used = [view for view in views if (view.light, view.camera) in check.pairs]
    return refine_cameras(check, used), reason


def camera_differences(
    check: CalibrationCheck, views: Sequence[ReducedView]
) -> dict[tuple[int, int, int], float]:
    """Median relative difference of the square roots of radiance that two cameras see at
    the same surfels, without a factor between the cameras; by light and two cameras.
    """
    values: dict[int, dict[int, Float64]] = {}
    for view in views:
        light = check.irradiance[view.light]
        surfels = view.clear & (light > MIN_IRRADIANCE * light.max())
        surfels &= check.cosine(check.dome.cameras[view.camera]) > MIN_COSINE
        root = np.full(len(surfels), np.nan)
        root[surfels] = bilinear(view.image, view.pixels[surfels])
        values.setdefault(view.light, {})[view.camera] = np.log(np.maximum(root, FLOOR))
    differences = {}
    for j, by_camera in sorted(values.items()):
        for a, b in combinations(sorted(by_camera), 2):
            ratio = by_camera[a] - by_camera[b]
            ratio = ratio[np.isfinite(ratio)]
            if len(ratio) >= MIN_SURFELS:
                deviation = np.abs(ratio - np.median(ratio))
                differences[j, a, b] = max(float(np.median(deviation)), FLOOR)
    return differences


def applied_rotations(before: DomeRecord, after: DomeRecord) -> Float64:
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


def _with_cameras(check: CalibrationCheck, dome: DomeRecord) -> CalibrationCheck:
    """The check of other cameras; compared surfels alone are projected anew."""
    pixels = check.pixels.copy()
    points = check.surfels.position[check.compared]
    for c, camera in enumerate(dome.cameras):
        pixels[check.compared, c] = camera.project(points)
    return replace(check, dome=dome, pixels=pixels)


def _largest_move(before: CalibrationCheck, after: CalibrationCheck) -> float:
    """Largest root mean square displacement [mm] of the face in the pictures of a camera."""
    clear = before.clear[before.compared]
    moves = float64((after.pixels - before.pixels)[before.compared])
    middle = before.surfels.position.mean(axis=0)
    lengths = [
        camera.pixel_width(middle) * np.sqrt(np.mean(square[seen]))
        for camera, square, seen in zip(
            before.dome.cameras,
            np.square(moves).sum(axis=2).T,
            clear.T,
            strict=True,
        )
        if seen.any()
    ]
    return max(lengths, default=0.0)


def _turn(check: CalibrationCheck, c: int, offset: Offset) -> Float64:
    """Rotation vector (3,) [rad] in the frame of camera c that compensates for its offset."""
    points = check.surfels.position[check.compared][check.clear[check.compared, c]]
    camera = check.dome.cameras[c]

    def pixels(turn: Float64) -> Float64:
        return _turned(camera, turn).project(points) / check.factor(c)

    moves = offset.moves(pixels(np.zeros(3)))
    slopes = [
        (pixels(SMALL_TURN * axis) - pixels(-SMALL_TURN * axis)).ravel()
        / (2 * SMALL_TURN)
        for axis in np.eye(3)
    ]
    matrix = np.stack(slopes, axis=1)
    return np.asarray(np.linalg.lstsq(matrix, moves.ravel())[0])


def _turned(camera: CameraRecord, turn: Float64) -> CameraRecord:
    """The camera rotated about its centre by a rotation vector [rad] in its own frame."""
    rotation = Rotation.from_rotvec(turn).as_matrix()
    return replace(camera, R=rotation @ camera.R, t=rotation @ camera.t)
