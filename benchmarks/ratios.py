"""Times of skindb beside those of peers that do the same work, in one run.

    python -m benchmarks ratios [--only ROW...] [--json ratios.json] [--page docs/performance.md]
    python -m benchmarks ratios --quick

Every row measures skindb and its peer one after the other on this machine, so that
their ratio is meaningful although absolute times vary. `--page` replaces the table
between the marks of a page by the rows with an aim, without the stages of ingest;
`--quick` takes 30 s of CPU time. The first run also compiles.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import numpy as np

import skindb
from benchmarks import ingest
from benchmarks.curve import cpu_time
from benchmarks.curves_internal import p_values_of_scipy
from benchmarks.curves_surface import refit_curves, surface_curves
from benchmarks.reads import measure
from benchmarks.rendering import difference, sky
from benchmarks.study_cost import grow
from skindb.calibration.radiance import frame_mergers, read_view
from skindb.format.folder import read_capture
from skindb.numerics.inference import permutation_p
from skindb.parameters import SimulationParameters
from skindb.render.image import write_exr
from skindb.render.monte_carlo import Quality, render_monte_carlo
from skindb.render.rendering import chosen_camera
from skindb.render.scene import Lighting, from_model
from skindb.virtual.capture import simulate_takes
from skindb.workflow import ingest_take, register_takes, study
from skindb.workflow.derive import groups_of

START = "<!-- ratios: made by python -m benchmarks ratios --page -->"
END = "<!-- end of ratios -->"
SAMPLING = "decoding, merging, sampling and refinement"
TAKES = 8
STUDY_TAKES = 16
SURFELS = 1_000_000
FRAMES = {
    "small": {"cameras": 6, "lights": 32, "width": 325, "height": 258},
    "full-size": {"cameras": 4, "lights": 16, "width": 1300, "height": 1030},
}
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Row:
    """A figure of skindb, that of its peer, and the aim for it."""

    work: str
    figure: float
    unit: str
    peer: str = ""
    peer_figure: float | None = None
    aim: str = ""


@dataclass(frozen=True)
class Bench:
    """Folder of a run, with captures and a database of small takes; captures of `frames` are
    ingested.
    """

    folder: Path
    frames: dict[str, dict[str, int]]

    def captures(self, name: str, takes: int, **parameters: int) -> list[Path]:
        """Virtual captures; simulated by the first call."""
        out = self.folder / name
        if out.exists():
            return sorted(path for path in out.iterdir() if path.is_dir())
        return simulate_takes(out, SimulationParameters(**parameters), takes=takes)

    def ingested(self) -> Path:
        """A database of takes that are not fitted."""
        path = self.folder / "captures-only"
        if not path.exists():
            size = {"cameras": 4, "lights": 16, "width": 120, "height": 150}
            db = skindb.open(path, create=True)
            for capture in self.captures("takes", TAKES, **size):
                ingest_take(db, capture, spacing_mm=4.0)
        return path

    def database(self) -> Path:
        """A database of fitted takes."""
        path = self.folder / "db"
        if not path.exists():
            shutil.copytree(self.ingested(), path)
            program("fit", str(path))
        return path


def spent(*command: str, **environment: str) -> tuple[float, float]:
    """Wall and CPU time [s] of a command that succeeds."""
    start = time.perf_counter()
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    surroundings = os.environ | environment
    subprocess.run(command, env=surroundings, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - start, cpu


def program(*arguments: str, **environment: str) -> tuple[float, float]:
    """Wall and CPU time [s] of a `skindb` command."""
    return spent(
        str(Path(sys.executable).with_name("skindb")), *arguments, **environment
    )


def compiling(bench: Bench) -> list[Row]:
    """Ingest and fit with and without compiled kernels on disk."""
    [capture] = bench.captures("first", 1, cameras=4, lights=16, width=120, height=150)
    times = []
    for name in ("new", "warm"):
        db = str(bench.folder / f"first-{name}")
        cache = {"NUMBA_CACHE_DIR": str(bench.folder / "kernels")}
        runs = [
            program("ingest", db, str(capture), **cache),
            program("fit", db, **cache),
        ]
        times.append(np.sum(runs, axis=0))
    (wall, cpu), (warm_wall, warm_cpu) = times
    work = "first ingest and fit after an installation"
    peer = "the same again"
    return [
        Row(f"{work}, wall time", wall - warm_wall, "s more", peer, warm_wall, "20 s"),
        Row(f"{work}, CPU time", cpu - warm_cpu, "s more", peer, warm_cpu, ""),
    ]


def reading(bench: Bench) -> list[Row]:
    """Samples of a capture of 150 lights and 16 cameras in the page cache, read by one thread."""
    size = {"cameras": 16, "lights": 150, "width": 60, "height": 72}
    [capture] = bench.captures("dome", 1, **size)
    path = bench.folder / "dome-db"
    record = ingest_take(skindb.open(path, create=True), capture, spacing_mm=2.0)
    _, results = measure(str(path), record.take)
    _, speed = results["the store, with digests"]
    _, peer_speed = results["decompression alone"]
    peer = "decompression alone"
    return [Row("reading samples", speed, "MB/s", peer, peer_speed, "1,000 MB/s")]


def merged(folder: Path, out: Path) -> Path:
    """The capture with merged half-float OpenEXR frames instead of exposures."""
    record = json.loads((folder / "dome/dome.json").read_text())
    dome = read_capture(folder).dome
    assert dome is not None
    mergers = frame_mergers(dome, [])
    shutil.copytree(folder, out, ignore=shutil.ignore_patterns("e0", "e1", "dark"))
    template = "{}/{{light}}_{{camera}}.exr"
    for white, name in ((False, "face"), (True, "target")):
        (out / name).mkdir()
        path = template.format(name)
        cameras = record["white"]["cameras"] if white else mergers
        for camera in (mergers[name].camera for name in cameras):
            for light in dome.lights:
                frames = read_view(dome, light.id, camera, white=white)
                radiance, _ = mergers[camera.id].merge(frames)
                file = out / path.format(light=light.id, camera=camera.id)
                write_exr(file, radiance.astype(np.float16))
        if white:
            record["white"]["frames"] = path
        else:
            record["frames"] = path
    del record["dark"], record["sequence"]
    record["exposures"] = [{"id": "merged", "seconds": 1.0}]
    geometry = ("id", "width", "height", "K", "R", "t", "distortion")
    record["cameras"] = [
        {key: camera[key] for key in geometry} | {"bit_depth": 0}
        for camera in record["cameras"]
    ]
    (out / "dome/dome.json").write_text(json.dumps(record))
    return out


def ingesting(bench: Bench) -> list[Row]:
    """Ingest of small and large frames, over decoding them once."""
    rows = []
    for name, size in bench.frames.items():
        [folder] = bench.captures(name, 1, **size)
        exr = merged(folder, bench.folder / f"{name}-exr")
        for capture, kind in ((folder, "PNG"), (exr, "OpenEXR")):
            result = ingest.measure(capture, stride=1)
            for stages, decoded, text in (
                (["all"], "all", "ingest"),
                (["sample", "refine"], "frames", SAMPLING),
            ):
                seconds = sum(result["stages"][stage]["cpu"] for stage in stages)
                peer = result["decoding"][decoded]
                work = f"{text}, {peer['frames']:.0f} {name} {kind} frames, CPU time"
                rows.append(
                    Row(work, seconds, "s", "decoding alone", peer["cpu"], "1.4 x")
                )
    return rows


def fitting(bench: Bench) -> list[Row]:  # noqa: ARG001
    """Surface fits of one surfel under 150 lights in 16 cameras, by CPU time."""

    def microseconds(curve: Any, start: str) -> float:
        [point] = [p for p in curve.points if p.name.startswith(start)]
        return 1e6 * point.seconds

    full = surface_curves(quick=True)[0]
    few = refit_curves(quick=True)[0]
    scipy = "SciPy nnls, precomputed rows, three channels"
    linear = microseconds(full, "skindb linear, rank 16")
    return [
        Row(
            "59-basis fit, linear, rank 16",
            linear,
            "us",
            "SciPy nnls, ready rows",
            microseconds(full, scipy),
            "45 us",
        ),
        Row(
            "refit by 4 components, linear",
            microseconds(few, "skindb linear"),
            "us",
            "the 59-basis fit",
            linear,
            "40 us",
        ),
        Row(
            "refit by 4 components with errors, linear",
            microseconds(few, "skindb with errors"),
            "us",
            "the 59-basis fit",
            linear,
            "60 us",
        ),
    ]


def starting(bench: Bench) -> list[Row]:
    """Commands that read metadata, by the best of three wall times."""
    db = str(bench.database())
    imports = (sys.executable, "-c", "import xarray, dask")
    peer = min(spent(*imports)[0] for _ in range(3))
    rows = []
    for arguments, aim in ((("info", db), "0.7 s"), (("--help",), "0.25 s")):
        wall = min(program(*arguments)[0] for _ in range(3))
        work = f"skindb {arguments[0]}" + (f", {TAKES} takes" * (len(arguments) > 1))
        rows.append(Row(work, wall, "s", "Python, xarray, dask", peer, aim))
    return rows


def workers(bench: Bench) -> list[Row]:
    """Fits of small takes by one and by two processes, each with one thread."""
    walls = []
    for count in ("1", "2"):
        db = bench.folder / f"workers-{count}"
        shutil.copytree(bench.ingested(), db)
        arguments = ("fit", str(db), "--workers", count, "--no-progress")
        walls.append(program(*arguments, **ONE_THREAD)[0])
    work = f"{TAKES} small takes, two workers"
    return [Row(work, walls[1], "s", "one worker", walls[0], "0.54 x")]


def permuting(bench: Bench) -> list[Row]:  # noqa: ARG001
    """P values of 30 quantities of 87 subjects by 2,000 permutations."""
    rng = np.random.default_rng(0)
    group = (np.arange(87) % 4 == 0).astype(float)
    values = rng.standard_normal((87, 30))

    def ours() -> None:
        permutation_p(values, group, max_draws=2000, rng=np.random.default_rng(1))

    def products() -> None:
        orders = np.stack([rng.permutation(group) for _ in range(2000)])
        _ = orders @ values, orders @ values**2

    seconds = [cpu_time(work)[0] for work in (ours, products)]
    theirs, _ = cpu_time(lambda: p_values_of_scipy(values, group, 2000))
    work = "permutations, 30 quantities x 2,000"
    return [
        Row(work, seconds[0], "s", "matrix products", seconds[1], "0.02 s"),
        Row(f"{work}, beside SciPy", seconds[0], "s", "permutation_test", theirs),
    ]


def rendering(bench: Bench) -> list[Row]:
    """Efficiency 1 / (error^2 CPU time) of a picture under sky and sun, 64 rays a pixel."""
    db = skindb.open(bench.database())
    model = db.read("model", db.takes("model")[0])
    surface = from_model(model)
    camera, _ = chosen_camera(model["dome"].to_dataset().load(), None)

    def picture(samples: int, seed: int) -> Any:
        return render_monte_carlo(
            surface,
            camera,
            Lighting(None, sky()),
            Quality(samples=samples),
            rng=np.random.default_rng(seed),
        )

    reference = picture(1024, 9)
    picture(4, 0)
    seconds, few = cpu_time(lambda: picture(64, 1))
    efficiency = 1 / (difference(few, reference) ** 2 * seconds)
    work = f"picture of {camera.width} x {camera.height}, sky and sun, 64 rays"
    return [Row(work, efficiency, "/s of 1 / error^2")]


def storing(bench: Bench) -> list[Row]:
    """Objects of a model of a million surfels."""
    source = skindb.open(bench.database())
    model = source.read("model", source.takes("model")[0]).load()
    groups = groups_of(model)
    index = np.arange(SURFELS) % groups["fitted"].sizes["surfel"]
    groups["fitted"] = groups["fitted"].isel(surfel=index)
    db = skindb.open(bench.folder / "large", create=True)
    with db.stage("model", "A1") as stage:
        stage.write(groups)
        record = stage.commit({"take": "A1"})
    files = sum(path.is_file() for path in (db.root / record.path).rglob("*"))
    peer = "one per 16 MB"
    return [
        Row(
            "objects of a model of 1M surfels",
            files,
            "files",
            peer,
            max(record.bytes / 16e6, 1),
            "100",
        )
    ]


def studying(bench: Bench) -> list[Row]:
    """CPU time of the albedo study and of the maps that it needs."""
    source = skindb.open(bench.database())
    path = bench.folder / "cohort"
    target = skindb.open(path, create=True)
    grow(source, target, STUDY_TAKES, 0)
    register_takes(target)
    study(target, "albedo", takes=target.takes("model")[:2])  # compiles
    _, cpu = program("analyze", str(path), "albedo", "--no-progress")
    work = f"albedo study of {STUDY_TAKES} takes, CPU time"
    return [Row(work, cpu, "s", "a take", STUDY_TAKES, "0.57 s a take")]


ROWS: dict[str, Callable[[Bench], list[Row]]] = {
    "render": rendering,
    "study": studying,
    "workers": workers,
    "start": starting,
    "reading": reading,
    "objects": storing,
    "ingest": ingesting,
    "permutations": permuting,
    "fit": fitting,
    "compiling": compiling,
}


def machine() -> dict[str, str]:
    """The machine and the versions that were measured."""
    info = Path("/proc/cpuinfo")
    names = [platform.processor()]
    if info.exists():
        lines = info.read_text().splitlines()
        names = [line.partition(": ")[2] for line in lines if "model name" in line]
    packages = ("skindb", "numpy", "numba", "zarr", "xarray", "imagecodecs", "OpenEXR")
    return {
        "processor": names[0],
        "cores": str(os.cpu_count()),
        "load": f"{os.getloadavg()[0]:.1f}",
        "python": platform.python_version(),
        "date": time.strftime("%Y-%m-%d"),
    } | {name: version(name) for name in packages}


def table(rows: Sequence[Row]) -> str:
    """The rows as a table of Markdown."""
    lines = ["| work | skindb | peer | ratio | aim |", "|---|---|---|---|---|"]
    for row in rows:
        cells = [row.work, f"{_number(row.figure)} {row.unit}", row.peer, "", row.aim]
        if row.peer_figure:
            cells[2] += f": {_number(row.peer_figure)}"
            cells[3] = f"{row.figure / row.peer_figure:.2f}"
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _number(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def replace_block(page: Path, text: str) -> None:
    """Replace what is between the marks of a page."""
    content = page.read_text(encoding="utf-8")
    before, _, rest = content.partition(START)
    _, _, after = rest.partition(END)
    page.write_text(f"{before}{START}\n\n{text}\n\n{END}{after}", encoding="utf-8")


def main(
    *,
    only: Sequence[str] = (),
    json_: Path | None = None,
    page: Path | None = None,
    work: Annotated[
        Path | None, "Folder for captures and databases, which are kept there."
    ] = None,
    quick: Annotated[bool, "The ingest of small frames alone."] = False,
) -> None:
    """Measure, print and write; with `only`, other rows of the JSON file are kept."""
    rows = dict[str, Row]()
    if only and json_ and json_.exists():
        earlier = json.loads(json_.read_text(encoding="utf-8"))["rows"]
        rows = {row["work"]: Row(**row) for row in earlier}
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(
            work or Path(folder), {"small": FRAMES["small"]} if quick else FRAMES
        )
        for name in only or (["ingest"] if quick else ROWS):
            begin = time.monotonic()
            found = ROWS[name](bench)
            rows |= {row.work: row for row in found}
            seconds = time.monotonic() - begin
            print(f"{table(found)}\n{name}: {seconds:.0f} s", flush=True)
            if json_:
                records = [asdict(row) for row in rows.values()]
                result = {"machine": machine(), "rows": records}
                json_.write_text(json.dumps(result, indent=1), encoding="utf-8")
    text = table([*rows.values()])
    print(f"\n{text}\n{time.monotonic() - start:.0f} s in all")
    if page:
        note = ", ".join(f"{key} {value}" for key, value in machine().items())
        note = textwrap.fill(f"Measured with {note}.", 100)
        shown = [r for r in rows.values() if r.aim and not r.work.startswith(SAMPLING)]
        replace_block(page, f"{table(shown)}\n\n{note}")
