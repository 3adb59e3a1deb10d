"""Text and colours of plots."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from xarray import Dataset

from skindb.types import Array, Mask

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# colours that colour-blind readers can distinguish (Okabe and Ito 2008)
BLUE, ORANGE, GREEN, RED, PURPLE, SKY, YELLOW = (
    "#0072b2",
    "#e69f00",
    "#009e73",
    "#d55e00",
    "#cc79a7",
    "#56b4e9",
    "#f0e442",
)
SYMBOLS = {"R_d": "$R_d$", "sigma_tr": r"$\sigma_{tr}$", "mm-1": "mm$^{-1}$"}
MARKERS = "osD^vP"  # as many as colours
CYCLE = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY)
CHANNELS = (RED, GREEN, BLUE)  # of the camera


@contextmanager
def plain_text() -> Iterator[None]:
    """Context, or decorator, in which plots show text as it is: "$" in the value of an
    attribute begins no formula.
    """
    from matplotlib import rc_context

    with rc_context({"text.parse_math": False}):
        yield


def typeset(text: str) -> str:
    """Text with the symbols of quantities as formulas, for artists with `parse_math`."""
    pattern = rf"\b({'|'.join(SYMBOLS)})\b"
    return re.sub(pattern, lambda m: SYMBOLS[m[0]], text.replace("$", r"\$"))


def new_axes(width: float, height: float) -> Axes:
    """Axes of a new figure of this size [inch]."""
    from matplotlib import pyplot

    ax: Axes
    _, ax = pyplot.subplots(figsize=(width, height))
    return ax


def axes_of_rows(
    names: Sequence[str], ax: Axes | None, *, lines: int = 1
) -> tuple[Axes, Array]:
    """Axes with a row of so many lines for each name, by default new ones, and the places
    (n,) of the rows.
    """
    ax = ax or new_axes(6.5, 1.2 + max(0.22, 0.11 * lines) * len(names))
    places = np.arange(float(len(names)))[::-1]
    ax.set_yticks(places, [*map(typeset, names)], fontsize=7, parse_math=True)
    ax.set_ylim(-0.6, len(names) - 0.4)
    return ax, places


def legend_entry(text: str) -> str:
    """Text of a legend: without the space, Matplotlib would omit "_a"."""
    return f" {text}" if text.startswith("_") else text


def legend_above(ax: Axes, *, fontsize: float = 7) -> None:
    """Legend above the axes, in two columns."""
    ax.legend(
        fontsize=fontsize,
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
        ncols=2,
        frameon=False,
    )


def legend_beside(ax: Axes) -> None:
    """Legend at the right of the axes."""
    ax.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


def intervals(
    ax: Axes,
    table: Dataset,
    name: str,
    places: Array,
    *,
    vertical: bool = False,
    **style: Any,
) -> None:
    """A variable (n,) at places (n,), with bars to the ends of its intervals, the
    variables with "_low" and "_high" after the name; none where these are NaN.
    """
    values, low, high = (table[f"{name}{end}"].values for end in ("", "_low", "_high"))
    bars = np.maximum(np.nan_to_num([values - low, high - values]), 0.0)
    style = {"markersize": 5, "capsize": 2, "linewidth": 1} | style
    if vertical:
        ax.errorbar(places, values, yerr=bars, **style)
    else:
        ax.errorbar(values, places, xerr=bars, **style)


def significant_intervals(
    ax: Axes,
    table: Dataset,
    name: str,
    places: Array,
    is_significant: Mask,
    *,
    colour: str,
    marker: str = "o",
) -> None:
    """`intervals` whose markers are filled where they are significant."""
    for rows, fill in ((is_significant, colour), (~is_significant, "white")):
        part = table.isel({table[name].dims[0]: rows})
        style: dict[str, Any] = {
            "fmt": marker,
            "color": colour,
            "mfc": fill,
            "markersize": 4,
        }
        intervals(ax, part, name, places[rows], **style)
