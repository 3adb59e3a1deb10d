"""Error of every stage of a fitted take relative to the truth of an independent
capture, one Markdown row per stage.

    python -m benchmarks stage_errors DB CAPTURE

CAPTURE.truth.npz contains the truth, and CAPTURE.truth/<light>_<camera>.exr the
noise-free radiance of some frames. The take must have been ingested into DB and fitted,
for example by benchmarks/validate.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import skindb
from skindb.calibration.irradiance import light_falloff
from skindb.calibration.radiance import frame_mergers, read_view
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
SOME = 20_000  # number of surfels whose distance is measured
Row = tuple[str, str, str]


def main(db: str, capture: Path) -> None:
    folder = capture
    with np.load(folder.with_name(folder.name + ".truth.npz")) as file:
        truth = dict(file)
    record = read_capture(folder)
    assert record.dome is not None
    db = skindb.open(db)
    capture = db.read("capture", record.take)
    model = db.read("model", record.take)
    print("| stage | error | of what |\n|---|---|---|")
    for row in rows(
        record.dome, capture, model, truth, folder.with_name(folder.name + ".truth")
    ):
        print("| " + " | ".join(row) + " |", flush=True)


def rows(
    dome: DomeRecord,
    capture: xr.DataTree,
    model: xr.DataTree,
    truth: dict[str, NDArray],
    frames: Path,
) -> Iterator[Row]:
    surfels = capture["surfels"].to_dataset()
    position = surfels["surfel_position"].values.astype(float)
    some = np.random.default_rng(0).choice(
        len(position), min(SOME, len(position)), replace=False
    )
    _, _, distance = closest_on_mesh(
        truth["vertices"].astype(float), truth["faces"].astype(int), position[some]
    )
    yield (
        "scan, subdivision",
        f"{quantiles(distance)} mm",
        f"distance of {len(some):,} surfels from the true surface",
    )
    found = capture["dome/light_intensity"].values
    true = truth["light_intensity"]
    off = found / true - 1
    yield (
        "white target",
        f"{100 * np.sqrt(np.mean(off**2)):.3f} % rms",
        f"intensity of {len(off)} lights",
    )
    merged = []
    sampled = []
    mergers = frame_mergers(dome, faults := [])
    assert not faults
    lights = {light.id: j for j, light in enumerate(dome.lights)}
    cameras = {camera.id: c for c, camera in enumerate(dome.cameras)}
    for path in sorted(frames.glob("*.exr")):
        light, camera = path.stem.split("_")
        image, _ = read_exr(path)
        radiance, flag = mergers[camera].merge(
            read_view(dome, light, dome.cameras[cameras[camera]])
        )
        lit = (flag == 0) & (image.min(axis=-1) > LIT * np.quantile(image, 0.999))
        merged.append((radiance[lit] / image[lit] - 1).ravel())
        sampled.append(
            of_samples(dome, capture, true, image, lights[light], cameras[camera])
        )
    if merged:
        yield (
            "merged exposures",
            relative(np.concatenate(merged)),
            f"lit pixels of {len(merged)} frames, noise-free",
        )
        yield (
            "samples",
            relative(np.concatenate(sampled)),
            "the same frames at the same pixels, noise-free",
        )
    yield from of_visibility(surfels, truth, dome)
    summary = recovered_against_true(model, truth).summary()
    median = summary["normal_median_deg"]
    worst = summary["normal_95_deg"]
    yield "normals", f"{median} deg median, {worst} at 95 %", "fitted surfels"
    diffuse = summary["diffuse_median_percent"]
    bias = summary["diffuse_bias_percent"]
    yield (
        "diffuse albedo",
        f"{diffuse} % median, bias {bias} %",
        "fitted surfels, R G B",
    )
    if "held_out_error" in model["fitted"]:
        held = model["fitted/held_out_error"].values
        yield (
            "surface BRDF",
            f"{quantiles(100 * held[np.isfinite(held)])} %",
            "samples of held-out lights",
        )
    if summary["sigma_tr_percent"]:
        sites = "; ".join(
            f"{site} {' '.join(f'{v:+.1f}' for v in by)}"
            for site, by in summary["sigma_tr_percent"].items()
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
    at = np.flatnonzero(np.isfinite(stored).all(axis=1))
    position = capture["surfels/surfel_position"].values[at].astype(float)
    seen = dome.cameras[camera]
    shone = dome.lights[light]
    pixels, _ = project(position, seen.K, seen.R, seen.t, seen.distortion)
    square, falloff = light_falloff(shone, position)
    true = bilinear(image, pixels) * (square / falloff)[:, None] / intensity[light]
    lit = (true > LIT * np.quantile(true, 0.999)).all(axis=1)
    return (stored[at][lit] / true[lit] - 1).ravel()


def of_visibility(
    surfels: xr.Dataset, truth: dict[str, NDArray], dome: DomeRecord
) -> Iterator[Row]:
    """Errors of the visibility of light centres and cameras, at the surfels nearest to
    true vertices.
    """
    vertices = truth["vertices"].astype(float)
    normals = truth["normals"].astype(float)
    distance, nearest = cKDTree(surfels["surfel_position"].values).query(
        vertices, workers=1
    )
    same = (distance < NEAR) & (
        np.einsum("ni,ni->n", surfels["surfel_normal"].values[nearest], normals)
        > TURNED
    )
    for kind, devices in (("light", dome.lights), ("camera", dome.cameras)):
        share = surfels[f"{kind}_visible_fraction"].values
        seen = np.unpackbits(truth[f"visible_{kind}"], axis=1).astype(bool)
        right = pairs = 0
        for j, device in enumerate(devices):
            eye = device.position if kind == "light" else -device.R.T @ device.t
            way = eye - vertices
            steep = np.einsum("ni,ni->n", way, normals) > STEEP * np.linalg.norm(
                way, axis=1
            )
            at = np.flatnonzero(same & steep)
            right += int(((share[nearest[at], j] > 0.5) == seen[at, j]).sum())
            pairs += len(at)
        yield (
            f"visibility, {kind}s",
            f"{100 * (1 - right / pairs):.2f} % wrong",
            f"{pairs:,} pairs, cosine above {STEEP}",
        )


def quantiles(x: NDArray) -> str:
    return f"{np.median(x):.3g} median, {np.quantile(x, 0.95):.3g} at 95"


def relative(off: NDArray) -> str:
    return f"{100 * np.median(np.abs(off)):.2f} % median, bias {100 * np.median(off):+.3f} %"
