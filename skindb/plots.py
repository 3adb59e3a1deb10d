"""Text and colours of plots."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

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


def new_axes(width: float, height: float) -> Axes:
    """Axes of a new figure of this size [inch]."""
    from matplotlib import pyplot

    ax: Axes
    _, ax = pyplot.subplots(figsize=(width, height))
    return ax


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


def significance_bars(
    ax: Axes,
    values: Array,
    places: Array,
    bars: Array,
    is_significant: Mask,
    *,
    colour: str,
    marker: str = "o",
) -> None:
    """Values (n,) at heights (n,) with bars (2, n) to both sides; filled markers are
    significant.
    """
    for rows, fill in ((is_significant, colour), (~is_significant, "white")):
        ax.errorbar(
            values[rows],
            places[rows],
            xerr=bars[:, rows],
            fmt=marker,
            color=colour,
            mfc=fill,
            markersize=4,
            capsize=2,
            linewidth=1,
        )
