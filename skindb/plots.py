"""Text in plots."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def plain_text() -> Iterator[None]:
    """Context, or decorator, in which plots show text as it is: "$" in the value of an
    attribute begins no formula.
    """
    from matplotlib import rc_context

    with rc_context({"text.parse_math": False}):
        yield
