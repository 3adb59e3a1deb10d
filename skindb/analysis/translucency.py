"""Translucency of a population (Weyrich et al. 2005, section 10.3 and table 2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb import plots
from skindb.analysis.contrasts import FEW
from skindb.analysis.study import (
    Population,
    Results,
    Study,
    Table,
    skipped_takes,
    table_of,
)
from skindb.analysis.subjects import groups_by, takes_to_compare
from skindb.numerics.statistics import Moments, variance_components
from skindb.parameters import group_option
from skindb.schema import IDENTIFIED, ProbeStatus, dataset, variables
from skindb.schema.cohort import require_same_fit, require_takes
from skindb.types import Array, float64

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PROBED = variables.SITE_SIGMA_TR
COLUMNS = (
    variables.SIGMA_TR_COUNT,
    variables.SIGMA_TR_MEAN,
    variables.SIGMA_TR_MEAN_LOW,
    variables.SIGMA_TR_MEAN_HIGH,
    variables.SIGMA_TR_STANDARD_DEVIATION,
    variables.SIGMA_TR_MEASUREMENT_ERROR,
    variables.SIGMA_TR_TOTAL_ERROR,
    variables.SIGMA_TR_PEOPLE_FRACTION,
    variables.SIGMA_TR_REPEAT_DEVIATION,
)


def translucency_table(
    cohort: xr.Dataset, *, group_by: str | None = None, mixed_fits: bool = False
) -> xr.Dataset:
    """Count, mean, standard deviation and variance of sigma_tr per site and channel,
    with 95 % intervals.

    Parameters
    ----------
    cohort
        ``db.cohort("tables")``. Takes in other conditions than normal are used only if
        `group_by` is "condition" or a trait of it, so that no subject counts several
        times.
    group_by
        Attribute or trait to group by (condition, gender, gender:male, age:older, ...);
        None puts all takes into the group "all".
    mixed_fits
        Accept takes that were fitted with different parameters.

    Returns
    -------
    Dataset
        (group, site, channel); NaN where a group has too few values. The interval of
        the mean is Student's; that of the standard deviation assumes a normal
        distribution. Errors of single takes differ between takes, so that both
        intervals and the standard deviation include them. `sigma_tr_measurement_error`
        is the RMS of these errors due to the noise of the fibres,
        `sigma_tr_total_error` their RMS including the error of the profile's model; NaN
        where no take has an error. `sigma_tr_people_fraction` is the fraction of the
        variance that the noise of the fibres does not explain: differences between
        people and, because the probe is never placed identically, within people.
        `sigma_tr_repeat_deviation` is the standard deviation between the takes of one
        subject, from subjects with several takes in a group (restricted maximum
        likelihood). The intervals do not include model errors that are common to all
        takes. Attribute "statuses": number of profiles of each status.

    Raises
    ------
    InputError
        If the takes were fitted with different parameters, or if no take has the
        attribute `group_by`.
    """
    require_takes(cohort, "tables")
    if not mixed_fits:
        require_same_fit(cohort)
    takes, people = takes_to_compare(cohort, group_by)
    groups = groups_by(people, group_by)
    names = sorted(set(groups))
    members = [np.flatnonzero([group == name for group in groups]) for name in names]
    sites = takes["site"].values.tolist() if PROBED in takes else []
    measured = _trusted(takes)
    empty = np.full((takes.sizes["take"], len(sites), 3), np.nan)

    def moments(name: str) -> Moments:
        values = measured.get(name, empty)
        return Moments.stacked(Moments.of(values[rows]) for rows in members)

    subjects = np.array(people.subject)
    sigma_tr = measured.get(PROBED, empty)
    repeats = [_repeat_deviation(sigma_tr[rows], subjects[rows]) for rows in members]
    noise = moments(variables.SITE_SIGMA_TR_ERROR)
    return dataset(
        {
            **_distribution(moments(PROBED), noise),
            variables.SIGMA_TR_MEASUREMENT_ERROR: _rms(noise),
            variables.SIGMA_TR_TOTAL_ERROR: _rms(
                moments(variables.SITE_SIGMA_TR_TOTAL_ERROR)
            ),
            variables.SIGMA_TR_REPEAT_DEVIATION: np.stack(repeats),
        },
        coords={"group": names, "site": sites, "channel": ["R", "G", "B"]},
        attrs={
            "takes": sorted(map(str, takes["take"].values)),
            "group_by": group_by or "",
            "statuses": _statuses(takes),
            "skipped": skipped_takes(cohort),
        },
    )


def _distribution(values: Moments, noise: Moments) -> dict[str, Array]:
    """Count, mean and spread of sigma_tr, and the fraction that noise does not explain."""
    low, high = values.mean_interval()
    deviation_low, deviation_high = values.deviation_interval()
    return {
        variables.SIGMA_TR_COUNT: values.count,
        variables.SIGMA_TR_MEAN: np.where(values.count > 0, values.mean, np.nan),
        variables.SIGMA_TR_MEAN_LOW: low,
        variables.SIGMA_TR_MEAN_HIGH: high,
        variables.SIGMA_TR_STANDARD_DEVIATION: values.standard_deviation,
        variables.SIGMA_TR_DEVIATION_LOW: deviation_low,
        variables.SIGMA_TR_DEVIATION_HIGH: deviation_high,
        variables.SIGMA_TR_VARIANCE: values.variance,
        variables.SIGMA_TR_PEOPLE_FRACTION: _people_fraction(values.variance, noise),
    }


def describe_translucency(table: xr.Dataset) -> list[str]:
    """Statuses of the profiles, and groups whose intervals depend on an assumption, one
    line each.
    """
    statuses = ", ".join(
        f"{count} {name}" for name, count in table.attrs.get("statuses", {}).items()
    )
    lines = (
        [f"status of the profiles: {statuses}; only fitted and poor_fit are used"]
        if statuses
        else []
    )
    for group in map(str, table["group"].values):
        count = table[variables.SIGMA_TR_COUNT].sel(group=group).values
        if count.size and 0 < (largest := int(count.max())) < FEW:
            low = (table[variables.SIGMA_TR_MEAN_LOW].sel(group=group) < 0).any()
            ends = "; some reach below 0, where sigma_tr cannot be" if low else ""
            takes = f"{largest} take{'s' if largest > 1 else ''}"
            lines.append(
                f"{group}: {takes}; with fewer than {FEW} the intervals assume normal values{ends}"
            )
    return lines


def _trusted(takes: xr.Dataset) -> dict[str, Array]:
    """Variables (take, site, channel) of trusted fits; NaN where a take lacks a site or
    its fit is not trusted.
    """
    if PROBED not in takes:  # the probe was not used
        return {}
    names = (
        PROBED,
        variables.SITE_SIGMA_TR_ERROR,
        variables.SITE_SIGMA_TR_TOTAL_ERROR,
        variables.SITE_STATUS,
    )
    node = takes[[name for name in names if name in takes]].load()
    good = node[variables.SITE_STATUS].isin(IDENTIFIED)
    return {
        str(name): float64(node[name].where(good).values)
        for name in node
        if name != names[-1]
    }


def _statuses(takes: xr.Dataset) -> dict[str, int]:
    """Number of profiles of each status."""
    if variables.SITE_STATUS not in takes:
        return {}
    statuses = takes[variables.SITE_STATUS].values
    counts = {
        member.name.lower(): int((statuses == member).sum()) for member in ProbeStatus
    }
    return {
        name: count
        for name, count in counts.items()
        if count and name != ProbeStatus.NOT_MEASURED.name.lower()
    }


def _people_fraction(variance: Array, errors: Moments) -> Array:
    """Fraction of a variance that measurement errors do not explain; NaN where the
    variance is 0 or unknown.
    """
    noise = _rms(errors) ** 2
    return np.where(
        variance > 0,
        np.clip(1 - noise / np.where(variance > 0, variance, 1.0), 0.0, 1.0),
        np.nan,
    )


def _repeat_deviation(values: Array, subjects: NDArray[np.str_]) -> Array:
    """Standard deviation (site, channel) between the takes of one subject, from values
    (take, site, channel).
    """
    out = np.full(values.shape[1:], np.nan)
    for index in np.ndindex(out.shape):
        is_known = np.isfinite(values[:, *index])
        people = len(set(subjects[is_known].tolist()))
        if people >= 2 and is_known.sum() > people:
            out[index] = np.sqrt(
                variance_components(values[is_known, *index], subjects[is_known])[2]
            )
    return out


def _rms(moments: Moments) -> Array:
    square = moments.mean**2 + moments.second / np.maximum(moments.count, 1)
    return np.where(moments.count > 0, np.sqrt(square), np.nan)


def plot_translucency(table: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot mean sigma_tr with its 95 % interval per site; colours are channels, markers
    are groups.
    """
    ax = ax or plots.new_axes(6, 3.6)
    sites = table["site"].values.tolist()
    for g, group in enumerate(map(str, table["group"].values)):
        for c, colour in enumerate(plots.CHANNELS):
            part = table.isel(group=g, channel=c)
            x = np.arange(len(sites)) + 0.12 * (c - 1) + 0.03 * g
            mean = part[variables.SIGMA_TR_MEAN].values
            # sigma_tr is never negative
            low = np.maximum(part[variables.SIGMA_TR_MEAN_LOW].values, 0.0)
            bars = np.nan_to_num(
                [mean - low, part[variables.SIGMA_TR_MEAN_HIGH].values - mean]
            )
            count = int(part[variables.SIGMA_TR_COUNT].max())
            name = f"{table['channel'].values[c]}" + (
                f", {group}" if table.sizes["group"] > 1 else ""
            )
            label = f"{name} (n = {count})"
            ax.errorbar(
                x,
                mean,
                yerr=bars,
                fmt="os^Dv"[g % 5],
                color=colour,
                capsize=3,
                label=label,
            )
    ax.set_xticks(range(len(sites)), sites)
    ax.set_ylim(bottom=0)
    ax.set_ylabel("mean sigma_tr with 95 % CI [mm-1]")
    plots.legend_beside(ax)
    return ax


def tabulate_translucency(table: xr.Dataset) -> Table:
    """Header and one row per group, site and channel."""
    names = [name for name in COLUMNS if name in table]
    return table_of(table, names, ("group", "site", "channel"))


@dataclass(frozen=True)
class Parameters:
    """Parameters of the study of translucency."""

    group_by: str | None = group_option()


def compute(population: Population, parameters: Parameters) -> Results:
    """The results of the study."""
    table = translucency_table(
        population.cohort,
        group_by=parameters.group_by,
        mixed_fits=population.mixed_fits,
    )
    return {"translucency_table": table}


STUDY = Study(
    name="translucency",
    description="translucency by site of the face",
    layout="tables",
    parameters=Parameters,
    compute=compute,
    shown=("translucency_table",),
    tabulate=tabulate_translucency,
    plot=plot_translucency,
    describe=describe_translucency,
    columns_of_files=(
        variables.SIGMA_TR_TOTAL_ERROR,
        variables.SIGMA_TR_REPEAT_DEVIATION,
    ),
    compares_normal=True,
)
