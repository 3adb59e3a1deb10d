"""A study of a population as one record: what it reads, its parameters, its results; and the
application of functions to every take of a cohort.

The command analyze, the functions of `skindb.workflow`, the names under which studies are
stored and their repetition by ``refresh`` follow from these records.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import wraps
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
from dask.base import compute
from dask.delayed import Delayed, delayed
from xarray import Dataset

from skindb.schema.notes import Note
from skindb.threads import c_contiguous
from skindb.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from skindb.analysis.subjects import Subjects


Result = TypeVar("Result")
Results = dict[str, Dataset]  # group of the stored version -> its variables
Table = tuple[list[str], list[list[Any]]]  # header and rows


def each_take(
    function: Callable[..., Result],
    cohort: Dataset,
    variables: Iterable[str],
    *shared: Any,
) -> list[Result]:
    """Apply a function to every take of a cohort and return the results in the order of the takes.

    Parameters
    ----------
    function
        Called with the loaded Dataset of one take and with the shared values; its
        result should be small.
    cohort
        Dataset with the dimension ``take``.
    variables
        Names of the variables and coordinates that the function receives; names that
        the cohort lacks are ignored.
    shared
        Arrays, or Dask collections, that every call receives; the graph holds one copy of each.
    """
    names = [name for name in variables if name in cohort.variables]
    chosen = cohort[names]
    chosen = chosen.drop_vars(
        [name for name in chosen.coords if name not in names]
    )  # otherwise every task would hold them
    takes = [chosen.isel(take=i) for i in range(cohort.sizes["take"])]
    call = delayed(_InOrder(function), pure=False, traverse=False)
    once = [shared_once(value) for value in shared]
    return list(compute(*(call(value, *once) for value in takes)))  # type: ignore[no-untyped-call]


def each_item(function: Callable[[Any], Result], items: Iterable[Any]) -> list[Result]:
    """Apply a function to every item; the graph holds one copy of `function`."""
    call = delayed(_InOrder(function), pure=False, traverse=False)
    return list(compute(*(call(item) for item in items)))  # type: ignore[no-untyped-call]


@dataclass(frozen=True)
class _InOrder:
    """Call a function with arrays that are in C order and aligned in memory.

    Arrays from the store or the network may have another layout. NumPy and BLAS would
    then add in another order, and the last digits of results would depend on the
    scheduler.
    """

    function: Callable[..., Any]

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        return self.function(*map(_in_order, arguments))


def _in_order(value: Any) -> Any:
    if isinstance(value, Dataset):
        return value.map(
            lambda array: array.copy(data=c_contiguous(array.values)), keep_attrs=True
        )
    return c_contiguous(value) if isinstance(value, np.ndarray) else value


def shared_once(value: Any) -> Delayed:
    """Wrap a value so that a Dask graph holds one copy for all tasks; Dask collections
    are returned unchanged.
    """
    return (
        value
        if isinstance(value, Delayed)
        else delayed(value, pure=False, traverse=False)
    )


@dataclass(frozen=True)
class Population:
    """What a study reads of the takes of a database.

    Parameters
    ----------
    cohort
        Cohort with the layout of the study.
    open_cohort
        Opens another cohort of the same takes; arguments as of `Database.cohort`.
    brdf_tables
        Tables of the dictionary with which the takes were fitted, computed at need.
    landmarks
        Name -> (2,) mean position in the common (u, v) of the registered takes.
    registered
        Takes that are registered.
    notes
        Notes on the registration, to which a study may append.
    """

    cohort: Dataset
    open_cohort: Callable[..., Dataset]
    brdf_tables: Callable[[], Array | Delayed]
    landmarks: Mapping[str, Array] = field(default_factory=dict)
    registered: Sequence[str] = ()
    notes: list[Note] = field(default_factory=list)


@dataclass(frozen=True)
class Study:
    """A study of a population.

    Parameters
    ----------
    name
        Word by which it is requested and stored.
    description
        What it finds, in a few words: the help of its command is "Study the ...".
    parameters
        Frozen record of its parameters, whose fields have the help and the limits of the
        options of the command.
    layout
        Layout of the cohort that it reads, see `Database.cohort`. Cohorts of maps have
        registered takes only, which need landmarks.
    compute
        Function of a `Population` and of the parameters that returns groups of variables.
    shown
        Groups of the results that table, notes and plot read. No other study has the
        first one.
    tabulate, plot, describe
        Functions of these groups: header and rows, a figure, and notes for the reader.
    columns_of_files
        Columns of the table that would make lines too long for a terminal.
    cohort_options
        Further options of `Database.cohort`.
    uses_registration
        Whether takes with landmarks are registered first, as for maps always.
    absolute
        Whether it needs absolute reflectance.
    conditions
        Function of the `Subjects` and of the parameters that returns the conditions whose
        takes it uses, none for all; subjects without such a take are reported as skipped.
    counts_takes
        Whether visits and repeats of a subject count by themselves, not by their mean.
    """

    name: str
    description: str
    parameters: type[Any]
    layout: Literal["tables", "surfels", "maps"]
    compute: Callable[[Population, Any], Results]
    shown: tuple[str, ...]
    tabulate: Callable[..., Table]
    plot: Callable[..., Axes | Figure]
    describe: Callable[..., list[str]] = lambda *_: []
    columns_of_files: tuple[str, ...] = ()
    cohort_options: Mapping[str, Any] = field(default_factory=dict)
    uses_registration: bool = False
    absolute: bool = False
    conditions: Callable[[Subjects, Any], Sequence[str]] = lambda *_: ()
    counts_takes: bool = False

    @property
    def registers(self) -> bool:
        """Whether it reads registrations: maps exist of registered takes only."""
        return self.uses_registration or self.layout == "maps"


def of_cohort(
    group: str, function: Callable[..., Dataset]
) -> Callable[[Population, Any], Results]:
    """What a study computes with one function of its cohort, whose keyword arguments are
    the parameters, with a generator ``rng`` in place of a seed. The digest of its code
    is that of the function.
    """

    @wraps(function)
    def results_of(population: Population, parameters: Any) -> Results:
        arguments = dict(vars(parameters))
        if "seed" in arguments:
            arguments["rng"] = np.random.default_rng(arguments.pop("seed"))
        return {group: function(population.cohort, **arguments)}

    return results_of


def table_of(
    table: Dataset, names: Sequence[str], dims: Sequence[str] | None = None
) -> Table:
    """Header and rows of variables with the same dims, by default those of the first, one
    row per element.
    """
    dims = dims or [str(dim) for dim in table[names[0]].dims]
    stacked = table[list(names)].stack(row=dims, create_index=False)
    columns = [stacked[name].values.tolist() for name in names]
    keys = itertools.product(*(table[dim].values.tolist() for dim in dims))
    values = zip(*columns, strict=True)
    rows = [[*key, *row] for key, row in zip(keys, values, strict=True)]
    return [*dims, *names], rows


def skipped_takes(cohort: Dataset) -> list[Note]:
    """Notes on the takes that a cohort lacks, which its results repeat."""
    return list(cohort.attrs.get("skipped", []))
