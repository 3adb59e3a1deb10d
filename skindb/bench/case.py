"""One case of the stress set of DESIGN, section 7: a promised behaviour that is checked
against a number or a law.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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


def stress_cases(kernel: str, *rows: Sequence[Any]) -> tuple[Case, ...]:
    """Cases of a kernel from rows (name, promise, check) or (name, promise, check, values).

    A row with values gives one case for each of them (a tuple holds several arguments of
    `check`), whose name is formatted with the value.
    """
    cases = []
    for name, promise, check, *values in rows:
        if not values:
            cases.append(Case(kernel, name, promise, check))
        for value in values[0] if values else ():
            arguments = value if isinstance(value, tuple) else (value,)
            called = partial(check, *arguments)
            cases.append(Case(kernel, name.format(*arguments), promise, called))
    return tuple(cases)


def combinations(values: tuple[Any, ...], *second: Any) -> list[tuple[Any, ...]]:
    """All combinations of `first` and `second` (a tuple holds several arguments), as
    values of `stress_cases`.
    """
    return [(a, *(b if isinstance(b, tuple) else (b,))) for a in values for b in second]


def expect(holds: Any, value: Any = "") -> None:
    """Raise AssertionError unless `holds` is true, also under `python -O`."""
    if not np.all(holds):
        raise AssertionError(f"found {value}")


def close(value: Any, want: Any, *, rtol: float = 0.0, atol: float = 0.0) -> None:
    """Raise AssertionError unless two arrays agree; NaN agrees with NaN."""
    np.testing.assert_allclose(value, want, rtol=rtol, atol=atol)


def failure_of(case: Case) -> str:
    """Description of a broken promise; empty if it holds."""
    try:
        case.check()
    # any error is reported as a broken promise
    except Exception as error:  # noqa: BLE001
        lines = str(error).strip().splitlines() or ["no message"]
        text = " ".join(line.strip() for line in lines if line.strip())
        return f"{type(error).__name__}: {text[:300]}"
    return ""
