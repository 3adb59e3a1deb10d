"""Wall time of each stage of a fit, and its progress."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from dask.callbacks import Callback

from skindb.jit import reported_compilation
from skindb.types import Progress

COMPILING = "compiling, only after an installation"


@dataclass
class Clock:
    """Times stages; `progress` is called with the stage, the steps done and the total
    number of steps.
    """

    progress: Progress | None
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage; the tasks of local dask schedulers are its steps, an eager
        stage is one step.
        """
        begin = time.perf_counter()
        if self.progress is None:
            yield
        else:
            tell = self.progress
            ticker = _Ticker(name, self.progress)
            tell(name, 0, 1)
            with (
                ticker,
                reported_compilation(
                    lambda: tell(f"{name} ({COMPILING})", ticker.done, ticker.total)
                ),
            ):
                yield
            tell(name, ticker.total, ticker.total)
        self.seconds[name] = round(time.perf_counter() - begin, 3)


class _Ticker(Callback):
    """Counts the finished tasks of the graphs that run while it is active."""

    def __init__(self, name: str, progress: Progress) -> None:
        super().__init__(start=self._begin, posttask=self._finish)  # type: ignore[no-untyped-call]
        self.name = name
        self.tell = progress
        self.total = 1
        self.done = 0

    def _begin(self, graph: Mapping[Any, Any]) -> None:
        self.total = max(len(graph), 1)
        self.done = 0

    def _finish(self, *_: Any) -> None:
        self.done = min(self.done + 1, self.total)
        self.tell(self.name, self.done, self.total)
