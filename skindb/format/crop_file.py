"""The file beside the landmarks that holds the box by which the scan is cropped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from skindb.errors import Fault, InputError
from skindb.geometry.scan import Crop

MAX_COORDINATE_MM = 1e30  # smaller than infinity in single precision


def crop_path(landmarks: Path) -> Path:
    """The file that holds the crop box that belongs to this file of landmarks."""
    return landmarks.with_suffix(".crop.json")


def parsed_crop(value: Any, where: str) -> Crop:
    """A crop box from JSON: {"low": [x, y, z], "high": [x, y, z]}.

    Raises
    ------
    InputError
        If it is not that, or its corners are exchanged.
    """
    if not isinstance(value, dict) or not (
        is_point(value.get("low")) and is_point(value.get("high"))
    ):
        rule = 'a crop box must be {"low": [x, y, z], "high": [x, y, z]} in mm'
        raise InputError(
            Fault(where, rule, str(value)[:80], "correct it, or remove the file")
        )
    low, high = (tuple(map(float, value[corner])) for corner in ("low", "high"))
    return Crop((low[0], low[1], low[2]), (high[0], high[1], high[2]))


def is_point(value: Any) -> bool:
    """Whether JSON holds three finite numbers."""
    sound = isinstance(value, list) and len(value) == 3
    # not NaN either
    return sound and all(
        type(x) in (int, float) and abs(x) < MAX_COORDINATE_MM for x in value
    )
