"""Types that many modules share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]
Progress = Callable[[str, int, int], None]  # called with the stage, the number of finished steps and the total number


def silent(stage: str, done: int, total: int) -> None:
    """Progress that is not shown."""
