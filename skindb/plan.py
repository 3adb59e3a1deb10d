"""What a fit needs of a capture, what is left out, and the bound on the error that costs (MODEL.md, section 11)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.errors import Fault, InputError

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Omission:
    """One thing left out: what, how many of how many, why, and what the results can differ by."""

    what: str
    left_out: int
    of: int
    reason: str
    bound: float = 0.0

    def __str__(self) -> str:
        cost = "results stay the same" if self.bound == 0 else f"results differ by at most {self.bound:.2g}"
        return f"{self.what}: {self.left_out} of {self.of} left out ({self.reason}); {cost}"


@dataclass(frozen=True)
class Plan:
    """What is worked on; everything else is in `omissions`."""

    surfels: Mask  # (surfel,) fitted
    lights: Mask  # (light,) read
    translucency: bool
    omissions: tuple[Omission, ...]

    def explain(self) -> list[str]:
        """One line per thing left out, for `--explain`."""
        return [str(omission) for omission in self.omissions] or ["nothing is left out"]


def plan_fit(capture: xr.DataTree) -> Plan:
    """Plan the fit of one take.

    Parameters
    ----------
    capture
        Version of kind "capture": groups surfels and samples, and probe if the probe touched the subject.

    Returns
    -------
    Plan
        Surfels with at least one sample, lights that reach at least one surfel, and whether translucency can be
        had. Nothing that carries a sample is left out, so the bound on the error is zero.

    Raises
    ------
    InputError
        A capture without a dome.
    """
    if "samples" not in capture.children:
        measured = "only the probe was measured" if "probe" in capture.children else "neither dome nor probe"
        cure = "photograph the subject in the dome, or leave this take out"
        where = str(capture.attrs.get("subject", "capture"))
        raise InputError(Fault(where, "a fit needs photographs of a dome", measured, cure))
    count = capture["samples"].to_dataset()["sample_count"].values
    # a light whose every disc point is hidden from every surfel has only NaN samples
    reached = (capture["surfels"].to_dataset()["light_visible_fraction"].max("surfel") > 0).values
    surfels, probe = count > 0, "probe" in capture.children
    found = [
        Omission("surfels", int((~surfels).sum()), surfels.size, "no usable sample: no camera sees them lit"),
        Omission("lights", int((~reached).sum()), reached.size, "they reach no surfel"),
    ]
    omissions = tuple(omission for omission in found if omission.left_out)
    if not probe:
        omissions += (Omission("translucency", 1, 1, "no probe measurement: the model has no sigma_tr"),)
    return Plan(surfels, reached, probe, omissions)
