"""Results of the demo, which its report shows."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import xarray as xr

from skindb.render.photographs import Comparison
from skindb.virtual.truth import Recovery

PER_TAKE = ("models", "fits", "recovered", "compared")


@dataclass
class Results:
    """Models, errors, studies, edits and run times of a demo."""

    models: dict[str, xr.DataTree] = field(default_factory=dict)
    fits: dict[str, dict[str, Any]] = field(default_factory=dict)
    recovered: dict[str, Recovery] = field(default_factory=dict)
    compared: dict[str, list[Comparison]] = field(default_factory=dict)
    studies: dict[str, xr.DataTree] = field(default_factory=dict)
    edits: dict[float, xr.DataTree] = field(default_factory=dict)
    edited_take: str = ""
    target_take: str = ""  # the measured take that the edit at amount 1 should match
    seconds: dict[str, float] = field(default_factory=dict)
    began: float = field(default_factory=time.monotonic)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure the time of a stage and add it to `seconds`."""
        start = time.monotonic()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - start

    def sort_takes(self, takes: Sequence[str]) -> None:
        """Sort the takes, which processes may have finished in any order, into the given order."""
        for name in PER_TAKE:
            found = getattr(self, name)
            setattr(self, name, {take: found[take] for take in takes if take in found})

    def add(self, other: Results) -> None:
        """Add the results of another process."""
        for name in PER_TAKE:
            getattr(self, name).update(getattr(other, name))
        for name, seconds in other.seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds
