"""One case of the stress set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

SCALES = (1e-30, 1e-12, 1e12, 1e30)


@dataclass(frozen=True)
class Case:
    """A kernel, the name of its input, the promised behaviour, and a check that raises
    if the promise is broken.
    """

    kernel: str
    name: str
    promise: str
    check: Callable[[], None]


def each(
    kernel: str, name: str, promise: str, check: Callable[..., None], *values: Any
) -> tuple[Case, ...]:
    """One case per value (a tuple holds several arguments of `check`); `name` is
    formatted with the value.
    """
    arguments = [value if isinstance(value, tuple) else (value,) for value in values]
    return tuple(
        Case(kernel, name.format(*one), promise, partial(check, *one))
        for one in arguments
    )


def combinations(first: tuple[Any, ...], *second: Any) -> list[tuple[Any, ...]]:
    """All combinations of `first` and `second` (a tuple holds several arguments), as
    values for `each`.
    """
    return [(a, *(b if isinstance(b, tuple) else (b,))) for a in first for b in second]


def expect(holds: Any, found: Any = "") -> None:
    """Raise AssertionError unless `holds` is true, also under `python -O`."""
    if not np.all(holds):
        raise AssertionError(f"found {found}")


def close(found: Any, want: Any, *, rtol: float = 0.0, atol: float = 0.0) -> None:
    """Raise AssertionError unless two arrays agree; NaN agrees with NaN."""
    np.testing.assert_allclose(found, want, rtol=rtol, atol=atol)
