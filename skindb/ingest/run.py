"""`ingest_capture`: a capture folder becomes a version of kind capture."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import TypeVar

import numpy as np
import xarray as xr

from skindb.errors import Fault, InputError
from skindb.geometry.crop import Crop
from skindb.geometry.rays import RayScene
from skindb.ingest.devices import DomeRecord
from skindb.ingest.folder import read_capture
from skindb.ingest.groups import dome_group, mesh_group, photograph_group, probe_group, sample_group, surfel_group
from skindb.ingest.irradiance import light_intensities
from skindb.ingest.lumitexels import Views, choose_photographs, fully_lit, sample_lumitexels, sample_store
from skindb.ingest.probe import fibre_profiles
from skindb.ingest.provenance import capture_provenance, require_fit_consent
from skindb.ingest.radiance import darkrooms
from skindb.ingest.surfels import SurfelSet, build_surfels
from skindb.ingest.visibility import camera_visibility, light_visibility
from skindb.store import Database, Record

Progress = Callable[[str, int, int], None]
T = TypeVar("T")
THREADS = 2  # decoding and rays release the interpreter


def ingest_capture(
    db: Database,
    folder: str | Path,
    *,
    spacing_mm: float = 1.5,
    photographs: int = 4,
    crop: Crop | None = None,
    progress: Progress | None = None,
) -> Record:
    """Turn a capture folder into a committed version.

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
    progress
        Called with stage, steps done and steps in all.

    Returns
    -------
    Record
        Of the commit.

    Raises
    ------
    InputError
        With every fault of the folder, before anything is written; also without the consent to fit.
    """
    report = progress or _silent
    capture = read_capture(folder, crop=crop)
    require_fit_consent(capture)
    report("check", 1, 1)
    surfels = build_surfels(capture, spacing_mm=spacing_mm)
    report("surfels", 1, 1)
    groups, faults = {"mesh": mesh_group(capture, surfels)}, list[Fault]()
    with ExitStack() as stack:
        pool = stack.enter_context(ThreadPoolExecutor(THREADS))
        if (probe := capture.probe) is not None:
            profiles = _attempt(faults, lambda: fibre_profiles(probe))
            groups |= {} if profiles is None else {"probe": probe_group(probe, profiles, capture, surfels)}
        if capture.dome is None:
            groups["surfels"] = surfel_group(surfels)
        else:
            groups |= _dome_groups(capture.dome, surfels, photographs, faults, stack, pool, report)
        if faults:
            raise InputError(faults)
        provenance = capture_provenance(capture, {"spacing_mm": spacing_mm, "photographs": photographs})
        with db.stage("capture", capture.take) as stage:
            stage.write(groups)
            report("write", 1, 1)
            return stage.commit(provenance)


def _dome_groups(
    dome: DomeRecord,
    surfels: SurfelSet,
    photographs: int,
    faults: list[Fault],
    stack: ExitStack,
    pool: Executor,
    report: Progress,
) -> dict[str, xr.Dataset]:
    """Groups surfels, samples, dome and photographs; nothing when `faults` were added."""
    rooms = darkrooms(dome, faults)
    intensity = _attempt(faults, lambda: light_intensities(dome, rooms, pool))
    if intensity is None:  # go on: the frames of the face may be damaged as well
        intensity = np.ones((len(dome.lights), 3))
    report("lights", 1, 1)
    scene = RayScene(surfels.position, surfels.faces)
    light_share = light_visibility(surfels, dome.lights, scene, pool)
    camera_share, clear, pixels = camera_visibility(surfels, dome.cameras, scene, pool)
    report("visibility", 1, 1)
    store = stack.enter_context(sample_store((len(surfels.position), len(dome.lights), len(dome.cameras), 3)))
    kept = choose_photographs(dome, surfels.position.mean(axis=0), photographs)
    views = Views(surfels, fully_lit(surfels, light_share, dome.cameras), clear, pixels)
    found = _attempt(
        faults,
        lambda: sample_lumitexels(dome, intensity, views, rooms, store, kept=kept, pool=pool, progress=report),
    )
    if found is None:
        return {}
    groups = {
        "surfels": surfel_group(surfels, dome, light_share, camera_share),
        "samples": sample_group(dome, found),
        "dome": dome_group(dome, intensity),
    }
    return groups | ({"photographs": photograph_group(found.photographs)} if kept else {})


def _attempt(faults: list[Fault], step: Callable[[], T]) -> T | None:
    """The step's result, or None and its faults noted: the next step may find more."""
    try:
        return step()
    except InputError as error:
        faults += error.faults
        return None


def _silent(stage: str, done: int, total: int) -> None:
    """Progress nobody asked for."""
