"""Comparisons of groups in cohorts that are drawn from measured faces (International
Skin Spectra Archive).
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from skindb.analysis import albedo_table, group_effects
from skindb.schema import dataset

SPECTRA = (
    Path(__file__).resolve().parents[2]
    / ".."
    / "shared"
    / "data"
    / "optics"
    / "issa2025_skin.csv"
)
SITES = ["forehead", "cheek"]
COLOUR = ["lin_sRGB_r", "lin_sRGB_g", "lin_sRGB_b"]
# subjects of each gender
COHORTS = 60
EACH = 25

pytestmark = pytest.mark.skipif(
    not SPECTRA.is_file(), reason="the data beside the project are absent"
)


@lru_cache
def people() -> pd.DataFrame:
    """Mean linear colour at both sites, of all persons of the largest group who were
    measured at both.
    """
    table = pd.read_csv(SPECTRA, low_memory=False)
    table = table[table["body_location"].isin(SITES) & table["gender"].isin(["F", "M"])]
    mean = table.groupby(["origin", "subject", "ethnicity", "gender", "body_location"])[
        COLOUR
    ].mean()
    wide = mean.unstack("body_location").dropna()
    group = wide.index.get_level_values("ethnicity").value_counts().idxmax()
    return wide.xs(group, level="ethnicity")


def colours_of(rows: pd.DataFrame) -> np.ndarray:
    """(person, site, channel)."""
    return np.stack(
        [
            np.stack([rows[channel, site] for channel in COLOUR], axis=-1)
            for site in SITES
        ],
        axis=1,
    )


def drawn(seed: int) -> xr.Dataset:
    """A cohort of tables of randomly chosen people."""
    rng = np.random.default_rng(seed)
    everybody = people()
    gender = everybody.index.get_level_values("gender")
    rows = np.concatenate(
        [
            rng.choice(np.flatnonzero(gender == name), EACH, replace=False)
            for name in ("F", "M")
        ]
    )
    values = colours_of(everybody.iloc[rows])
    names = [f"S{i}" for i in range(len(rows))]
    along = {
        "subject": ("take", np.array(names, object)),
        "condition": ("take", np.array(["normal"] * len(rows), object)),
        "gender": ("take", np.array(["female"] * EACH + ["male"] * EACH, object)),
    }
    return xr.Dataset(
        {"region_diffuse_reflectance": (("take", "region", "channel"), values)},
        {"take": names, "region": SITES, "channel": ["R", "G", "B"], **along},
    )


def truth() -> dict[str, np.ndarray]:
    """Means of all persons, for each gender."""
    everybody = people()
    gender = everybody.index.get_level_values("gender")
    return {
        name: colours_of(everybody[gender == key]).mean(axis=0)
        for name, key in (("female", "F"), ("male", "M"))
    }


def test_people__enough_of_them():
    counts = people().index.get_level_values("gender").value_counts()
    assert counts.min() >= 3 * EACH  # so that cohorts differ


def test_group_effects__intervals_hold_the_difference_of_all_measured_people():
    """At least 95 % of 360 intervals contain it; somewhat more, as each cohort is a
    part of the population.
    """
    want = truth()
    difference = (want["male"] - want["female"]).ravel()
    inside = []
    for seed in range(COHORTS):
        found = group_effects(
            drawn(seed),
            group_by="gender",
            permutations=100,
            rng=np.random.default_rng(seed),
        )
        one = found.sel(contrast="male less female")
        inside.append(
            (one["effect_low"].values <= difference)
            & (difference <= one["effect_high"].values)
        )
    # the six quantities of a cohort are correlated: with three independent ones the
    # fraction is known to 1.5 %
    assert 0.91 <= np.mean(inside) <= 1.0


def test_albedo_table__intervals_hold_the_means_of_all_measured_people():
    want = truth()
    inside = []
    for seed in range(COHORTS):
        cohort = drawn(seed)
        takes = cohort.sizes["take"]
        sites = len(SITES)
        means = cohort["region_diffuse_reflectance"].values
        albedo = dataset(
            {
                "albedo_mean": means,
                "albedo_histogram": np.full((takes, sites, 3, 256), np.nan),
            },
            coords={
                "take": cohort["take"].values,
                "region": SITES,
                "channel": ["R", "G", "B"],
            },
        )
        table = albedo_table(cohort, albedo=albedo, group_by="gender")
        low, high = (table[f"group_albedo_mean_{end}"] for end in ("low", "high"))
        for name, mean in want.items():
            inside.append(
                (low.sel(group=name).values <= mean)
                & (mean <= high.sel(group=name).values)
            )
    assert 0.91 <= np.mean(inside) <= 1.0
