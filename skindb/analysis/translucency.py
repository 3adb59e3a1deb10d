"""Translucency of a population (Weyrich et al. 2005, section 10.3 and table 2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from skindb.analysis.members import EVERYBODY, Takes, consenting, groups_by, left_out, people
from skindb.numerics.statistics import Moments
from skindb.schema import IDENTIFIED, dataset

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def translucency_table(models: Takes, *, group_by: str | None = None) -> xr.Dataset:
    """Count, mean, standard deviation and variance of sigma_tr per site and channel, with 95 % intervals.

    Parameters
    ----------
    models
        Take -> version of kind "model". Takes in another condition than normal count only if `group_by` is
        "condition" or one of them: a subject is one subject.
    group_by
        Attribute or trait to group by (condition, gender, ancestry, male, older, ...); None makes the one group "all".

    Returns
    -------
    Dataset
        (group, site, channel); NaN where a group has too few values. The interval of the mean is Student's, that of
        the standard deviation assumes normal values. Errors of single takes scatter between takes: both intervals and
        the standard deviation contain them, `sigma_tr_measurement_error` says how much of it they are (NaN where no
        take has an error). What the model of a profile has wrong in all takes alike is in none of them.
    """
    takes = {t: m for t, m in people(consenting(models), group_by).items() if "translucency" in m.children}
    sites = sorted({str(s) for m in takes.values() for s in m["translucency"].to_dataset()["site"].values})
    groups = groups_by(takes, group_by) if takes else {}
    names = sorted(set(groups.values())) or [EVERYBODY]
    stacked = _moments(takes, groups, names, sites, "site_effective_transport")
    errors = _moments(takes, groups, names, sites, "site_effective_transport_error")
    low, high = stacked.mean_interval()
    deviation_low, deviation_high = stacked.deviation_interval()
    known = stacked.count > 0
    return dataset(
        {
            "sigma_tr_count": stacked.count,
            "sigma_tr_mean": np.where(known, stacked.mean, np.nan),
            "sigma_tr_mean_low": low,
            "sigma_tr_mean_high": high,
            "sigma_tr_standard_deviation": stacked.standard_deviation,
            "sigma_tr_deviation_low": deviation_low,
            "sigma_tr_deviation_high": deviation_high,
            "sigma_tr_variance": stacked.variance,
            "sigma_tr_measurement_error": _rms(errors),
        },
        coords={"group": names, "site": sites, "channel": ["R", "G", "B"]},
        attrs={"takes": sorted(takes), "group_by": group_by or "", "left_out": left_out(models)},
    )


def _moments(takes: Takes, groups: Mapping[str, str], names: list[str], sites: list[str], variable: str) -> Moments:
    """Moments (group, site, channel) of a variable of the sites over takes."""
    parts = {name: Moments.zero((len(sites), 3)) for name in names}
    for take, model in takes.items():
        parts[groups[take]] += Moments.of(_trusted(model, sites, variable)[None])
    return Moments(*(np.stack([getattr(parts[n], f) for n in names]) for f in ("count", "mean", "second")))


def _rms(moments: Moments) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    square = moments.mean**2 + moments.second / np.maximum(moments.count, 1)
    return np.where(moments.count > 0, np.sqrt(square), np.nan)


def _trusted(model: xr.DataTree, sites: list[str], variable: str) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """(site, channel) with NaN where a site is absent or its fit is not to be trusted."""
    node = model["translucency"].to_dataset()
    good = node["site_status"].isin(IDENTIFIED)
    if variable not in node:
        return np.full((len(sites), 3), np.nan)
    values = node[variable].where(good).astype(np.float64)
    return np.asarray(values.reindex(site=np.array(sites, np.dtypes.StringDType())).values)


def plot_translucency(table: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Mean sigma_tr with its interval per site, one colour a channel, one marker a group."""
    from matplotlib import pyplot

    if ax is None:
        _, ax = pyplot.subplots(figsize=(6, 3.6))
    sites = [str(s) for s in table["site"].values]
    for g, group in enumerate(map(str, table["group"].values)):
        for c, colour in enumerate(("tab:red", "tab:green", "tab:blue")):
            one = table.isel(group=g, channel=c)
            x = np.arange(len(sites)) + 0.12 * (c - 1) + 0.03 * g
            mean = one["sigma_tr_mean"].values
            bars = np.nan_to_num([mean - one["sigma_tr_mean_low"].values, one["sigma_tr_mean_high"].values - mean])
            name = f"{table['channel'].values[c]}" + (f", {group}" if table.sizes["group"] > 1 else "")
            ax.errorbar(x, mean, yerr=bars, fmt="os^Dv"[g % 5], color=colour, capsize=3, label=name)
    ax.set_xticks(range(len(sites)), sites)
    ax.set_ylabel("sigma_tr [mm-1]")
    ax.legend(fontsize=8)
    return ax
