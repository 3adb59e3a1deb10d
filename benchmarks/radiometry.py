"""Error of responses and of light intensities, from simulated captures with known truth.

python -m benchmarks radiometry CAPTURE...

The truth of each CAPTURE is in CAPTURE.truth.npz.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.truth import read_truth
from skindb.calibration.irradiance import (
    TargetPixels,
    fit_light,
    light_intensities,
    target_pixels,
)
from skindb.calibration.lights import calibrate_lights
from skindb.calibration.radiance import frame_mergers, merge_exposures, read_view
from skindb.calibration.response import recover_response
from skindb.format.folder import read_capture
from skindb.format.frames import read_frame

# of radiance, where 0 is the white level of the longest exposure
OCTAVES = range(-9, 1)
MIN_VALUES = 200  # number of values in an octave below which its mean is not compared


def radiance_biases(capture, folder):
    """Bias (octave,) of merged radiance relative to the truth, with the given and with
    the recovered response.

    With a recovered response the unit of radiance is free in each channel; it is set by
    the median of bright octaves.
    """
    dome = capture.dome
    faults = []
    mergers = frame_mergers(dome, faults)
    sensor = dome.cameras[0].sensor
    seconds = tuple(dome.exposures.values())
    views = [
        np.stack(read_view(dome, light.id, c))
        for c in dome.cameras
        for light in dome.lights
    ]
    table = recover_response(
        np.concatenate(views, axis=1), seconds, black=sensor.black, white=sensor.white
    )
    biases = []
    for variant in (sensor, replace(sensor, response=table)):
        merged = []
        truth = []
        for path in sorted(folder.glob("*.exr")):
            light, name = path.stem.split("_")
            camera = next(c for c in dome.cameras if c.id == name)
            frames = read_view(dome, light, camera)
            radiance, _, flag = merge_exposures(
                frames, seconds, variant, dark=mergers[name].dark
            )
            expected = read_frame(path, None)
            usable = (flag == 0) & (expected > 0).all(axis=-1)
            merged.append(radiance[usable].astype(float))
            truth.append(expected[usable].astype(float))
        biases.append(
            _octave_biases(np.concatenate(merged), np.concatenate(truth), seconds[0])
        )
    return biases


def _octave_biases(merged, truth, longest):
    bright = truth * longest > 1 / 16
    scale = [np.median((merged[:, c] / truth[:, c])[bright[:, c]]) for c in range(3)]
    octave = np.round(np.log2(truth * longest))
    groups = [octave == o for o in OCTAVES]
    merged = merged / scale
    return [
        merged[g].sum() / truth[g].sum() - 1 if g.sum() >= MIN_VALUES else np.nan
        for g in groups
    ]


def light_errors(capture, truth):
    """Relative errors of the intensities from `light_intensities` and from `fit_light`."""
    dome = capture.dome
    faults = []
    mergers = frame_mergers(dome, faults)
    with ThreadPoolExecutor(2) as pool:
        target_errors = (
            light_intensities(dome, mergers, pool) / truth["light_intensity"] - 1
        )
    targets = [
        target_pixels(c, dome.white) for c in dome.cameras if c.id in dome.white.cameras
    ]
    fits = []
    axes = truth.get("light_axis", [light.axis for light in dome.lights])
    for light, axis in zip(dome.lights, axes, strict=True):
        radiance = [
            _target_radiance(dome, light, mergers[t.camera], t) for t in targets
        ]
        points = np.concatenate([t.points for t in targets])
        white = dome.white
        pixels = TargetPixels(
            np.concatenate(radiance),
            points,
            light.position,
            axis,
            white.normal,
            white.reflectance,
        )
        fits.append(fit_light(pixels, falloff=light.falloff))
    fit_errors = np.array([f.intensity for f in fits]) / truth["light_intensity"] - 1
    return target_errors, fit_errors


def _target_radiance(dome, light, merger, target):
    radiance, flag = merger.merge(
        read_view(dome, light.id, merger.camera, white=True), target.spans
    )
    values = radiance.reshape(-1, 3)[target.at].astype(float)
    values[flag.ravel()[target.at] != 0] = np.nan
    return values


def stated_errors(capture, truth):
    """Mean and largest relative error of `calibrate_lights` with the stated fall-off,
    glare, and rms z-score.
    """
    calibrated = calibrate_lights(
        replace(
            capture.dome,
            lights=[replace(light, intensity=None) for light in capture.dome.lights],
        )
    )
    error = calibrated["calibrated_intensity"].values / truth["light_intensity"] - 1
    noise = (
        calibrated["calibrated_intensity_error"] / calibrated["calibrated_intensity"]
    ).values
    position, glare = (
        calibrated[name].values[:, None]
        for name in ("calibrated_intensity_position_error", "glare_fraction")
    )
    z = error / np.sqrt(noise**2 + position**2 + glare**2)
    return (
        100 * error.mean(),
        100 * np.abs(error).max(),
        100 * np.median(glare),
        np.sqrt((z**2).mean()),
    )


def print_captures(captures: Sequence[Path]) -> None:
    """Print a row for each capture, and biases of radiance where responses are curved."""
    print(
        "| capture | largest error of `light_intensities` | of `fit_light` "
        "| `calibrate_lights`: mean error, largest error, glare, rms z |"
    )
    print("|---" * 4 + "|")
    curved = {}
    for folder in captures:
        capture = read_capture(folder)
        truth = read_truth(folder)
        target_errors, fit_errors = light_errors(capture, truth)
        frames = folder.with_name(f"{folder.name}.truth")
        if capture.dome.cameras[0].sensor.response is not None and frames.is_dir():
            curved[folder.name] = radiance_biases(capture, frames)
        cells = [
            folder.name,
            *(f"{100 * np.abs(e).max():.2f} %" for e in (target_errors, fit_errors)),
            "{:.2f} %, {:.2f} %, {:.2f} %, {:.2f}".format(
                *stated_errors(capture, truth)
            ),
        ]
        print(f"| {' | '.join(cells)} |", flush=True)
    for name, biases in curved.items():
        for response, bias in zip(("given", "recovered"), biases, strict=True):
            cells = ", ".join(
                f"2^{o} {100 * b:+.2f} %" for o, b in zip(OCTAVES, bias, strict=True)
            )
            print(f"{name}, bias of radiance with the {response} response: {cells}")


def main(captures: Sequence[Path]) -> None:
    """Print one table."""
    print_captures(captures)
