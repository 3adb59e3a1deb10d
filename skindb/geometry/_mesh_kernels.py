"""Compiled operations on the neighbours of vertices, which visit the triangles and need
no list of neighbours.
"""

from __future__ import annotations

import numpy as np

from skindb.jit import kernel
from skindb.types import AnyArray, BoolVector


@kernel
def grown(faces: AnyArray, mask: BoolVector) -> BoolVector:
    """Mask (n,) extended by all vertices that share an edge with a vertex of the mask,
    by triangles (f, 3).
    """
    out = mask.copy()
    for k in range(len(faces)):
        a, b, c = faces[k]
        if mask[a] or mask[b] or mask[c]:
            out[a] = out[b] = out[c] = True
    return out


@kernel
def mixed(faces: AnyArray, mask: BoolVector) -> BoolVector:
    """Vertices (n,) that share an edge with a vertex of another mask value, by triangles (f, 3)."""
    out = np.zeros(len(mask), np.bool_)
    for k in range(len(faces)):
        a, b, c = faces[k]
        if mask[a] != mask[b] or mask[b] != mask[c]:
            out[a] = out[b] = out[c] = True  # the values of the three corners differ
    return out
