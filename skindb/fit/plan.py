"""Plan of a fit: what is computed and what is skipped, with a bound on the resulting error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from skindb.errors import Fault, InputError
from skindb.fit.lumitexels import disc_angle, lumitexels
from skindb.parameters import FitParameters
from skindb.reflectance.dictionary import Dictionary
from skindb.reflectance.kinds import unfitted_model
from skindb.reflectance.model import FitRequest, ReflectanceModel
from skindb.schema.notes import Omission, explain
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
    name = str(capture.attrs.get("take", capture.attrs.get("subject", "capture")))
    if "samples" not in capture.children:
        measured = (
            "only the probe was measured"
            if "probe" in capture.children
            else "neither dome nor probe"
        )
        cure = "photograph the subject in the dome, or exclude this take"
        raise InputError(
            Fault(name, "a fit needs photographs of a dome", measured, cure)
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
        raise InputError(Fault(f"{name}: samples", rule, "no usable sample", cure))
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
    surface = surface_of(lumitexels(capture), parameters, dictionary)
    return FitPlan(surfels, reached, probe, omissions + surface.omissions)


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
        parameters.mode,
        parameters.rank,
        parameters.k,
        dictionary,
    )
    return unfitted_model(parameters.surface, request)
