"""Trait vectors: differences of the means with and without a trait (Weyrich et al.
2005, section 11).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.random import Generator
from xarray import Dataset

from skindb import plots
from skindb.analysis.albedo import albedo_and_texture, quantiles
from skindb.analysis.brdf import population_basis
from skindb.analysis.contrasts import unreliable_surfaces
from skindb.analysis.quantities import trusted
from skindb.analysis.study import (
    Population,
    Results,
    Study,
    Table,
    skipped_takes,
    table_of,
)
from skindb.analysis.subjects import (
    CONDITION,
    Subjects,
    numeric_attributes,
    require_adjustable,
    sides,
    subjects_of,
    trait_names,
)
from skindb.analysis.summary import SAMPLED
from skindb.errors import InputError, require
from skindb.numerics.inference import missing_patterns
from skindb.numerics.statistics import known_mean
from skindb.schema import dataset, variables
from skindb.schema.cohort import require_comparable
from skindb.schema.label import CHANNELS, FACE
from skindb.study_parameters import DECLARED, TraitParameters
from skindb.types import Array, Mask, finite_rows, float64

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIDES = ("with", "without")
# subjects with or without a trait, below which individual differences dominate its
# vector
FEW = 10
BRDF_DISTANCE = variables.TRAIT_BRDF_DISTANCE
LOG_SIGMA_TR = variables.TRAIT_LOG_SIGMA_TR_SHIFT
RESAMPLES = 200  # of subjects in the bootstrap, which gives standard errors to 5 %


@dataclass(frozen=True)
class Units:
    """Units of a comparison for a trait: subjects, or differences within subjects."""

    takes: tuple[Mask, ...]  # (take,) mask of the takes of each unit
    # takes whose mean is subtracted; empty where subjects are compared
    against: tuple[Mask, ...]
    design: Array  # (n, p) regressors; the coefficient of the first is the vector
    count: tuple[int, int]  # subjects with and without the trait

    def values(self, of_takes: Array) -> Array:
        """Mean values (n, ...) of the units."""
        means = np.stack([known_mean(of_takes[rows]) for rows in self.takes])
        return (
            means - np.stack([known_mean(of_takes[rows]) for rows in self.against])
            if self.against
            else means
        )


def trait_vectors(
    cohort: Dataset,
    *,
    basis: Dataset,
    albedo: Dataset,
    texture: Dataset | None = None,
    adjust: Sequence[str] = (),
    rng: Generator | None = None,
) -> Dataset:
    """Shifts of surface BRDF, albedo histograms and translucency that are associated with traits.

    Parameters
    ----------
    cohort
        ``db.cohort("tables")``.
    basis, albedo
        From `population_basis` and `albedo_histograms` of the same takes.
    texture
        From `texture_statistics` of the registered ones of these takes.
    adjust
        Attributes for which comparisons between subjects are adjusted; subjects without
        them are excluded.
    rng
        Random generator of the bootstrap over subjects; by default with seed 0.

    Returns
    -------
    Dataset
        Of every trait that some takes have and others lack, such as "condition:lotion",
        and of every numeric attribute, such as "age", whose vector is that of one unit
        (a year). A condition is compared within the subjects measured with and without
        it, if there are any. `trait_brdf_shift` and the `trait_brdf_distance` that it is,
        `trait_histogram_shift`, `trait_quantile_shift`,
        `trait_log_sigma_tr_shift`, with `texture` also `trait_texture_shift`, and
        standard errors of all except histograms and texture by bootstrap over subjects
        (NaN if a side has fewer than two); `trait_count`, subjects (side: with, without;
        for numeric attributes all are "with"); `take_log_sigma_tr` (reference for the
        distance of an edit). NaN where a side has no such region, or no probe site was
        measured on both sides. Attribute `flags`: traits with few subjects on a side,
        and those that are excluded because the attributes in `adjust` determine them.

    Raises
    ------
    InputError
        If a name in `adjust` is not an attribute, or if the takes were fitted with
        different parameters.
    """
    require_comparable(cohort, "tables")
    subjects = subjects_of(cohort)
    split = _split_takes(subjects)
    require_adjustable(subjects, adjust)
    for name in adjust:
        subjects.require_constant(name)
        subjects.attribute(name).require_one_kind()
    units = {}
    flags = []
    for name, (carries, lacks) in split.items():
        try:
            units[name] = _units(subjects, name, carries, lacks, adjust)
        except InputError as error:
            flags.append(f"excluded: {error}")
    values = _compared_values(cohort, basis, albedo, texture)
    rng = np.random.default_rng(0) if rng is None else rng
    shifts = _shifts([*units.values()], values, rng)
    length = float(np.linalg.norm(known_mean(values[BRDF_DISTANCE]))) or 1.0
    for name in (BRDF_DISTANCE, f"{BRDF_DISTANCE}_error"):
        shifts[name] = np.linalg.norm(shifts[name], axis=-1) / length
    if not units:
        flags.append("no attribute and no condition differs between the takes")
    counts = np.reshape([unit.count for unit in units.values()], (-1, len(SIDES)))
    part = {} if texture is None else {"part": texture["part"].values}
    return dataset(
        {
            variables.TRAIT_COUNT: counts,
            variables.TAKE_LOG_SIGMA_TR: _mean_over_sites(values[LOG_SIGMA_TR]),
            **shifts,
        },
        coords={
            "take": cohort["take"].values.tolist(),
            "trait": list(units),
            "side": list(SIDES),
            "region": albedo["region"].values,
            "channel": CHANNELS,
            **part,
        },
        attrs={
            "flags": flags
            + _flags(list(units), counts)
            + unreliable_surfaces(cohort, CONDITION),
            "adjust": list(adjust),
            "skipped": skipped_takes(cohort),
        },
    )


def _split_takes(subjects: Subjects) -> dict[str, tuple[Mask, Mask]]:
    """Trait -> masks of the takes with and without it; all takes of a numeric attribute,
    those in the condition normal, are on one side.
    """
    split = {name: sides(subjects, name) for name in trait_names(subjects)}
    for name in numeric_attributes(subjects):
        carries = np.isfinite(subjects.attribute(name).numbers) & subjects.is_normal
        if carries.any():
            split[name] = (carries, np.zeros_like(carries))
    return split


def _compared_values(
    cohort: Dataset, basis: Dataset, albedo: Dataset, texture: Dataset | None
) -> dict[str, Array]:
    """Variable of the vectors -> values (take, ...) of which it is the difference."""
    takes = cohort["take"].values
    edges = albedo[variables.HISTOGRAM_EDGE].values
    histograms = albedo[variables.ALBEDO_HISTOGRAM].sel(take=takes).values
    log_sigma_tr = np.full((len(takes), 1, 3), np.nan)
    if variables.SITE_SIGMA_TR in cohort:
        sites = cohort[[variables.SITE_SIGMA_TR, variables.SITE_STATUS]].load()
        log_sigma_tr = np.log(float64(trusted(sites, variables.SITE_SIGMA_TR).values))
    coefficients = basis[variables.TAKE_COEFFICIENT].sel(take=takes).values
    values = {
        variables.TRAIT_BRDF_SHIFT: coefficients,
        BRDF_DISTANCE: coefficients @ basis[variables.COMPONENT_VECTOR].values,
        variables.TRAIT_QUANTILE_SHIFT: quantiles(histograms, edges),
        LOG_SIGMA_TR: log_sigma_tr,
    }
    if texture is not None:
        everything = {"take": takes, "region": albedo["region"].values}
        quantile = texture[variables.TEXTURE_QUANTILE].reindex(everything)
        values[variables.TRAIT_TEXTURE_SHIFT] = quantile.values
    return values


def _shifts(
    units: Sequence[Units], values: Mapping[str, Array], rng: Generator
) -> dict[str, Array]:
    """Vectors (trait, ...) of all values (take, ...), with their errors by bootstrap
    except for textures.
    """
    shapes = {name: of_takes.shape[1:] for name, of_takes in values.items()}
    shapes[LOG_SIGMA_TR] = (len(CHANNELS),)
    shifts: dict[str, list[Array]] = {name: [] for name in values}
    errors: dict[str, list[Array]] = {name: [] for name in values}
    errors.pop(variables.TRAIT_TEXTURE_SHIFT, None)
    for unit in units:
        count = len(unit.design)
        drawn = rng.multinomial(count, np.full(count, 1 / count), RESAMPLES)
        for name, of_takes in values.items():
            resamples = drawn[: RESAMPLES if name in errors else 0].astype(float)
            shift, resampled = _coefficients(
                unit.values(of_takes), unit.design, resamples
            )
            # averaged over sites last: differences between sites must not appear as a
            # trait
            if name == LOG_SIGMA_TR:
                shift = known_mean(shift)
                resampled = _mean_over_sites(resampled)
            shifts[name].append(shift)
            if name in errors:
                errors[name].append(_deviation(resampled))
    stated = {f"{name}_error": rows for name, rows in errors.items()}
    return {
        name: np.reshape(rows, (len(units), *shapes[name.removesuffix("_error")]))
        for name, rows in (shifts | stated).items()
    }


def _units(
    subjects: Subjects, trait: str, carries: Mask, lacks: Mask, adjust: Sequence[str]
) -> Units:
    """Subjects with and without a trait; differences within subjects if all with it
    were also measured without it.

    A value that a subject has on one side only is then ignored, because differences
    between people must not appear as the trait. A numeric attribute is its own regressor.
    """
    is_number = not lacks.any()
    who = np.array(subjects.subject)
    pairs = sorted(set(who[carries]))
    if not is_number and set(pairs) <= set(who[lacks]):
        rows, rows_without = (
            tuple(mask & (who == s) for s in pairs) for mask in (carries, lacks)
        )
        return Units(rows, rows_without, np.ones((len(pairs), 1)), (len(pairs),) * 2)
    others = sorted(set(who[lacks]) - set(pairs))
    names = [*pairs, *others]
    rows = tuple((carries if s in pairs else lacks) & (who == s) for s in names)
    regressor = [1.0] * len(pairs) + [0.0] * len(others)
    if is_number:
        values = subjects.attribute(trait).numbers
        regressor = [float(values[of_subject].mean()) for of_subject in rows]
    held = [subjects.by_subject(name, names).columns for name in adjust]
    design = np.column_stack([regressor, np.ones(len(names)), *held])
    complete = finite_rows(design)
    design = design[complete]
    require(
        np.linalg.matrix_rank(design) > np.linalg.matrix_rank(design[:, 1:]),
        f"trait {trait}",
        "must vary independently of the attributes that are adjusted for",
        ", ".join(adjust) or "one value",
        "adjust for fewer attributes, or exclude the trait",
    )
    count = (int(complete[: len(pairs)].sum()), int(complete[len(pairs) :].sum()))
    return Units(tuple(itertools.compress(rows, complete)), (), design, count)


def _coefficients(values: Array, design: Array, drawn: Array) -> tuple[Array, Array]:
    """First regression coefficient (...) of values (n, ...) on a design (n, p), and of
    resamples with counts (b, n).

    NaN where the subjects with a value, or a resample of them, do not determine the coefficient.
    """
    flat = values.reshape(len(values), -1)
    out = np.full(flat.shape[1], np.nan)
    resampled = np.full((len(drawn), flat.shape[1]), np.nan)
    for rows, columns in missing_patterns(flat):
        rows_design = design[rows]
        rank = np.linalg.matrix_rank(rows_design)
        others = rows_design[:, 1:]
        if rank == (np.linalg.matrix_rank(others) if others.size else 0):
            continue
        out[columns] = np.linalg.pinv(rows_design)[0] @ flat[np.ix_(rows, columns)]
        counts = drawn[:, rows]
        square = np.einsum("bi,ip,iq->bpq", counts, rows_design, rows_design)
        able = np.linalg.matrix_rank(square, hermitian=True) == rank
        weights = np.einsum(
            "bq,iq,bi->bi",
            np.linalg.pinv(square[able], hermitian=True)[:, 0],
            rows_design,
            counts[able],
        )
        resampled[np.ix_(able, columns)] = weights @ flat[np.ix_(rows, columns)]
    return out.reshape(values.shape[1:]), resampled.reshape(
        len(drawn), *values.shape[1:]
    )


def _deviation(resampled: Array) -> Array:
    """Standard deviation over resamples; NaN where over 10 % are undefined, or all are
    the same (a single subject).
    """
    count = np.isfinite(resampled).sum(axis=0)
    squares = known_mean((resampled - known_mean(resampled)) ** 2)
    rounding = (1e-9 * np.abs(np.nan_to_num(known_mean(resampled)))) ** 2
    return np.where(
        (count > 0.9 * len(resampled)) & (squares > rounding), np.sqrt(squares), np.nan
    )


def _flags(names: Sequence[str], counts: Array) -> list[str]:
    """Traits with few subjects on a side; all of a numeric attribute are on one side."""
    flags = []
    for name, (carries, lacks) in zip(names, counts.tolist(), strict=True):
        smallest = min(carries, lacks) if lacks else carries
        if smallest == 1:
            flags.append(
                f"{name}: only one subject {SIDES[carries > 1]} it, so that the "
                "vector contains an individual"
            )
        elif smallest < FEW:
            among = f"{carries} subjects with and {lacks} without"
            among = among if lacks else f"{carries} subjects"
            flags.append(f"{name}: {among}; the vector contains individual differences")
    return flags


def _mean_over_sites(values: Array) -> Array:
    """Means (n, ...) of values (n, site, ...)."""
    return known_mean(np.moveaxis(values, 1, 0))


def plot_traits(traits: Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the shift of the coefficients of the surface BRDF: rows are traits, columns
    are components of the basis.
    """
    shift = traits[variables.TRAIT_BRDF_SHIFT].values
    ax = ax or plots.new_axes(6, 1.2 + 0.22 * max(len(shift), 8))
    largest = max(float(np.abs(shift).max(initial=0.0)), 1e-12)
    image = ax.imshow(shift, cmap="RdBu_r", vmin=-largest, vmax=largest, aspect="auto")
    counts = [
        f"{t} ({w}/{o})"
        for t, (w, o) in zip(
            traits["trait"].values, traits[variables.TRAIT_COUNT].values, strict=True
        )
    ]
    ax.set_yticks(range(len(counts)), counts, fontsize=7)
    components = np.arange(shift.shape[1])
    ax.set_xticks(components, components + 1)
    ax.set_xlabel("component of the common basis (subjects with/without)")
    if not counts:
        ax.set_title("no attribute and no condition differs", fontsize=8)
    ax.figure.colorbar(image, ax=ax, label="coefficient with minus without")
    return ax


def tabulate_traits(traits: Dataset) -> Table:
    """Header and one row per trait: numbers of subjects, the distance of BRDFs, RMS lengths
    of the other parts of its vector, and their errors.
    """
    face = traits.sel(region=FACE, drop=True)
    columns = {
        f"subjects_{side}": traits[variables.TRAIT_COUNT].sel(side=side, drop=True)
        for side in SIDES
    }
    for name, variable in (
        ("brdf", BRDF_DISTANCE),
        ("colour", variables.TRAIT_QUANTILE_SHIFT),
        ("log_sigma_tr", LOG_SIGMA_TR),
    ):
        for column, part in (("shift", variable), ("noise", f"{variable}_error")):
            if part in face:
                dims = [dim for dim in face[part].dims if dim != "trait"]
                square = (face[part] ** 2).mean(dims, skipna=False)
                columns[f"{name}_{column}"] = square**0.5
    return table_of(traits.assign(columns), list(columns))


def compute(population: Population, parameters: TraitParameters) -> Results:
    """The results of the study."""
    rng = np.random.default_rng(parameters.seed)
    basis = population_basis(
        population.cohort,
        tables=population.brdf_tables(),
        k=parameters.k,
        rng=rng,
    )
    colours = albedo_and_texture(population)
    vectors = trait_vectors(
        population.open_cohort("tables"),
        basis=basis,
        albedo=colours["albedo"],
        texture=colours.get("texture"),
        adjust=parameters.adjust,
        rng=rng,
    )
    return {"population_basis": basis, "traits": vectors, **colours}


STUDY = Study(
    *DECLARED["traits"],
    layout="surfels",
    compute=compute,
    shown=("traits",),
    tabulate=tabulate_traits,
    plot=plot_traits,
    describe=lambda traits: traits.attrs["flags"],
    cohort_options={"surfels": SAMPLED},
    uses_registration=True,
)
