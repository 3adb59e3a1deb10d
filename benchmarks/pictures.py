"""Photographs of real objects and faces by `skindb quick`, from files to maps.

    python -m benchmarks pictures DATA OUT

DATA is as in `benchmarks/real.py`. For each object the folder OUT/NAME gets pictures and
lights.csv, and OUT/NAME-maps the maps. Normals are compared with those of a laser scanner
(cat) and of the outline (gray sphere).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.real_photographs import MIN_FRONTAL
from skindb.format.frames import write_frame
from skindb.render.image import read_exr
from skindb.workflow import quick

Array = NDArray[np.float64]
UW = ("buddha", "cat", "gray", "horse", "owl", "rock")


def _write(folder: Path, pictures: Array, lights: Array, mask: Array | None) -> None:
    """Pictures (light, h, w, 3) of 16 bits, lights.csv and mask.png."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = ["picture,x,y,z"]
    for k, (picture, light) in enumerate(zip(pictures, lights, strict=True)):
        write_frame(folder / f"{k:03d}.png", np.rint(65535 * picture).astype(np.uint16))
        rows.append(f"{k:03d}.png,{light[0]},{light[1]},{light[2]}")
    (folder / "lights.csv").write_text("\n".join(rows), encoding="utf-8")
    if mask is not None:
        shown = np.repeat(mask[..., None] * np.uint8(255), 3, axis=2)
        write_frame(folder / "mask.png", shown)


def diligent(path: Path, folder: Path) -> Array:
    """The cat; returns its measured normals (h, w, 3)."""
    with np.load(path) as archive:
        image = archive["image"] / archive["light_intensity"][:, None, None, :]
        _write(folder, image / image.max(), archive["light_direction"], archive["mask"])
        normal = np.where(archive["mask"][..., None], archive["normal"], np.nan)
    return np.asarray(normal, np.float64)


def yale(path: Path, folder: Path) -> None:
    """A face under its frontal strobes."""
    with np.load(path) as archive:
        azimuth, elevation = (
            np.radians(archive[f"{name}_degree"]) for name in ("azimuth", "elevation")
        )
        image = archive["image"] / 255
    across = -np.sin(azimuth) * np.cos(elevation)
    towards = np.cos(azimuth) * np.cos(elevation)
    lights = np.stack([across, np.sin(elevation), towards], axis=1)
    frontal = towards >= MIN_FRONTAL
    _write(
        folder, np.repeat(image[frontal, ..., None], 3, axis=3), lights[frontal], None
    )


def sphere(normals: Array) -> Array:
    """Normals of a sphere with the outline of the points that have one."""
    row, column = np.nonzero(np.isfinite(normals[..., 2]))
    radius = np.sqrt(len(row) / np.pi)
    y, x = np.mgrid[: normals.shape[0], : normals.shape[1]].astype(np.float64)
    x = (x - column.mean()) / radius
    y = (row.mean() - y) / radius
    z = np.sqrt(np.where(x * x + y * y < 1, 1 - x * x - y * y, np.nan))
    return np.stack([x, y, z], axis=-1)


def report(
    name: str,
    source: Path,
    out: Path,
    options: Mapping[str, Any],
    truth: Array | Callable[[Array], Array] | None = None,
) -> str:
    """A row of the table of one object."""
    start = time.process_time()
    result = quick(source, out / f"{name}-maps", response="linear", **options)
    seconds = time.process_time() - start
    angle = ""
    if truth is not None:
        normals = read_exr(out / f"{name}-maps/normals.exr")[0].astype(np.float64)
        known = truth(normals) if callable(truth) else truth
        cosine = (normals * known).sum(axis=-1)
        angles = np.degrees(np.arccos(np.clip(cosine[np.isfinite(cosine)], -1, 1)))
        angle = f"{angles.mean():.1f}, {np.median(angles):.1f}"
    points = result["points"]
    total = sum(points.values())
    fitted = points.get("fitted", 0) / total
    missing = (points.get("unseen", 0) + points.get("too_few_samples", 0)) / total
    return f"| {name} | {total:,} | {fitted:.1%} | {missing:.1%} | {angle} | {seconds:.0f} |"


def main(data: Path, out: Path) -> None:
    """Make the pictures and the maps of every object, and print the table."""
    photometric = data / "photometric"
    print(
        "| object | points | fitted | no value | normals, mean, median [deg] | CPU [s] |"
    )
    print("|---|---|---|---|---|---|")
    truth = diligent(photometric / "diligent/cat.npz", out / "DiLiGenT-cat")
    print(report("DiLiGenT-cat", out / "DiLiGenT-cat", out, {}, truth), flush=True)
    for name in UW:
        ball = {"mirror_ball": photometric / "uw/chrome"}
        known = sphere if name == "gray" else None
        row = report(f"UW-{name}", photometric / "uw" / name, out, ball, known)
        print(row, flush=True)
    matt = ball | {"eta": 1.0}
    print(report("UW-gray-matt", photometric / "uw/gray", out, matt, sphere))
    for path in sorted((photometric / "yale").glob("*.npz")):
        yale(path, out / path.stem)
        print(report(path.stem, out / path.stem, out, {}), flush=True)
