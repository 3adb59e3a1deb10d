"""How a stored variable is declared."""

from __future__ import annotations

from dataclasses import dataclass

PAPER = "Weyrich et al. 2005"


@dataclass(frozen=True)
class Variable:
    """Declaration of a stored variable."""

    name: str
    dims: tuple[str, ...]
    dtype: str
    units: str
    doc: str
    source: str = "skindb"


def declare(
    name: str, dims: str, dtype: str, units: str, doc: str, source: str = "skindb"
) -> Variable:
    """A declaration whose dims are given in one text."""
    return Variable(name, tuple(dims.split()), dtype, units, doc, source)
