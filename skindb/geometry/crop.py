"""The part of a scan that is kept: within a box, around the landmarks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from skindb.errors import Fault, InputError

Float = NDArray[np.floating[Any]]
Faces = NDArray[np.integer[Any]]


@dataclass(frozen=True)
class Crop:
    """Limits of the part of a scan that is kept; all of them apply."""

    low: tuple[float, float, float] | None = None  # corner of a box along the axes, mm
    high: tuple[float, float, float] | None = None
    reach_mm: float | None = None  # largest distance from the nearest landmark

    def __post_init__(self) -> None:
        """Check that the limits are not empty."""
        if (
            self.low is not None
            and self.high is not None
            and not (np.array(self.low) < self.high).all()
        ):
            found = f"{self.low} and {self.high}"
            rule = "its lower corner must lie below the higher one, in mm"
            raise InputError(Fault("crop", rule, found, "exchange them"))
        if self.reach_mm is not None and not self.reach_mm > 0:
            raise InputError(
                Fault(
                    "crop",
                    "its reach must be positive, in mm",
                    str(self.reach_mm),
                    "give a positive one",
                )
            )


def crop_faces(
    vertices: Float, faces: Faces, crop: Crop, *, landmarks: Float | None = None
) -> NDArray[np.bool_]:
    """Mask (f,) of the faces whose corners are all kept, so that none extends beyond the box.

    Parameters
    ----------
    vertices, faces
        (v, 3) mm and (f, 3).
    crop
        Limits.
    landmarks
        (k, 3) mm, needed where the crop has a reach.
    """
    points = np.asarray(vertices, np.float64)
    kept = np.ones(len(points), bool)
    if crop.low is not None:
        kept &= (points >= crop.low).all(axis=1)
    if crop.high is not None:
        kept &= (points <= crop.high).all(axis=1)
    if crop.reach_mm is not None:
        if landmarks is None or not len(landmarks):
            raise ValueError("a crop around the landmarks needs landmarks")
        kept &= cKDTree(landmarks).query(points)[0] <= crop.reach_mm
    return np.asarray(kept[faces].all(axis=1))
