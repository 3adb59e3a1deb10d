"""Photographs of real objects and faces by `skindb quick`, from files to maps.

    python -m benchmarks pictures DATA OUT

DATA is as in `benchmarks/real.py`. For each object the folder OUT/NAME gets pictures and
lights.csv, and OUT/NAME-maps the maps. Normals are compared with those of a laser scanner
(cat) and of the outline (gray sphere). Then every face is ingested with the lights as
stated and with those that the other faces have in common, and lights are predicted.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.real_photographs import HELD_OUT_EVERY, MIN_FRONTAL
from skindb import workflow
from skindb.format.frames import write_frame
from skindb.ingest.pictures import import_images
from skindb.parameters import FitParameters
from skindb.render.image import read_exr
from skindb.store import Database
from skindb.workflow import quick

Array = NDArray[np.float64]
FACE_SPACING_MM = 2.0
UW = ("buddha", "cat", "gray", "horse", "owl", "rock")


def _write(
    folder: Path,
    pictures: Array,
    lights: Array,
    mask: Array | None = None,
    *,
    names: Sequence[str] = (),
) -> None:
    """Pictures (light, h, w, 3) of 16 bits, lights.csv and mask.png."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = ["picture,x,y,z"]
    names = names or [f"{k:03d}" for k in range(len(lights))]
    for name, picture, light in zip(names, pictures, lights, strict=True):
        write_frame(folder / f"{name}.png", np.rint(65535 * picture).astype(np.uint16))
        rows.append(f"{name}.png,{light[0]},{light[1]},{light[2]}")
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
        degrees = np.stack([archive["azimuth_degree"], archive["elevation_degree"]])
        image = archive["image"] / 255
    azimuth, elevation = np.radians(degrees)
    across = -np.sin(azimuth) * np.cos(elevation)
    towards = np.cos(azimuth) * np.cos(elevation)
    lights = np.stack([across, np.sin(elevation), towards], axis=1)
    frontal = towards >= MIN_FRONTAL
    signs = str.maketrans("+-", "pm")
    names = [f"{a:+04.0f}{e:+03.0f}".translate(signs) for a, e in degrees.T[frontal]]
    pictures = np.repeat(image[frontal, ..., None], 3, axis=3)
    _write(folder, pictures, lights[frontal], names=names)


def rig_rows(faces: Sequence[Path], out: Path) -> list[str]:
    """Errors at held-out lights of each face [%], with lights as stated and with those
    that `skindb calibrate --from-takes` finds in the other faces.
    """
    db = Database(out / "faces.db")
    consent = {"scope": ["fit"], "reference": "public data"}
    parameters = FitParameters(hold_out_lights=1 / HELD_OUT_EVERY)
    captures = {}
    for face in faces:
        person = {"subject": face.name, "consent": consent}
        captures[face.name] = out / f"{face.name}-capture"
        import_images(face, captures[face.name], person, response="linear")

    def held_out(db: Database, take: str) -> float:
        workflow.ingest_take(db, captures[take], spacing_mm=FACE_SPACING_MM)
        workflow.fit_take(db, take, parameters)
        fitted = db.read("model", take)["fitted"].to_dataset()
        return 100 * float(np.nanmedian(fitted["held_out_error"].values))

    stated = {take: held_out(db, take) for take in captures}
    rows = [
        "| error at held-out lights [%] | lights as stated | those of the other faces |",
        "|---|---|---|",
    ]
    for take, before in stated.items():
        # the others must not know a calibration that contains this face
        own = Database(shutil.copytree(db.folder, out / f"faces-{take}.db"))
        workflow.calibrate_rig(own, [t for t in captures if t != take], name="strobes")
        rows.append(f"| {take} | {before:.1f} | {held_out(own, take):.1f} |")
    return rows


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
    faces = sorted((photometric / "yale").glob("*.npz"))
    for path in faces:
        yale(path, out / path.stem)
        print(report(path.stem, out / path.stem, out, {}), flush=True)
    print("\n".join(["", *rig_rows([out / path.stem for path in faces], out)]))
