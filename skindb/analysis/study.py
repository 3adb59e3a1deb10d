"""A study of a population as one record: what it reads, its parameters, its results.

The command ``analyze``, the functions of `skindb.workflow`, the names under which
studies are stored and their repetition by ``refresh`` follow from these records.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import xarray as xr
from dask.delayed import Delayed

from skindb.limits import MAX_PERMUTATIONS, MAX_SEED
from skindb.parameters import option
from skindb.schema.notes import Note
from skindb.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# help of the parameter `dictionary`; its file may change, so that a study with one is
# always computed
DICTIONARY = (
    "Dictionary to use instead of the embedded one: a folder of MERL files, or an .npz "
    "file of tables."
)
Results = dict[str, xr.Dataset]  # group of the stored version -> its variables
Table = tuple[list[str], list[list[Any]]]  # header and rows


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
    mixed_fits
        Accept takes that were fitted with different parameters.
    notes
        Notes on the registration, to which a study may append.
    """

    cohort: xr.Dataset
    open_cohort: Callable[..., xr.Dataset]
    brdf_tables: Callable[[], Array | Delayed]
    landmarks: Mapping[str, Array] = field(default_factory=dict)
    registered: Sequence[str] = ()
    mixed_fits: bool = False
    notes: list[Note] = field(default_factory=list)


@dataclass(frozen=True)
class Study:
    """A study of a population.

    Parameters
    ----------
    name
        Word by which it is requested and stored.
    description
        What it finds, in a few words.
    layout
        Layout of the cohort that it reads, see `Database.cohort`. Cohorts of maps have
        registered takes only, which need landmarks.
    parameters
        Frozen record of its parameters, whose fields have the help and the limits of the
        options of the command.
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
        Whether takes with landmarks are registered first.
    compares_normal
        Whether it compares subjects in the condition normal, so that those without such
        a take are reported as skipped.
    """

    name: str
    description: str
    layout: Literal["tables", "surfels", "maps"]
    parameters: type[Any]
    compute: Callable[[Population, Any], Results]
    shown: tuple[str, ...]
    tabulate: Callable[..., Table]
    plot: Callable[..., Axes | Figure]
    describe: Callable[..., list[str]] = lambda *_: []
    columns_of_files: tuple[str, ...] = ()
    cohort_options: Mapping[str, Any] = field(default_factory=dict)
    uses_registration: bool = False
    compares_normal: bool = False


def table_of(table: xr.Dataset, names: Sequence[str], dims: Sequence[str]) -> Table:
    """Header and rows of variables with the same dims, one row per element."""
    stacked = table[list(names)].stack(row=dims, create_index=False)
    columns = [stacked[name].values.tolist() for name in names]
    keys = itertools.product(*(table[dim].values.tolist() for dim in dims))
    values = zip(*columns, strict=True)
    rows = [[*key, *row] for key, row in zip(keys, values, strict=True)]
    return [*dims, *names], rows


def group_option() -> Any:
    """Field of a record for the attribute or trait of the groups."""
    text = "Attribute or trait by which takes are grouped: gender, age, ..."
    return option(None, text)


def compared_option() -> Any:
    """Field of a record for the attribute or trait that is compared, which has no default."""
    text = "Attribute or trait that is compared: gender, age, ..."
    return option(MISSING, text)


def adjust_option() -> Any:
    """Field of a record for attributes that a comparison is adjusted for."""
    text = "Attributes that the comparison adjusts for, separated by commas."
    return option((), text, metavar="NAME,...", show_default=False)


def permutations_option(default: int = 10_000) -> Any:
    """Field of a record for the number of permutations."""
    text = "Largest number of permutations for p values."
    return option(default, text, minimum=100, maximum=MAX_PERMUTATIONS)


def seed_option(purpose: str) -> Any:
    """Field of a record for the random seed."""
    return option(0, f"Random seed for {purpose}.", minimum=0, maximum=MAX_SEED)
