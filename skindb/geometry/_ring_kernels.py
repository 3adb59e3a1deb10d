"""Compiled looks at the neighbours of vertices, triangle by triangle: no list of neighbours is needed for it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb._compiled import kernel

Bools = NDArray[np.bool_]


@kernel
def grown(faces: NDArray[Any], mask: Bools) -> Bools:
    """Vertices (n,) of the mask, and those that share an edge with one of them, by triangles (f, 3)."""
    out = mask.copy()
    for k in range(len(faces)):
        a, b, c = faces[k]
        if mask[a] or mask[b] or mask[c]:
            out[a] = out[b] = out[c] = True
    return out


@kernel
def mixed(faces: NDArray[Any], mask: Bools) -> Bools:
    """Vertices (n,) that share an edge with one for which the mask says something else, by triangles (f, 3)."""
    out = np.zeros(len(mask), np.bool_)
    for k in range(len(faces)):
        a, b, c = faces[k]
        if mask[a] != mask[b] or mask[b] != mask[c]:
            out[a] = out[b] = out[c] = True  # of three corners and two answers each has another beside it
    return out
