"""Combining Datasets of many takes into one labelled, lazy Dataset."""

import math
import re
import unicodedata
import uuid
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import NoneType
from typing import Any, NamedTuple, Protocol

import numpy as np
from xarray import Dataset, Variable

from skindb.errors import Fault, InputError, choices, few_names, require, require_none
from skindb.schema.label import label, text_labels
from skindb.schema.notes import note
from skindb.schema.variables import VARIABLES
from skindb.types import AnyArray

TAKE = "take"
NORMAL = "normal"  # the condition of bare skin
# of a variable of a cohort in one task; maps and samples of takes are larger
MAX_BLOCK_TAKES = 256
MAX_BLOCK_BYTES = 1 << 22
COMPARED = (
    "k",
    "mode",
    "rank",
    "eta",
    "surface_energy",
    "surface_energy_error",
    "hold_out_lights",
    "hold_out_cameras",
    "dictionary",
    "dictionary_digest",
)
EVEN = ("even_reflection", "even_reflection_error")
# attributes of models that cohorts name beside the parameters of the fit
OF_MODEL = ("dictionary", "dictionary_digest", "relative_reflectance", *EVEN)
# coordinate -> parameter of the fit, or attribute of the model
FIT_COORDS = {
    f"fit_{name}": name for name in (*COMPARED, "relative_reflectance", *EVEN)
}
# columns of the catalogue and coordinates of cohorts that are no attributes
COLUMN = re.compile(
    r"take|subject|condition|visit|repeat|session|consent|outdated|(fit|status|attribute)_.*|(.*_)?(generation|created)",
    re.DOTALL,
)


def take_name(
    subject: str, condition: str = NORMAL, visit: int = 1, repeat: int = 1
) -> str:
    """`<subject>[.<condition>[.<visit>[.<repeat>]]]`; at the end, the condition normal,
    the first visit and the first repeat are omitted.
    """
    parts = [subject, condition, visit, repeat]
    while parts[-1] == (None, NORMAL, 1, 1)[len(parts) - 1]:
        parts.pop()
    return ".".join(map(str, parts))


def visit_of(take: str) -> tuple[int, int]:
    """Visit and repeat of a take, by its name; 1 where it names none."""
    numbers = [int(part) for part in take.split(".")[2:4] if part.isdecimal()]
    visit, repeat = [*numbers, 1, 1][:2]
    return visit, repeat


class Values(NamedTuple):
    """Values of a variable of one take, along its dims."""

    array: AnyArray
    labels: Mapping[str, Sequence[Any]]  # dim -> labels, if it has some


class Source(Protocol):
    """Source of the values of a part; it is pickled into the tasks of a cohort."""

    def read(self, name: str) -> Values:
        """Values of a variable."""


def values_of(ds: Dataset, name: str) -> Values:
    """Values of a variable of a Dataset."""
    variables = ds.variables
    variable = variables[name]
    labels = {
        str(dim): variables[dim].values.tolist()
        for dim in variable.dims
        if dim in variables
    }
    return Values(variable.values, labels)


@dataclass(frozen=True)
class Part:
    """The Dataset of one take: its layout, and the source of its values."""

    take: str
    # subject, condition, visit, repeat, session, attributes and parameters of the fit
    coords: Mapping[str, Any]
    variables: Sequence[str]
    sizes: Mapping[str, int]
    labels: Mapping[str, Sequence[Any]]  # dim -> labels
    source: Source


@dataclass(frozen=True)
class Held:
    """A Dataset in memory as the source of a part."""

    ds: Dataset

    def read(self, name: str) -> Values:
        """Values of a variable of the Dataset."""
        return values_of(self.ds, name)

    @classmethod
    def part(cls, take: str, coords: Mapping[str, Any], ds: Dataset) -> Part:
        """The part of a cohort that a Dataset is."""
        labels = {
            str(dim): ds[dim].values.tolist() for dim in ds.dims if dim in ds.coords
        }
        sizes = {str(dim): size for dim, size in ds.sizes.items()}
        return Part(
            take, coords, [str(name) for name in ds.data_vars], sizes, labels, cls(ds)
        )


@lru_cache
def imitates_column(name: str) -> bool:
    """Whether the name of an attribute is that of another column of the catalogue, or
    looks like it.
    """
    plain = unicodedata.normalize("NFKC", name).casefold().strip()
    return COLUMN.fullmatch(re.sub(r"[\s-]+", "_", plain)) is not None


def attribute_name(name: str) -> str:
    """Name of the column of an attribute; data that were not ingested may have
    attributes that imitate columns.
    """
    return f"attribute_{name}" if imitates_column(name) else name


def take_coords(
    take: str, attrs: Mapping[Any, Any], fit: Mapping[Any, Any] | None = None
) -> dict[str, Any]:
    """Coordinates of one take: subject, condition, visit, repeat, session, attributes,
    and the parameters of its fit.

    Parameters
    ----------
    take
        Name of the take.
    attrs
        Attributes of a capture, or of a model.
    fit
        Attributes of its model, if there is one.
    """
    visit, repeat = visit_of(take)
    coords = {
        "subject": str(attrs.get("subject", take)),
        "condition": str(attrs.get("condition", NORMAL)),
        "visit": visit,
        "repeat": repeat,
        "session": attrs.get("session"),
    }
    for name, value in dict(attrs.get("traits", {})).items():
        if not isinstance(value, (dict, list)):
            coords[attribute_name(str(name))] = value
    if fit is not None:
        parameters = fit.get("parameters", {})
        for coordinate, name in FIT_COORDS.items():
            coords[coordinate] = (fit if name in OF_MODEL else parameters).get(name)
    return coords


def combine(
    parts: Sequence[Part],
    *,
    variables: Iterable[str] | None = None,
    sizes: Mapping[str, int] | None = None,
    attrs: Mapping[str, Any] | None = None,
) -> Dataset:
    """The Dataset of many takes, lazy, with the dim "take" in front.

    Parameters
    ----------
    parts
        One for each take.
    variables
        Default every variable that any take has.
    sizes
        Number of elements of dims without labels, such as surfel; default the largest of any take.
    attrs
        Attributes of the result.

    Returns
    -------
    Dataset
        Labels along a dim are those of all takes together. Where a take lacks a label
        or an element, the value is NaN, for a status its member for missing values, and
        0 for other integers. Coordinates along "take" are what the parts name; a value
        that a take does not have is missing (NaN).

    Raises
    ------
    InputError
        For a variable that no take has.
    """
    layouts = _different_layouts(parts)
    available = list(dict.fromkeys(name for part in layouts for name in part.variables))
    chosen = available if variables is None else list(dict.fromkeys(variables))
    if unknown := [name for name in chosen if name not in available]:
        raise InputError(
            Fault(
                f"variable {name}",
                "a cohort has it",
                "no take with it",
                choices(name, available),
            )
            for name in unknown
        )
    labels = _all_labels(layouts, chosen)
    extent = {dim: len(values) for dim, values in labels.items()}
    for part in layouts:
        for dim in _dims(part, chosen) - labels.keys():
            extent[dim] = max(extent.get(dim, 0), int(part.sizes[dim]))
    extent |= {dim: size for dim, size in (sizes or {}).items() if dim in extent}
    arrays = {
        name: _lazy(
            name,
            [part.source if name in part.variables else None for part in parts],
            extent,
            labels,
        )
        for name in chosen
    }
    coords: dict[Hashable, Any] = {
        dim: text_labels(values) for dim, values in labels.items()
    }
    coords[TAKE] = np.array([part.take for part in parts], object)
    taken = {*arrays, *coords, *extent}
    for name in dict.fromkeys(name for part in parts for name in part.coords):
        values = column([part.coords.get(name) for part in parts])
        coords[name if name not in taken else f"attribute_{name}"] = (TAKE, values)
    return Dataset(arrays, coords, dict(attrs or {}))


def column(values: Sequence[Any]) -> AnyArray:
    """Values of one attribute of takes as an array of numbers, truth values or text;
    NaN where it is missing.
    """
    types = {*map(type, values)}
    is_complete = NoneType not in types
    types.discard(NoneType)
    truths = {one for one in types if issubclass(one, bool)}
    numbers = {one for one in types if issubclass(one, (int, float))}
    if types and types == truths and is_complete:
        return np.array(values, bool)
    if not numbers:
        text = [np.nan if value is None else str(value) for value in values]
        return np.array(text, object)
    known = [np.nan if value is None else value for value in values]
    if types != numbers or truths:
        # numbers and words: each stays what it is
        return np.array(known, object)
    is_whole = is_complete and all(issubclass(one, int) for one in types)
    return np.array(known, np.int64 if is_whole else np.float64)


def one_take_each(cohort: Dataset) -> Dataset:
    """The first take of every subject in the condition normal, along the dim "subject".

    A subject who was measured only in other conditions is skipped and named in the
    attribute "skipped".
    """
    takes, subjects, conditions = (
        [str(word) for word in cohort[name].values.tolist()]
        for name in (TAKE, "subject", "condition")
    )
    index_by_subject: dict[str, int] = {}
    for i in sorted(range(len(takes)), key=lambda i: visit_of(takes[i])):
        if conditions[i] == NORMAL:
            index_by_subject.setdefault(subjects[i], i)
    missing = sorted(set(subjects) - set(index_by_subject))
    picked = cohort.isel({TAKE: sorted(index_by_subject.values())})
    return picked.swap_dims({TAKE: "subject"}).assign_attrs(
        skipped=[
            *cohort.attrs.get("skipped", []),
            *(note(subject, "no take in the condition normal") for subject in missing),
        ]
    )


def require_takes(cohort: Dataset, layout: str) -> None:
    """Raise `InputError` if a cohort has no dimension "take", or is not of the layout
    "tables" or "maps".
    """
    dims = ", ".join(map(str, cohort.dims)) or "none"
    cure = f'use db.cohort("{layout}")'
    rule = "must have the dimension take"
    require(TAKE in cohort.dims, "cohort", rule, f"the dimensions {dims}", cure)
    rule = "must hold maps with the dimensions v and u"
    require(layout != "maps" or "v" in cohort.dims, "cohort", rule, "tables", cure)


def require_comparable(cohort: Dataset, layout: str) -> None:
    """`require_takes`, and `require_same_fit` unless the attribute ``mixed_fits`` is set."""
    require_takes(cohort, layout)
    if not cohort.attrs.get("mixed_fits"):
        require_same_fit(cohort)


def require_same_fit(cohort: Dataset) -> None:
    """Raise `InputError` if takes of a cohort were fitted with different parameters.

    Results of such takes differ for that reason too: a refractive index of 1.4 instead
    of 1.3 once made a trait vector seven times as long.
    """
    faults = []
    takes = cohort[TAKE].values.tolist()
    for name in COMPARED:
        if f"fit_{name}" not in cohort.coords:
            continue
        groups: dict[str, list[str]] = {}
        for take, value in zip(
            takes, cohort[f"fit_{name}"].values.tolist(), strict=True
        ):
            # models of earlier versions do not say all
            if value is not None and value == value and value != "":
                groups.setdefault(str(value), []).append(str(take))
        if len(groups) > 1:
            rule = "the takes of a study are fitted with the same parameters"
            finding = "; ".join(f"{v} of {few_names(of)}" for v, of in groups.items())
            cure = "refit them alike, or name the takes that the study is to use"
            faults.append(Fault(f"parameter {name}", rule, finding, cure))
    require_none(faults)


def _all_labels(
    parts: Sequence[Part], variables: Sequence[str]
) -> dict[str, list[Any]]:
    """Dim -> the labels of all takes, in the order in which they are met."""
    labels: dict[str, dict[Any, None]] = {}
    for part in parts:
        for dim in sorted(_dims(part, variables) & part.labels.keys()):
            labels.setdefault(dim, {}).update(dict.fromkeys(part.labels[dim]))
    return {dim: list(values) for dim, values in labels.items()}


def _different_layouts(parts: Sequence[Part]) -> list[Part]:
    """One part of each layout; parts of a large cohort share the objects that describe it."""
    layouts: dict[tuple[int, int, int], Part] = {}
    for part in parts:
        key = (id(part.variables), id(part.sizes), id(part.labels))
        layouts.setdefault(key, part)
    return [*layouts.values()]


def _dims(part: Part, variables: Sequence[str]) -> set[str]:
    """Dims of those of these variables that a part has."""
    names = {*part.variables}.intersection(variables)
    return {dim for name in names for dim in VARIABLES[name].dims}


@dataclass(frozen=True)
class Stack:
    """A variable of many takes as an array, of which only the selected takes are read."""

    variable: str
    sources: tuple[Source | None, ...]  # of each take; None if it lacks the variable
    size: tuple[int, ...]  # of the values of one take
    places: Mapping[str, Mapping[Any, int]]  # dim -> index of each label

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of takes, and size of the values of one."""
        return (len(self.sources), *self.size)

    @property
    def ndim(self) -> int:
        """Number of dims."""
        return len(self.shape)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the values."""
        return _absent(self.variable, ()).dtype

    def __getitem__(self, key: tuple[Any, ...]) -> AnyArray:
        first, *others = key
        takes = np.arange(len(self.sources))[first]
        blank = np.broadcast_to(_absent(self.variable, ()), self.size)
        out = np.empty((takes.size, *selected(blank, others).shape), self.dtype)
        for i, take in enumerate(takes.flat):
            source = self.sources[take]
            values = blank
            if source is not None:
                values = self._in_layout(source.read(self.variable))
            out[i] = selected(values, others)
        return out if takes.ndim else out[0]

    def _in_layout(self, values: Values) -> AnyArray:
        """Values of one take in the layout of the cohort."""
        indices = []
        extents = zip(
            VARIABLES[self.variable].dims, values.array.shape, self.size, strict=True
        )
        for dim, length, size in extents:
            if dim in self.places and dim in values.labels:
                place = self.places[dim]
                indices.append([place[label] for label in values.labels[dim]])
            else:
                indices.append([*range(min(length, size))])
        inside = values.array[tuple(slice(len(index)) for index in indices)]
        if indices == [[*range(size)] for size in self.size]:
            return inside
        out = _absent(self.variable, self.size)
        out[np.ix_(*indices)] = inside
        return out


def selected(values: AnyArray, key: Sequence[Any]) -> AnyArray:
    """Values at a slice, index or list of indices along each of the first dims."""
    for dim, index in reversed([*enumerate(key)]):
        values = values[(slice(None),) * dim + (index,)]
    return values


def _lazy(
    name: str,
    sources: Iterable[Source | None],
    extent: Mapping[str, int],
    labels: Mapping[str, Sequence[Any]],
) -> Variable:
    """A variable of every take, in blocks of few bytes; selected takes are read alone."""
    # a third of the start-up of `skindb info`, which forms no arrays
    import dask.array as da

    dims = VARIABLES[name].dims
    stack = Stack(
        name,
        tuple(sources),
        tuple(extent[dim] for dim in dims),
        {
            dim: {value: i for i, value in enumerate(labels[dim])}
            for dim in dims
            if dim in labels
        },
    )
    take_bytes = max(stack.dtype.itemsize * math.prod(stack.size), 1)
    takes = min(max(MAX_BLOCK_BYTES // take_bytes, 1), MAX_BLOCK_TAKES)
    data = da.from_array(  # type: ignore[no-untyped-call]
        stack,
        chunks=(takes, *stack.size),
        name=f"cohort-{uuid.uuid4().hex}",
        meta=np.empty((0,) * stack.ndim, stack.dtype),
    )
    plain = label(name, np.zeros((0,) * len(dims)))
    return Variable((TAKE, *dims), data, plain.attrs)


def _absent(name: str, shape: tuple[int, ...]) -> AnyArray:
    spec = VARIABLES[name]
    dtype = np.dtype(spec.dtype)
    return np.full(shape, spec.absent if dtype.kind in "iu" else np.nan, dtype)
