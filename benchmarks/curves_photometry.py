"""Curves of normals and diffuse reflectance on samples of the model, and of radiance
merged from exposures.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from benchmarks.curve import Curve, Point, cpu_time
from benchmarks.curves_surface import spiral
from skindb.calibration._merge_kernels import OK
from skindb.calibration.radiance import merge_exposures
from skindb.fit import estimate_diffuse_reflectance, estimate_normals
from skindb.format.frames import FrameKind
from skindb.format.sensor import SensorRecord
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.mixture import basis_rows
from skindb.reflectance.separation import surface_lobes
from skindb.schema import dataset, label, variables
from skindb.types import Array, Mask, Values16, dots, finite_rows, unit
from skindb.virtual.dome import Sensor

ETA = 1.3
SCAN_ERROR = 3.0  # degree
DOMES = ((12, 2), (16, 4), (32, 6), (64, 8), (150, 16))  # lights, cameras
NOISE = 0.03
GLOSS = 0.1
SHORTEST = 0.09  # exposure [s]
STEP = 4.0  # factor between exposures


@dataclass(frozen=True)
class ModelSamples:
    """Lumitexels of points on a head-sized cap, and their true parameters."""

    lumitexels: xr.Dataset
    normal: Array
    diffuse: Array
    weight: Array  # of the lobes used by the fit of R_d

    @property
    def with_normals(self) -> xr.Dataset:
        """The lumitexels with the true normals."""
        return self.lumitexels.assign(
            shading_normal=label(variables.SHADING_NORMAL, self.normal)
        )


def model_samples(
    rng: np.random.Generator,
    *,
    surfels: int,
    lights: int,
    cameras: int,
    noise: float,
    gloss: float,
    floor: float = 0.0,
    lobes: tuple[int, ...] = (),
) -> ModelSamples:
    """Samples of diffuse light and of lobes that the fit uses, made with the public
    functions of `skindb.optics`.

    Every surfel has two random lobes with weights up to `gloss`, or the given `lobes`,
    each with at least a fifth of `gloss`. Noise is relative, with `floor` [sr^-1] added
    in quadrature.
    """
    normal = unit(spiral(surfels, 1, 0.4) + 0.05 * rng.normal(size=(surfels, 3)))
    position = spiral(surfels, 80, 0.4)
    light = spiral(lights, 880, 0.9)
    camera = spiral(cameras, 830, 0.5)
    wi = unit(light - position[:, None])
    wo = unit(camera - position[:, None])
    lit = np.einsum("nk,ntk->nt", normal, wi)
    seen = np.einsum("nk,ntk->nt", normal, wo)
    brightness = rng.uniform(0.7, 1.2, (surfels, 1))
    tint = rng.uniform(0.95, 1.05, (surfels, 3))
    diffuse = np.array([0.5, 0.33, 0.24]) * brightness * tint
    table, grid = surface_lobes()
    usable = (lit > 0)[:, :, None] & (seen > 0)[:, None]
    rows, offsets, index = basis_rows(table, grid, normal, wi, wo, usable)
    s = np.repeat(np.arange(surfels), np.diff(offsets))
    i, o = index.T
    weight = _lobe_weights(rng, (surfels, table.shape[-1]), gloss, lobes)
    ci = lit.clip(0, 1)
    transmitted = fresnel_transmittance(seen.clip(0, 1), ETA)
    body = (lit * fresnel_transmittance(ci, ETA))[s, i] * transmitted[s, o]
    surface = dots(rows, weight[s])
    value = body[:, None] / np.pi * diffuse[s] + surface[:, None]
    scatter = np.hypot(noise * value, floor) * rng.normal(size=value.shape)
    sample = np.full((surfels, lights, cameras, 3), np.nan)
    sample[s, i, o] = value + scatter
    off = np.deg2rad(SCAN_ERROR / np.sqrt(2)) * rng.normal(size=normal.shape)
    values = {
        variables.REFLECTANCE_SAMPLE: sample,
        variables.SURFEL_POSITION: position,
        variables.SURFEL_NORMAL: unit(normal + off),
        variables.SURFEL_AREA: np.ones(surfels),
        variables.LIGHT_POSITION: light,
        variables.LIGHT_DISC_RADIUS: np.zeros(lights),
        variables.CAMERA_POSITION: camera,
        variables.NOISE_FLOOR: 0.0,
    }
    lumitexels = dataset(values, coords={"channel": ["R", "G", "B"]})
    return ModelSamples(lumitexels, normal, diffuse, weight)


def _lobe_weights(
    rng: np.random.Generator,
    shape: tuple[int, int],
    gloss: float,
    lobes: tuple[int, ...],
) -> Array:
    """Weights (surfel, lobe) of two random lobes, or of the given ones."""
    surfels, count = shape
    chosen = rng.permuted(np.tile(np.arange(count), (surfels, 1)), axis=1) < 2
    weight = rng.uniform(0, gloss, shape) * chosen
    if lobes:
        weight[:] = 0
        weight[:, list(lobes)] = rng.uniform(gloss / 5, gloss, (surfels, len(lobes)))
    return weight


def _domes(quick: bool) -> list[tuple[str, ModelSamples]]:
    """Samples of every dome, named by their mean number per surfel."""
    rng = np.random.default_rng(11)
    surfels = 60 if quick else 300
    domes = []
    for lights, cameras in DOMES[1::2] if quick else DOMES:
        skin = model_samples(
            rng,
            surfels=surfels,
            lights=lights,
            cameras=cameras,
            noise=NOISE,
            gloss=GLOSS,
        )
        sample = skin.lumitexels[variables.REFLECTANCE_SAMPLE].values[..., 0]
        count = np.isfinite(sample).sum((1, 2)).mean()
        domes.append((f"{count:.0f} samples", skin))
    return domes


def normals_curves(quick: bool) -> list[Curve]:
    """The estimate by size of the dome."""
    domes = _domes(quick)
    points = [_normals(skin, samples) for samples, skin in domes]
    skin = domes[0][1]
    scan = skin.lumitexels[variables.SURFEL_NORMAL].values
    angle = float(np.median(_angles(scan, skin.normal)))
    points.append(Point("normals of the scan", "", np.nan, angle))
    return [
        Curve(
            kernel="normals",
            error_of="median angle [degree]",
            reference=f"true normals of samples of the model, {NOISE:.0%} noise",
            seconds_of="a surfel",
            base=f"combined, {domes[-1][0]}",
            points=points,
        )
    ]


def _normals(skin: ModelSamples, samples: str) -> Point:
    options: dict[str, Any] = {"eta": ETA, "scan_error": SCAN_ERROR}
    estimate_normals(skin.lumitexels.isel(surfel=slice(0, 2)), **options)  # compiles
    work = partial(estimate_normals, skin.lumitexels, **options)
    seconds, estimate = cpu_time(work, len(skin.normal))
    angle = _angles(estimate[variables.SHADING_NORMAL].values, skin.normal)
    return Point("combined", samples, seconds, float(np.nanmedian(angle)))


def _angles(normal: Array, true: Array) -> Array:
    """Angles (n,) between normals [degree]."""
    cosine = dots(normal, true).clip(-1, 1)
    return np.asarray(np.degrees(np.arccos(cosine)))


def albedo_curves(quick: bool) -> list[Curve]:
    """The estimate by size of the dome."""
    domes = _domes(quick)
    return [
        Curve(
            kernel="albedo",
            error_of="median relative error of R_d",
            reference=f"true R_d of samples of the model, {NOISE:.0%} noise, true normals",
            seconds_of="a surfel",
            base=f"separated, {domes[-1][0]}",
            points=[_albedo(skin, samples) for samples, skin in domes],
        )
    ]


def _albedo(skin: ModelSamples, samples: str) -> Point:
    lumitexels = skin.with_normals
    # compiles
    estimate_diffuse_reflectance(lumitexels.isel(surfel=slice(0, 2)), eta=ETA)
    work = partial(estimate_diffuse_reflectance, lumitexels, eta=ETA)
    seconds, estimate = cpu_time(work, len(skin.normal))
    relative = estimate[variables.DIFFUSE_REFLECTANCE].values / skin.diffuse - 1
    estimated = float(np.isfinite(relative).all(1).mean())
    failure = ""
    if estimated <= 0.5:
        failure = f"{1 - estimated:.0%} of the surfels have too few samples"
    error = float(np.nanmedian(np.abs(relative)))
    return Point("separated", samples, seconds, error, failure)


def exposures_curves(quick: bool) -> list[Curve]:
    """Radiance over four decades from one to five exposures in steps of a factor of four."""
    side = 100 if quick else 300
    rng = np.random.default_rng(6)
    sensor = Sensor()
    record = SensorRecord(
        FrameKind(side, side, 16),
        sensor.black,
        sensor.white,
        sensor.read_noise,
        sensor.electrons_per_dn,
        sensor.step,
    )
    # 1 is white after a second
    truth = np.asarray(10 ** rng.uniform(-3, 1, (side, side, 3)), np.float32)
    still = np.zeros_like(truth)
    points = []
    for count in (1, 2, 3) if quick else (1, 2, 3, 4, 5):
        times = tuple(float(s) for s in SHORTEST * STEP ** np.arange(count))
        frames = [sensor.expose(truth * np.float32(s), still, rng=rng) for s in times]
        work = partial(merge_exposures, frames, times, record)
        setting = f"{count} exposure{'s' * (count > 1)}"
        seconds, (merged, _, flag) = cpu_time(work, side**2)
        error = _radiance_error(merged, truth, np.asarray(flag == OK))
        points.append(Point("skindb merge_exposures", setting, seconds, error))
        work_of_longest = partial(_longest_exposure, frames, times, sensor)
        seconds, longest = cpu_time(work_of_longest, side**2)
        name = "longest exposure that is not saturated"
        error = _radiance_error(longest, truth, finite_rows(longest))
        points.append(Point(name, setting, seconds, error))
    medium = (SHORTEST * STEP**2,)
    frame = sensor.expose(truth * np.float32(medium[0]), still, rng=rng)
    radiance, _, flag = merge_exposures([frame], medium, record)
    usable = np.asarray(flag == OK)
    failure = (
        f"{1 - usable.mean():.0%} of the pixels are white or black: one exposure does "
        "not cover four decades"
    )
    error = _radiance_error(radiance, truth, usable)
    points.append(Point("one medium exposure", "", np.nan, error, failure))
    return [
        Curve(
            kernel="exposures",
            error_of=(
                "median relative error of radiance from 1e-3 to 10 (white after 1 s at 1)"
            ),
            reference="radiance given to a virtual sensor",
            seconds_of="a pixel",
            base="skindb merge_exposures, 1 exposure",
            points=points,
        )
    ]


def _longest_exposure(
    frames: list[Values16], times: tuple[float, ...], sensor: Sensor
) -> Array:
    radiance = np.full(frames[0].shape, np.nan)
    for frame, seconds in zip(frames, times, strict=True):  # from short to long
        level = frame.astype(float) - sensor.black
        level = level / (sensor.white - sensor.black) / seconds
        radiance = np.where(frame < sensor.white, level, radiance)
    return radiance


def _radiance_error(radiance: Array, truth: Array, usable: Mask) -> float:
    """Median relative error of the usable pixels."""
    return float(np.median(np.abs(radiance[usable] / truth[usable] - 1)))
