"""A finer mesh of the same surface, for light under the skin near the edges of shadows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.render.scene import Surface

MAX_LEVELS = 6  # of triangles, each divided into four
MAX_VERTICES = 2_000_000  # of the finer mesh: about 1 GB with the octree


def refined(surface: Surface, spacing: float, shown: NDArray[np.bool_]) -> Surface:
    """The surface with triangles whose edges are at most so long, where a picture shows it.

    Irradiance is known at vertices, so the edge of a shadow is as sharp as the mesh; the dipole then spreads a ragged
    edge. Positions and reflectances of new vertices are means of those at both ends of their edge, so that pictures
    without light under the skin stay the same.

    Parameters
    ----------
    surface
        Surface.
    spacing
        Longest edge [mm].
    shown
        (v,) vertices that the picture shows; triangles without any stay as they are.

    Raises
    ------
    InputError
        If the mesh would have more than two million vertices.
    """
    names = [name for name in ("normals", "diffuse", "weights", "s", "sigma_tr") if getattr(surface, name) is not None]
    values = {name: np.asarray(getattr(surface, name), np.float64) for name in names}
    values["shown"] = shown.astype(np.float64)[:, None]
    vertices, faces = np.asarray(surface.vertices, np.float64), np.asarray(surface.faces, np.int64)
    for _ in range(MAX_LEVELS):
        corners = vertices[faces]
        longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=1)
        chosen = np.flatnonzero((values["shown"][faces, 0] > 0).any(axis=1) & (longest > spacing))
        if not len(chosen):
            break
        if len(vertices) + 3 * len(chosen) > MAX_VERTICES:
            rule = f"the part of the face in the picture must have at most {MAX_VERTICES:,} vertices"
            found = f"{len(chosen):,} triangles to be divided at {spacing:g} mm"
            raise InputError(Fault("spacing", rule, found, "choose a larger spacing, or a closer picture"))
        vertices, faces, values = trimesh.remesh.subdivide(vertices, faces, chosen, vertex_attributes=values)
    values.pop("shown")
    values["normals"] = values["normals"] / np.maximum(np.linalg.norm(values["normals"], axis=1, keepdims=True), 1e-12)
    made: dict[str, Any] = values
    return replace(surface, vertices=vertices, faces=faces, **made)
