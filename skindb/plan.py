"""What fits and pictures need, what they leave out, and the bound on the error that costs (MODEL.md, section 11)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.errors import Fault, InputError

if TYPE_CHECKING:
    from skindb.optics.dictionary import Dictionary
    from skindb.optics.truncation import Truncation

Mask = NDArray[np.bool_]
NOTHING = "nothing is left out"


@dataclass(frozen=True)
class Omission:
    """One thing left out: what, how many of how many, why, and what the results can differ by."""

    what: str
    left_out: int
    of: int
    reason: str
    bound: float = 0.0
    bounded: str = "results"  # what the bound is a share of

    def __str__(self) -> str:
        cost = f"{self.bounded} differ by at most {100 * self.bound:.3g} %" if self.bound else "results stay the same"
        return f"{self.what}: {self.left_out} of {self.of} left out ({self.reason}); {cost}"


@dataclass(frozen=True)
class Plan:
    """What is worked on; everything else is in `omissions`."""

    surfels: Mask  # (surfel,) fitted
    lights: Mask  # (light,) read
    translucency: bool
    omissions: tuple[Omission, ...]
    generation: int | None = None  # of the capture that was planned; a fit by this plan reads it, not a newer one

    def explain(self) -> list[str]:
        """One line per thing left out, for `--explain`."""
        return [str(omission) for omission in self.omissions] or [NOTHING]


def plan_fit(capture: xr.DataTree) -> Plan:
    """Plan the fit of one take.

    Parameters
    ----------
    capture
        Version of kind "capture": groups surfels and samples, and probe if the probe touched the subject.

    Returns
    -------
    Plan
        Surfels with at least one sample, lights that reach at least one of them, and whether translucency can be
        had. Nothing that carries a sample is left out, so the bound on the error is zero.

    Notes
    -----
    Surfels with fewer samples than a fit needs are worked on: they get a normal, and what lacks as their status, and
    cost less than the others. Measured BRDFs that get no weight anywhere, 28 of the 59 in one take, are known only
    after the fit: the factorisation without them takes 0.04 s less and starts elsewhere.

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
    surfels, probe = capture["samples"].to_dataset()["sample_count"].values > 0, "probe" in capture.children
    # a light hidden from every surfel that has a sample has none itself; dark lights cannot be ingested
    share = capture["surfels"].to_dataset()["light_visible_fraction"].values
    reached = np.asarray((share[surfels] > 0).any(axis=0))
    found = [
        Omission("surfels", int((~surfels).sum()), surfels.size, "no usable sample: no camera sees them lit"),
        Omission("lights", int((~reached).sum()), reached.size, "they reach no surfel that has a sample"),
    ]
    omissions = tuple(omission for omission in found if omission.left_out)
    if not probe:
        omissions += (Omission("translucency", 1, 1, "no probe measurement: the model has no sigma_tr"),)
    return Plan(surfels, reached, probe, omissions, capture.attrs.get("generation"))


def with_rank(plan: Plan, tables: Dictionary, *, rank: int, cube_roots: bool = False) -> Plan:
    """The plan with what a reduction of the measured BRDFs to `rank` dimensions costs (`truncation_bound`).

    The bound is one of a mixture of given weights. On a take of 32 lights and 6 cameras, mixtures that were fitted
    differed by 0.8 % (median) and 3.6 % (largest; bound 3.9 %) at rank 16, and the fit left as much as with all 59 in
    the median surfel and 5 % more in one of twenty. Time per surfel: 0.066 ms instead of 0.081 there, so that the
    reduction itself costs as much as it saves, and 0.22 instead of 0.68 under 150 lights with 16 cameras.

    Channels that are equal are not looked for: the three share one system of equations, and only the slopes of the
    diffuse reflectance are computed for each, 7 % of that stage.
    """
    count = len(tables.names)
    if rank >= count:
        return plan
    bound = _truncation(tables, rank, cube_roots)
    reason = f"rank {rank}; at a single pair of directions up to {bound.worst:.3g} times the value"
    what = "cube roots of mixtures" if cube_roots else "mixtures"
    left = Omission("dimensions of the BRDFs", count - rank, count, reason, bound.rms, f"{what}, rms over directions,")
    return replace(plan, omissions=(*plan.omissions, left))


@lru_cache(maxsize=4)
def _truncation(tables: Dictionary, rank: int, cube_roots: bool) -> Truncation:
    """Takes of one dome share it: 0.5 s."""
    from skindb.optics.dictionary import reduced_dictionary
    from skindb.optics.truncation import truncation_bound

    table = np.cbrt(tables.table) if cube_roots else tables.table
    return truncation_bound(table, *reduced_dictionary(tables, rank, cube_roots=cube_roots))


def plan_render(shown: Mask, *, lights: int, subsurface: bool) -> Plan:
    """Plan a picture in which the triangles of some surfels are seen (surfel,), under a number of lights.

    Light is carried under the skin to these surfels only. It comes from all of them, and the picture is interpolated
    between those shown, so nothing changes.

    Measured and not worth it, on faces of 37,000 surfels in domes of 64 and 150 lights: all reflection is 7 % of the
    time, shadow rays 82 %; every light reaches what is shown, and rays are cast only to lights above the horizon;
    weights of zero are passed over one by one. Light under the skin is carried also where it gets no farther than a
    pixel: it moves the diffuse term by 3 to 7 % rms, and what the range of the irradiance around a surfel bounds is ten
    times that.
    """
    left: tuple[Omission, ...] = ()
    if subsurface and not shown.all():
        left = (Omission("surfels that light is carried to", int((~shown).sum()), shown.size, "nobody sees them"),)
    return Plan(shown, np.ones(lights, np.bool_), subsurface, left)
