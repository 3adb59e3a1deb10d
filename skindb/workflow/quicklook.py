"""From a folder of pictures to maps and a page, without a database."""

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from xarray import DataTree

from skindb.errors import InputError, require
from skindb.files import Json, make_private, private_file, private_umask
from skindb.fit.plan import RELATIVE
from skindb.format.fields import read_json
from skindb.geometry.camera import project
from skindb.ingest.pictures import import_images
from skindb.jit import reported_compilation
from skindb.optics.fresnel import fresnel_transmittance
from skindb.parameters import FitParameters, QuickParameters
from skindb.render.image import write_exr, write_png
from skindb.schema import FitStatus
from skindb.store.database import Database
from skindb.store.lease import has_ended, this_process
from skindb.types import Array, Float64, Progress, silent
from skindb.workflow.captures import ingest_take
from skindb.workflow.fit import fit_take
from skindb.workflow.pictures import view_takes

PREFIX = "skindb-quick-"  # of temporary folders
PROCESS = "process.json"
# sRGB of the brightest hundredth of the albedo, which is relative
BRIGHT = 0.9
PAGE = "page.html"
NO_SESSION = "1970-01-01T00:00:00+00:00"  # nothing of it is stored
MAPS = ("normals", "albedo", "gloss")


def quick(
    source: str | Path,
    out: str | Path,
    *,
    progress: Progress = silent,
    compiling: Callable[[], None] | None = None,
    **parameters: Any,
) -> Json:
    """Maps of normals, albedo and gloss, and a page to turn and light them, from pictures
    of one camera.

    Parameters
    ----------
    source, progress
        As in `skindb.ingest.import_images`.
    out
        Folder to write: normals, albedo and gloss as .png and .exr, and page.html.
        Normals are in the frame of the picture: x to the right, y up, z to the camera.
        Albedo is the fraction of light along the normal that is reflected in total,
        gloss the part of the surface; both are relative.
        It must not hold these files.
    compiling
        Called before each kernel that is compiled, which takes minutes in the first call.
    **parameters
        Of `skindb.parameters.QuickParameters`: eta, points, and those of `import_images`.

    Returns
    -------
    dict
        `files`; `notes` on what was assumed and what is missing; numbers of `points` by
        fit_status; `normal_error`, the median stated error [degree].

    Raises
    ------
    InputError
        As in `import_images`, or if no pixel could be fitted.
    """
    out = Path(out)
    names = [PAGE, *(f"{name}.{kind}" for name in MAPS for kind in ("png", "exr"))]
    present = [name for name in names if (out / name).exists()]
    require(
        not present,
        str(out),
        "results are not replaced",
        ", ".join(present),
        "name another folder, or remove them",
    )
    require(
        out.resolve() != Path(source).resolve(),
        str(out),
        "results must not be among the pictures",
        "the folder of the pictures",
        "name another folder",
    )
    place = next(one for one in (out, *out.absolute().parents) if one.exists())
    require(
        place.is_dir() and os.access(place, os.W_OK | os.X_OK),
        str(out),
        "must be a folder that can be written",
        f"{place}, which is a file or cannot be written",
        "name another folder",
    )
    known = asdict(QuickParameters(**parameters))
    fit = FitParameters(eta=known.pop("eta"))
    points = known.pop("points")
    consent = {"scope": ["fit", "export"], "reference": "quick, nothing is stored"}
    # folders of killed runs, with their copies of photographs
    for left in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        holder = read_json(left / PROCESS, [])
        if isinstance(holder, dict) and has_ended(holder):
            shutil.rmtree(left, ignore_errors=True)
    with (
        private_umask(),
        tempfile.TemporaryDirectory(prefix=PREFIX) as folder,
        _naming(source, folder),
        reported_compilation(compiling) if compiling else nullcontext(),
    ):
        # which a killed run leaves
        private_file(Path(folder) / PROCESS).write_text(json.dumps(this_process()))
        capture = Path(folder) / "capture"
        imported = import_images(
            source,
            capture,
            {"subject": "pictures", "session": NO_SESSION, "consent": consent},
            progress=progress,
            **known,
        )
        (camera,) = read_json(capture / "dome/dome.json", [])["cameras"]
        pixel = camera["t"][2] / camera["K"][0][0]
        area = camera["width"] * camera["height"]
        step = max(int(np.ceil(np.sqrt(area / points))), 1)
        db = Database(Path(folder) / "db")
        record = ingest_take(db, capture, spacing_mm=step * pixel, progress=progress)
        fit_take(db, record.take, fit, progress=progress)
        make_private(out)
        view_takes(db, [record.take], out / PAGE, progress=progress)
        model = db.read("model", record.take)
        result = _write_maps(model, out, step)
    notes = [*imported.notes, *record.provenance["summary"]["notes"], RELATIVE]
    if step > 1:
        notes.append(
            f"maps have a pixel for {step} x {step} of the pictures; --points makes them finer"
        )
    return {"files": [str(out / name) for name in names], "notes": notes} | result


@contextmanager
def _naming(source: str | Path, folder: str) -> Iterator[None]:
    """Context whose faults in the temporary folder are those of the source."""
    try:
        yield
    except InputError as error:
        raise InputError(
            replace(fault, where=str(source))
            if fault.where.startswith(folder)
            else fault
            for fault in error.faults
        ) from None


def _write_maps(model: DataTree, out: Path, step: int) -> Json:
    """Write the maps on the grid of the points, and describe them."""
    fitted = model["fitted"].dataset.load()
    dome = model["dome"].dataset
    lens = [
        dome[f"camera_{name}"].values[0].astype(np.float64)
        for name in ("matrix", "rotation", "translation", "distortion")
    ]
    pixel = project(fitted["surfel_position"].values.astype(np.float64), *lens)[0]
    column, row = np.floor(pixel / step).astype(int).T
    width, height = (int(x) // step for x in dome["camera_size"].values[0])
    at = np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)

    def grid(values: Array) -> Float64:
        out = np.full((height, width, values.shape[-1]), np.nan)
        out[at] = values
        return out

    normal = grid(fitted["shading_normal"].values @ lens[1].T * [1, -1, -1])
    gloss = grid(fitted["surface_reflectance"].values[:, None])
    # one camera determines the sum better than its parts: wide lobes look like R_d
    passed = _transmitted(float(fitted["refractive_index"]))
    albedo = passed * grid(fitted["diffuse_reflectance"].values) + gloss
    pictures = {
        "normals": (normal, (normal + 1) / 2),
        "albedo": (albedo, _shown(albedo)),
        "gloss": (gloss, np.repeat(_shown(gloss), 3, axis=2)),
    }
    for name, (values, shown) in pictures.items():
        write_exr(out / f"{name}.exr", values.astype(np.float32))
        alpha = np.isfinite(shown).all(axis=-1, keepdims=True)
        filled = np.where(alpha, np.clip(shown, 0, 1), 0)
        rgba = np.concatenate([filled, alpha], axis=-1)
        write_png(out / f"{name}.png", np.rint(255 * rgba).astype(np.uint8))
    status = fitted["fit_status"].values
    error = fitted["normal_total_error"].values
    return {
        "points": {
            x.name.lower(): int((status == x).sum())
            for x in FitStatus
            if (status == x).any()
        },
        "normal_error": float(np.nanmedian(error)) if error.size else None,
    }


def _transmitted(eta: float) -> float:
    """Fraction of the diffuse light along the normal that passes the boundary twice."""
    cosine = (np.arange(200) + 0.5) / 200
    leaves = 2 * np.mean(fresnel_transmittance(cosine, eta) * cosine)
    return float(fresnel_transmittance(np.ones(1), eta)[0] * leaves)


def _shown(values: Float64) -> Float64:
    """Values of a display: a square root, so that the brightest hundredth is bright."""
    finite = values[np.isfinite(values)]
    bright = float(np.quantile(finite, 0.99)) if finite.size else 1.0
    return np.sqrt(np.maximum(values, 0) / max(bright, 1e-9)) * BRIGHT
