"""Subdivision of a surface, for subsurface light near the edges of shadows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.render.scene import Surface

MAX_LEVELS = 6  # of subdivision of a triangle into four
MAX_VERTICES = 2_000_000  # of the finer mesh: about 1 GB with the octree


def subdivide_surface(
    surface: Surface, spacing: float, shown: NDArray[np.bool_]
) -> Surface:
    """Subdivide the visible triangles of a surface until their edges have at most a given length.

    Irradiance is known at vertices, so the mesh limits the sharpness of shadow edges,
    and the dipole would blur a jagged edge. Positions and reflectances of new vertices
    are means of those at both ends of their edge, so that pictures without subsurface
    light stay the same.

    Parameters
    ----------
    surface
        Surface.
    spacing
        Maximum length of edges [mm].
    shown
        (v,) visible vertices; triangles without a visible vertex are not divided.

    Raises
    ------
    InputError
        If the mesh would have more than two million vertices.
    """
    names = [
        name
        for name in ("normals", "diffuse", "parameters", "s", "sigma_tr")
        if getattr(surface, name) is not None
    ]
    values = {name: np.asarray(getattr(surface, name), np.float64) for name in names}
    values["shown"] = shown.astype(np.float64)[:, None]
    vertices = np.asarray(surface.vertices, np.float64)
    faces = np.asarray(surface.faces, np.int64)
    for _ in range(MAX_LEVELS):
        corners = vertices[faces]
        longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(
            axis=1
        )
        chosen = np.flatnonzero(
            (values["shown"][faces, 0] > 0).any(axis=1) & (longest > spacing)
        )
        if not len(chosen):
            break
        if len(vertices) + 3 * len(chosen) > MAX_VERTICES:
            rule = (
                "the part of the face in the picture must have at most "
                f"{MAX_VERTICES:,} vertices"
            )
            found = (
                f"{len(vertices):,} and {len(chosen):,} triangles that are still "
                f"coarser than {spacing:g} mm"
            )
            raise InputError(
                Fault(
                    "spacing",
                    rule,
                    found,
                    "choose a larger spacing, or a closer picture",
                )
            )
        vertices, faces, values = trimesh.remesh.subdivide(
            vertices, faces, chosen, vertex_attributes=values
        )
    values.pop("shown")
    values["normals"] = values["normals"] / np.maximum(
        np.linalg.norm(values["normals"], axis=1, keepdims=True), 1e-12
    )
    made: dict[str, Any] = values
    return replace(surface, vertices=vertices, faces=faces, **made)
