"""Errors of virtual subjects under few lights, without and with the lobes that other
subjects of the rig have in common.

    python -m benchmarks rig_lobes DB CAPTURES [--takes V001 ...]

DB has fitted takes that `skindb simulate` wrote to CAPTURES. Each take is seen by its most
frontal camera, without its scan, under some of its lights; every fifth one is held out.
The lobes are those that all other takes have in common, of the face alone or also of its
regions. The first table has means over the takes of the errors at held-out lights
(as in `benchmarks/real.py`), of R_d and of normals, and the fractions of R_d and of normals
within the 95 % limits of their total errors; the second one errors of R_d [%] by region.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

import skindb
from benchmarks.real import ISOTROPIC_95, fitted_samples
from benchmarks.real_photographs import HELD_OUT_EVERY, spread_lights
from skindb.analysis.regions import own_masks
from skindb.calibration.lights import rig_lobes
from skindb.fit.gloss import common_lobes, take_gloss
from skindb.fit.lumitexels import directions, lumitexels
from skindb.ingest.surfels import blended_lobes
from skindb.schema import label
from skindb.schema.label import FACE
from skindb.virtual.capture import at_foot_points, foot_points

Array = NDArray[np.float64]

ETA = 1.3
LIGHT_COUNTS = (4, 6, 8)
VARIANTS = ("without lobes of others", "lobes of the face", "lobes by region")
REGIONS = (FACE, "forehead", "nose", "cheek", "lips", "chin")
MIN_FRONTAL = 0.5  # cosine at the face between the camera and a light
MIN_SAMPLES = 4
PIXELS = 1500
COLUMNS = (
    "held-out lights [%]",
    "R_d [%]",
    "normals, mean, median [deg]",
    "R_d, normals within the total error [%]",
)


class Subject(NamedTuple):
    """One camera's samples of a take, its regions, and what is true."""

    samples: xr.Dataset
    masks: dict[str, NDArray[np.bool_]]
    light: Array  # (light, 3) directions; the camera is at +z
    normal: Array
    diffuse: Array


def subject(capture: xr.DataTree, model: xr.DataTree, truth: Path) -> Subject:
    """The samples by the most frontal camera, with its direction instead of a scan."""
    samples = lumitexels(capture)
    camera = samples["camera_position"].values.astype(np.float64)
    camera /= np.linalg.norm(camera, axis=1, keepdims=True)
    frontal = int(camera[:, 2].argmax())
    view = camera[frontal]
    light = samples["light_position"].values.astype(np.float64)
    light /= np.linalg.norm(light, axis=1, keepdims=True)
    shown = np.flatnonzero(light @ view > MIN_FRONTAL)
    samples = samples.isel(camera=[frontal], light=shown)
    finite = np.isfinite(samples["reflectance_sample"].values).all(axis=3)
    rows = np.flatnonzero(finite.sum(axis=(1, 2)) >= MIN_SAMPLES)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, PIXELS).astype(int))]
    samples = samples.isel(surfel=rows).load()
    fitted = model["fitted"].to_dataset().isel(surfel=rows).load()
    with np.load(truth) as archive:
        arrays = {
            name: archive[name]
            for name in ("vertices", "faces", "normals", "diffuse_reflectance")
        }
    face, corner = foot_points(fitted, arrays)
    corners = arrays["faces"][np.maximum(face, 0)]
    true = [
        np.where(
            (face >= 0)[:, None], at_foot_points(arrays[name][corners], corner), np.nan
        )
        for name in ("normals", "diffuse_reflectance")
    ]
    normal = true[0] / np.linalg.norm(true[0], axis=1, keepdims=True)
    flat = label("surfel_normal", np.tile(view, (len(rows), 1)).astype(np.float32))
    across = np.cross(view, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(across, view), view])
    masks = own_masks(capture["surfels"].to_dataset())
    return Subject(
        samples.assign(surfel_normal=flat),
        {FACE: np.ones(len(rows), bool)} | {k: mask[rows] for k, mask in masks.items()},
        light[shown] @ axes.T,
        normal,
        true[1],
    )


def errors(
    seen: Subject, count: int, lobes: dict[str, tuple[float, ...]]
) -> tuple[list[float], list[float]]:
    """The columns of the table for one take, and the median error of R_d by region [%]."""
    held_out = np.arange(len(seen.light)) % HELD_OUT_EVERY == 0
    training = np.flatnonzero(~held_out)
    chosen = training[spread_lights(seen.light[training], count)]
    few = seen.samples.isel(light=chosen)
    position = seen.samples["surfel_position"].values.astype(np.float64)
    if lobes:
        applied = blended_lobes(position, seen.masks, lobes)
        few = few.assign(lobe_strength_applied=label("lobe_strength_applied", applied))
    fitted, predict = fitted_samples(few, eta=ETA)
    others = seen.samples.isel(light=np.flatnonzero(held_out))
    predicted = predict(
        directions(position, others["light_position"].values),
        directions(position, others["camera_position"].values)[:, 0],
    )
    measured = others["reflectance_sample"].values[:, :, 0].astype(float).mean(axis=2)
    samples = np.isfinite(few["reflectance_sample"].values).all(axis=3).sum(axis=(1, 2))
    shared = (samples >= MIN_SAMPLES) & np.isfinite(predicted).all(axis=1)
    known = np.isfinite(measured) & shared[:, None]
    square = (np.where(known, measured, 0.0) ** 2).sum(axis=1)
    wrong = (np.where(known, predicted - measured, 0.0) ** 2).sum(axis=1)
    diffuse = fitted["diffuse_reflectance"].values[shared]
    off = np.abs(diffuse - seen.diffuse[shared])
    total = fitted["diffuse_reflectance_total_error"].values[shared]
    cosine = (fitted["shading_normal"].values * seen.normal).sum(axis=1)[shared]
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    limit = ISOTROPIC_95 * fitted["normal_total_error"].values[shared]
    true = np.isfinite(angle)
    relative = 100 * off / seen.diffuse[shared]
    by_region = [
        float(np.nanmedian(relative[seen.masks[name][shared]])) for name in REGIONS
    ]
    columns = [
        100 * float(np.median(np.sqrt(wrong[square > 0] / square[square > 0]))),
        by_region[0],
        float(np.nanmean(angle)),
        float(np.nanmedian(angle)),
        100 * float((off < 1.96 * total)[true].mean()),
        100 * float((angle < limit)[true].mean()),
    ]
    return columns, by_region


def main(
    db: Annotated[Path, "Database with fitted takes."],
    captures: Annotated[Path, "Folder of the captures and truths."],
    *,
    takes: Annotated[Sequence[str], "Default: all without a condition."] = (),
) -> None:
    """Print a table."""
    database = skindb.open(str(db))
    names = list(takes) or [t for t in database.takes("model") if "." not in t]
    known = {}
    subjects = {}
    for take in names:
        capture = database.read("capture", take)
        masks = own_masks(capture["surfels"].to_dataset())
        known[take] = take_gloss(lumitexels(capture), eta=ETA, regions=masks)
        model = database.read("model", take)
        subjects[take] = subject(capture, model, captures / f"{take}.truth.npz")
    of_others = {
        take: rig_lobes(common_lobes([known[x] for x in names if x != take]))
        for take in names
    }
    print(f"| {len(names)} virtual subjects | {' | '.join(COLUMNS)} |")
    print("|---" * (len(COLUMNS) + 1) + "|")
    by_region = dict[str, Array]()
    for count in LIGHT_COUNTS:
        for variant in VARIANTS:
            rows = []
            for take, seen in subjects.items():
                lobes = of_others[take] if variant != VARIANTS[0] else {}
                if variant == VARIANTS[1]:
                    lobes = {FACE: lobes[FACE]}
                rows.append(errors(seen, count, lobes))
            columns, regions = (
                np.mean(part, axis=0) for part in zip(*rows, strict=True)
            )
            held, diffuse, mean, median, *covered = columns
            within = ", ".join(f"{value:.0f}" for value in covered)
            name = f"{count} lights, {variant}"
            by_region[name] = regions
            print(
                f"| {name} | {held:.1f} | {diffuse:.1f} | {mean:.1f}, {median:.1f} "
                f"| {within} |",
                flush=True,
            )
    print(f"\n| R_d [%] | {' | '.join(REGIONS)} |")
    print("|---" * (len(REGIONS) + 1) + "|")
    for name, regions in by_region.items():
        print(f"| {name} | {' | '.join(f'{value:.1f}' for value in regions)} |")
