"""The truth beside a capture, CAPTURE.truth.npz, and what benchmarks derive from it.

`skindb simulate` writes vertices, faces, normals and the membership of each vertex in
regions. Another generator may write `region`, the index of a region for each vertex, and
`visible_light` and `visible_camera`, bits for each vertex and device. Its BRDFs are sums
of bases with the weights `surface_weights`; `surface_kind` is "table" (`surface_tables`,
nodes of `skindb.reflectance.tables.TableGrid`, but with phi_d = pi), "lafortune"
(`surface_lobes`: C_xy, C_z and n of each lobe and channel) or "abc" (`surface_abc`: A, B,
C and index of refraction of Low et al. 2012).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.geometry.rays import RayScene
from skindb.optics.fresnel import fresnel_reflectance
from skindb.reflectance.tables import lookup

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


def mirror_bases(truth: Truth, theta: float) -> NDArray[np.float64]:
    """Bases (k,) of the true BRDFs [sr^-1], mean over the channels, where the half vector
    is the normal, theta [rad] from both directions.
    """
    kind = str(truth["surface_kind"])
    square = np.cos(theta) ** 2
    if kind == "table":
        tables = np.moveaxis(truth["surface_tables"][..., :-1], 0, -1)
        return lookup(tables, 0.0, theta, 0.0)
    if kind == "lafortune":
        across, along, power = np.moveaxis(truth["surface_lobes"], 1, 0)
        lobe = np.maximum(along * square - across * (1 - square), 0) ** power
        return np.array([lobe.sum(axis=0).mean()])
    height, _, _, index = truth["surface_abc"]
    fresnel = fresnel_reflectance(np.cos(theta), index)
    return np.array([height * fresnel / (np.pi * square)])


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
