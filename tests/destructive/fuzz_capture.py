"""Damaged capture folders: each is ingested by a process of its own, within limits of time and memory.

    python tests/destructive/fuzz_capture.py --cases 1000 --seed 0
    python tests/destructive/fuzz_capture.py --cases 1000 --seed 0 --capture FOLDER --capture ANOTHER --tiff

An ingest must end in lines that each have a cure, or in numbers. Tracebacks, hangs, gigabytes of memory and messages
of libraries are failures, and the program then ends with 1.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1] / "ingest"), str(Path(__file__).parent)]

import numpy as np
from mutations import damage
from sphere import BLACK, SECONDS, WHITE, write_capture

import skindb
import skindb.ingest.run
from skindb.errors import InputError
from skindb.ingest import sample_lines
from skindb.ingest.frames import read_frame, write_frame
from skindb.workflow.ingest import ingest_take

TIME_LIMIT_S, ADDRESS_LIMIT_BYTES, RESIDENT_LIMIT_KB = 20.0, 3 << 30, 1_500_000
COMPARED = {
    "samples": ("reflectance_sample", "sample_count"),
    "surfels": ("surfel_position", "region_mask"),
    "mesh": ("landmark_position",),
    "dome": ("light_intensity",),
    "probe": ("fibre_profile", "site_position", "fibre_distance"),
}
FAILURES = ("refused without a cure", "message of a library", "traceback", "hang", "memory")
ENDS = ("refused", "same numbers", "changed by at most 1 %", "changed and reported", "changed numbers")
OUTCOMES = (*ENDS, *FAILURES)
MAX_DIFFERENCE = 0.01  # relative to the median size of a quantity
Truth = tuple[dict[str, np.ndarray], list[str]]  # numbers of the whole capture, and what is said of it


@dataclass(frozen=True)
class Case:
    """One damaged folder and what became of it."""

    number: int
    variant: str
    damage: str
    outcome: str
    detail: str


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


def numbers(capture: Path, place: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """What an ingest of the folder stores, and what it says of it."""
    db = skindb.open(place)
    record = ingest_take(db, capture, spacing_mm=8.0, photographs=1)
    tree, made = db.read("capture", record.take), record.provenance
    said = [*made["summary"].get("notes", []), *made["skipped"], *made["unknown_keys"]]
    said += sample_lines(made["summary"]["samples"])[1:] if "samples" in made["summary"] else []
    said += [f"{kind}: {count}" for kind, count in made["cleaning"].items()]
    stored = {
        name: tree[group][name].values
        for group, names in COMPARED.items()
        if group in tree
        for name in names
        if name in tree[group]
    }
    return stored, said


def difference(found: dict[str, np.ndarray], true: dict[str, np.ndarray]) -> tuple[float, str]:
    """Largest difference relative to the median size of its quantity, and what differs; nothing if all is the same."""
    said = [f"{name} missing" for name in true if name not in found]
    worst = np.inf if said else 0.0
    for name, value in found.items():
        if name not in true or value.shape != true[name].shape:
            said.append(f"{name} of shape {value.shape}, not {true[name].shape if name in true else 'there'}")
            worst = np.inf
        elif not np.array_equal(value, true[name], equal_nan=value.dtype.kind == "f"):
            a, b = value.astype(np.float64), true[name].astype(np.float64)
            known = np.isfinite(a) & np.isfinite(b)
            size = max(float(np.nanmedian(np.abs(b))), 1e-30)
            off = float(np.abs(a - b)[known].max() / size) if known.any() else 0.0
            part = float(((a != b) & known).mean())
            lost = int((np.isfinite(a) != np.isfinite(b)).sum())
            worst = np.inf if lost else max(worst, off)
            said.append(f"{name} by {off:.2g} in {part:.1%}, {lost} lost or new")
    return worst, "; ".join(said)


def attempt(capture: Path, work: Path, true: Truth) -> None:
    """Ingest in this process, and write outcome and detail beside it."""
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_LIMIT_BYTES, ADDRESS_LIMIT_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        found, notes = numbers(capture, work / "db")
        (off, how), told = difference(found, true[0]), sorted({*notes} - {*true[1]})
        if not how:
            outcome = ("same numbers", "")
        elif off <= MAX_DIFFERENCE:
            outcome = ("changed by at most 1 %", how)
        else:
            outcome = ("changed and reported", f"{how}; told: {told[0]}") if told else ("changed numbers", how)
    except InputError as error:
        bad = [str(f) for f in error.faults if not (f.cure and str(f).isprintable())] if error.faults else ["no fault"]
        outcome = ("refused without a cure", bad[0]) if bad else ("refused", str(error.faults[0]))
    except MemoryError:
        outcome = ("memory", traceback.format_exc())
    except Exception:
        outcome = ("traceback", traceback.format_exc())
    (work / "outcome").write_text(json.dumps(outcome))


def start(capture: Path, work: Path, true: Truth) -> int:
    """Process that attempts it."""
    process = os.fork()
    if process:
        return process
    try:
        os.setsid()
        target = os.open(work / "output", os.O_WRONLY | os.O_CREAT)
        os.dup2(target, 1)
        os.dup2(target, 2)
        attempt(capture, work, true)
    finally:
        os._exit(0)


def judged(work: Path, status: int, usage: resource.struct_rusage, *, late: bool) -> tuple[str, str]:
    """Outcome and detail of a process that ended."""
    if late:
        return "hang", f"ended after {usage.ru_utime + usage.ru_stime:.1f} s of CPU time"
    peak_kb = usage.ru_maxrss
    if not (work / "outcome").exists():
        return "traceback", f"the process died with status {status}: {_output(work)[-300:]}"
    outcome, detail = json.loads((work / "outcome").read_text())
    if outcome in ENDS and peak_kb > RESIDENT_LIMIT_KB:
        return "memory", f"{peak_kb / 1e6:.1f} GB; {detail}"
    if outcome in ENDS and (said := _output(work).strip()):
        return "message of a library", said[-500:]
    return outcome, detail


def _output(work: Path) -> str:
    """What was printed, but for the lines of OpenEXR about damaged pixels: it has no setting to keep them back."""
    text = (work / "output").read_text(errors="replace") if (work / "output").exists() else ""
    known = ("(EXR_ERR_", "Warning: Exception raised reading pixel data")
    return "\n".join(line for line in text.splitlines() if not any(mark in line for mark in known))


def given(captures: list[Path], folder: Path, *, tiff: bool) -> dict[str, Path]:
    """Captures by name; with `tiff` also copies whose PNG frames were converted."""
    out = {capture.name: capture for capture in captures}
    for name, capture in [*out.items()] if tiff else []:
        if any(capture.rglob("dome/frames/**/*.png")):
            out[f"{name}-tiff"] = Path(shutil.copytree(capture, folder / f"{name}-tiff"))
            _as_tiff(out[f"{name}-tiff"])
    return out


def run(
    cases: range, seed: int, folder: Path, whole: dict[str, Path], *, jobs: int = 2, limit: float = TIME_LIMIT_S
) -> list[Case]:
    """Damage, ingest and judge every case, of one of the whole captures each; each may take `limit` seconds."""
    true = {}
    for name, capture in whole.items():
        work = folder / f"true-{name}"
        work.mkdir()
        process = os.fork()  # threads of compiled code must not be forked
        if not process:
            stored, said = numbers(capture, work / "db")
            np.savez(work / "numbers.npz", **stored)
            (work / "said").write_text(json.dumps(said))
            os._exit(0)
        if os.waitpid(process, 0)[1]:
            raise RuntimeError(f"the whole capture {name} does not pass")
        true[name] = dict(np.load(work / "numbers.npz")), json.loads((work / "said").read_text())
    waiting, running, done = list(cases), {}, []
    while waiting or running:
        while waiting and len(running) < jobs:
            number = waiting.pop(0)
            rng = np.random.default_rng([seed, number])
            name = list(whole)[rng.integers(len(whole))]
            work = folder / f"case-{number}"
            work.mkdir()
            capture = Path(shutil.copytree(whole[name], work / "capture"))
            what = damage(capture, rng)
            running[start(capture, work, true[name])] = (number, name, what, work, time.monotonic())
        for process, (number, name, what, work, began) in list(running.items()):
            ended, status, usage = os.wait4(process, os.WNOHANG)
            late = not ended and time.monotonic() - began > limit
            if late:
                os.kill(process, signal.SIGKILL)
                ended, status, usage = os.wait4(process, 0)
            if ended:
                del running[process]
                done.append(Case(number, name, what, *judged(work, status, usage, late=late)))
                shutil.rmtree(work)
        time.sleep(0.01)
    return sorted(done, key=lambda case: case.number)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cases", type=int, default=1000, help="Number of damaged folders.")
    parser.add_argument("--first", type=int, default=0, help="Number of the first case, to repeat one.")
    parser.add_argument("--seed", type=int, default=0, help="Seed of the damage.")
    parser.add_argument("--jobs", type=int, default=2, help="Number of processes at a time.")
    parser.add_argument("--capture", type=Path, action="append", help="Capture to damage copies of; several allowed.")
    parser.add_argument("--tiff", action="store_true", help="Damage copies with TIFF frames of these captures as well.")
    parser.add_argument(
        "--seconds", type=float, default=TIME_LIMIT_S, help="Time limit of a case [s]; longer on busy cores."
    )
    parser.add_argument("--changed", action="store_true", help="List the cases whose numbers changed.")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        whole = given(asked.capture, place, tiff=asked.tiff) if asked.capture else variants(place)
        cases = run(
            range(asked.first, asked.first + asked.cases),
            asked.seed,
            place,
            whole,
            jobs=asked.jobs,
            limit=asked.seconds,
        )
    count = Counter(case.outcome for case in cases)
    for outcome in OUTCOMES:
        print(f"{outcome:<24} {count[outcome]:>6}")
    listed = FAILURES + (ENDS[3:] if asked.changed else ())
    for case in cases:
        if case.outcome in listed or asked.cases == 1:
            print(f"\ncase {case.number} ({case.variant}): {case.damage}\n{case.outcome}: {case.detail}")
    sys.exit(any(count[outcome] for outcome in FAILURES))


if __name__ == "__main__":
    main()
