"""Error of every stage of a fitted take relative to the truth of an independent
capture, one Markdown row per stage.

    python -m benchmarks stage_errors DB CAPTURE

CAPTURE.truth.npz contains the truth, and CAPTURE.truth/<light>_<camera>.exr the
noise-free radiance of some frames, if the generator writes them. The take must have been
ingested into DB and fitted, for example by benchmarks/validate.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import skindb
from benchmarks.truth import TrueVisibility, Truth, read_truth
from skindb.calibration.irradiance import light_falloff
from skindb.calibration.radiance import frame_mergers, read_view
from skindb.errors import Fault
from skindb.format.dome import DomeRecord
from skindb.format.folder import read_capture
from skindb.geometry.atlas import bilinear
from skindb.geometry.camera import project
from skindb.geometry.mesh import closest_on_mesh
from skindb.render.image import read_exr
from skindb.virtual.capture import recovered_against_true

# fraction of the 99.9 % quantile of a frame's radiance, below which relative errors are
# not computed
LIT = 0.02
# mm and cosine, within which a vertex and a surfel are the same place
NEAR = 0.5
TURNED = 0.9
STEEP = 0.1  # smallest cosine to a light or camera
SURFELS = 20_000  # number of surfels whose distance is measured
Row = tuple[str, str, str]


def main(db: str, capture: Path) -> None:
    truth = read_truth(capture)
    record = read_capture(capture)
    assert record.dome is not None
    database = skindb.open(db)
    ingested = database.read("capture", record.take)
    model = database.read("model", record.take)
    frames = capture.with_name(f"{capture.name}.truth")
    parts = (
        of_scan(ingested, truth),
        of_lights(ingested, truth),
        of_frames(record.dome, ingested, truth, frames),
        of_visibility(ingested["surfels"].to_dataset(), truth, record.dome),
        of_model(model, truth),
    )
    print("| stage | error | of what |\n|---|---|---|")
    for row in chain(*parts):
        print("| " + " | ".join(row) + " |", flush=True)


def of_scan(ingested: xr.DataTree, truth: Truth) -> Iterator[Row]:
    """Distances of surfels from the true surface."""
    position = ingested["surfels/surfel_position"].values.astype(float)
    count = min(SURFELS, len(position))
    chosen = np.random.default_rng(0).choice(len(position), count, replace=False)
    _, _, distance = closest_on_mesh(
        truth["vertices"].astype(float), truth["faces"].astype(int), position[chosen]
    )
    meaning = f"distance of {count:,} surfels from the true surface"
    yield "scan, subdivision", quantiles(distance, "mm"), meaning


def of_lights(ingested: xr.DataTree, truth: Truth) -> Iterator[Row]:
    """Errors of the intensities of lights."""
    intensity = ingested["dome/light_intensity"].values
    off = intensity / truth["light_intensity"] - 1
    error = f"{100 * np.sqrt(np.mean(off**2)):.3f} % rms"
    yield "white target", error, f"intensity of {len(off)} lights"


def of_frames(
    dome: DomeRecord, ingested: xr.DataTree, truth: Truth, frames: Path
) -> Iterator[Row]:
    """Errors of merged exposures and of samples, where there are noise-free frames."""
    merged = []
    sampled = []
    faults: list[Fault] = []
    mergers = frame_mergers(dome, faults)
    assert not faults
    lights = {light.id: j for j, light in enumerate(dome.lights)}
    cameras = {camera.id: c for c, camera in enumerate(dome.cameras)}
    for path in sorted(frames.glob("*.exr")):
        light, camera = path.stem.split("_")
        image, _ = read_exr(path)
        view = read_view(dome, light, dome.cameras[cameras[camera]])
        radiance, flag = mergers[camera].merge(view)
        lit = (flag == 0) & (image.min(axis=-1) > LIT * np.quantile(image, 0.999))
        merged.append((radiance[lit] / image[lit] - 1).ravel())
        intensity = truth["light_intensity"]
        place = lights[light], cameras[camera]
        sampled.append(of_samples(dome, ingested, intensity, image, *place))
    if merged:
        meaning = f"lit pixels of {len(merged)} frames, noise-free"
        yield "merged exposures", relative(np.concatenate(merged)), meaning
        meaning = "the same frames at the same pixels, noise-free"
        yield "samples", relative(np.concatenate(sampled)), meaning


def of_model(model: xr.DataTree, truth: Truth) -> Iterator[Row]:
    """Errors of the fitted parameters."""
    summary = recovered_against_true(model, truth).summary()
    median = summary["normal_median_deg"]
    error = f"{median} deg median, {summary['normal_95_deg']} at 95 %"
    yield "normals", error, "fitted surfels"
    median = summary["diffuse_median_percent"]
    error = f"{median} % median, bias {summary['diffuse_bias_percent']} %"
    yield "diffuse albedo", error, "fitted surfels, R G B"
    if "held_out_error" in model["fitted"]:
        held_out = model["fitted/held_out_error"].values
        error = quantiles(100 * held_out[np.isfinite(held_out)], "%")
        yield "surface BRDF", error, "samples of held-out lights"
    if summary["sigma_tr_percent"]:
        sites = "; ".join(
            f"{site} {' '.join(f'{v:+.1f}' for v in channels)}"
            for site, channels in summary["sigma_tr_percent"].items()
        )
        yield "translucency", f"{sites} %", "sigma_tr, R G B"


def of_samples(
    dome: DomeRecord,
    capture: xr.DataTree,
    intensity: NDArray,
    image: NDArray,
    light: int,
    camera: int,
) -> NDArray:
    """Stored samples of a view over those of its noise-free frame, minus 1."""
    stored = (
        capture["samples/reflectance_sample"]
        .isel(light=light, camera=camera)
        .values.astype(float)
    )
    sampled = np.flatnonzero(np.isfinite(stored).all(axis=1))
    position = capture["surfels/surfel_position"].values[sampled].astype(float)
    seen = dome.cameras[camera]
    shone = dome.lights[light]
    pixels, _ = project(position, seen.K, seen.R, seen.t, seen.distortion)
    square, falloff = light_falloff(shone, position)
    true = bilinear(image, pixels) * (square / falloff)[:, None] / intensity[light]
    lit = (true > LIT * np.quantile(true, 0.999)).all(axis=1)
    return (stored[sampled][lit] / true[lit] - 1).ravel()


def of_visibility(surfels: xr.Dataset, truth: Truth, dome: DomeRecord) -> Iterator[Row]:
    """Errors of the visibility of light centres and cameras, at the surfels nearest to
    true vertices.
    """
    true = TrueVisibility(truth)
    tree = cKDTree(surfels["surfel_position"].values)
    distance, nearest = tree.query(true.vertices, workers=1)
    normal = surfels["surfel_normal"].values[nearest]
    same = distance < NEAR
    same &= np.einsum("ni,ni->n", normal, true.normals) > TURNED
    for kind, devices in (("light", dome.lights), ("camera", dome.cameras)):
        fraction = surfels[f"{kind}_visible_fraction"].values
        right = 0
        pairs = 0
        for j, device in enumerate(devices):
            place = device.position if kind == "light" else -device.R.T @ device.t
            compared = np.flatnonzero(same & (true.cosine(place) > STEEP))
            seen = fraction[nearest[compared], j] > 0.5
            right += int((seen == true.of(kind, j, place)[compared]).sum())
            pairs += len(compared)
        error = f"{100 * (1 - right / pairs):.2f} % wrong"
        meaning = f"{pairs:,} pairs, cosine above {STEEP}"
        yield f"visibility, {kind}s", error, meaning


def quantiles(x: NDArray, unit: str) -> str:
    """Median and 95 % quantile."""
    return (
        f"{np.median(x):.3g} {unit} median, {np.quantile(x, 0.95):.3g} {unit} at 95 %"
    )


def relative(off: NDArray) -> str:
    return f"{100 * np.median(np.abs(off)):.2f} % median, bias {100 * np.median(off):+.3f} %"
