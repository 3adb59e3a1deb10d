"""Ingest damaged capture folders by the command line, each in its own process, within
limits of time and memory.

    python tests/destructive/fuzz_capture.py --cases 1000 --seed 0 python
    tests/destructive/fuzz_capture.py --cases 1000 --seed 0 --capture FOLDER --capture
    ANOTHER --tiff

An ingest must end with exit code 1 and lines that each name a place, a rule, what was
found and a cure, or with 0 and numbers. Tracebacks, hangs, gigabytes of memory and
messages of libraries are failures: the program then ends with 1.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]

import apart
import numpy as np
from mutations import damage
from sphere import BLACK, SECONDS, WHITE, write_capture

import skindb
import skindb.cli
import skindb.ingest.capture
from skindb.format.frames import read_frame, write_frame
from skindb.ingest import sample_lines

COMPARED = {
    "samples": ("reflectance_sample", "sample_count"),
    "surfels": ("surfel_position", "region_mask"),
    "mesh": ("landmark_position",),
    "dome": ("light_intensity",),
    "probe": ("fibre_profile", "site_position", "fibre_distance"),
}
BAD = ("refused without a cure", "another exit code")
LINE = re.compile(r"skindb: (.+: .+; found .+; .+|and \d+ more: .+ \(-v lists them\))")
LIBRARY = re.compile(
    r"Traceback|-packages|\.py\b|[a-z]Error\b|Warning\b|EXR_ERR|internal error|0x[0-9a-f]{6}|"
    r"numpy|tifffile|imagecodecs|trimesh"
)
ENDS = (
    "refused",
    "same numbers",
    "changed by at most 1 %",
    "changed and reported",
    "changed numbers",
)
OUTCOMES = (*ENDS, *BAD, *apart.FAILURES)
MAX_DIFFERENCE = 0.01  # relative to the median size of a quantity
# numbers of the undamaged capture, and the lines that ingest prints
Truth = tuple[dict[str, np.ndarray], list[str]]


def variants(folder: Path) -> dict[str, Path]:
    """Undamaged captures: PNG and a binary PLY; TIFF and an OBJ scan; OpenEXR and a PLY of text."""
    out = {name: folder / name for name in ("png", "tif", "exr")}
    write_capture(out["png"])
    values = np.linspace(BLACK, WHITE, 9)
    rows = [
        f"{v},{e},{e},{e}" for v, e in zip(values, np.linspace(0, 1, 9), strict=True)
    ]
    (out["png"] / "dome/r.csv").write_text("\n".join(["dn,r,g,b", *rows]))
    _edit(
        out["png"] / "dome/dome.json",
        lambda dome: dome["cameras"][0].update(response="dome/r.csv"),
    )
    for name in ("tif", "exr"):
        shutil.copytree(out["png"], out[name])
        _edit(
            out[name] / "dome/dome.json",
            lambda dome: dome["cameras"][0].pop("response"),
        )
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
            radiance = (
                (read_frame(path).astype(np.float32) - BLACK)
                / (WHITE - BLACK)
                / SECONDS[longest]
            )
            write_frame(path.with_suffix(".exr"), radiance)
        path.unlink()
    path = folder / "dome/dome.json"
    path.write_text(path.read_text().replace(".png", ".exr"))
    _edit(path, lambda dome: dome.update(exposures=[{"id": longest, "seconds": 1.0}]))


def numbers(place: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """The numbers that an ingest has stored in a database, and the lines that it has printed."""
    db = skindb.open(place)
    (take,) = db.takes("capture")
    record = db.record("capture", take)
    tree = db.read("capture", record.take)
    made = record.provenance
    said = [*made["summary"].get("notes", []), *made["skipped"], *made["unknown_keys"]]
    said += (
        sample_lines(made["summary"]["samples"])[1:]
        if "samples" in made["summary"]
        else []
    )
    said += [f"{kind}: {count}" for kind, count in made["cleaning"].items()]
    stored = {
        name: tree[group][name].values
        for group, names in COMPARED.items()
        if group in tree
        for name in names
        if name in tree[group]
    }
    return stored, said


def ingest(capture: Path, work: Path) -> tuple[int, str, str]:
    """Exit code of `skindb ingest` into a new database, and what it prints to standard
    output and standard error.
    """
    options = ["--spacing", "8", "--photographs", "1", "--progress", "none"]
    sys.argv = ["skindb", "ingest", str(work / "db"), str(capture), *options]
    code: object = 0
    with _printed_to(work / "out", 1), _printed_to(work / "err", 2):
        try:
            skindb.cli.main()
        except SystemExit as end:
            code = end.code
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout = sys.__stdout__
        sys.stderr = sys.__stderr__
    return (
        int(str(code or 0)),
        (work / "out").read_text(errors="replace"),
        (work / "err").read_text(errors="replace"),
    )


@contextmanager
def _printed_to(path: Path, number: int) -> Iterator[None]:
    """Context in which a descriptor leads to a file, also for libraries that print
    without Python.
    """
    kept = os.dup(number)
    file = os.open(path, os.O_WRONLY | os.O_CREAT)
    os.dup2(file, number)
    os.close(file)
    try:
        yield
    finally:
        os.dup2(kept, number)
        os.close(kept)


def difference(
    found: dict[str, np.ndarray], true: dict[str, np.ndarray]
) -> tuple[float, str]:
    """Largest difference relative to the median size of its quantity, and its name;
    empty if all are equal.
    """
    said = [f"{name} missing" for name in true if name not in found]
    worst = np.inf if said else 0.0
    for name, value in found.items():
        if name not in true or value.shape != true[name].shape:
            said.append(
                f"{name} of shape {value.shape}, not "
                f"{true[name].shape if name in true else 'there'}"
            )
            worst = np.inf
        elif not np.array_equal(value, true[name], equal_nan=value.dtype.kind == "f"):
            a = value.astype(np.float64)
            b = true[name].astype(np.float64)
            known = np.isfinite(a) & np.isfinite(b)
            size = max(float(np.nanmedian(np.abs(b))), 1e-30)
            off = float(np.abs(a - b)[known].max() / size) if known.any() else 0.0
            part = float(((a != b) & known).mean())
            lost = int((np.isfinite(a) != np.isfinite(b)).sum())
            worst = np.inf if lost else max(worst, off)
            said.append(f"{name} by {off:.2g} in {part:.1%}, {lost} lost or new")
    return worst, "; ".join(said)


def attempt(capture: Path, work: Path, true: Truth) -> apart.Outcome:
    """Ingest the folder and compare what is stored."""
    code, out, err = ingest(capture, work)
    if found := LIBRARY.search((out + err).replace(str(work), "")):
        return "message of a library", f"{found.group()}: {out + err}"
    lines = err.splitlines()
    if code == 1:
        bad = (
            [
                line
                for line in lines
                if not LINE.fullmatch(line) or not line.isprintable()
            ]
            if lines
            else ["no line"]
        )
        return ("refused without a cure", bad[0]) if bad else ("refused", lines[0])
    if code != 0 or not all(re.fullmatch(r"\w+: warning: .+", line) for line in lines):
        return "another exit code", f"{code}: {err}"
    stored, notes = numbers(work / "db")
    (off, how), told = difference(stored, true[0]), sorted({*notes} - {*true[1]})
    if not how:
        return "same numbers", ""
    if off <= MAX_DIFFERENCE:
        return "changed by at most 1 %", how
    return (
        ("changed and reported", f"{how}; reported: {told[0]}")
        if told
        else ("changed numbers", how)
    )


def given(captures: list[Path], folder: Path, *, tiff: bool) -> dict[str, Path]:
    """Captures by name; with `tiff` also copies whose PNG frames were converted."""
    out = {capture.name: capture for capture in captures}
    for name, capture in [*out.items()] if tiff else []:
        if any(capture.rglob("dome/frames/**/*.png")):
            out[f"{name}-tiff"] = Path(
                shutil.copytree(capture, folder / f"{name}-tiff")
            )
            _as_tiff(out[f"{name}-tiff"])
    return out


def run(
    cases: range,
    seed: int,
    folder: Path,
    limits: apart.Limits,
    *,
    capture: list[Path] | None,
    tiff: bool,
) -> list[apart.Case]:
    """Damage, ingest and judge every case, each with one of the undamaged captures."""
    whole = given(capture, folder, tiff=tiff) if capture else variants(folder)
    true: dict[str, Truth] = {}
    for name, place in whole.items():
        work = folder / f"true-{name}"
        work.mkdir()
        apart.in_a_process(partial(_keep, place, work))
        true[name] = (
            dict(np.load(work / "numbers.npz")),
            json.loads((work / "said").read_text()),
        )

    def prepare(number: int, work: Path):
        rng = np.random.default_rng([seed, number])
        name = list(whole)[rng.integers(len(whole))]
        damaged = Path(shutil.copytree(whole[name], work / "capture"))
        return name, damage(damaged, rng), partial(attempt, damaged, work, true[name])

    return apart.run(cases, prepare, folder, limits)


def _keep(capture: Path, work: Path) -> None:
    code, _, err = ingest(capture, work)
    if code:
        raise RuntimeError(err)
    stored, said = numbers(work / "db")
    np.savez(work / "numbers.npz", **stored)
    (work / "said").write_text(json.dumps(said))


if __name__ == "__main__":
    damaged = {
        "type": Path,
        "action": "append",
        "help": "Capture to damage copies of; several allowed.",
    }
    tiff = {
        "action": "store_true",
        "help": "Damage copies with TIFF frames of these captures as well.",
    }
    apart.program(
        __doc__, run, OUTCOMES, BAD, options={"--capture": damaged, "--tiff": tiff}
    )
