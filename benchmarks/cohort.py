"""Results of the studies of a simulated cohort, compared with the truth of its subjects.

    skindb simulate captures --cohort 87 --workers 2
    skindb ingest db captures/*/ --workers 2 && skindb fit db --workers 2
    python -m benchmarks cohort captures db [--group-by gender] [--adjust age]

For every quantity that `analyze groups` compares and whose truth is known (R_d of
regions, sigma_tr of sites), the table has the mean over subjects and its truth, the
difference between groups and its truth (the same regression of the true values), and
whether the stated 95 % interval of the difference contains that truth. It should nearly
always do so, because the interval also covers the variation between subjects, which the
true values share.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr

import skindb
from skindb.analysis import group_effects

CHANNELS = ("R", "G", "B")


def truth_of(path: Path, cohort: xr.Dataset) -> xr.Dataset:
    """True means of regions and sites of a take, in the layout of the cohort."""
    held = np.load(path)
    names = held["region_names"].tolist()
    sites = held["site_names"].tolist()
    regions = np.full((cohort.sizes["region"], 3), np.nan)
    for i, name in enumerate(cohort["region"].values.tolist()):
        inside = np.ones(len(held["vertices"]), bool) if name == "face" else None
        if name in names:
            inside = held["region_membership"][:, names.index(name)] > 0.5
        if inside is not None and inside.any():
            regions[i] = held["diffuse_reflectance"][inside].mean(axis=0)
    probed = np.full((cohort.sizes["site"], 3), np.nan)
    for i, name in enumerate(cohort["site"].values.tolist()):
        if name in sites:
            probed[i] = held["site_sigma_tr"][sites.index(name)]
    return xr.Dataset(
        {
            "region_diffuse_reflectance": (("region", "channel"), regions),
            "site_sigma_tr": (("site", "channel"), probed),
        }
    )


def main(
    captures: Path, db: str, *, group_by: str = "gender", adjust: Sequence[str] = ()
) -> None:
    """Compare and print."""
    cohort = skindb.open(db).cohort("tables").load()
    true = [
        truth_of(captures / f"{take}.truth.npz", cohort)
        for take in cohort["take"].values.tolist()
    ]
    planted = xr.concat(true, "take").assign_coords(cohort.coords)
    measured = [
        name
        for name in ("region_diffuse_reflectance", "site_sigma_tr")
        if name in cohort
    ]
    # restrict the truth to where estimates exist
    compared = {
        name: planted[name].where(np.isfinite(cohort[name])) for name in measured
    }
    planted = cohort.drop_vars(
        [name for name in cohort if str(name).endswith("_error")]
    ).assign(compared)
    options = {"group_by": group_by, "adjust": adjust, "permutations": 1000}
    estimated, want = (
        group_effects(cohort_part, rng=np.random.default_rng(0), **options)
        for cohort_part in (cohort, planted)
    )
    for contrast in estimated["contrast"].values.tolist():
        inside = []
        print(
            f"| {contrast} | true mean | mean | true difference | difference | 95 "
            "% interval | contains the truth |"
        )
        for quantity in estimated["quantity"].values.tolist():
            if quantity.startswith("surface"):
                continue
            est = estimated.sel(contrast=contrast, quantity=quantity)
            true_effect = want.sel(contrast=contrast)
            truth = float(true_effect["effect"].sel(quantity=quantity))
            low = float(est["effect_low"])
            high = float(est["effect_high"])
            inside.append(low <= truth <= high)
            means = [_mean(cohort_part, quantity) for cohort_part in (planted, cohort)]
            numbers = f"{means[0]:.3f} | {means[1]:.3f} | {truth:.4f} | {float(est['effect']):.4f}"
            print(
                f"| {quantity} | {numbers} | {low:.4f} to {high:.4f} | "
                f"{'yes' if inside[-1] else 'no'} |"
            )
        print(f"{sum(inside)} of {len(inside)} intervals contain the truth")


def _mean(cohort: xr.Dataset, quantity: str) -> float:
    """Mean over takes of the quantity with this name."""
    prefix, place, channel = quantity.rsplit(" ", 2)
    variable, dim = {
        "R_d": ("region_diffuse_reflectance", "region"),
        "sigma_tr": ("site_sigma_tr", "site"),
    }[prefix]
    labels = (
        cohort["channel"].values.tolist()
        if "channel" in cohort.coords
        else list(CHANNELS)
    )
    return float(
        cohort[variable].sel({dim: place}).isel(channel=labels.index(channel)).mean()
    )
