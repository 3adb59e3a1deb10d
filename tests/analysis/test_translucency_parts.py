"""The fraction of the variance of sigma_tr between people, on planted cohorts."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib import pyplot
from planted_tables import planted_tables

from skindb.analysis import plot_translucency, translucency_table
from skindb.errors import InputError


def _cohort(subjects, repeats, *, people, repeat, noise, seed):
    """Sigma_tr around 1, with given deviations between people and takes and given stated noise."""
    rng = np.random.default_rng([7, seed])
    own = np.repeat(rng.normal(0, people, subjects), repeats)
    who = np.repeat([f"S{i:02d}" for i in range(subjects)], repeats).tolist()
    cohort = planted_tables(who)
    values = 1 + own + rng.normal(0, repeat, len(who)) + rng.normal(0, noise, len(who))
    cohort["site_sigma_tr"][:] = values[:, None, None]
    cohort["site_sigma_tr_error"] = cohort["site_sigma_tr"] * 0 + noise
    return cohort


def test_translucency_table__parts_of_the_variance_are_those_that_were_planted():
    """Means over 20 cohorts, within two of their standard errors."""
    found = [
        translucency_table(
            _cohort(30, 3, people=0.2, repeat=0.05, noise=0.1, seed=seed)
        ).isel(group=0, site=0, channel=0)
        for seed in range(20)
    ]
    fractions = np.array([float(one["sigma_tr_people_fraction"]) for one in found])
    repeats = np.array([float(one["sigma_tr_repeat_deviation"]) for one in found])
    total = 0.2**2 + (0.05**2 + 0.1**2) / 3  # of the means of three takes
    assert (
        abs(fractions.mean() - (1 - 0.1**2 / 3 / total))
        < 2 * fractions.std() / np.sqrt(20) + 0.01
    )
    assert (
        abs(repeats.mean() - np.hypot(0.05, 0.1))
        < 2 * repeats.std() / np.sqrt(20) + 0.001
    )


def test_translucency_table__parts_are_nan_if_undetermined():
    alone = translucency_table(_cohort(8, 1, people=0.2, repeat=0.0, noise=0.1, seed=1))
    assert np.isnan(alone["sigma_tr_repeat_deviation"]).all()
    without = translucency_table(
        _cohort(8, 1, people=0.2, repeat=0.0, noise=0.1, seed=1).drop_vars(
            "site_sigma_tr_error"
        )
    )
    assert np.isnan(without["sigma_tr_people_fraction"]).all()
    same = translucency_table(_cohort(8, 2, people=0.0, repeat=0.0, noise=0.0, seed=1))
    assert np.isnan(same["sigma_tr_people_fraction"]).all()  # there is no variation
    assert (same["sigma_tr_repeat_deviation"] < 1e-9).all()
    noisy = translucency_table(_cohort(8, 1, people=0.01, repeat=0.0, noise=0.0, seed=1).assign(
        site_sigma_tr_error=lambda one: one["site_sigma_tr"] * 0 + 1.0))  # fmt: skip
    assert (noisy["sigma_tr_people_fraction"] == 0).all()


def test_translucency_table__needs_a_probe():
    cohort = _cohort(3, 1, people=0.2, repeat=0.0, noise=0.1, seed=1)
    with pytest.raises(InputError, match="must have sites of the probe"):
        translucency_table(cohort.drop_dims("site"))


def test_plot_translucency__points_of_groups_do_not_coincide_and_are_not_cut():
    word = [f"{i // 2:02d} a" for i in range(24)]
    table = translucency_table(planted_tables(range(24), word=word), group_by="word")
    ax = plot_translucency(table)
    places = [line.lines[0].get_xdata().item() for line in ax.containers]
    assert np.diff(np.sort(places)).min() > 0.01
    assert max(map(abs, places)) < 0.5
    highest = np.nanmax(table["sigma_tr_mean_high"])
    assert ax.get_ylim()[1] > 1.02 * highest
    pyplot.close(ax.figure)
