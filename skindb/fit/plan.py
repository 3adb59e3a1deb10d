"""Plan of a fit: what is computed and what is skipped, with a bound on the resulting error."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import xarray as xr

from skindb.cache import cached_arrays
from skindb.errors import Fault, InputError
from skindb.fit.lumitexels import disc_angle, lumitexels
from skindb.parameters import FitParameters
from skindb.reflectance.dictionary import SOURCES, Dictionary, disc_dictionary
from skindb.reflectance.reduction import (
    Truncation,
    reduced_dictionary,
    truncation_bound,
)
from skindb.schema.omission import Omission, explain
from skindb.types import Mask


@dataclass(frozen=True)
class FitPlan:
    """Surfels and lights that are used; everything else is listed in `omissions`."""

    surfels: Mask  # (surfel,) with a sample
    lights: Mask  # (light,) that reach one of them
    translucency: bool
    omissions: tuple[Omission, ...]

    def explain(self) -> list[str]:
        """One line per thing that is skipped, for `--explain`."""
        return explain(self.omissions)


def plan_fit(
    capture: xr.DataTree,
    parameters: FitParameters | None = None,
    *,
    dictionary: Dictionary | None = None,
) -> FitPlan:
    """Plan the fit of one take.

    Parameters
    ----------
    capture
        Version of kind "capture": groups surfels, samples and dome, and probe if there
        are probe measurements.
    parameters
        Parameters of the fit; default `FitParameters()`.
    dictionary
        BRDFs for point lights; default the embedded 59.

    Returns
    -------
    FitPlan
        Surfels with at least one sample, lights that reach at least one of them, and
        whether translucency can be estimated. No sample is skipped, so that the only
        error is that of the rank.

    Raises
    ------
    InputError
        A capture without a dome, or without any usable sample.

    Notes
    -----
    Surfels with fewer samples than a fit needs are included: they get a normal and a
    status that states the reason, and cost less than the others. BRDFs that have no
    weight anywhere, 28 of the 59 in one take, are known only after the fit: the
    factorisation without them takes 0.04 s less and has another start. Equal channels
    are not detected, as all three use the same system of equations.
    """
    parameters = parameters or FitParameters()
    where = str(capture.attrs.get("take", capture.attrs.get("subject", "capture")))
    if "samples" not in capture.children:
        measured = (
            "only the probe was measured"
            if "probe" in capture.children
            else "neither dome nor probe"
        )
        cure = "photograph the subject in the dome, or exclude this take"
        raise InputError(
            Fault(where, "a fit needs photographs of a dome", measured, cure)
        )
    surfels = capture["samples"].to_dataset()["sample_count"].values > 0
    probe = "probe" in capture.children
    # a light that is hidden from every sampled surfel has no samples; dark lights
    # cannot be ingested
    fraction = capture["surfels"].to_dataset()["light_visible_fraction"].values
    reached = np.asarray((fraction[surfels] > 0).any(axis=0))
    if not surfels.any() or not reached.any():
        rule = "a fit needs surfels that a camera sees lit"
        cure = "check calibration, mesh and frames, then ingest again"
        raise InputError(Fault(f"{where}: samples", rule, "no usable sample", cure))
    found = [
        Omission(
            "surfels",
            int((~surfels).sum()),
            surfels.size,
            "no usable sample: no camera sees them lit",
        ),
        Omission(
            "lights",
            int((~reached).sum()),
            reached.size,
            "they reach no surfel that has a sample",
        ),
    ]
    omissions = tuple(omission for omission in found if omission.skipped)
    if not probe:
        omissions += (
            Omission(
                "translucency", 1, 1, "no probe measurement: the model has no sigma_tr"
            ),
        )
    tables = disc_dictionary(dictionary, disc_angle(lumitexels(capture)))
    return FitPlan(
        surfels, reached, probe, omissions + rank_omissions(tables, parameters)
    )


def rank_omissions(
    tables: Dictionary, parameters: FitParameters
) -> tuple[Omission, ...]:
    """Error by a reduction of the dictionary to `rank` dimensions (`truncation_bound`).

    The bound applies to a mixture with given weights. On a take of 32 lights and 6
    cameras, fitted mixtures differed by 0.8 % (median) and 3.6 % (maximum; bound 3.9 %)
    at rank 16; the residual was the same as with all 59 in the median surfel, and 5 %
    larger in one of twenty.
    """
    count = len(tables.names)
    if parameters.rank >= count:
        return ()
    roots = parameters.mode == "paper"
    bound = _truncation(tables, parameters.rank, roots)
    reason = (
        f"rank {parameters.rank}; at a single pair of directions up to "
        f"{bound.worst:.3g} times the value"
    )
    what = f"{'cube roots of mixtures' if roots else 'mixtures'}, RMS over directions,"
    return (
        Omission(
            "dimensions of the dictionary",
            count - parameters.rank,
            count,
            reason,
            bound.rms,
            what,
        ),
    )


@lru_cache(maxsize=4)
def _truncation(tables: Dictionary, rank: int, cube_roots: bool) -> Truncation:
    """Takes of one dome share it."""

    def make() -> dict[str, np.ndarray]:
        table = np.cbrt(tables.table) if cube_roots else tables.table
        found = truncation_bound(
            table, *reduced_dictionary(tables, rank, cube_roots=cube_roots)
        )
        return {"rms": np.array(found.rms), "worst": np.array(found.worst)}

    kept = cached_arrays(
        "truncation", (tables.digest, rank, cube_roots), sources=SOURCES, make=make
    )
    return Truncation(float(kept["rms"]), float(kept["worst"]))
