"""`ingest_capture`: a capture folder becomes a version of kind capture."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import dask
import numpy as np
import xarray as xr

from skindb.errors import Fault, InputError
from skindb.geometry.crop import Crop
from skindb.geometry.rays import RayScene
from skindb.ingest.devices import DomeRecord
from skindb.ingest.exposures import exposure_faults
from skindb.ingest.folder import Capture, read_capture
from skindb.ingest.frames import Digests
from skindb.ingest.groups import (
    atlas_group,
    dome_group,
    mesh_group,
    photograph_group,
    probe_group,
    sample_group,
    surfel_group,
)
from skindb.ingest.irradiance import light_intensities
from skindb.ingest.lumitexels import Soft, Views, choose_photographs, fully_lit, sample_lumitexels
from skindb.ingest.probe import fibre_profiles
from skindb.ingest.provenance import capture_provenance, frame_marks, require_fit_consent, samples_digest
from skindb.ingest.radiance import darkrooms
from skindb.ingest.report import describe_samples
from skindb.ingest.spool import Spool
from skindb.ingest.surfels import SurfelSet, build_surfels
from skindb.ingest.visibility import Method, camera_visibility, coarse_maps, light_visibility
from skindb.store import Database, Record

Progress = Callable[[str, int, int], None]
T = TypeVar("T")
STAGE = "stage"  # what the spool keeps the path of the data under
LEAST, MOST = 2, 8  # threads: one reads while the other computes
MEMORY = 4 << 30  # bytes that all of them take together, unless the least take more


def ingest_capture(
    db: Database,
    folder: str | Path,
    *,
    spacing_mm: float = 1.5,
    photographs: int = 4,
    crop: Crop | None = None,
    soft: Soft = "leave_out",
    footprint: bool = False,
    visibility: Method = "rays",
    progress: Progress | None = None,
) -> Record:
    """Turn a capture folder into a committed version; killed at any point, the same call goes on where it was.

    Parameters
    ----------
    db
        Database to write to.
    folder
        Capture folder, format version 1.
    spacing_mm
        Wanted distance of neighbouring surfels; subdivision hits it within a factor of sqrt 2.
    photographs
        How many merged photographs to keep for comparisons.
    crop
        What to keep of the scan: a box, the surroundings of the landmarks; None for all of it.
    soft
        Samples at the soft edges of shadows: left out, or kept and divided by the visible share of the light.
    footprint
        Samples are means over the surfel's splat (elliptical weighted average), else between the nearest pixels.
    visibility
        What a surfel sees is found by rays, or by splats as the paper does.
    progress
        Called with stage, steps done and steps in all.

    Returns
    -------
    Record
        Of the commit.

    Raises
    ------
    InputError
        With every fault of the folder, before anything is visible; also without the consent to fit.
    """
    report = progress or _silent
    _require_outside(db, Path(folder))
    capture = read_capture(folder, crop=crop)
    require_fit_consent(capture)
    report("check", 1, 1)
    surfels = build_surfels(capture, spacing_mm=spacing_mm)
    report("surfels", 1, 1)
    parameters = {
        "spacing_mm": spacing_mm,
        "photographs": photographs,
        "soft": soft,
        "footprint": footprint,
        "visibility": visibility,
    }
    groups = {"mesh": mesh_group(capture, surfels), "atlas": atlas_group(surfels)}
    faults, digests = list[Fault](), Digests()
    with ExitStack() as stack:
        if (probe := capture.probe) is not None:
            profiles = _attempt(faults, lambda: fibre_profiles(probe, digests))
            groups |= {} if profiles is None else {"probe": probe_group(probe, profiles, capture, surfels)}
        summary: dict[str, Any] = {}
        spool: Spool | None = None
        if capture.dome is None:
            groups["surfels"] = surfel_group(surfels)
        else:
            spool = stack.enter_context(_spool(db, capture, len(surfels.position), parameters))
            _remove_left(db, capture.take, spool)
            pool = stack.enter_context(ThreadPoolExecutor(threads(capture.dome)))  # ends before the spool does
            plan = Plan(capture.dome, surfels, photographs, soft, footprint, visibility)
            made, summary = _dome_groups(plan, faults, digests, spool, pool, report)
            groups |= made
            digests |= {Path(path): digest for path, digest in spool.digests.items()}
        if faults:
            raise InputError(faults)
        summary |= {"surfels": {"count": len(surfels.position), "spacing_mm": surfels.spacing()}}
        summary["notes"] = [*summary.get("notes", []), *_spacing_notes(surfels, spacing_mm)]
        provenance = capture_provenance(capture, parameters, digests) | {"summary": summary}
        stack.enter_context(dask.config.set(scheduler="threads", num_workers=threads(capture.dome)))
        with db.stage("capture", capture.take) as stage:
            if spool is not None:
                spool.keep(STAGE, np.array(stage.path))
            stage.write(groups)
            report("write", 1, 1)
            return stage.commit(provenance)


def _require_outside(db: Database, folder: Path) -> None:
    if folder.resolve() in (db.root.resolve(), *db.root.resolve().parents):
        rule, cure = "a database lies outside the captures it holds", "choose another folder for the database"
        raise InputError(Fault(str(db.root), rule, f"the capture {folder} around it", cure))


def _spacing_notes(surfels: SurfelSet, wanted: float) -> list[str]:
    """What to say where the scan is coarser than asked for; subdivision hits what it can within a factor of sqrt 2."""
    found = surfels.spacing()
    said = f"the scan itself has points {found:.2g} mm apart: wider spacings leave it as it is"
    return [said] if wanted > 1.5 * found else []


def threads(dome: DomeRecord | None) -> int:
    """How many threads decode, trace and write: one a core, as far as memory goes; all release the interpreter.

    Each holds the exposures of a view and what is made of them: measured 22 to 28 bytes a pixel for two exposures,
    0.3 GB at 12 megapixels; 32 are counted.
    """
    if dome is None:
        return LEAST
    one = max(camera.width * camera.height for camera in dome.cameras) * (16 + 8 * len(dome.exposures))
    return max(min(os.cpu_count() or 1, MOST, MEMORY // one), LEAST)


@dataclass(frozen=True)
class Plan:
    """What is asked of the dome's frames."""

    dome: DomeRecord
    surfels: SurfelSet
    photographs: int
    soft: Soft
    footprint: bool
    visibility: Method


def _spool(db: Database, capture: Capture, surfels: int, parameters: dict[str, Any]) -> Spool:
    """The spool of this capture and these parameters, new or left by a run that was killed."""
    assert capture.dome is not None
    shape = (len(capture.dome.lights), len(capture.dome.cameras), surfels)
    folder = db.root / "tmp" / f"{capture.take}-{samples_digest(capture, parameters)[:16]}"
    return Spool(folder, shape, frame_marks(capture.dome))


def _remove_left(db: Database, take: str, spool: Spool) -> None:
    """Remove the data that a killed run of this very ingest had begun to write."""
    left = spool.kept(STAGE)
    if left is None:
        return
    with suppress(InputError):  # a damaged log does not say what is listed: nothing is removed then
        listed = db.history("capture", take) if take in db.takes("capture") else []
        if str(left) not in {record.path for record in listed}:
            shutil.rmtree(db.root / str(left), ignore_errors=True)


def _dome_groups(
    plan: Plan, faults: list[Fault], digests: Digests, spool: Spool, pool: Executor, report: Progress
) -> tuple[dict[str, xr.Dataset], dict[str, Any]]:
    """Groups surfels, samples, dome and photographs, and their summary; nothing when `faults` were added."""
    dome, surfels = plan.dome, plan.surfels
    rooms = darkrooms(dome, faults, digests)
    faults += exposure_faults(dome)
    intensity = _attempt(faults, lambda: light_intensities(dome, rooms, pool, digests))
    if intensity is None:  # go on: the frames of the face may be damaged as well
        intensity = np.ones((len(dome.lights), 3))
    report("lights", 1, 1)
    scene = RayScene(surfels.position, surfels.faces)
    light_share = light_visibility(surfels, dome.lights, scene, pool, method=plan.visibility)
    camera_share, clear, pixels = camera_visibility(surfels, dome.cameras, scene, pool, method=plan.visibility)
    report("visibility", 1, 1)
    kept = choose_photographs(dome, surfels.position.mean(axis=0), plan.photographs)
    lit = fully_lit(surfels, light_share, dome.cameras, soft=plan.soft)
    share = light_share if plan.soft == "keep" else None
    views = Views(surfels, lit, clear, pixels, share=share, footprint=plan.footprint)
    found = _attempt(
        faults,
        lambda: sample_lumitexels(dome, intensity, views, rooms, spool, kept=kept, pool=pool, progress=report),
    )
    if found is None:
        return {}, {}
    if not found.sample_count.any():
        rule, cure = "some surfel must be lit by a light and seen by a camera", "check the crop, poses and positions"
        faults.append(Fault("samples", rule, "none is", cure))
        return {}, {}
    groups = {
        "surfels": surfel_group(surfels, dome, light_share, camera_share),
        "samples": sample_group(dome, found),
        "dome": dome_group(dome, intensity),
    }
    groups |= {"photographs": photograph_group(found.photographs)} if kept else {}
    summary: dict[str, Any] = {"samples": describe_samples(found, surfels, dome)}
    if plan.visibility == "splats":
        summary["notes"] = coarse_maps(surfels, dome.lights, dome.cameras)
    return groups, summary


def _attempt(faults: list[Fault], step: Callable[[], T]) -> T | None:
    """The step's result, or None and its faults noted: the next step may find more."""
    try:
        return step()
    except InputError as error:
        faults += error.faults
        return None


def _silent(stage: str, done: int, total: int) -> None:
    """Progress nobody asked for."""
