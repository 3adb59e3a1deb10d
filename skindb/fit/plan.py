"""Plan of a fit: what is computed and what is skipped, with a bound on the resulting error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from skindb.errors import require
from skindb.fit.lumitexels import disc_angle, lumitexels, relative_reflectance
from skindb.parameters import FitParameters
from skindb.reflectance.dictionary import Dictionary
from skindb.reflectance.kinds import SURFACES
from skindb.reflectance.model import FitRequest, ReflectanceModel
from skindb.schema import dataset
from skindb.schema.notes import Omission
from skindb.types import Index, Mask

RELATIVE = "no white target: R_d is relative to an unknown factor per channel"


@dataclass(frozen=True)
class FitPlan:
    """Surfels and lights that are used; everything else is listed in `omissions`."""

    surfels: Mask  # (surfel,) with a sample
    lights: Mask  # (light,) that reach one of them
    translucency: bool
    omissions: tuple[Omission, ...]
    relative: bool  # R_d has an unknown factor per channel

    def skipped(self) -> list[str]:
        """One line per thing that is skipped or unknown."""
        lines = [str(omission) for omission in self.omissions]
        return [*lines, RELATIVE] if self.relative else lines

    def explain(self) -> list[str]:
        """The lines of `skipped`, or one that says that there are none."""
        return self.skipped() or ["nothing is skipped"]


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
        BRDFs for point lights; default `embedded_dictionary()`.

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
    weight anywhere, 28 of 59 in one take, are known only after the fit: the
    factorisation without them takes 0.04 s less and has another start. Equal channels
    are not detected, as all three use the same system of equations.
    """
    parameters = parameters or FitParameters()
    name = str(capture.attrs.get("take", capture.attrs.get("subject", "capture")))
    probe = "probe" in capture.children
    require(
        "samples" in capture.children,
        name,
        "a fit needs photographs of a dome",
        "only the probe was measured" if probe else "neither dome nor probe",
        "photograph the subject in the dome, or exclude this take",
    )
    surfels = capture["samples"].dataset["sample_count"].values > 0
    # a light that is hidden from every sampled surfel has no samples; dark lights
    # cannot be ingested
    fraction = capture["surfels"].dataset["light_visible_fraction"].values
    reached = np.asarray((fraction[surfels] > 0).any(axis=0))
    require(
        surfels.any() and reached.any(),
        f"{name}: samples",
        "a fit needs surfels that a camera sees lit",
        "no usable sample",
        "check calibration, mesh and frames, then ingest again",
    )
    candidates = [
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
    omissions = tuple(omission for omission in candidates if omission.skipped)
    if not probe:
        omissions += (
            Omission(
                "translucency", 1, 1, "no probe measurement: the model has no sigma_tr"
            ),
        )
    samples = lumitexels(capture)
    omissions += surface_of(samples, parameters, dictionary).omissions
    relative = relative_reflectance(samples)
    return FitPlan(surfels, reached, probe, omissions, relative)


def surface_of(
    lumitexels: xr.Dataset, parameters: FitParameters, dictionary: Dictionary | None
) -> ReflectanceModel:
    """The surface model that a take is fitted with.

    Raises
    ------
    InputError
        If the model cannot have as many components as asked for.
    """
    request = FitRequest(
        parameters.eta,
        disc_angle(lumitexels),
        parameters.rank,
        parameters.k,
        dictionary,
    )
    return SURFACES[parameters.surface].unfitted(request)


def hold_out(
    capture: xr.DataTree, plan: FitPlan, parameters: FitParameters
) -> xr.Dataset:
    """Choose lights and cameras that are held out of a fit.

    Parameters
    ----------
    capture
        Version of kind "capture".
    plan
        Lights that reach the subject.
    parameters
        Fractions to hold out, and the seed.

    Returns
    -------
    Dataset
        `light_held_out` (light) and `camera_held_out` (camera). Those of kept
        photographs are chosen first, so that a comparison with such a photograph is a
        prediction.
    """
    visible = capture["surfels"].dataset["camera_visible_fraction"]
    # cameras that see no surfel are useless for a test
    seeing = np.ones(visible.sizes["camera"], np.bool_)
    if parameters.hold_out_cameras:
        seeing = (visible.max("surfel") > 0).values
    dark = _drawn(
        capture, "light", plan.lights, parameters.hold_out_lights, [parameters.seed, 0]
    )
    away = _drawn(
        capture, "camera", seeing, parameters.hold_out_cameras, [parameters.seed, 2]
    )
    flags = {
        "light_held_out": np.isin(np.arange(len(plan.lights)), dark),
        "camera_held_out": np.isin(np.arange(len(seeing)), away),
    }
    dome = capture["dome"].to_dataset()
    return dataset(
        flags,
        coords={
            dim: dome[dim].values for dim in ("light", "camera") if dim in dome.coords
        },
    )


def fitted_part(lumitexels: xr.Dataset, held_out: xr.Dataset) -> xr.Dataset:
    """Lumitexels without the lights and cameras that are held out."""
    part = lumitexels
    for dim in ("light", "camera"):
        fitted = np.flatnonzero(held_out[f"{dim}_held_out"].values == 0)
        # indexing everything would copy the samples
        part = part if len(fitted) == part.sizes[dim] else part.isel({dim: fitted})
    return part


def _drawn(
    capture: xr.DataTree, dim: str, useful: Mask, fraction: float, seed: list[int]
) -> Index:
    """Indices of the useful lights or cameras that are held out: at least one if any, never all."""
    count = int(useful.sum())
    require(
        not fraction or count >= 2,
        f"hold_out_{dim}s",
        f"to hold out a {dim}, two or more must reach the subject",
        str(count),
        "hold nothing out",
    )
    order = np.random.default_rng(seed).permutation(np.flatnonzero(useful))
    if "photographs" in capture.children:
        photographed = np.isin(
            order, capture["photographs"].dataset[f"photograph_{dim}"].values
        )
        order = order[np.argsort(~photographed, kind="stable")]
    return np.sort(
        order[: min(max(round(fraction * count), int(fraction > 0)), count - 1)]
    )
