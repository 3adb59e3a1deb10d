"""Waiting for what other processes and threads do."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_SECONDS = 300.0  # after which a test fails because something hangs


def wait_until(condition: Callable[[], object], pause: float = 0.01) -> None:
    """Wait until a condition is met; the pause lies between two evaluations [s]."""
    end = time.monotonic() + PATIENCE_SECONDS
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(pause)
