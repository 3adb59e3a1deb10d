"""Selection of the takes of a cohort for comparisons, their groups and their traits.

A trait is an attribute with a value, such as ``condition:lotion`` or ``gender:male``; a
boolean attribute is a trait by itself, and ``age:older`` is an age above the median of
the subjects. The value alone can name a trait if no other attribute has this value.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import xarray as xr

from skindb.errors import Fault, InputError
from skindb.schema.notes import Note, note
from skindb.types import Array, Mask

CONDITION = "condition"
NORMAL = "normal"
AGE = "age"
OLDER = "age:older"
ALL_TAKES = "all"
UNKNOWN = "unknown"
OTHER = "other conditions"
# coordinates along "take" that describe no subject
NO_ATTRIBUTES = ("take", "subject", "session", "model_generation")
FIT = "fit_"  # prefix of coordinates that are parameters of the fit


def attributes(cohort: xr.Dataset) -> dict[str, xr.DataArray]:
    """Attributes of the takes, by the names that the captures give them, with their
    values along "take".
    """
    named = {
        str(name): coord
        for name, coord in cohort.coords.items()
        if coord.dims == ("take",)
    }
    return {
        name: coord
        for name, coord in named.items()
        if name not in NO_ATTRIBUTES and not name.startswith(FIT)
    }


def texts(coord: xr.DataArray) -> list[str | None]:
    """Values as text; None where a value is missing (None, NaN or empty text)."""
    return [
        None if one is None or one != one or one == "" else str(one)
        for one in coord.values.tolist()
    ]


def trait_names(cohort: xr.Dataset) -> list[str]:
    """All traits that some takes have and others lack, in alphabetical order."""
    return [
        name
        for name in known_traits(cohort)
        if all(side.any() for side in sides(cohort, name))
    ]


def trait_name(name: str, known: Iterable[str]) -> str:
    """Full name of the trait that a name refers to: a full name, or a value that only
    one trait has.

    Raises
    ------
    InputError
        If the name refers to no trait, or to more than one.
    """
    traits = list(known)
    if name in traits:
        return name
    meant = [trait for trait in traits if trait.partition(":")[2] == name]
    if len(meant) == 1:
        return meant[0]
    found = f"{len(meant)} matches: {', '.join(meant)}" if meant else "an unknown name"
    cure = f"choose from: {', '.join(traits) or 'none'}"
    raise InputError(
        Fault(
            f"trait {name}",
            "must name exactly one trait of the population",
            found,
            cure,
        )
    )


def sides(cohort: xr.Dataset, trait: str) -> tuple[Mask, Mask]:
    """Masks (take,) of the comparable takes with and without a trait."""
    carries = has_trait(cohort, trait)
    usable = comparable_takes(cohort, trait)
    return carries & usable, ~carries & usable


def has_trait(cohort: xr.Dataset, trait: str) -> Mask:
    """Mask (take,) of the takes that have a trait, given by its full name."""
    attribute, _, value = trait.partition(":")
    if trait == OLDER:
        ages = number_of_takes(cohort, AGE)
        subjects: dict[str | None, float] = {}
        for subject, age in zip(texts(cohort["subject"]), ages.tolist(), strict=True):
            if np.isfinite(age):  # use the first take of a subject that states an age
                subjects.setdefault(subject, age)
        known = list(subjects.values())
        return np.asarray(ages > (np.median(known) if known else np.inf))
    coord = attributes(cohort).get(attribute)
    if coord is None:
        return np.zeros(cohort.sizes["take"], np.bool_)
    return np.array(
        [
            one is True or one is np.True_ if not value else one == value
            for one in coord.values.tolist()
        ],
        np.bool_,
    )


def has_attribute(cohort: xr.Dataset, trait: str) -> Mask:
    """Mask (take,) of the takes that have the attribute of a trait."""
    if trait == OLDER:
        return np.isfinite(number_of_takes(cohort, AGE))
    coord = attributes(cohort).get(trait.partition(":")[0])
    return np.array(
        [False] * cohort.sizes["take"]
        if coord is None
        else [one is not None for one in texts(coord)]
    )


def comparable_takes(cohort: xr.Dataset, trait: str) -> Mask:
    """Mask (take,) of the takes that are compared for a trait; takes without its
    attribute are excluded.

    A condition is compared within the subjects that were measured with and without it,
    if there are any: between subjects it would be confounded with everything else that
    differs.
    """
    carries = has_trait(cohort, trait)
    subjects = np.array([str(one) for one in texts(cohort["subject"])])
    plain = is_normal(cohort)
    if not trait.startswith(f"{CONDITION}:"):
        # takes in other conditions are used only if no take with the trait is in the
        # condition normal
        return np.asarray(
            has_attribute(cohort, trait)
            & (plain if (carries & plain).any() else plain | carries)
        )
    paired = {s for s in subjects[carries] if ((subjects == s) & plain).any()}
    if not paired:
        return np.asarray(carries | plain)
    return np.asarray(np.isin(subjects, list(paired)) & (carries | plain))


def subjects_without_normal(cohort: xr.Dataset) -> list[Note]:
    """One note for each subject without a take in the condition normal; such subjects
    are not compared with others.
    """
    subjects = np.array([str(one) for one in texts(cohort["subject"])])
    plain = is_normal(cohort)
    others = [
        str(one) for one in dict.fromkeys(subjects) if not plain[subjects == one].any()
    ]
    return [note(subject, "no take in the condition normal") for subject in others]


def takes_to_compare(cohort: xr.Dataset, group_by: str | None) -> xr.Dataset:
    """Takes that are used in a comparison: those in the condition normal, or all takes
    if conditions are compared.

    Raises
    ------
    InputError
        If no take remains.
    """
    compared = group_by == CONDITION
    if group_by is not None and not compared and group_by not in attributes(cohort):
        compared = trait_of(cohort, group_by).startswith(f"{CONDITION}:")
    kept = cohort if compared else cohort.isel(take=np.flatnonzero(is_normal(cohort)))
    if not kept.sizes["take"]:
        rule = "groups must have a take in the condition normal"
        found = f"only {', '.join(map(str, cohort['take'].values))}"
        cure = "group by condition, or add takes in the condition normal"
        raise InputError(Fault("population", rule, found, cure))
    return kept


def groups_by(cohort: xr.Dataset, name: str | None) -> list[str]:
    """Name of the group of every take, by an attribute or a trait; None puts all takes
    into one group.

    Raises
    ------
    InputError
        If no take has the attribute or trait.
    """
    if name is None:
        return [ALL_TAKES] * cohort.sizes["take"]
    if name in attributes(cohort):
        coord = attributes(cohort)[name]
        known = [one is not None for one in texts(coord)]
        return [
            _text(one) if there else UNKNOWN
            for one, there in zip(coord.values.tolist(), known, strict=True)
        ]
    trait = trait_of(cohort, name)
    words = {(True, True): trait, (False, True): f"not {trait}"}
    pairs = list(
        zip(
            has_trait(cohort, trait).tolist(),
            has_attribute(cohort, trait).tolist(),
            strict=True,
        )
    )
    # only takes in the condition normal count as without it
    if trait.startswith(f"{CONDITION}:"):
        plain = is_normal(cohort)
        return [
            trait if carries else f"not {trait}" if plain[i] else OTHER
            for i, (carries, _) in enumerate(pairs)
        ]
    return [words.get(pair, UNKNOWN) for pair in pairs]


def trait_of(cohort: xr.Dataset, name: str) -> str:
    """Full name of the trait that a name refers to; the error lists the attributes and
    traits that can be used.
    """
    known = known_traits(cohort)
    try:
        return trait_name(name, known)
    except InputError as error:
        there = (
            f"choose from the attributes: {', '.join(sorted(attributes(cohort)))}; "
            f"traits: {', '.join(known) or 'none'}"
        )
        found = error.faults[0].found
        rule = "must be an attribute or a trait"
        raise InputError(Fault(f"group by {name}", rule, found, there)) from None


def known_traits(cohort: xr.Dataset) -> list[str]:
    """All traits that any take has, in alphabetical order."""
    found = set()
    for name, coord in attributes(cohort).items():
        values = coord.values.tolist()
        found |= {f"{name}:{one}" for one in values if isinstance(one, str) and one} - {
            f"{CONDITION}:{NORMAL}"
        }
        found |= {name for one in values if isinstance(one, bool | np.bool_) and one}
    if np.isfinite(number_of_takes(cohort, AGE)).any():
        found.add(OLDER)
    return sorted(found)


def is_normal(cohort: xr.Dataset) -> Mask:
    """Mask (take,) of the takes in the condition normal."""
    if CONDITION not in cohort.coords:
        return np.ones(cohort.sizes["take"], np.bool_)
    return np.array([one == NORMAL for one in texts(cohort[CONDITION])], np.bool_)


def numeric_attributes(cohort: xr.Dataset) -> list[str]:
    """Numeric attributes: those with more than two different numbers."""
    return [
        name
        for name in sorted(attributes(cohort))
        if len(set(_finite(number_of_takes(cohort, name)))) > 2
    ]


def number_of_takes(cohort: xr.Dataset, name: str) -> Array:
    """Values (take,) of an attribute that are numbers; NaN for the others."""
    coord = attributes(cohort).get(name)
    if coord is None:
        return np.full(cohort.sizes["take"], np.nan)
    values = coord.values.tolist()
    numbers = [
        isinstance(one, int | float | np.number) and not isinstance(one, bool)
        for one in values
    ]
    return np.array(
        [
            float(one) if good else np.nan
            for one, good in zip(values, numbers, strict=True)
        ]
    )


def _finite(values: Array) -> list[float]:
    return [one for one in values.tolist() if np.isfinite(one)]


def _text(value: object) -> str:
    return (
        str(int(value))
        if isinstance(value, float) and value.is_integer()
        else str(value)
    )
