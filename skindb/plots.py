"""Text and colours of plots."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

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
