"""How a stored variable is declared."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Flag, auto

from skindb.schema.status import Explained

PAPER = "Weyrich et al. 2005"
HEADER = re.compile(
    r"(?P<dtype>\w+) (?P<group>\w+)/(?P<name>\w+)\((?P<dims>[\w, ]*)\) \[(?P<units>.+)\]"
)


class Use(Flag):
    """What the values of a variable are used for beyond their version."""

    NONE = 0
    COPIED = auto()  # from the surfels of a capture into its model
    REPORTED = auto()  # median and 95 % quantile stand in the report of a fit
    EXPORTED = auto()  # median and 95 % quantile stand in the manifest of an export
    SAMPLED = auto()  # in the samples of surfels and sites that cohorts read
    MEDIAN = auto()  # median stands in the tables that cohorts read
    MAPPED = auto()  # as texel_<name> in the maps of a registered take
    SURVIVES_EDIT = auto()  # an edited model has it; others describe the unedited one


@dataclass(frozen=True)
class Variable:
    """Declaration of a stored variable."""

    group: str
    name: str
    dims: tuple[str, ...]
    dtype: str
    units: str
    doc: str
    source: str = "skindb"
    uses: Use = Use.NONE
    statuses: type[Explained] | None = None  # its values are codes of this enumeration
    absent: int = 0  # integer that stands where a take has no such element


DECLARED: dict[str, Variable] = {}  # in the order of their declarations


def declare(
    header: str,
    doc: str,
    source: str = "skindb",
    uses: Use = Use.NONE,
    *,
    statuses: type[Explained] | None = None,
    absent: int = 0,
) -> str:
    """Declare a stored variable and return its name, by which code refers to it.

    Parameters
    ----------
    header
        "dtype group/name(dim, dim) [units]", where group/name is the path in a version.
    doc
        One sentence.
    source
        Of the definition.
    uses
        What the values are used for beyond their version.
    statuses
        Enumeration of the values, for a status.
    absent
        Integer that stands in a cohort where a take has no such element; numbers with a
        fraction are NaN there.
    """
    match = HEADER.fullmatch(header)
    if match is None:
        raise ValueError(
            f"{header}: a variable is declared as 'dtype group/name(dim, dim) [units]'"
        )
    name = match["name"]
    dims = tuple(match["dims"].replace(",", " ").split())
    if name in DECLARED:
        raise ValueError(f"{name} is declared twice")
    DECLARED[name] = Variable(
        match["group"],
        name,
        dims,
        match["dtype"],
        match["units"],
        doc,
        source,
        uses,
        statuses,
        absent,
    )
    return name


def names_of(use: Use) -> tuple[str, ...]:
    """Names of the variables with this use, in the order of their declarations."""
    return tuple(name for name, declared in DECLARED.items() if use in declared.uses)
