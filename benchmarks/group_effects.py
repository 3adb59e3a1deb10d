"""P values, intervals and power of group comparisons and of models over many planted
cohorts.

    python -m benchmarks group_effects [--cohorts 200] [--subjects 87] [--permutations
    1000] [--seed 0]

Each cohort has the tables of `--subjects` subjects. The smaller of two groups is a
fifth of the subjects, with the same spread as the other or twice the spread. Without a
difference, p values must be uniform (Kolmogorov and Smirnov), and 5 % of the cohorts
may have a quantity with an adjusted p below 0.05. With a difference, its interval must
cover it in 93 to 97 % of the cohorts. A difference of the size `effect_detectable` must
be found in 80 %. An attribute that is only correlated with age must have no effect
after adjustment for age.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import xarray as xr
from planted_tables import planted_tables
from scipy import stats

from skindb.analysis import group_effects, linear_model
from skindb.analysis.quantities import DEFAULT

R_D = "R_d face G"
SIGMA_TR = "sigma_tr cheek G"
SURFACE = ("surface reflectance face", "surface reflectance beard")
SURFACE_SPREAD = 0.0024  # between virtual subjects
SURFACE_ERROR = (0.0006, 0.002)  # of face and beard
VISITS = 3


def cohort_of_two(
    n: int, seed: int, difference: float = 0.0, log_tr: float = 0.0, spread: float = 2.0
) -> xr.Dataset:
    """Two groups, of which the smaller one, a fifth of the subjects, has `spread` times
    the spread of the other.
    """
    rng = np.random.default_rng([1, seed])
    few = np.arange(n) % 5 == 0
    albedo = difference * few + np.where(
        few, np.sqrt(spread**2 - 1), 0.0
    ) * 0.03 * rng.normal(size=n)
    gender = np.where(few, "women", "men")
    cohort = planted_tables(
        [f"S{i}" for i in range(n)],
        albedo=albedo,
        log_tr=log_tr * few,
        seed=seed,
        gender=gender,
    )
    return with_surface(cohort, seed, np.where(few, spread, 1.0))


def with_surface(
    cohort: xr.Dataset, seed: int, spread: float | np.ndarray = 1.0
) -> xr.Dataset:
    """Surface reflectance that does not depend on any attribute, with its errors; `spread`
    (take,) is a factor of the differences between subjects.
    """
    rng = np.random.default_rng([5, seed])
    subjects, index = np.unique(
        cohort["subject"].values.astype(str), return_inverse=True
    )
    person = SURFACE_SPREAD * spread * rng.normal(size=len(subjects))[index]
    error = np.broadcast_to(SURFACE_ERROR, (len(index), len(SURFACE_ERROR)))
    values = 0.03 + person[:, None] + error * rng.normal(size=error.shape)
    dims = ("take", "region")
    return cohort.assign(
        region_surface_reflectance=(dims, values),
        region_surface_reflectance_error=(dims, error),
    )


def at_visits(n: int, seed: int) -> xr.Dataset:
    """Three visits of every subject; no attribute has an effect."""
    rng = np.random.default_rng([6, seed])
    who = np.repeat(np.arange(n), VISITS)
    cohort = planted_tables(
        [f"S{i}" for i in who],
        seed=seed,
        gender=np.where(np.arange(n) % 5 == 0, "women", "men")[who],
        dose=rng.normal(size=len(who)),
    )
    names = [f"S{i}.normal.{1 + k % VISITS}" for k, i in enumerate(who)]
    return with_surface(cohort.assign_coords(take=names), seed)


def confounded(n: int, seed: int) -> xr.Dataset:
    """Ancestry is correlated with age, and albedo depends only on age."""
    rng = np.random.default_rng([2, seed])
    age = rng.uniform(20, 60, n)
    ancestry = np.where(rng.random(n) < 1 / (1 + np.exp(-(age - 40) / 5)), "a", "b")
    albedo = -0.002 * (age - 40)
    return planted_tables(
        [f"S{i}" for i in range(n)],
        albedo=albedo,
        seed=seed,
        age=age,
        ancestry=ancestry,
    )


def paired(n: int, seed: int) -> xr.Dataset:
    """All subjects in two conditions, with a mean change of 0.001 that differs between subjects."""
    rng = np.random.default_rng([3, seed])
    who = np.repeat(np.arange(n), 2)
    conditions = np.tile(["normal", "lotion"], n)
    change = np.repeat(rng.normal(0.001, 0.003, n), 2) * (conditions == "lotion")
    return planted_tables(
        [f"S{i}" for i in who],
        conditions=list(conditions),
        albedo=change,
        seed=seed,
        spread=0.1,
    )


@dataclass(frozen=True)
class Cohorts:
    """Many planted cohorts of a size."""

    count: int
    subjects: int
    permutations: int
    seed: int

    @property
    def seeds(self) -> range:
        """Seeds of the cohorts."""
        return range(self.seed * 100_000, self.seed * 100_000 + self.count)

    def contrasts(
        self,
        cohort: Callable[[int, int], xr.Dataset],
        group_by: str,
        **options: tuple[str, ...],
    ) -> xr.Dataset:
        """First contrast of every cohort, which `cohort` plants by size and seed."""
        results = []
        for number in self.seeds:
            table = group_effects(
                cohort(self.subjects, number),
                group_by=group_by,
                permutations=self.permutations,
                rng=np.random.default_rng([4, number]),
                **options,
            )
            results.append(table.isel(contrast=0, drop=True))
        return xr.concat(results, "cohort", combine_attrs="override")

    def of_two_groups(self, *planted: float, spread: float) -> xr.Dataset:
        """Contrasts of two groups with planted differences."""

        def cohort(subjects: int, seed: int) -> xr.Dataset:
            effects = planted or (0.0, 0.0)
            return cohort_of_two(subjects, seed, *effects, spread)

        return self.contrasts(cohort, "gender")


def covered(effects: xr.Dataset, quantity: str, truth: float) -> str:
    """Percentage of intervals that contain the truth."""
    effect = effects.sel(quantity=quantity)
    inside = (effect["effect_low"] < truth) & (effect["effect_high"] > truth)
    return f"{100 * float(inside.mean()):.1f} %"


def print_two_groups(cohorts: Cohorts, name: str, spread: float) -> None:
    """P values, coverage and power where two groups have equal or other spreads."""
    null = cohorts.of_two_groups(spread=spread)
    case = f"| no difference, {name}"
    for quantity in (R_D, SIGMA_TR, *SURFACE):
        p = null["effect_p"].sel(quantity=quantity).dropna("cohort").values
        even = stats.kstest(p, "uniform").pvalue
        print(
            f"{case} | {quantity} | uniformity of p: {even:.2f}; p < 0.05: "
            f"{100 * np.mean(p < 0.05):.1f} % of {len(p)} |"
        )
    false = 100 * float((null["effect_p_adjusted"] < 0.05).any("quantity").mean())
    print(f"{case} | any quantity | adjusted p < 0.05: {false:.1f} % |")
    planted = dict(zip((R_D, SIGMA_TR), (-0.03, 0.05), strict=True))
    effects = cohorts.of_two_groups(*planted.values(), spread=spread)
    for quantity, true in planted.items():
        inside = covered(effects, quantity, true)
        print(f"| planted, {name} | {quantity} | covered: {inside} |")
    detectable = float(null["effect_detectable"].sel(quantity=R_D).median())
    effects = cohorts.of_two_groups(detectable, 0.0, spread=spread)
    power = 100 * float((effects["effect_p"].sel(quantity=R_D) < 0.05).mean())
    case = f"| detectable difference ({detectable:.3f}), {name}"
    print(f"{case} | {R_D} | found: {power:.0f} % |")


def print_models(cohorts: Cohorts) -> None:
    """False positives of models without and with random intercepts of subjects."""
    cases = {
        "one take, equal spreads": ("gender", partial(cohort_of_two, spread=1.0)),
        "one take, twice the spread": ("gender", cohort_of_two),
        "three visits": ("gender + dose + (1 | subject)", at_visits),
    }
    for case, (terms, cohort) in cases.items():
        for quantity in DEFAULT:
            formula = f"{quantity} ~ {terms}"
            found = [
                linear_model(cohort(cohorts.subjects, seed), formula=formula)
                for seed in cohorts.seeds
            ]
            tables = xr.concat(found, "cohort", combine_attrs="override")
            tables = tables.drop_sel(term="Intercept")
            for term in tables["term"].values:
                part = tables.sel(term=term)
                false = 100 * float((part["model_p"] < 0.05).mean())
                any_of = (part["model_p_false_discovery"] < 0.05).any("quantity")
                print(
                    f"| model, {case} | {quantity}, {term} | p < 0.05: {false:.1f} %; "
                    f"any after the false discovery rate: {100 * float(any_of.mean()):.1f} % |"
                )


def main(
    *, cohorts: int = 200, subjects: int = 87, permutations: int = 1000, seed: int = 0
) -> None:
    """Compare all cohorts and print a table."""
    planted = Cohorts(cohorts, subjects, permutations, seed)
    for name, spread in (("equal spreads", 1.0), ("twice the spread", 2.0)):
        print_two_groups(planted, name, spread)
    for name, adjust in (("not adjusted", ()), ("adjusted for age", ("age",))):
        contrasts = planted.contrasts(confounded, "ancestry", adjust=adjust)
        effects = contrasts["effect"].sel(quantity=R_D)
        error = float(effects.std()) / np.sqrt(cohorts)
        print(
            f"| confounded by age, {name} | {R_D} | mean effect "
            f"{float(effects.mean()):.4f}, standard error {error:.4f} |"
        )
    both = planted.contrasts(paired, "condition")
    inside = covered(both, R_D, 0.001)
    print(f"| conditions within subjects | {R_D} | covered: {inside} |")
    print_models(planted)
