"""`ingest_capture`: turns a capture folder into a DataTree of kind "capture"."""

import ctypes
import gc
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import dask
import numpy as np
import xarray as xr

from skindb.calibration.frame_checks import (
    dark_faults,
    dark_notes,
    level_notes,
    repeated_frame_faults,
)
from skindb.calibration.irradiance import light_intensities
from skindb.calibration.radiance import FrameMerger, frame_mergers
from skindb.elementwise import thread_count
from skindb.errors import Fault, InputError, attempt, grouped, require
from skindb.format.dome import DomeRecord
from skindb.format.folder import Capture
from skindb.format.frames import Digests
from skindb.geometry.rays import RayScene
from skindb.ingest.consistency import CalibrationCheck
from skindb.ingest.detail import pixel_width
from skindb.ingest.faults import (
    calibration_faults,
    calibration_notes,
    intensity_faults,
    light_notes,
    sample_faults,
)
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
    Lumitexels,
    Sampler,
    choose_photographs,
    fully_lit,
)
from skindb.ingest.probe_profiles import fibre_profiles, isotropy_p_values, probe_notes
from skindb.ingest.refinement import (
    applied_rotations,
    choose_refinement,
    held_out_lights,
    pictures_to_judge,
    reason_to_skip,
    refine_cameras,
)
from skindb.ingest.relief import NO_SCAN_DEGREES, Relief, estimate_relief
from skindb.ingest.report import capture_provenance, describe_samples
from skindb.ingest.spool import Spool
from skindb.ingest.surfels import (
    SurfelSet,
    build_surfels,
    camera_visibility,
    light_visibility,
    site_positions,
)
from skindb.limits import MAX_RELIEF_POINTS
from skindb.parameters import IngestParameters
from skindb.types import Float64, Half, Progress, silent

MIN_THREADS = 2  # with two, one reads while the other computes
MAX_THREADS = 8
# width of a pixel over the spacing of the surfels from which on neighbours share pixels: at 2.4,
# 52 to 58 % of R_d at points are within one standard error, of R_d over a pixel 66 to 72 %
COARSE_PIXEL = 1.5
MAX_BYTES = 4 << 30  # of memory for all threads together, unless two threads need more
LARGE = 100_000  # surfels of a take whose freed memory is worth a search


@contextmanager
def ingest_capture(
    capture: Capture,
    parameters: IngestParameters | None = None,
    *,
    scratch: str | Path,
    progress: Progress = silent,
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
        Folder on a disk with space for the samples; they are in a file without a name
        until they are stored.
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
    parameters = parameters or IngestParameters()
    require(
        "fit" in capture.consent_scope,
        f"{capture.folder / 'capture.json'}[consent][scope]",
        "ingest needs the scope 'fit'",
        ", ".join(capture.consent_scope) or "nothing",
        "ask the subject, then correct it",
    )
    progress("check", 1, 1)
    relief = None
    if not capture.has_scan:
        capture, relief = _with_relief(capture, parameters.spacing_mm)
        progress("relief", 1, 1)
    surfels = build_surfels(
        capture, spacing_mm=parameters.spacing_mm, planar=relief is not None
    )
    progress("surfels", 1, 1)
    groups = {"mesh": mesh_group(capture, surfels), "atlas": atlas_group(surfels)}
    begun = capture, surfels, parameters, progress, relief, groups
    with ExitStack() as stack:
        if capture.dome is None:
            run = _Run(*begun)
            run.groups["surfels"] = surfel_group(surfels, scan_error=capture.scan_error)
        else:
            dome = capture.dome
            shape = (len(dome.lights), len(dome.cameras), len(surfels.position))
            spool = stack.enter_context(Spool(Path(scratch), shape))
            # ends before the spool does
            pool = stack.enter_context(ThreadPoolExecutor(threads(dome)))
            run = _DomeRun(*begun, dome=dome, spool=spool, pool=pool)
            run.sample()
        # last, as the frames of the dome are checked only if nothing else is at fault
        run.measure_probe()
        run.require_no_faults()
        tree = xr.DataTree.from_dict(run.groups)
        tree.attrs = run.attributes()
        if len(surfels.position) > LARGE:
            # what was freed, which the C library would keep while samples are written
            gc.collect()
            with suppress(AttributeError):  # of glibc
                ctypes.CDLL(None).malloc_trim(0)
        stack.enter_context(
            dask.config.set(scheduler="threads", num_workers=threads(capture.dome))
        )
        yield tree


def _with_relief(capture: Capture, spacing_mm: float) -> tuple[Capture, Relief]:
    """The capture with the surface that its photographs show."""
    dome = capture.dome
    assert dome is not None  # as there is no scan
    faults = list[Fault]()
    mergers = frame_mergers(dome, faults)
    if faults:
        raise InputError(grouped(faults))
    with ThreadPoolExecutor(threads(dome)) as pool:
        relief = estimate_relief(dome, mergers, pool, spacing_mm=spacing_mm)
    scanned = replace(
        capture,
        scan=relief.scan,
        surface=relief.surface,
        scan_error=NO_SCAN_DEGREES,
    )
    return scanned, relief


@dataclass
class _Run:
    """An ingest, and what its stages have produced so far."""

    capture: Capture
    surfels: SurfelSet
    parameters: IngestParameters
    report: Progress
    relief: Relief | None
    groups: dict[str, xr.Dataset]
    faults: list[Fault] = field(default_factory=list)
    digests: Digests = field(default_factory=Digests)
    summary: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    probe_notes: list[str] = field(default_factory=list)

    def measure_probe(self) -> None:
        """Add the group "probe" and its notes."""
        probe = self.capture.probe
        if probe is None:
            return
        profiles = attempt(self.faults, lambda: fibre_profiles(probe, self.digests))
        if profiles is not None:
            isotropy = isotropy_p_values(probe, profiles)
            sites = site_positions(self.capture, self.surfels, probe.sites)
            self.groups["probe"] = probe_group(probe, profiles, sites, isotropy)
            self.probe_notes = probe_notes(probe, profiles, isotropy)

    def require_no_faults(self) -> None:
        """Raise the faults of all stages, and of frames that are copies of others."""
        folder = self.capture.folder
        copies = _copies(self.capture)
        self.faults += repeated_frame_faults(folder, self.digests, besides=copies)
        if self.faults:
            raise InputError(grouped(self.faults))

    def attributes(self) -> dict[str, Any]:
        """Provenance and summary of the version."""
        spacing = self.surfels.spacing()
        notes = [*self.notes]
        wanted = self.parameters.spacing_mm
        if self.relief is not None and self.capture.dome is not None:
            (camera,) = self.capture.dome.cameras
            spacing = self.relief.step * camera.pixel_width(np.zeros(3))
            notes += self.relief.notes
            if spacing > 1.5 * wanted:
                notes.append(
                    f"the surface that the photographs show has points {spacing:.2g} mm apart; "
                    f"it is limited to the pixels, and to {MAX_RELIEF_POINTS:,} points"
                )
        elif wanted > 1.5 * spacing:
            notes.append(
                f"the points of the scan are {spacing:.2g} mm apart; a wider spacing leaves "
                "the scan unchanged"
            )
        count = len(self.surfels.position)
        summary = self.summary | {
            "surfels": {"count": count, "spacing_mm": spacing},
            "notes": notes + self.probe_notes,
        }
        parameters = asdict(self.parameters)
        provenance = capture_provenance(self.capture, parameters, self.digests)
        return provenance | {"summary": summary, "take": self.capture.take}


def _copies(capture: Capture) -> list[Path]:
    """Frames that may be copies of each other: dark frames, and those of the probe of a
    rehearsal.
    """
    dark = [] if capture.dome is None else capture.dome.frame_files("dark")
    if capture.probe is None or capture.attributes.get("virtual") is not True:
        return dark
    return [*dark, *capture.probe.frame_files()]


def threads(dome: DomeRecord | None) -> int:
    """Number of threads that decode, trace and write: one per core, limited by memory;
    they release the GIL.

    Each holds the exposures of a view and intermediate arrays: measured 22 to 28 bytes
    per pixel for two exposures, 0.3 GB at 12 megapixels; the estimate uses 32.
    """
    if dome is None:
        return MIN_THREADS
    pixels = max(camera.width * camera.height for camera in dome.cameras)
    thread_bytes = pixels * (16 + 8 * len(dome.exposures))
    return max(min(thread_count(), MAX_THREADS, MAX_BYTES // thread_bytes), MIN_THREADS)


@dataclass(kw_only=True)
class _DomeRun(_Run):
    """An ingest with a dome."""

    dome: DomeRecord
    spool: Spool
    pool: Executor

    def sample(self) -> None:
        """Add the groups of the dome, unless faults are found."""
        groups = self._dome_groups()
        if groups and self.dome.sequence is not None:
            groups["sequence"] = sequence_group(self.dome.sequence, self.dome)
        self.groups |= groups
        self.digests |= self.spool.digests

    def _dome_groups(self) -> dict[str, xr.Dataset]:
        surfels = self.surfels
        parameters = self.parameters
        mergers = frame_mergers(self.dome, self.faults, self.digests)
        for merger in mergers.values():
            self.faults += dark_faults(self.dome, merger)
        intensity, measured = self._intensity(mergers)
        scene = RayScene(surfels.position, surfels.faces)
        relief = self.relief
        if relief is None:
            light_fraction = light_visibility(
                surfels, self.dome.lights, scene, self.pool
            )
        else:
            light_fraction = relief.light_fraction(
                self.dome.cameras[0], surfels.position
            )
        sees = partial(camera_visibility, surfels, pool=self.pool)
        visible, clear, pixels = sees(self.dome.cameras, scene=scene)
        del scene  # 0.2 kB a surfel, which only rotated cameras need again
        if relief is not None:
            # every point was made from pixels that show it
            visible, clear = np.ones_like(visible), np.ones_like(clear)
        self.report("visibility", 1, 1)
        check = CalibrationCheck(
            self.dome, surfels, light_fraction, clear, pixels, intensity
        )
        sampler = self._sampler(mergers, check)
        rotations = np.zeros((len(self.dome.cameras), 3))
        # a surface made from the photographs cannot contradict them
        checked = relief is None
        if checked and parameters.refine is not False and not self.faults:
            refined = self._refined(sampler)
            if refined is not self.dome:
                rotations = applied_rotations(self.dome, refined)
                self.spool.restart()
                self.dome = refined
                scene = RayScene(surfels.position, surfels.faces)
                visible, clear, pixels = sees(refined.cameras, scene=scene)
                del scene
                check = replace(check, dome=refined, clear=clear, pixels=pixels)
                sampler = self._sampler(mergers, check)
            self.report("refine", 1, 1)
        lumitexels = attempt(
            self.faults,
            lambda: sampler.lumitexels(
                check=checked and not self.faults,
                refuse=parameters.calibration == "refuse",
            ),
        )
        if lumitexels is None:
            return {}
        if measured and not self.faults:
            levels = lumitexels.views
            self.faults += sample_faults(self.dome, levels.median, levels.bright)
        if not lumitexels.view_count.any():
            self.faults.append(
                Fault(
                    "samples",
                    "a surfel must be lit by a light and seen by a camera",
                    "none is",
                    "check the crop, poses and positions",
                )
            )
        if self.faults:
            return {}
        self._note(lumitexels, mergers, intensity)
        return self._labelled(lumitexels, check, visible, rotations)

    def _refined(self, sampler: Sampler) -> DomeRecord:
        """The dome with rotated cameras, or as it is if that is chosen or a photograph
        has a fault.

        The photographs that show this are sampled with the cameras as they are, and
        again if the cameras are rotated.
        """
        check = sampler.check
        choose = self.parameters.refine == "auto"
        if choose and (reason := reason_to_skip(check)):
            self.summary["corrections"] = {"refine": reason}
            return self.dome
        held_out = held_out_lights(check) if choose else frozenset[int]()
        pictures = sampler.pictures(pictures_to_judge(check, held_out))
        if sampler.faults:
            return self.dome
        if not choose:
            return refine_cameras(check, check.views(pictures))
        dome, reason = choose_refinement(check, pictures, held_out)
        self.summary["corrections"] = {"refine": reason}
        return dome

    def _sampler(
        self, mergers: Mapping[str, FrameMerger], check: CalibrationCheck
    ) -> Sampler:
        surfels = self.surfels
        parameters = self.parameters
        cameras = self.dome.cameras
        middle = surfels.position.mean(axis=0)
        return Sampler(
            check,
            fully_lit(surfels, check.light_visible, cameras),
            mergers,
            self.spool,
            self.pool,
            self.report,
            kept=choose_photographs(self.dome, middle, parameters.photographs),
        )

    def _labelled(
        self,
        lumitexels: Lumitexels,
        check: CalibrationCheck,
        visible: Half,
        rotations: Float64,
    ) -> dict[str, xr.Dataset]:
        dome = self.dome
        groups = {
            "surfels": surfel_group(
                self.surfels,
                dome,
                check.light_visible,
                visible,
                scan_error=self.capture.scan_error,
            ),
            "samples": sample_group(dome, lumitexels),
            "dome": dome_group(dome, check.intensity),
        }
        if lumitexels.photographs:
            groups["photographs"] = photograph_group(lumitexels.photographs)
        if lumitexels.detail and (detail := lumitexels.detail.group()):
            groups["detail"] = detail
        if lumitexels.calibration is not None:
            groups["calibration"] = calibration_group(
                dome, lumitexels.calibration, rotations
            )
        return groups

    def _note(
        self,
        lumitexels: Lumitexels,
        mergers: Mapping[str, FrameMerger],
        intensity: Float64,
    ) -> None:
        dome = self.dome
        levels = lumitexels.views
        for merger in mergers.values():
            self.notes += dark_notes(dome, merger)
        pixel = pixel_width(self.surfels, dome.cameras)
        if pixel > COARSE_PIXEL * self.surfels.spacing():
            self.notes.append(
                f"a pixel is {pixel:.2g} mm wide on the face: values of surfels are means "
                "over its width, and their errors do not contain finer detail"
            )
        self.notes += level_notes(dome, levels.highest, levels.clipped)
        self.notes += light_notes(dome, intensity, levels.median)
        calibration = lumitexels.calibration
        if calibration is not None:
            # empty if refused
            faults = calibration_faults(dome, calibration)
            self.notes += [str(fault) for fault in faults]
            self.notes += calibration_notes(dome, calibration)
        self.summary |= {"samples": describe_samples(lumitexels, self.surfels, dome)}

    def _intensity(self, mergers: Mapping[str, FrameMerger]) -> tuple[Float64, bool]:
        """Intensities of the lights (light, 3), and whether they could be determined.

        Otherwise they are 1, to find damaged frames of the face in the same run.
        """
        intensity = attempt(
            self.faults,
            lambda: light_intensities(
                self.dome,
                mergers,
                self.pool,
                self.digests,
                centre=self.surfels.position.mean(axis=0),
            ),
        )
        self.report("lights", 1, 1)
        if intensity is None:
            return np.ones((len(self.dome.lights), 3)), False
        self.faults += intensity_faults(self.dome, intensity)
        return intensity, True
