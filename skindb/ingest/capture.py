"""`ingest_capture`: turns a capture folder into a DataTree of kind "capture"."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import dask
import numpy as np
import xarray as xr

from skindb.calibration.frame_checks import (
    dark_faults,
    dark_notes,
    dark_pattern_fault,
    level_notes,
    repeated_frame_faults,
)
from skindb.calibration.irradiance import light_intensities
from skindb.calibration.radiance import dark_frame_files, frame_mergers
from skindb.elementwise import thread_count
from skindb.errors import Fault, InputError, grouped
from skindb.format.dome import DomeRecord
from skindb.format.folder import Capture
from skindb.format.frames import Digests
from skindb.geometry.rays import RayScene
from skindb.ingest.consistency import (
    CalibrationCheck,
    applied_rotations,
    refine_cameras,
)
from skindb.ingest.consistency_checks import calibration_faults, calibration_notes
from skindb.ingest.groups import (
    atlas_group,
    calibration_group,
    dome_group,
    mesh_group,
    photograph_group,
    probe_group,
    sample_group,
    sequence_group,
    surfel_group,
)
from skindb.ingest.lumitexels import (
    Views,
    checked_pictures,
    choose_photographs,
    fully_lit,
    sample_lumitexels,
)
from skindb.ingest.probe_profiles import fibre_profiles, isotropy_p_values, probe_notes
from skindb.ingest.provenance import (
    capture_provenance,
    frame_marks,
    require_fit_consent,
    samples_digest,
)
from skindb.ingest.report import describe_samples
from skindb.ingest.sample_quality import intensity_faults, light_notes, sample_faults
from skindb.ingest.spool import Spool
from skindb.ingest.surfels import SurfelSet, build_surfels, site_positions
from skindb.ingest.visibility import (
    camera_visibility,
    coarse_maps,
    light_visibility,
)
from skindb.parameters import IngestParameters
from skindb.types import Progress, silent

T = TypeVar("T")
# with two, one reads while the other computes
MIN_THREADS = 2
MAX_THREADS = 8
MAX_BYTES = 4 << 30  # of memory for all threads together, unless two threads need more


@contextmanager
def ingest_capture(
    capture: Capture,
    parameters: IngestParameters | None = None,
    *,
    scratch: str | Path,
    progress: Progress | None = None,
) -> Iterator[xr.DataTree]:
    """Turn a capture folder into a DataTree of kind "capture": samples of light at
    surfels of the scan.

    Parameters
    ----------
    capture
        From `read_capture`.
    parameters
        Default `IngestParameters()`.
    scratch
        Folder in which the subfolder `scratch_name` holds the samples until they are
        stored. A run after a killed one resumes from this subfolder; a run that ends
        removes the subfolder and nothing else.
    progress
        Called with the stage, the number of finished steps and the total number of steps.

    Yields
    ------
    DataTree
        Lazy, and valid until the context closes. Its attributes are the provenance of a version.

    Raises
    ------
    InputError
        With every fault of the folder, or if the consent does not include fits.

    Examples
    --------
    >>> capture = read_capture("captures/S01")  # doctest: +SKIP
    >>> with ingest_capture(capture, scratch="scratch") as tree:  # doctest: +SKIP
    ...     model = skindb.fit.fit_model(tree)
    """
    report = progress or silent
    asked = parameters or IngestParameters()
    require_fit_consent(capture)
    report("check", 1, 1)
    surfels = build_surfels(capture, spacing_mm=asked.spacing_mm)
    report("surfels", 1, 1)
    groups = {"mesh": mesh_group(capture, surfels), "atlas": atlas_group(surfels)}
    faults = list[Fault]()
    digests = Digests()
    touched = list[str]()
    with ExitStack() as stack:
        if (probe := capture.probe) is not None:
            profiles = _attempt(faults, lambda: fibre_profiles(probe, digests))
            if profiles is not None:
                isotropy = isotropy_p_values(probe, profiles)
                places = site_positions(capture, surfels, probe.sites)
                groups["probe"] = probe_group(probe, profiles, places, isotropy)
                touched = probe_notes(probe, profiles, isotropy)
        summary: dict[str, Any] = {}
        if capture.dome is None:
            groups["surfels"] = surfel_group(surfels)
        else:
            folder = Path(scratch) / scratch_name(capture, asked)
            spool = stack.enter_context(
                _spool(folder, capture, len(surfels.position), asked)
            )
            # ends before the spool does
            pool = stack.enter_context(ThreadPoolExecutor(threads(capture.dome)))
            made, summary = _dome_groups(
                Plan(capture.dome, surfels, asked), faults, digests, spool, pool, report
            )
            groups |= made
            if made and capture.dome.sequence is not None:
                groups["sequence"] = sequence_group(capture.dome.sequence, capture.dome)
            digests |= {Path(path): digest for path, digest in spool.digests.items()}
        faults += repeated_frame_faults(
            capture.folder, digests, besides=_copies(capture)
        )
        if faults:
            raise InputError(grouped(faults))
        summary |= {
            "surfels": {"count": len(surfels.position), "spacing_mm": surfels.spacing()}
        }
        summary["notes"] = [
            *summary.get("notes", []),
            *_spacing_notes(surfels, asked.spacing_mm),
            *touched,
        ]
        tree = xr.DataTree.from_dict(groups)
        tree.attrs = capture_provenance(capture, asdict(asked), digests) | {
            "summary": summary,
            "take": capture.take,
        }
        stack.enter_context(
            dask.config.set(scheduler="threads", num_workers=threads(capture.dome))
        )
        yield tree


def _copies(capture: Capture) -> list[Path]:
    """Frames that may be copies of each other: dark frames, and those of the probe of a
    rehearsal.
    """
    dark = [] if capture.dome is None else dark_frame_files(capture.dome)
    if capture.probe is None or capture.attributes.get("virtual") is not True:
        return dark
    return [*dark, *capture.probe.frame_files()]


def scratch_name(capture: Capture, parameters: IngestParameters | None = None) -> str:
    """Name of the scratch folder, unique to the capture and the parameters of its ingest."""
    digest = samples_digest(capture, asdict(parameters or IngestParameters()))
    return f"{capture.take}-{digest[:16]}"


def _spacing_notes(surfels: SurfelSet, wanted: float) -> list[str]:
    """Warning if the spacing of the scan does not allow the target spacing within a
    factor of sqrt 2.
    """
    found = surfels.spacing()
    said = (
        f"the points of the scan are {found:.2g} mm apart; a wider spacing leaves the "
        "scan unchanged"
    )
    return [said] if wanted > 1.5 * found else []


def threads(dome: DomeRecord | None) -> int:
    """Number of threads that decode, trace and write: one per core, limited by memory;
    they release the GIL.

    Each holds the exposures of a view and intermediate arrays: measured 22 to 28 bytes
    per pixel for two exposures, 0.3 GB at 12 megapixels; the estimate uses 32.
    """
    if dome is None:
        return MIN_THREADS
    one = max(camera.width * camera.height for camera in dome.cameras) * (
        16 + 8 * len(dome.exposures)
    )
    return max(min(thread_count(), MAX_THREADS, MAX_BYTES // one), MIN_THREADS)


@dataclass(frozen=True)
class Plan:
    """How the frames of the dome are to be processed."""

    dome: DomeRecord
    surfels: SurfelSet
    asked: IngestParameters


def _spool(
    folder: Path, capture: Capture, surfels: int, parameters: IngestParameters
) -> Spool:
    """The spool of this capture and these parameters, new or left by a run that was killed."""
    assert capture.dome is not None
    shape = (len(capture.dome.lights), len(capture.dome.cameras), surfels)
    return Spool(
        folder,
        shape,
        frame_marks(capture.dome),
        key=samples_digest(capture, asdict(parameters)),
    )


def _dome_groups(
    plan: Plan,
    faults: list[Fault],
    digests: Digests,
    spool: Spool,
    pool: Executor,
    report: Progress,
) -> tuple[dict[str, xr.Dataset], dict[str, Any]]:
    """Groups surfels, samples, dome and photographs, and their summary; both empty if
    faults were found.
    """
    dome = plan.dome
    surfels = plan.surfels
    mergers = frame_mergers(dome, faults, digests)
    faults += [
        fault for merger in mergers.values() for fault in dark_faults(dome, merger)
    ]
    if not faults:
        patterns = _attempt(
            faults,
            lambda: [
                *pool.map(lambda name: dark_pattern_fault(dome, name, mergers), mergers)
            ],
        )
        faults += [fault for fault in patterns or [] if fault is not None]
    intensity = _attempt(
        faults, lambda: light_intensities(dome, mergers, pool, digests)
    )
    if judged := intensity is not None:
        faults += intensity_faults(dome, intensity)
    else:  # continue, to find damaged frames of the face in the same run
        intensity = np.ones((len(dome.lights), 3))
    report("lights", 1, 1)
    scene = RayScene(surfels.position, surfels.faces)
    light_fraction = light_visibility(
        surfels, dome.lights, scene, pool, method=plan.asked.visibility
    )
    sees = partial(
        camera_visibility, surfels, scene=scene, pool=pool, method=plan.asked.visibility
    )
    camera_share, clear, pixels = sees(dome.cameras)
    report("visibility", 1, 1)
    given = dome
    if plan.asked.refine and not faults:
        check = CalibrationCheck(
            dome, surfels, light_fraction, clear, pixels, intensity
        )
        pictures = _attempt(faults, lambda: checked_pictures(check, mergers, pool=pool))
        if pictures is None:
            return {}, {}
        dome = refine_cameras(check, pictures)
        camera_share, clear, pixels = sees(dome.cameras)
        report("refine", 1, 1)
    kept = choose_photographs(
        dome, surfels.position.mean(axis=0), plan.asked.photographs
    )
    lit = fully_lit(surfels, light_fraction, dome.cameras, soft=plan.asked.soft)
    divisor = light_fraction if plan.asked.soft == "keep" else None
    views = Views(
        surfels,
        lit,
        clear,
        pixels,
        light_fraction=divisor,
        footprint=plan.asked.footprint,
    )
    refuse = plan.asked.calibration == "refuse"
    final = (
        None
        if faults
        else CalibrationCheck(dome, surfels, light_fraction, clear, pixels, intensity)
    )
    found = _attempt(
        faults,
        lambda: sample_lumitexels(
            dome,
            intensity,
            views,
            mergers,
            spool,
            kept=kept,
            check=final,
            refuse=refuse,
            pool=pool,
            progress=report,
        ),
    )
    if found is None:
        return {}, {}
    if judged and not faults:
        faults += sample_faults(dome, found.views.median, found.views.bright)
    if not found.sample_count.any():
        rule = "a surfel must be lit by a light and seen by a camera"
        cure = "check the crop, poses and positions"
        faults.append(Fault("samples", rule, "none is", cure))
    if faults:
        return {}, {}
    groups = {
        "surfels": surfel_group(surfels, dome, light_fraction, camera_share),
        "samples": sample_group(dome, found),
        "dome": dome_group(dome, intensity),
    }
    groups |= {"photographs": photograph_group(found.photographs)} if kept else {}
    notes = [note for merger in mergers.values() for note in dark_notes(dome, merger)]
    notes += level_notes(dome, found.views.highest, found.views.clipped)
    notes += light_notes(dome, intensity, found.views.median)
    if plan.asked.visibility == "splats":
        notes += coarse_maps(surfels, dome.lights, dome.cameras)
    if found.calibration is not None:
        groups["calibration"] = calibration_group(
            dome, found.calibration, applied_rotations(given, dome)
        )
        # empty if refused
        notes += [str(fault) for fault in calibration_faults(dome, found.calibration)]
        notes += calibration_notes(dome, found.calibration)
    return groups, {"samples": describe_samples(found, surfels, dome), "notes": notes}


def _attempt(faults: list[Fault], step: Callable[[], T]) -> T | None:
    """Result of a step, or None with its faults recorded, so that the next step can find more."""
    try:
        return step()
    except InputError as error:
        faults += error.faults
        return None
