"""Removal of slivers: needles are collapsed, caps are flipped away."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.geometry.holes import sliver_mask

Float = NDArray[np.floating[Any]]
Index = NDArray[np.int64]
ROUNDS = 10  # a flip can hand a sliver on to the neighbour
NEEDLE = 0.01  # shortest over longest side of a sliver that is collapsed


def repair_slivers(vertices: Float, faces: Index) -> tuple[Index, Index, Index]:
    """Faces (f', 3) without slivers, the slivers repaired (r, 3) as they were, and those that had to stay (s, 3).

    A needle loses its short edge (one end moves onto the other). A cap gives its long edge up for the other diagonal
    of the quadrilateral it forms with its neighbour, or is dropped where that edge is open.
    """
    current = np.array(faces, np.int64)
    repaired: list[Index] = []
    for _ in range(ROUNDS):
        bad = sliver_mask(vertices, current)
        near = np.flatnonzero(np.isin(current, current[bad]).any(axis=1))  # all that a repair looks at
        local, before = current[near], len(repaired)
        for i in np.flatnonzero(bad[near]):
            corners = local[i].copy()
            if _repair(vertices, local, int(i)):
                repaired.append(corners)
        current[near] = local
        current = current[current[:, 0] >= 0]
        if len(repaired) == before:
            break
    return current, np.array(repaired, np.int64).reshape(-1, 3), current[sliver_mask(vertices, current)]


def _repair(vertices: Float, faces: Index, i: int) -> bool:
    """Repair face i in place (dropped faces become -1); whether anything was done."""
    if faces[i, 0] < 0 or not sliver_mask(vertices, faces[i : i + 1])[0]:
        return False  # an earlier repair took it along
    corner = faces[i]
    side = np.linalg.norm(vertices[np.roll(corner, -1)] - vertices[corner], axis=1)
    short, long = int(side.argmin()), int(side.argmax())
    if side[short] <= NEEDLE * side[long] and _collapse(faces, corner[short], corner[(short + 1) % 3]):
        return True
    return _flip(faces, i, long)


def _collapse(faces: Index, one: int, other: int) -> bool:
    """Move the later of two vertices onto the other unless that would pinch the surface (link condition)."""
    keep, gone = sorted((int(one), int(other)))
    at_keep, at_gone = (faces == keep).any(axis=1), (faces == gone).any(axis=1)
    between = at_keep & at_gone
    common = np.intersect1d(np.setdiff1d(faces[at_keep], [keep, gone]), np.setdiff1d(faces[at_gone], [keep, gone]))
    open_ends = _is_open(faces[at_keep], keep) and _is_open(faces[at_gone], gone)
    if len(common) != between.sum() or (open_ends and between.sum() == 2):
        return False
    faces[between] = -1
    rows = np.flatnonzero(at_gone & ~between)
    faces[rows] = np.where(faces[rows] == gone, keep, faces[rows])
    return True


def _is_open(around: Index, vertex: int) -> bool:
    """Whether a vertex lies on the boundary: some neighbour is in one of its faces only."""
    _, count = np.unique(around[around != vertex], return_counts=True)
    return bool((count == 1).any())


def _flip(faces: Index, i: int, side: int) -> bool:
    """Replace side `side` of face i by the other diagonal of the two faces at it; drop the face if it is open."""
    a, b, c = (int(faces[i, (side + k) % 3]) for k in range(3))
    both = _faces_at(faces, a, b)
    if len(both) == 1:
        return _drop(faces, i, a, b, c)
    j = int(both[both != i][0])
    d = int(faces[j][(faces[j] != a) & (faces[j] != b)][0])
    if len(_faces_at(faces, c, d)):
        return False
    faces[i], faces[j] = (a, d, c), (d, b, c)
    return True


def _drop(faces: Index, i: int, a: int, b: int, c: int) -> bool:
    """Drop face i, whose side ab is open, unless the boundary already passes c."""
    hangs = min(len(_faces_at(faces, b, c)), len(_faces_at(faces, a, c))) == 1
    if not hangs and _is_open(faces[(faces == c).any(axis=1)], c):
        return False
    faces[i] = -1
    return True


def _faces_at(faces: Index, a: int, b: int) -> Index:
    return np.flatnonzero((faces == a).any(axis=1) & (faces == b).any(axis=1))
