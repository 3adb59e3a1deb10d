"""The truth beside a capture, CAPTURE.truth.npz, and what benchmarks derive from it.

`skindb simulate` writes vertices, faces, normals and the membership of each vertex in
regions. Another generator may write `region`, the index of a region for each vertex, and
`visible_light` and `visible_camera`, bits for each vertex and device.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.geometry.rays import RayScene

Truth = dict[str, NDArray[Any]]


def read_truth(capture: Path) -> Truth:
    """The truth of a capture folder."""
    with np.load(capture.with_name(f"{capture.name}.truth.npz")) as file:
        return dict(file)


def regions(truth: Truth) -> NDArray[Any]:
    """Name of the region of each vertex; "other" where there is none."""
    if "region" in truth:
        return truth["region_names"][truth["region"]]
    membership = truth["region_membership"]
    names = truth["region_names"].astype("U16")[membership.argmax(axis=1)]
    return np.where(membership.max(axis=1) > 0, names, "other")


class TrueVisibility:
    """Which vertices of the true surface see a device."""

    def __init__(self, truth: Truth) -> None:
        self.truth = truth
        self.vertices = truth["vertices"].astype(float)
        self.normals = truth["normals"].astype(float)
        self.scene = RayScene(self.vertices, truth["faces"].astype(np.int64))

    def cosine(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Cosine (v,) between the normals and the directions to a place."""
        way = place - self.vertices
        return np.einsum("ni,ni->n", way, self.normals) / np.linalg.norm(way, axis=1)

    def of(
        self, kind: str, number: int, place: NDArray[np.float64]
    ) -> NDArray[np.bool]:
        """Mask (v,) of the vertices that see a light or camera, by its number and place."""
        if (bits := self.truth.get(f"visible_{kind}")) is not None:
            return ((bits[:, number // 8] >> (7 - number % 8)) & 1).astype(bool)
        hidden = self.scene.occluded(self.vertices, place[None], normal=self.normals)
        return ~hidden & (self.cosine(place) > 0)
