"""Faults and warnings that an ingest finds: intensities and samples that no skin has, and
calibrations that the photographs contradict.
"""

from collections.abc import Iterator

import numpy as np

from skindb.errors import Fault
from skindb.format.dome import DomeRecord
from skindb.ingest.consistency import MAX_OFFSET_MM, MIN_AGREEMENT, Calibration
from skindb.types import Float64, lengths

MIN_MEDIAN_SAMPLES = 50  # of a view, for a reliable median
# of a light to the median one, in a channel: lights of a dome differ by tens of
# percent, of two types by ten times
MAX_INTENSITY_RATIO = 1_000.0
NOTED_INTENSITY_RATIO = 20.0
# sr^-1, of the median sample: black velvet has 0.002, a perfect diffuser 0.3
MEDIAN_SAMPLES = (3e-4, 3.0)
# of the median sample of a light to that of all lights: 0.55 to 1.3 in virtual domes,
# less for grazing lights
MAX_SAMPLE_RATIO = 50.0
NOTED_SAMPLE_RATIO = 8.0
# sr^-1, of a sample: sharp highlights of wet skin have about 50; and fraction of the
# samples of a view that exceed it
MAX_SAMPLE = 1_000.0
MAX_BRIGHT_FRACTION = 0.05
SAMPLE_CURE = (
    "give each light its intensity in the unit of the frames, times mm^2, or a white "
    "target; check the frames"
)
# Heads in domes with common errors (lights 1 mm, cameras 0.03 degrees, hair, motion)
# have offsets of up to 1.4 mm, scales of 1.5 %, agreements of 0.93 and more, a scan
# within 0.8 mm and 0.2 degrees: see docs/results
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


def intensity_faults(dome: DomeRecord, intensity: Float64) -> list[Fault]:
    """Faults of lights whose intensities (light, 3) are far above or below those of the others."""
    rule = (
        f"the intensity of a light must be at most {MAX_INTENSITY_RATIO:,g} times as "
        "large or small as the median"
    )
    cure = "correct it; remove a light that was not switched on, and its frames"
    return [
        Fault(
            f"{dome.file}[lights][{j}][intensity]",
            rule,
            f"{ratio:.3g} times, of light {dome.lights[j].id}",
            cure,
        )
        for j, ratio in _beyond(_relative(intensity), MAX_INTENSITY_RATIO)
    ]


def sample_faults(
    dome: DomeRecord, view_median: Float64, bright: Float64
) -> list[Fault]:
    """Faults of samples that are too large or small for skin, by their medians and
    bright fractions (light, camera).
    """
    median = _light_medians(view_median)
    middle = _nan_median(median)
    smallest, largest = MEDIAN_SAMPLES
    if not np.isnan(middle) and not smallest <= middle <= largest:
        rule = f"the median reflectance sample of a face must be {smallest:g} to {largest:g} sr^-1"
        finding = f"{middle:.3g}"
        if np.isinf(middle):
            finding = "samples beyond 65504, the largest half float"
        return [Fault(f"{dome.file}[lights]", rule, finding, SAMPLE_CURE)]
    rule = (
        f"the median sample of a light must be at most {MAX_SAMPLE_RATIO:g} times the "
        "overall median, or its inverse"
    )
    lights = [
        Fault(
            f"{dome.file}[lights][{j}]",
            rule,
            f"{ratio:.3g} times, of light {dome.lights[j].id}",
            SAMPLE_CURE,
        )
        for j, ratio in _beyond(median[:, None] / middle, MAX_SAMPLE_RATIO)
    ]
    return lights or _bright_faults(dome, bright)


def _bright_faults(dome: DomeRecord, bright: Float64) -> list[Fault]:
    """Faults of views (light, camera) in which more than a few samples are too large
    for a surface.
    """
    rule = (
        f"at most {MAX_BRIGHT_FRACTION:.0%} of the samples of a view may be above "
        f"{MAX_SAMPLE:g} sr^-1"
    )
    cure = "copy the frame from the camera again, or merge its exposures again"
    return [
        Fault(
            f"{dome.file}[frames]",
            rule,
            f"camera {dome.cameras[c].id}, light {dome.lights[j].id}: {bright[j, c]:.0%}",
            cure,
        )
        for j, c in np.argwhere(bright > MAX_BRIGHT_FRACTION)
    ]


def light_notes(
    dome: DomeRecord, intensity: Float64, view_median: Float64
) -> list[str]:
    """Warnings about lights whose intensities or samples are unusual, but not impossible."""
    median = _light_medians(view_median)
    return [
        f"light {dome.lights[j].id}: its {quantity} {ratio:.3g} times the median of all lights"
        for quantity, ratios, limit in (
            ("intensity is", _relative(intensity), NOTED_INTENSITY_RATIO),
            ("samples are", median[:, None] / _nan_median(median), NOTED_SAMPLE_RATIO),
        )
        for j, ratio in _beyond(ratios, limit)
    ]


def _relative(intensity: Float64) -> Float64:
    return intensity / np.median(intensity, axis=0)


def _light_medians(view_median: Float64) -> Float64:
    """Median over the cameras (light,) of medians (light, camera); NaN where there is none."""
    return np.array([_nan_median(row) for row in view_median])


def _nan_median(values: Float64) -> float:
    """Median of the values that are not NaN; NaN if there is none."""
    numbers = values[~np.isnan(values)]
    return float(np.median(numbers)) if len(numbers) else float("nan")


def _beyond(ratios: Float64, limit: float) -> list[tuple[int, float]]:
    """Rows of ratios (n, k) that differ from 1 by more than the limit, each with its
    most extreme ratio.
    """
    with np.errstate(divide="ignore"):
        away = np.abs(np.log(np.maximum(ratios, 0.0)))
    away = np.where(np.isnan(away), -1.0, away)
    worst = enumerate(away.argmax(axis=1))
    return [(j, float(ratios[j, k])) for j, k in worst if away[j, k] > np.log(limit)]


def calibration_faults(dome: DomeRecord, calibration: Calibration) -> list[Fault]:
    """Faults of cameras, lights and channels; a wrong pose of the scan is one fault,
    not one for each camera.
    """
    faults = [*_camera_faults(dome, calibration)]
    checked = int(np.isfinite(calibration.camera_agreement).sum())
    if len(faults) == checked > 1:
        faults = [
            Fault(
                str(dome.file),
                f"the photographs must show the face within {MAX_OFFSET_MM:g} mm of the scan",
                f"none of {checked} cameras does",
                f"align the scan: {_pose(calibration)}; or correct the dome and its frames",
            )
        ]
    faults = faults or [*_light_faults(dome, calibration)]
    return [
        *faults,
        *_channel_faults(dome, calibration),
        *_brightness_faults(dome, calibration),
    ]


def _channel_faults(dome: DomeRecord, calibration: Calibration) -> list[Fault]:
    """Faults of channels in another order than R, G, B: one if that of all cameras is
    wrong, else one for each.
    """
    ratio = _red_to_blue(calibration)
    if not np.isfinite(ratio).any():
        return []
    middle = np.nanmedian(ratio)
    findings = [
        f"a ratio of {ratio[c]:.2g} in the frames of camera {camera.id}"
        for c, camera in enumerate(dome.cameras)
        if ratio[c] < MIN_RED_TO_BLUE
    ]
    if middle < MIN_RED_TO_BLUE:
        findings = [f"a ratio of {middle:.2g}"]
    rule = "skin must reflect more red than blue"
    cure = "write the channels in the order R, G, B"
    return [Fault(f"{dome.file}[frames]", rule, text, cure) for text in findings]


def _red_to_blue(calibration: Calibration) -> Float64:
    """Red over blue reflectance of the face in the photographs of each camera
    (camera,); NaN if unknown.
    """
    seen = calibration.brightness.reflectance * calibration.brightness.camera
    return seen[:, 0] / seen[:, 2]


def _brightness_faults(dome: DomeRecord, calibration: Calibration) -> Iterator[Fault]:
    """Faults of cameras and lights whose photographs are much brighter or darker than
    those of the others.
    """
    rule = (
        "its photographs must be as bright as those of the others, within a factor of "
        f"{MAX_BRIGHTNESS:g}"
    )
    for c, finding in _cameras_beyond(calibration, MAX_BRIGHTNESS):
        place = f"{dome.file}[cameras], camera {dome.cameras[c].id}"
        cure = "correct colour_matrix, response, white_level or vignette of the camera"
        yield Fault(place, rule, finding, cure)
    for light, factor in _lights_beyond(dome, calibration, MAX_BRIGHTNESS):
        place = f"{dome.file}[lights], light {light}"
        cure = "correct its intensity or position, or its frames of the white target"
        yield Fault(place, rule, f"{factor:.2g} times as bright", cure)


def _cameras_beyond(
    calibration: Calibration, limit: float
) -> Iterator[tuple[int, str]]:
    """Cameras whose brightness differs from that of the others by more than a factor,
    with the channel that does most.

    Cameras with exchanged channels are excluded, because these explain the difference.
    """
    ratio = _red_to_blue(calibration)
    for c, factors in enumerate(calibration.brightness.camera):
        away = np.abs(np.log(factors))
        if away.max() > np.log(limit) and not ratio[c] < MIN_RED_TO_BLUE:
            worst = int(away.argmax())
            yield c, f"{factors[worst]:.2g} times as bright in {CHANNELS[worst]}"


def _lights_beyond(
    dome: DomeRecord, calibration: Calibration, limit: float
) -> Iterator[tuple[str, float]]:
    """Lights whose brightness differs from that of the others by more than a factor."""
    factors = calibration.brightness.light
    for light, factor in zip(dome.lights, factors, strict=True):
        if abs(np.log(factor)) > np.log(limit):
            yield light.id, factor


def calibration_notes(dome: DomeRecord, calibration: Calibration) -> list[str]:
    """Warnings about parameters of the calibration that are probably inaccurate."""
    return [
        *_camera_notes(dome, calibration),
        *_light_notes(dome, calibration),
        *_brightness_notes(dome, calibration),
    ]


def _brightness_notes(dome: DomeRecord, calibration: Calibration) -> Iterator[str]:
    for c, finding in _cameras_beyond(calibration, DOUBTFUL_CAMERA_BRIGHTNESS):
        yield f"camera {dome.cameras[c].id}: its photographs are {finding} as those of the others"
    for light, factor in _lights_beyond(dome, calibration, DOUBTFUL_LIGHT_BRIGHTNESS):
        yield (
            f"light {light}: the face is {factor:.2g} times as bright under it as under the "
            "others; check its intensity, or use fit --light-gains"
        )
    low, high = RED_REFLECTANCES
    red = calibration.brightness.reflectance[0]
    if not low <= red <= high and np.isfinite(red):
        yield (
            f"the face reflects {red:.0%} of red light, and skin {low:.0%} to {high:.0%}; "
            "check the white target and the intensities of the lights"
        )
    ratio = _red_to_blue(calibration)
    for c, camera in enumerate(dome.cameras):
        if MIN_RED_TO_BLUE <= ratio[c] < DOUBTFUL_RED_TO_BLUE:
            yield (
                f"camera {camera.id}: the face reflects {ratio[c]:.2g} times as much red as "
                "blue; check the order of the channels"
            )


def _camera_notes(dome: DomeRecord, calibration: Calibration) -> Iterator[str]:
    shift = float(np.linalg.norm(calibration.scan_translation))
    turn = float(np.linalg.norm(calibration.scan_rotation))
    offsets = calibration.camera_offset
    if shift > DOUBTFUL_SCAN_MM or turn > DOUBTFUL_SCAN_DEGREES:
        yield (
            f"the scan is not where the photographs show the face; {_pose(calibration)}; "
            "use --refine on to compensate"
        )
        offsets = calibration.camera_residual
    for camera, offset, scale, agreement in zip(
        dome.cameras,
        offsets,
        calibration.camera_scale,
        calibration.camera_agreement,
        strict=True,
    ):
        if offset > DOUBTFUL_OFFSET_MM or abs(scale) > DOUBTFUL_SCALE:
            yield (
                f"camera {camera.id}: its photographs show the face {_beside(offset, scale)}; "
                "calibrate it again, or ingest with --refine on"
            )
        elif agreement < DOUBTFUL_AGREEMENT:
            yield (
                f"camera {camera.id}: its photographs differ from those of a matte "
                f"face (correlation {agreement:.2f}); inspect them"
            )


def _light_notes(dome: DomeRecord, calibration: Calibration) -> Iterator[str]:
    # the head is at the origin of a dome
    distance = lengths([light.position for light in dome.lights])
    for light, ratio in zip(dome.lights, distance / np.median(distance), strict=True):
        # hidden by a white target
        if not 1 / DOUBTFUL_DISTANCE_RATIO <= ratio <= DOUBTFUL_DISTANCE_RATIO:
            yield (
                f"light {light.id}: {ratio:.2g} times as far away as the median light; "
                "check its position"
            )
    shading = calibration.light_agreement
    better = calibration.light_similar_agreement - shading
    for j, light in enumerate(dome.lights):
        if better[j] > DOUBTFUL_BETTER_LIGHT or shading[j] < DOUBTFUL_LIGHT_AGREEMENT:
            yield (
                f"light {light.id}: the shading of the face does not match its "
                f"position; {_shading(dome, calibration, j)}"
            )
        elif not np.isfinite(shading[j]):
            yield (
                f"light {light.id}: its photographs are too dark or show too little of "
                "the face to check its position"
            )


def _camera_faults(dome: DomeRecord, calibration: Calibration) -> Iterator[Fault]:
    rule = f"its photographs must show the face within {MAX_OFFSET_MM:g} mm of the scan"
    for c, camera in enumerate(dome.cameras):
        offset = calibration.camera_offset[c]
        agreement = calibration.camera_agreement[c]
        scale = calibration.camera_scale[c]
        displaced = offset > MAX_OFFSET_MM or abs(scale) > MAX_SCALE
        if displaced or agreement < MIN_AGREEMENT:
            finding = f"the face {_beside(offset, scale)}, correlation {agreement:.2f}"
            yield Fault(
                f"{dome.file}[cameras], camera {camera.id}",
                rule,
                finding,
                "correct K, R, t, the order and orientation of its frames, or the pose of the scan",
            )


def _light_faults(dome: DomeRecord, calibration: Calibration) -> Iterator[Fault]:
    shading = calibration.light_agreement
    better = calibration.light_similar_agreement - shading
    for j, light in enumerate(dome.lights):
        if better[j] > MAX_BETTER_LIGHT or shading[j] < MIN_LIGHT_AGREEMENT:
            yield Fault(
                f"{dome.file}[lights], light {light.id}",
                "the shading of the face must match its position",
                _shading(dome, calibration, j),
                "correct its position, or the order of the frames",
            )


def _shading(dome: DomeRecord, calibration: Calibration, j: int) -> str:
    agreement = calibration.light_agreement[j]
    better = calibration.light_similar_agreement[j]
    text = f"correlation {agreement:.2f}"
    if better > agreement:
        similar = dome.lights[int(calibration.light_similar[j])].id
        text += f", {better:.2f} with light {similar}"
    return text


def _beside(offset: float, scale: float) -> str:
    text = f"{offset:.1f} mm away from the scan"
    if abs(scale) > REPORTED_SCALE:
        text += f" and {abs(scale):.1%} {'larger' if scale > 0 else 'smaller'}"
    return text


def _pose(calibration: Calibration) -> str:
    shift, turn = (
        ", ".join(f"{value:.1f}" for value in part)
        for part in (calibration.scan_translation, calibration.scan_rotation)
    )
    return f"a shift by ({shift}) mm and a rotation by ({turn}) degrees would align it"
