"""Types shared by many modules."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]
Progress = Callable[[str, int, int], None]  # called with the stage, the steps done and the steps in all


def silent(stage: str, done: int, total: int) -> None:
    """Progress callback that does nothing."""
