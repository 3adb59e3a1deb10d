"""Translucency of a population (Weyrich et al. 2005, section 10.3 and table 2)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from xarray import Dataset

from skindb import plots
from skindb.analysis.contrasts import FEW
from skindb.analysis.quantities import mean_error, trusted, within_deviation
from skindb.analysis.study import Study, of_cohort, table_of
from skindb.analysis.subjects import Groups, compared_conditions, grouped
from skindb.errors import counted, require
from skindb.numerics.statistics import SUMMARY, known_mean
from skindb.schema import ProbeStatus, dataset, variables
from skindb.schema.cohort import require_comparable
from skindb.schema.label import CHANNELS
from skindb.study_parameters import DECLARED
from skindb.types import Array, float64

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PROBED = (
    variables.SITE_SIGMA_TR,
    variables.SITE_SIGMA_TR_ERROR,
    variables.SITE_SIGMA_TR_TOTAL_ERROR,
    variables.SITE_STATUS,
)
COLUMNS = (
    *(f"sigma_tr_{name}" for name in SUMMARY),
    variables.SIGMA_TR_MEASUREMENT_ERROR,
    variables.SIGMA_TR_TOTAL_ERROR,
    variables.SIGMA_TR_PEOPLE_FRACTION,
    variables.SIGMA_TR_REPEAT_DEVIATION,
)


def translucency_table(cohort: Dataset, *, group_by: str | None = None) -> Dataset:
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

    Returns
    -------
    Dataset
        (group, site, channel); NaN where a group has too few values. The interval of
        the mean is Student's. Errors of single takes differ between takes, so that the
        interval and the standard deviation include them. `sigma_tr_measurement_error`
        is the RMS of these errors due to the noise of the fibres,
        `sigma_tr_total_error` their RMS including the error of the profile's model; NaN
        where no take has an error. `sigma_tr_people_fraction` is the fraction of the
        variance that the noise of the fibres does not explain: differences between
        people and, because the probe is never placed identically, within people.
        `sigma_tr_repeat_deviation` is the standard deviation between the takes of one
        subject, from the pooled variance of subjects with several takes in a group, of
        whom there must be three. The
        intervals do not include model errors that are common to all
        takes. Attribute "statuses": number of profiles of each status.

    Raises
    ------
    InputError
        If the takes were fitted with different parameters, or if no take has the
        attribute `group_by`.
    """
    require_comparable(cohort, "tables")
    groups = grouped(cohort, group_by)
    names = [name for name in PROBED if name in groups.takes]
    require(
        PROBED[0] in names,
        "population",
        "must have sites of the probe",
        "no take with any",
        "add a probe to the captures",
    )
    takes = groups.takes[names].load()
    sites = takes["site"].values.tolist()
    sigma_tr, noise, total = (
        float64(trusted(takes, name).values)
        if name in takes
        else np.full((takes.sizes["take"], len(sites), 3), np.nan)
        for name in PROBED[:3]
    )
    moments = groups.moments(sigma_tr)
    variance = moments.variance
    measurement_error = _rms(groups, noise)
    # of the means over the takes of subjects, whose variance it is
    errors = groups.of_subjects(noise, mean_error)
    explained = np.stack([known_mean(of_means**2) for of_means in errors])
    explained = explained / np.where(variance > 0, variance, np.nan)
    repeats = [
        within_deviation(sigma_tr[rows], [groups.subject[row] for row in rows])
        for rows in groups.members.values()
    ]
    return dataset(
        {
            **moments.summary("sigma_tr"),
            variables.SIGMA_TR_VARIANCE: variance,
            variables.SIGMA_TR_PEOPLE_FRACTION: np.clip(1 - explained, 0.0, 1.0),
            variables.SIGMA_TR_MEASUREMENT_ERROR: measurement_error,
            variables.SIGMA_TR_TOTAL_ERROR: _rms(groups, total),
            variables.SIGMA_TR_REPEAT_DEVIATION: np.stack(repeats),
        },
        coords={"group": [*groups.members], "site": sites, "channel": CHANNELS},
        attrs=groups.attrs | {"statuses": _statuses(takes)},
    )


def describe_translucency(table: Dataset) -> list[str]:
    """Statuses of the profiles, and groups whose intervals depend on an assumption, one
    line each.
    """
    lines = []
    if counts := table.attrs.get("statuses"):
        words = ", ".join(f"{count} {name}" for name, count in counts.items())
        lines = [f"status of the profiles: {words}; only fitted and poor_fit are used"]
    for group in map(str, table["group"].values):
        count = table[variables.SIGMA_TR_COUNT].sel(group=group).values
        if count.size and 0 < (largest := int(count.max())) < FEW:
            low = (table[variables.SIGMA_TR_MEAN_LOW].sel(group=group) < 0).any()
            ends = "; some reach below 0, where sigma_tr cannot be" if low else ""
            people = counted(largest, "subject")
            lines.append(
                f"{group}: {people}; with fewer than {FEW} the intervals assume normal values{ends}"
            )
    return lines


def _statuses(takes: Dataset) -> dict[str, int]:
    """Number of profiles of each status that occurs."""
    if variables.SITE_STATUS not in takes:
        return {}
    statuses = takes[variables.SITE_STATUS].values
    counts = {
        member.name.lower(): int((statuses == member).sum())
        for member in ProbeStatus
        if member != ProbeStatus.NOT_MEASURED
    }
    return {name: count for name, count in counts.items() if count}


def _rms(groups: Groups, errors: Array) -> Array:
    """Root mean square (group, site, channel) of errors (take, site, channel)."""
    members = groups.members.values()
    return np.stack([np.sqrt(known_mean(errors[rows] ** 2)) for rows in members])


def plot_translucency(table: Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot mean sigma_tr with its 95 % interval per site; colours are channels, markers
    are groups.
    """
    sites = table["site"].values.tolist()
    groups = [*map(str, table["group"].values)]
    lines = len(groups) * len(plots.CHANNELS)
    ax = ax or plots.new_axes(max(6, 1 + 0.12 * lines * len(sites)), 3.6)
    for g, group in enumerate(groups):
        for c, colour in enumerate(plots.CHANNELS):
            part = table.isel(group=g, channel=c)
            count = int(part[variables.SIGMA_TR_COUNT].max())
            of_group = f", {group}" if len(groups) > 1 else ""
            line = c * len(groups) + g
            plots.intervals(
                ax,
                part,
                variables.SIGMA_TR_MEAN,
                np.arange(len(sites)) + 0.7 * ((line + 0.5) / lines - 0.5),
                vertical=True,
                fmt="os^Dv"[g % 5],
                color=colour,
                label=f"{table['channel'].values[c]}{of_group} (n = {count})",
            )
    ax.set_xticks(range(len(sites)), sites)
    ax.set_xlim(-0.5, len(sites) - 0.5)
    ax.set_ylim(0, 1.05 * ax.get_ylim()[1])
    label = plots.typeset("mean sigma_tr with 95 % CI [mm-1]")
    ax.set_ylabel(label, parse_math=True)
    plots.legend_beside(ax)
    return ax


STUDY = Study(
    *DECLARED["translucency"],
    layout="tables",
    compute=of_cohort("translucency_table", translucency_table),
    shown=("translucency_table",),
    tabulate=lambda table: table_of(table, COLUMNS),
    plot=plot_translucency,
    describe=describe_translucency,
    columns_of_files=(
        variables.SIGMA_TR_TOTAL_ERROR,
        variables.SIGMA_TR_REPEAT_DEVIATION,
    ),
    conditions=compared_conditions,
)
