"""Faults and warnings for calibrations that the photographs contradict."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault
from skindb.format.dome import DomeRecord
from skindb.ingest.consistency import MAX_OFFSET_MM, MIN_AGREEMENT, Calibration

# Heads in domes with common errors (lights 1 mm, cameras 0.03 degrees, hair, motion)
# have offsets of up to 1.4 mm, scales of 1.5 %, agreements of 0.93 and more, a scan
# within 0.8 mm and 0.2 degrees: see docs/validation.md
DOUBTFUL_OFFSET_MM = 2.5
DOUBTFUL_AGREEMENT = 0.8
# relative: a wrong distance, focal length or unit
MAX_SCALE = 0.15
DOUBTFUL_SCALE = 0.04
REPORTED_SCALE = 0.02
DOUBTFUL_SCAN_MM = 2.0
DOUBTFUL_SCAN_DEGREES = 1.5
# agreement with the shading of another light minus that with its own
MAX_BETTER_LIGHT = 0.05
DOUBTFUL_BETTER_LIGHT = 0.0
MIN_LIGHT_AGREEMENT = 0.5
DOUBTFUL_LIGHT_AGREEMENT = 0.7
# distances differ by tens of percent in a dome, by factors of two or three in a studio
DOUBTFUL_DISTANCE_RATIO = 5.0
# skin of every tone reflects more red than blue; with exchanged channels the ratio is at most 0.7
MIN_RED_TO_BLUE = 0.8
DOUBTFUL_RED_TO_BLUE = 1.05
# brightness of a camera's or a light's photographs over that of the others: at most
# 1.08 and 1.17 in simulated domes
MAX_BRIGHTNESS = 2.0
DOUBTFUL_CAMERA_BRIGHTNESS = 1.25
DOUBTFUL_LIGHT_BRIGHTNESS = 1.4
RED_REFLECTANCES = (0.1, 0.9)  # of a face; skin of all tones has 0.2 to 0.75
CHANNELS = ("red", "green", "blue")


def calibration_faults(dome: DomeRecord, found: Calibration) -> list[Fault]:
    """Faults of cameras, lights and channels; a wrong pose of the scan is one fault,
    not one for each camera.
    """
    cameras = [*_camera_faults(dome, found)]
    checked = int(np.isfinite(found.camera_agreement).sum())
    if len(cameras) == checked > 1 and not found.explanations:
        rule = f"the photographs must show the face within {MAX_OFFSET_MM:g} mm of the scan"
        cameras = [
            Fault(
                str(dome.file),
                rule,
                f"none of {checked} cameras does",
                f"align the scan: {_pose(found)}",
            )
        ]
    faults = cameras or [*_light_faults(dome, found)]
    return faults + _channel_faults(dome, found) + _brightness_faults(dome, found)


def _channel_faults(dome: DomeRecord, found: Calibration) -> list[Fault]:
    """Faults of channels in another order than R, G, B: one if that of all cameras is
    wrong, else one for each.
    """
    ratio = _red_to_blue(found)
    rule = "skin must reflect more red than blue"
    cure = "write the channels in the order R, G, B"
    if not np.isfinite(ratio).any():
        return []
    if (middle := np.nanmedian(ratio)) < MIN_RED_TO_BLUE:
        return [Fault(f"{dome.file}[frames]", rule, f"a ratio of {middle:.2g}", cure)]
    return [
        Fault(
            f"{dome.file}[frames]",
            rule,
            f"a ratio of {ratio[c]:.2g} in the frames of camera {camera.id}",
            cure,
        )
        for c, camera in enumerate(dome.cameras)
        if ratio[c] < MIN_RED_TO_BLUE
    ]


def _red_to_blue(found: Calibration) -> NDArray[np.float64]:
    """Red over blue reflectance of the face in the photographs of each camera
    (camera,); NaN if unknown.
    """
    seen = found.brightness.reflectance * found.brightness.camera
    return np.asarray(seen[:, 0] / seen[:, 2])


def _brightness_faults(dome: DomeRecord, found: Calibration) -> list[Fault]:
    """Faults of cameras and lights whose photographs are much brighter or darker than
    those of the others.
    """
    rule = (
        "its photographs must be as bright as those of the others, within a factor of "
        f"{MAX_BRIGHTNESS:g}"
    )
    sensor = "correct colour_matrix, response, white_level or vignette of the camera"
    lamp = "correct its intensity or position, or its frames of the white target"
    cameras = [
        Fault(f"{dome.file}[cameras], camera {dome.cameras[c].id}", rule, said, sensor)
        for c, said in _brightness_beyond(found, MAX_BRIGHTNESS)
    ]
    lights = [
        Fault(
            f"{dome.file}[lights], light {light.id}",
            rule,
            f"{factor:.2g} times as bright",
            lamp,
        )
        for light, factor in zip(dome.lights, found.brightness.light, strict=True)
        if abs(np.log(factor)) > np.log(MAX_BRIGHTNESS)
    ]
    return cameras + lights


def _brightness_beyond(found: Calibration, limit: float) -> Iterator[tuple[int, str]]:
    """Cameras whose brightness differs from that of the others by more than a factor,
    with the channel that does most.

    Cameras with exchanged channels are excluded, because these explain the difference.
    """
    ratio = _red_to_blue(found)
    for c, factors in enumerate(found.brightness.camera):
        away = np.abs(np.log(factors))
        if away.max() > np.log(limit) and not ratio[c] < MIN_RED_TO_BLUE:
            worst = int(away.argmax())
            yield c, f"{factors[worst]:.2g} times as bright in {CHANNELS[worst]}"


def calibration_notes(dome: DomeRecord, found: Calibration) -> list[str]:
    """Warnings about parameters of the calibration that are probably inaccurate."""
    return [
        *_camera_notes(dome, found),
        *_light_notes(dome, found),
        *_brightness_notes(dome, found),
    ]


def _brightness_notes(dome: DomeRecord, found: Calibration) -> Iterator[str]:
    for c, said in _brightness_beyond(found, DOUBTFUL_CAMERA_BRIGHTNESS):
        yield f"camera {dome.cameras[c].id}: its photographs are {said} as those of the others"
    for light, factor in zip(dome.lights, found.brightness.light, strict=True):
        if abs(np.log(factor)) > np.log(DOUBTFUL_LIGHT_BRIGHTNESS):
            said = (
                f"the face is {factor:.2g} times as bright under it as under the others"
            )
            yield f"light {light.id}: {said}; check its intensity, or use fit --light-gains"
    low, high = RED_REFLECTANCES
    red = found.brightness.reflectance[0]
    if not low <= red <= high and np.isfinite(red):
        cure = "check the white target and the intensities of the lights"
        yield f"the face reflects {red:.0%} of red light, and skin {low:.0%} to {high:.0%}; {cure}"
    ratio = _red_to_blue(found)
    for c, camera in enumerate(dome.cameras):
        if MIN_RED_TO_BLUE <= ratio[c] < DOUBTFUL_RED_TO_BLUE:
            said = f"camera {camera.id}: the face reflects {ratio[c]:.2g} times as much red as blue"
            yield f"{said}; check the order of the channels"


def _camera_notes(dome: DomeRecord, found: Calibration) -> Iterator[str]:
    move, turn = (
        float(np.linalg.norm(part))
        for part in (found.scan_translation, found.scan_rotation)
    )
    offset = found.camera_offset
    if move > DOUBTFUL_SCAN_MM or turn > DOUBTFUL_SCAN_DEGREES:
        yield (
            f"the scan is not where the photographs show the face; {_pose(found)}; use "
            "--refine to compensate"
        )
        offset = found.camera_residual
    for c, camera in enumerate(dome.cameras):
        if (
            offset[c] > DOUBTFUL_OFFSET_MM
            or abs(found.camera_scale[c]) > DOUBTFUL_SCALE
        ):
            said = _beside(offset[c], found.camera_scale[c])
            cure = "calibrate it again, or ingest with --refine"
            yield f"camera {camera.id}: its photographs show the face {said}; {cure}"
        elif found.camera_agreement[c] < DOUBTFUL_AGREEMENT:
            said = f"(correlation {found.camera_agreement[c]:.2f})"
            yield (
                f"camera {camera.id}: its photographs differ from those of a matte "
                f"face {said}; inspect them"
            )


def _light_notes(dome: DomeRecord, found: Calibration) -> Iterator[str]:
    # the head is at the origin of a dome
    distance = np.linalg.norm([light.position for light in dome.lights], axis=1)
    for light, ratio in zip(dome.lights, distance / np.median(distance), strict=True):
        # hidden by a white target
        if not 1 / DOUBTFUL_DISTANCE_RATIO <= ratio <= DOUBTFUL_DISTANCE_RATIO:
            yield (
                f"light {light.id}: {ratio:.2g} times as far away as the median light; "
                "check its position"
            )
    better = found.light_similar_agreement - found.light_agreement
    for j, light in enumerate(dome.lights):
        if (
            better[j] > DOUBTFUL_BETTER_LIGHT
            or found.light_agreement[j] < DOUBTFUL_LIGHT_AGREEMENT
        ):
            yield (
                f"light {light.id}: the shading of the face does not match its "
                f"position; {_shading(dome, found, j)}"
            )
        elif not np.isfinite(found.light_agreement[j]):
            yield (
                f"light {light.id}: its photographs are too dark or show too little of "
                "the face to check its position"
            )


def _camera_faults(dome: DomeRecord, found: Calibration) -> Iterator[Fault]:
    for c, camera in enumerate(dome.cameras):
        offset = found.camera_offset[c]
        agreement = found.camera_agreement[c]
        scale = found.camera_scale[c]
        if (
            offset > MAX_OFFSET_MM
            or agreement < MIN_AGREEMENT
            or abs(scale) > MAX_SCALE
        ):
            rule = f"its photographs must show the face within {MAX_OFFSET_MM:g} mm of the scan"
            said = f"the face {_beside(offset, scale)}, correlation {agreement:.2f}"
            said = found.explanations.get(c, said)
            cure = (
                "correct K, R and t, the order of the frames, or the pose of the scan"
            )
            yield Fault(f"{dome.file}[cameras], camera {camera.id}", rule, said, cure)


def _light_faults(dome: DomeRecord, found: Calibration) -> Iterator[Fault]:
    better = found.light_similar_agreement - found.light_agreement
    for j, light in enumerate(dome.lights):
        if (
            better[j] > MAX_BETTER_LIGHT
            or found.light_agreement[j] < MIN_LIGHT_AGREEMENT
        ):
            rule = "the shading of the face must match its position"
            cure = "correct its position, or the order of the frames"
            yield Fault(
                f"{dome.file}[lights], light {light.id}",
                rule,
                _shading(dome, found, j),
                cure,
            )


def _shading(dome: DomeRecord, found: Calibration, j: int) -> str:
    own = found.light_agreement[j]
    other = found.light_similar_agreement[j]
    said = f"correlation {own:.2f}"
    return said + (
        f", {other:.2f} with light {dome.lights[int(found.light_similar[j])].id}"
        if other > own
        else ""
    )


def _beside(offset: float, scale: float) -> str:
    size = (
        f" and {abs(scale):.1%} {'larger' if scale > 0 else 'smaller'}"
        if abs(scale) > REPORTED_SCALE
        else ""
    )
    return f"{offset:.1f} mm away from the scan{size}"


def _pose(found: Calibration) -> str:
    move, turn = (
        ", ".join(f"{value:.1f}" for value in part)
        for part in (found.scan_translation, found.scan_rotation)
    )
    return f"a shift by ({move}) mm and a rotation by ({turn}) degrees would align it"
