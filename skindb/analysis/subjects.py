"""What is known of the subjects of a cohort: attributes, parsed once, and the traits and
groups that they give.

A trait is an attribute with a value, such as ``condition:lotion`` or ``gender:male``; a
boolean attribute is a trait by itself, and ``age:older`` is an age above the median of
the subjects. The value alone can name a trait if no other attribute has this value.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from statistics import fmean
from typing import Any

import numpy as np
from xarray import Dataset

from skindb.errors import Fault, InputError, input_error, require
from skindb.numerics.statistics import Moments, known_mean
from skindb.schema.notes import Note, note
from skindb.types import Array, Mask

Value = bool | int | float | str | None  # None where it is unknown
CONDITION = "condition"
NORMAL = "normal"
AGE = "age"
OLDER = "age:older"
MAX_AGE = 130  # years
ALL_TAKES = "all"
UNKNOWN = "unknown"
OTHER = "other conditions"
# coordinates along "take" that describe no subject
NO_ATTRIBUTES = ("take", "subject", "visit", "repeat", "session", "model_generation")
# coordinate of the error of R_d that all channels of a take share
LEVEL = "fit_even_reflection_error"
EVEN = "fit_even_reflection"  # what was subtracted from R_d of a take
FIT = "fit_"  # prefix of coordinates that are parameters of the fit


@dataclass(frozen=True)
class Attribute:
    """Values of an attribute, of takes or of subjects.

    Ages are in years; other numbers have the unit that the captures give them.
    """

    name: str
    values: tuple[Value, ...]

    @property
    def known(self) -> list[Value]:
        """The values that are known."""
        return [value for value in self.values if value is not None]

    @property
    def words(self) -> list[str]:
        """Different values as text, sorted."""
        return sorted({str(value) for value in self.known})

    @property
    def numbers(self) -> Array:
        """Values that are numbers; NaN for the others."""
        return np.array(
            [float(value) if _is_number(value) else np.nan for value in self.values]  # type: ignore[arg-type]
        )

    @property
    def is_numeric(self) -> bool:
        """Whether all values are numbers, of which more than two differ."""
        return all(map(_is_number, self.known)) and len(set(self.known)) > 2

    @property
    def odd_words(self) -> list[str]:
        """Sorted values that cannot be read as numbers, if others can."""
        words = [word for word in self.words if not _reads_as_number(word)]
        return words if words != self.words else []

    @property
    def columns(self) -> Array:
        """Regression columns (n, c): a centred number, or indicators of all values
        except the first. NaN where the attribute is unknown.
        """
        if self.is_numeric:
            return (self.numbers - np.nanmean(self.numbers))[:, None]
        columns = np.array(
            [[float(str(v) == word) for word in self.words[1:]] for v in self.values]
        ).reshape(len(self.values), -1)
        is_known = np.array([value is not None for value in self.values])
        return np.where(is_known[:, None], columns, np.nan)

    def require_one_kind(self) -> None:
        """Raise `InputError` if some values are numbers and others are words."""
        if words := self.odd_words:
            raise input_error(
                f"attribute {self.name}",
                "must be a number for all subjects or a word for all",
                f"numbers and {', '.join(map(repr, words[:3]))}",
                "correct the traits in capture.json and ingest again",
            )

    def notes(self) -> list[str]:
        """Lines about values that are likely to be mistakes."""
        notes = []
        if words := self.odd_words:
            examples = ", ".join(map(repr, words[:3]))
            notes.append(f"{self.name}: numbers and {examples}; it is not compared")
        spellings: dict[str, set[str]] = {}
        for value in self.values:
            if isinstance(value, str):
                spellings.setdefault(value.strip().casefold(), set()).add(value)
        for same in spellings.values():
            if len(same) > 1:
                alike = " and ".join(map(repr, sorted(same)))
                notes.append(f"{self.name}: {alike} count as different values")
        ages = self.numbers.tolist() if self.name == AGE else []
        odd = sorted({f"{age:g}" for age in ages if age < 0 or age > MAX_AGE})
        if odd:
            examples = ", ".join(odd[:3])
            rule = f"must be in years, from 0 to {MAX_AGE}"
            notes.append(f"{AGE}: {rule}; found {examples}")
        return notes


@dataclass(frozen=True)
class Subjects:
    """The takes of a cohort, with the subject and the attributes of each."""

    take: tuple[str, ...]
    subject: tuple[str, ...]
    attributes: Mapping[str, Attribute]  # by the names that the captures give them

    @property
    def is_normal(self) -> Mask:
        """Mask (take,) of the takes in the condition normal."""
        if CONDITION not in self.attributes:
            return np.ones(len(self.take), bool)
        conditions = self.attributes[CONDITION].values
        return np.array([value == NORMAL for value in conditions], bool)

    @property
    def names(self) -> tuple[str, ...]:
        """The subjects, in the order of their first takes."""
        return tuple(dict.fromkeys(self.subject))

    @property
    def described(self) -> list[str]:
        """Attributes of the subjects, which are the same in all conditions."""
        return [name for name in self.attributes if name != CONDITION]

    def attribute(self, name: str) -> Attribute:
        """An attribute of the takes, unknown in all of them if none states it."""
        unknown = Attribute(name, (None,) * len(self.take))
        return self.attributes.get(name, unknown)

    def select(self, rows: Iterable[int]) -> Subjects:
        """The takes with these indices."""
        rows = list(rows)
        return Subjects(
            tuple(self.take[i] for i in rows),
            tuple(self.subject[i] for i in rows),
            {
                name: Attribute(name, tuple(attribute.values[i] for i in rows))
                for name, attribute in self.attributes.items()
            },
        )

    def by_subject(self, name: str, subjects: Sequence[str]) -> Attribute:
        """An attribute of the named subjects, each from its first take that has it, or the
        mean of numbers.
        """
        values: dict[str, list[Any]] = {}
        attribute = self.attribute(name)
        for subject, value in zip(self.subject, attribute.values, strict=True):
            if value is not None:
                values.setdefault(subject, []).append(value)
        value_from = fmean if attribute.is_numeric else itemgetter(0)
        value_of = {subject: value_from(known) for subject, known in values.items()}
        return Attribute(name, tuple(value_of.get(subject) for subject in subjects))

    def require_constant(self, name: str) -> None:
        """Raise `InputError` if words of an attribute differ between takes of a subject."""
        attribute = self.attribute(name)
        values: dict[str, set[Value]] = {}
        for subject, value in zip(self.subject, attribute.values, strict=True):
            values.setdefault(subject, set()).add(value)
        differ = [
            f"{', '.join(sorted(map(str, known)))} of {subject}"
            for subject, found in values.items()
            if len(known := found - {None}) > 1
        ]
        require(
            attribute.is_numeric or not differ,
            f"attribute {name}",
            "must be the same in all takes of a subject",
            differ[0] if differ else "",
            "compare within subjects by analyze model, with (1 | subject)",
        )

    def rows_of(self, subject: str) -> Mask:
        """Mask (take,) of the takes of a subject."""
        return np.array([name == subject for name in self.subject], bool)


def subjects_of(cohort: Dataset) -> Subjects:
    """Parse the attributes of the takes of a cohort."""
    attributes = {}
    for name, coordinate in cohort.coords.items():
        name = str(name)
        if coordinate.dims == ("take",):
            attributes[name] = Attribute(name, tuple(map(_parsed, coordinate.values)))
    takes, subjects = (attributes[name].values for name in ("take", "subject"))
    return Subjects(
        tuple(map(str, takes)),
        tuple(map(str, subjects)),
        {
            name: attribute
            for name, attribute in attributes.items()
            if name not in NO_ATTRIBUTES and not name.startswith(FIT)
        },
    )


def takes_to_compare(cohort: Dataset, group_by: str | None) -> tuple[Dataset, Subjects]:
    """Takes that are used in a comparison, with their subjects: those in the condition
    normal, or all takes if conditions are compared.

    Raises
    ------
    InputError
        If no take remains.
    """
    subjects = subjects_of(cohort)
    compared = group_by is not None and attribute_of(subjects, group_by) == CONDITION
    rows = np.flatnonzero(subjects.is_normal | compared)
    require(
        rows.size,
        "population",
        "groups must have a take in the condition normal",
        f"only {', '.join(subjects.take)}",
        "group by condition, or add takes in the condition normal",
    )
    return cohort.isel(take=rows), subjects.select(rows)


@dataclass(frozen=True)
class Groups:
    """Takes that are compared, and those of each group."""

    takes: Dataset
    subject: tuple[str, ...]  # of each take
    members: dict[str, list[int]]  # sorted names of the groups -> rows of their takes
    attrs: dict[str, Any]  # of a table of the groups

    def moments(self, values: Array) -> Moments:
        """Moments (group, ...), over subjects, of values (take, ...)."""
        return Moments.stacked(map(Moments.of, self.of_subjects(values)))

    def of_subjects(
        self, values: Array, average: Callable[[Array], Array] = known_mean
    ) -> list[Array]:
        """Averages (subject, ...) over the takes of each subject, of every group."""
        groups = []
        for rows in self.members.values():
            of_subject: dict[str, list[int]] = {}
            for row in rows:
                of_subject.setdefault(self.subject[row], []).append(row)
            groups.append(
                np.stack([average(values[takes]) for takes in of_subject.values()])
            )
        return groups


def grouped(cohort: Dataset, group_by: str | None) -> Groups:
    """The groups of a comparison; see `takes_to_compare` and `groups_by`."""
    takes, subjects = takes_to_compare(cohort, group_by)
    members: dict[str, list[int]] = {}
    for row, name in enumerate(groups_by(subjects, group_by)):
        members.setdefault(name, []).append(row)
    attrs = {
        "takes": sorted(subjects.take),
        "group_by": group_by or "",
        "skipped": list(cohort.attrs.get("skipped", [])),
    }
    return Groups(takes, subjects.subject, dict(sorted(members.items())), attrs)


def describe_visits(cohort: Dataset) -> str:
    """Which of repeated takes of a subject in a condition are used; empty if there are none."""
    takes = list(zip(cohort["subject"].values, cohort["condition"].values, strict=True))
    if len(set(takes)) == len(takes):
        return ""
    count = len(set(cohort["subject"].values))
    return (
        f"{len(takes)} takes of {count} subjects; a subject counts with the mean over its "
        "visits and repeats in a condition"
    )


def level_error(takes: Dataset) -> float:
    """Largest standard error of R_d that the takes have in common by the prior of their
    surface's reflection; NaN if no take states one.
    """
    if LEVEL not in takes.coords:
        return math.nan
    errors = takes[LEVEL].values.astype(float)
    return float(np.nanmax(errors)) if np.isfinite(errors).any() else math.nan


def groups_by(subjects: Subjects, name: str | None) -> list[str]:
    """Name of the group of every take, by an attribute or a trait; None puts all takes
    into one group.

    Raises
    ------
    InputError
        If no take has the attribute or trait.
    """
    if name is None:
        return [ALL_TAKES] * len(subjects.take)
    if name in subjects.attributes:
        values = subjects.attributes[name].values
        return [UNKNOWN if value is None else word_of(value) for value in values]
    trait = trait_of(subjects, name)
    lacks = has_attribute(subjects, trait)
    rest = UNKNOWN
    if trait.startswith(f"{CONDITION}:"):
        # only takes in the condition normal count as without it
        lacks = subjects.is_normal
        rest = OTHER
    sides = [has_trait(subjects, trait), lacks]
    return [*map(str, np.select(sides, [trait, f"not {trait}"], rest))]


def attribute_of(subjects: Subjects, name: str) -> str:
    """The attribute to which a trait belongs; the name itself if it is an attribute."""
    if name in subjects.attributes:
        return name
    return parts_of(subjects, trait_of(subjects, name))[0]


def parts_of(subjects: Subjects, trait: str) -> tuple[str, str]:
    """Attribute and value of a trait; names of attributes may contain colons."""
    names = [name for name in subjects.attributes if f"{trait}:".startswith(f"{name}:")]
    attribute = max(names, key=len, default=trait)
    return attribute, trait[len(attribute) + 1 :]


def trait_of(subjects: Subjects, name: str) -> str:
    """Full name of the trait that a name refers to; the error lists the attributes and
    traits that can be used.
    """
    traits = known_traits(subjects)
    try:
        return trait_name(name, traits)
    except InputError as error:
        finding = error.faults[0].found
        raise input_error(
            f"group by {name}",
            "must be an attribute or a trait",
            finding,
            f"choose from the attributes: {', '.join(sorted(subjects.attributes))}; "
            f"traits: {', '.join(traits) or 'none'}",
        ) from None


def trait_name(name: str, candidates: Iterable[str]) -> str:
    """Full name of the trait that a name refers to: a full name, or a value that only
    one trait has.

    Raises
    ------
    InputError
        If the name refers to no trait, or to more than one.
    """
    traits = list(candidates)
    if name in traits:
        return name
    meant = [trait for trait in traits if trait.partition(":")[2] == name]
    if len(meant) == 1:
        return meant[0]
    finding = (
        f"{len(meant)} matches: {', '.join(meant)}" if meant else "an unknown name"
    )
    raise input_error(
        f"trait {name}",
        "must name exactly one trait of the population",
        finding,
        f"choose from: {', '.join(traits) or 'none'}",
    )


def known_traits(subjects: Subjects) -> list[str]:
    """All traits that any take has, in alphabetical order."""
    traits = set()
    for name, attribute in subjects.attributes.items():
        for value in attribute.values:
            if isinstance(value, str):
                traits.add(f"{name}:{value}")
            elif value is True:
                traits.add(name)
    if np.isfinite(subjects.attribute(AGE).numbers).any():
        traits.add(OLDER)
    return sorted(traits - {f"{CONDITION}:{NORMAL}"})


def trait_names(subjects: Subjects) -> list[str]:
    """All traits that some takes have and others lack, in alphabetical order."""
    return [
        name
        for name in known_traits(subjects)
        if all(side.any() for side in sides(subjects, name))
    ]


def sides(subjects: Subjects, trait: str) -> tuple[Mask, Mask]:
    """Masks (take,) of the comparable takes with and without a trait."""
    carries = has_trait(subjects, trait)
    usable = comparable_takes(subjects, trait)
    return carries & usable, ~carries & usable


def has_trait(subjects: Subjects, trait: str) -> Mask:
    """Mask (take,) of the takes that have a trait, given by its full name."""
    name, value = parts_of(subjects, trait)
    if trait == OLDER:
        ages = subjects.by_subject(AGE, subjects.names).numbers
        known = ages[np.isfinite(ages)]
        median = np.median(known) if known.size else np.inf
        # that of the subject: visits at other ages are not on both sides
        ages = subjects.by_subject(AGE, subjects.subject).numbers
        return has_attribute(subjects, trait) & (ages > median)
    values = subjects.attribute(name).values
    return np.array([v == value if value else v is True for v in values], bool)


def has_attribute(subjects: Subjects, trait: str) -> Mask:
    """Mask (take,) of the takes that have the attribute of a trait."""
    attribute = subjects.attribute(parts_of(subjects, trait)[0])
    if trait == OLDER:
        return np.isfinite(attribute.numbers)
    return np.array([value is not None for value in attribute.values], bool)


def comparable_takes(subjects: Subjects, trait: str) -> Mask:
    """Mask (take,) of the takes that are compared for a trait; takes without its
    attribute are excluded.

    A condition is compared within the subjects that were measured with and without it,
    if there are any: between subjects it would be confounded with everything else that
    differs.
    """
    carries = has_trait(subjects, trait)
    plain = subjects.is_normal
    if not trait.startswith(f"{CONDITION}:"):
        # takes in other conditions are used only if no take with the trait is in the
        # condition normal
        is_used = plain if (carries & plain).any() else plain | carries
        return has_attribute(subjects, trait) & is_used
    names = np.array(subjects.subject)
    paired = set(names[carries]) & set(names[plain])
    if not paired:
        return carries | plain
    return np.isin(names, list(paired)) & (carries | plain)


def compared_conditions(subjects: Subjects, parameters: Any) -> list[str]:
    """The condition of a comparison by `group_by`; none where conditions are compared."""
    group_by = getattr(parameters, "group_by", None)
    compared = None if group_by is None else attribute_of(subjects, group_by)
    return [] if compared == CONDITION else [NORMAL]


def subjects_without(subjects: Subjects, conditions: Sequence[str]) -> list[Note]:
    """One note for each subject without a take in one of the conditions, if any are named."""
    found = zip(subjects.subject, subjects.attribute(CONDITION).values, strict=True)
    counted = {subject for subject, condition in found if condition in conditions}
    names = [name for name in subjects.names if conditions and name not in counted]
    reason = f"no take in the condition {' or '.join(conditions)}"
    return [note(subject, reason) for subject in names]


def numeric_attributes(subjects: Subjects) -> list[str]:
    """Attributes with more than two different numbers, sorted."""
    return [
        name
        for name in sorted(subjects.attributes)
        if len({x for x in subjects.attribute(name).numbers if np.isfinite(x)}) > 2
    ]


def notes_on_attributes(subjects: Subjects) -> list[str]:
    """Lines about values of attributes that are likely to be mistakes."""
    return [
        line
        for name in subjects.described
        for line in subjects.by_subject(name, subjects.names).notes()
    ]


def require_adjustable(
    subjects: Subjects, adjust: Sequence[str], compared: str = ""
) -> None:
    """Raise `InputError` if a name in `adjust` is not an attribute, or is the compared
    attribute.
    """
    able = sorted(set(subjects.described) - {compared})
    if unknown := [name for name in adjust if name not in able]:
        rule = "must be an attribute other than the compared one"
        cure = f"choose from: {', '.join(able) or 'none'}"
        raise InputError(
            Fault(f"adjust {name}", rule, "an unknown name", cure) for name in unknown
        )


def multiple_correlation(y: Array, columns: Array) -> float:
    """Multiple correlation of values (n,) with columns (n, c), adjusted for their
    number; NaN where it is not determined.
    """
    x = np.column_stack([np.ones(len(y)), columns])
    free = len(y) - np.linalg.matrix_rank(x) if len(y) else 0
    if free < 1 or np.ptp(y) == 0:
        return float("nan")
    residual = y - x @ np.linalg.lstsq(x, y)[0]
    return float(
        np.sqrt(max(0.0, 1.0 - (residual @ residual / free) / np.var(y, ddof=1)))
    )


def word_of(value: Value) -> str:
    """A value as the name of a group: 20.0 is "20"."""
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    return str(value)


def _parsed(value: object) -> Value:
    """A value of a coordinate; None where it is missing (None, NaN or empty text)."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or value != value or value == "":
        return None
    return value if isinstance(value, bool | int | float | str) else str(value)


def _is_number(value: Value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _reads_as_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
