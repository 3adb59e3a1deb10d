"""Faults and warnings for calibrations that the photographs contradict."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from skindb.errors import Fault
from skindb.ingest.calibration import MAX_OFFSET_MM, MIN_AGREEMENT, Calibration
from skindb.ingest.devices import DomeRecord

# Heads in domes with common errors (lights 1 mm, cameras 0.03 degrees, hair, motion) have offsets of up to 1.4 mm,
# scales of 1.5 %, agreements of 0.93 and more, a scan within 0.8 mm and 0.2 degrees: see docs/validation.md
DOUBTFUL_OFFSET_MM, DOUBTFUL_AGREEMENT = 2.5, 0.8
MAX_SCALE, DOUBTFUL_SCALE, REPORTED_SCALE = 0.15, 0.04, 0.02  # relative: a wrong distance, focal length or unit
DOUBTFUL_SCAN_MM, DOUBTFUL_SCAN_DEGREES = 2.0, 1.5
MAX_BETTER_LIGHT, DOUBTFUL_BETTER_LIGHT = (
    0.05,
    0.0,
)  # agreement with the shading of another light minus that with its own
MIN_LIGHT_AGREEMENT, DOUBTFUL_LIGHT_AGREEMENT = 0.5, 0.7
DOUBTFUL_DISTANCE_RATIO = 5.0  # distances differ by tens of percent in a dome, by factors of two or three in a studio
MIN_RED_TO_BLUE, DOUBTFUL_RED_TO_BLUE = (
    0.8,
    1.05,
)  # skin of every tone reflects more red than blue; with exchanged channels the ratio is at most 0.7


def calibration_faults(dome: DomeRecord, found: Calibration) -> list[Fault]:
    """Faults of cameras, lights and channels; a wrong pose of the scan is one fault, not one for each camera."""
    cameras = [*_camera_faults(dome, found)]
    checked = int(np.isfinite(found.camera_agreement).sum())
    if len(cameras) == checked > 1 and not found.explanations:
        rule = f"the photographs must show the face within {MAX_OFFSET_MM:g} mm of the scan"
        cameras = [Fault(str(dome.file), rule, f"none of {checked} cameras does", f"align the scan: {_pose(found)}")]
    faults = cameras or [*_light_faults(dome, found)]
    if found.red_to_blue < MIN_RED_TO_BLUE:
        rule, said = "skin must reflect more red than blue", f"a ratio of {found.red_to_blue:.2g}"
        faults.append(Fault(f"{dome.file}[frames]", rule, said, "write the channels in the order R, G, B"))
    return faults


def calibration_notes(dome: DomeRecord, found: Calibration) -> list[str]:
    """Warnings about parameters of the calibration that are probably inaccurate."""
    return [*_camera_notes(dome, found), *_light_notes(dome, found)]


def _camera_notes(dome: DomeRecord, found: Calibration) -> Iterator[str]:
    move, turn = (float(np.linalg.norm(part)) for part in (found.scan_translation, found.scan_rotation))
    offset = found.camera_offset
    if move > DOUBTFUL_SCAN_MM or turn > DOUBTFUL_SCAN_DEGREES:
        yield f"the scan is not where the photographs show the face; {_pose(found)}; use --refine to compensate"
        offset = found.camera_residual
    for c, camera in enumerate(dome.cameras):
        if offset[c] > DOUBTFUL_OFFSET_MM or abs(found.camera_scale[c]) > DOUBTFUL_SCALE:
            said = _beside(offset[c], found.camera_scale[c])
            cure = "calibrate it again, or ingest with --refine"
            yield f"camera {camera.id}: its photographs show the face {said}; {cure}"
        elif found.camera_agreement[c] < DOUBTFUL_AGREEMENT:
            said = f"(correlation {found.camera_agreement[c]:.2f})"
            yield f"camera {camera.id}: its photographs differ from those of a matte face {said}; inspect them"
    if MIN_RED_TO_BLUE <= found.red_to_blue < DOUBTFUL_RED_TO_BLUE:
        yield f"the face reflects {found.red_to_blue:.2g} times as much red as blue: check the order of the channels"


def _light_notes(dome: DomeRecord, found: Calibration) -> Iterator[str]:
    distance = np.linalg.norm([light.position for light in dome.lights], axis=1)  # the head is at the origin of a dome
    for light, ratio in zip(dome.lights, distance / np.median(distance), strict=True):
        if not 1 / DOUBTFUL_DISTANCE_RATIO <= ratio <= DOUBTFUL_DISTANCE_RATIO:  # hidden by a white target
            yield f"light {light.id}: {ratio:.2g} times as far away as the median light; check its position"
    better = found.light_similar_agreement - found.light_agreement
    for j, light in enumerate(dome.lights):
        if better[j] > DOUBTFUL_BETTER_LIGHT or found.light_agreement[j] < DOUBTFUL_LIGHT_AGREEMENT:
            yield f"light {light.id}: the shading of the face does not match its position; {_shading(dome, found, j)}"
        elif not np.isfinite(found.light_agreement[j]):
            yield f"light {light.id}: its photographs are too dark or show too little of the face to check its position"


def _camera_faults(dome: DomeRecord, found: Calibration) -> Iterator[Fault]:
    for c, camera in enumerate(dome.cameras):
        offset, agreement, scale = found.camera_offset[c], found.camera_agreement[c], found.camera_scale[c]
        if offset > MAX_OFFSET_MM or agreement < MIN_AGREEMENT or abs(scale) > MAX_SCALE:
            rule = f"its photographs must show the face within {MAX_OFFSET_MM:g} mm of the scan"
            said = f"the face {_beside(offset, scale)}, correlation {agreement:.2f}"
            said = found.explanations.get(c, said)
            cure = "correct K, R and t, the order of the frames, or the pose of the scan"
            yield Fault(f"{dome.file}[cameras], camera {camera.id}", rule, said, cure)


def _light_faults(dome: DomeRecord, found: Calibration) -> Iterator[Fault]:
    better = found.light_similar_agreement - found.light_agreement
    for j, light in enumerate(dome.lights):
        if better[j] > MAX_BETTER_LIGHT or found.light_agreement[j] < MIN_LIGHT_AGREEMENT:
            rule = "the shading of the face must match its position"
            cure = "correct its position, or the order of the frames"
            yield Fault(f"{dome.file}[lights], light {light.id}", rule, _shading(dome, found, j), cure)


def _shading(dome: DomeRecord, found: Calibration, j: int) -> str:
    own, other = found.light_agreement[j], found.light_similar_agreement[j]
    said = f"correlation {own:.2f}"
    return said + (f", {other:.2f} with light {dome.lights[int(found.light_similar[j])].id}" if other > own else "")


def _beside(offset: float, scale: float) -> str:
    size = f" and {abs(scale):.1%} {'larger' if scale > 0 else 'smaller'}" if abs(scale) > REPORTED_SCALE else ""
    return f"{offset:.1f} mm away from the scan{size}"


def _pose(found: Calibration) -> str:
    move, turn = (", ".join(f"{value:.1f}" for value in part) for part in (found.scan_translation, found.scan_rotation))
    return f"a shift by ({move}) mm and a rotation by ({turn}) degrees would align it"
