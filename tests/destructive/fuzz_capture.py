"""Damaged capture folders: each is ingested by a process of its own, within limits of time and memory.

    python tests/destructive/fuzz_capture.py --cases 1000 --seed 0

An ingest must end in lines that each have a cure, or in numbers. Tracebacks, hangs, gigabytes of memory and messages
of libraries are failures, and the program then ends with 1.
"""

from __future__ import annotations

import json
import shutil
import sys
from functools import partial
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1] / "ingest"), str(Path(__file__).parent)]

import apart
import numpy as np
from mutations import damage
from sphere import BLACK, SECONDS, WHITE, write_capture

import skindb
import skindb.ingest.run
from skindb.errors import InputError
from skindb.ingest.frames import read_frame, write_frame
from skindb.workflow.ingest import ingest_take

COMPARED = {
    "samples": ("reflectance_sample", "sample_count"),
    "surfels": ("surfel_position", "region_mask"),
    "mesh": ("landmark_position",),
    "dome": ("light_intensity",),
    "probe": ("fibre_profile", "site_position", "fibre_distance"),
}
BAD = ("refused without a cure",)
OUTCOMES = ("refused", "same numbers", "changed numbers", *BAD, *apart.FAILURES)


def variants(folder: Path) -> dict[str, Path]:
    """Whole captures: PNG and a binary PLY; TIFF and an OBJ scan; OpenEXR and a PLY of text."""
    out = {name: folder / name for name in ("png", "tif", "exr")}
    write_capture(out["png"])
    values = np.linspace(BLACK, WHITE, 9)
    rows = [f"{v},{e},{e},{e}" for v, e in zip(values, np.linspace(0, 1, 9), strict=True)]
    (out["png"] / "dome/r.csv").write_text("\n".join(["dn,r,g,b", *rows]))
    _edit(out["png"] / "dome/dome.json", lambda dome: dome["cameras"][0].update(response="dome/r.csv"))
    for name in ("tif", "exr"):
        shutil.copytree(out["png"], out[name])
        _edit(out[name] / "dome/dome.json", lambda dome: dome["cameras"][0].pop("response"))
        (out[name] / "dome/r.csv").unlink()
    _as_tiff(out["tif"])
    _as_exr(out["exr"])
    import trimesh

    mesh = trimesh.load(out["png"] / "scan.ply", process=False)
    mesh.export(out["tif"] / "scan.obj")
    (out["tif"] / "scan.ply").unlink()
    _edit(out["tif"] / "capture.json", lambda capture: capture.update(mesh="scan.obj"))
    mesh.export(out["exr"] / "scan.ply", encoding="ascii")
    return out


def _edit(path: Path, change) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def _as_tiff(folder: Path) -> None:
    for path in [*folder.rglob("*.png")]:
        write_frame(path.with_suffix(".tif"), read_frame(path))
        path.unlink()
    for name in ("dome/dome.json", "contact/probe.json"):
        path = folder / name
        path.write_text(path.read_text().replace(".png", ".tif"))


def _as_exr(folder: Path) -> None:
    longest = max(SECONDS, key=SECONDS.get)
    for path in [*(folder / "dome").rglob("*.png")]:
        if path.parent.name == longest:
            radiance = (read_frame(path).astype(np.float32) - BLACK) / (WHITE - BLACK) / SECONDS[longest]
            write_frame(path.with_suffix(".exr"), radiance)
        path.unlink()
    path = folder / "dome/dome.json"
    path.write_text(path.read_text().replace(".png", ".exr"))
    _edit(path, lambda dome: dome.update(exposures=[{"id": longest, "seconds": 1.0}]))


def numbers(capture: Path, place: Path) -> dict[str, np.ndarray]:
    """What an ingest of the folder stores."""
    db = skindb.open(place)
    record = ingest_take(db, capture, spacing_mm=8.0, photographs=1)
    tree = db.read("capture", record.take)
    return {
        name: tree[group][name].values
        for group, names in COMPARED.items()
        if group in tree
        for name in names
        if name in tree[group]
    }


def difference(found: dict[str, np.ndarray], true: dict[str, np.ndarray]) -> str:
    """What differs and how much, relative to the median size of each quantity; nothing if all is the same."""
    said = [f"{name} missing" for name in true if name not in found]
    for name, value in found.items():
        if name not in true:
            said.append(f"{name} added")
        elif value.shape != true[name].shape:
            said.append(f"{name} of shape {value.shape}, not {true[name].shape}")
        elif not np.array_equal(value, true[name], equal_nan=value.dtype.kind == "f"):
            a, b = value.astype(np.float64), true[name].astype(np.float64)
            known = np.isfinite(a) & np.isfinite(b)
            size = max(float(np.nanmedian(np.abs(b))), 1e-30)
            off = float(np.abs(a - b)[known].max() / size) if known.any() else 0.0
            part = float(((a != b) & known).mean())
            said.append(
                f"{name} by {off:.2g} in {part:.1%}, {int((np.isfinite(a) != np.isfinite(b)).sum())} lost or new"
            )
    return "; ".join(said)


def attempt(capture: Path, work: Path, true: dict[str, np.ndarray]) -> apart.Outcome:
    """Ingest the folder and compare what is stored."""
    try:
        said = difference(numbers(capture, work / "db"), true)
    except InputError as error:
        bad = [str(f) for f in error.faults if not (f.cure and str(f).isprintable())] if error.faults else ["no fault"]
        return ("refused without a cure", bad[0]) if bad else ("refused", str(error.faults[0]))
    return ("changed numbers", said) if said else ("same numbers", "")


def run(cases: range, seed: int, folder: Path, limits: apart.Limits) -> list[apart.Case]:
    """Damage, ingest and judge every case."""
    whole, true = variants(folder), {}
    for name, capture in whole.items():
        work = folder / f"true-{name}"
        work.mkdir()
        apart.in_a_process(lambda c=capture, w=work: np.savez(w / "numbers.npz", **numbers(c, w / "db")))
        true[name] = dict(np.load(work / "numbers.npz"))

    def prepare(number: int, work: Path):
        rng = np.random.default_rng([seed, number])
        name = list(whole)[rng.integers(len(whole))]
        capture = Path(shutil.copytree(whole[name], work / "capture"))
        return name, damage(capture, rng), partial(attempt, capture, work, true[name])

    return apart.run(cases, prepare, folder, limits)


if __name__ == "__main__":
    apart.program(__doc__, run, OUTCOMES, BAD)
