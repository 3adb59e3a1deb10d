"""Removal of slivers: needles are collapsed, caps are removed by edge flips."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.geometry.holes import sliver_mask

Float = NDArray[np.floating[Any]]
Index = NDArray[np.int64]
MAX_FLIP_ROUNDS = 10  # a flip can create a sliver in the neighbour
DROPPED = (-1, -1, -1)
MAX_NEEDLE_RATIO = 0.01  # shortest over longest side of a sliver that is collapsed


def repair_slivers(vertices: Float, faces: Index) -> tuple[Index, Index, Index]:
    """Faces (f', 3) without slivers, the repaired slivers (r, 3), and those that could
    not be repaired (s, 3).

    The short edge of a needle is collapsed. The long edge of a cap is replaced by the
    other diagonal of the quadrilateral that it forms with its neighbour, or the cap is
    dropped if that edge is open.
    """
    current = np.array(faces, np.int64)
    repaired: list[Index] = []
    for _ in range(MAX_FLIP_ROUNDS):
        bad = sliver_mask(vertices, current)
        # the neighbourhood that a repair needs
        near = np.flatnonzero(np.isin(current, current[bad]).any(axis=1))
        patch = _patch(current[near])
        before = len(repaired)
        for i in np.flatnonzero(bad[near]).tolist():
            corners = patch.faces[i].copy()
            if _repair(vertices, patch, i):
                repaired.append(corners)
        current[near] = patch.faces
        current = current[current[:, 0] >= 0]
        if len(repaired) == before:
            break
    return (
        current,
        np.array(repaired, np.int64).reshape(-1, 3),
        current[sliver_mask(vertices, current)],
    )


@dataclass(frozen=True)
class _Patch:
    """Faces under repair, -1 where dropped, and which of them are at each vertex."""

    faces: Index
    star: defaultdict[int, set[int]]

    def put(self, i: int, corners: tuple[int, int, int]) -> None:
        """Replace the corners of face i."""
        for vertex in self.faces[i].tolist():
            self.star[vertex].discard(i)
        self.faces[i] = corners
        for vertex in corners:
            self.star[vertex].add(i)

    def around(self, vertex: int) -> Index:
        """Faces (k, 3) at a vertex."""
        return self.faces[list(self.star[vertex])]


def _patch(faces: Index) -> _Patch:
    star = defaultdict[int, set[int]](set)
    for i, corners in enumerate(faces.tolist()):
        for vertex in corners:
            star[vertex].add(i)
    return _Patch(faces, star)


def _repair(vertices: Float, patch: _Patch, i: int) -> bool:
    """Repair face i in place, and return whether it was changed."""
    corner = patch.faces[i]
    if corner[0] < 0 or not sliver_mask(vertices, corner[None])[0]:
        return False  # removed by an earlier repair
    side = np.linalg.norm(vertices[np.roll(corner, -1)] - vertices[corner], axis=1)
    short = int(side.argmin())
    long = int(side.argmax())
    ends = int(corner[short]), int(corner[(short + 1) % 3])
    if side[short] <= MAX_NEEDLE_RATIO * side[long] and _collapse(
        patch, min(ends), max(ends)
    ):
        return True
    return _flip(patch, i, long)


def _collapse(patch: _Patch, keep: int, gone: int) -> bool:
    """Move a vertex onto another unless that would pinch the surface (link condition)."""
    at_keep = patch.around(keep)
    at_gone = patch.around(gone)
    between = patch.star[keep] & patch.star[gone]
    common = (set(at_keep.ravel().tolist()) & set(at_gone.ravel().tolist())) - {
        keep,
        gone,
    }
    open_ends = _is_open(at_keep, keep) and _is_open(at_gone, gone)
    if len(common) != len(between) or (open_ends and len(between) == 2):
        return False
    for i in patch.star[gone] - between:
        a, b, c = (
            keep if vertex == gone else vertex for vertex in patch.faces[i].tolist()
        )
        patch.put(i, (a, b, c))
    for i in between:
        patch.put(i, DROPPED)
    return True


def _is_open(around: Index, vertex: int) -> bool:
    """Whether a vertex lies on the boundary: some neighbour is in one of its faces only."""
    _, count = np.unique(around[around != vertex], return_counts=True)
    return bool((count == 1).any())


def _flip(patch: _Patch, i: int, side: int) -> bool:
    """Replace side `side` of face i by the other diagonal of the two faces at it; drop
    the face if it is open.
    """
    a, b, c = np.roll(patch.faces[i], -side).tolist()
    both = patch.star[a] & patch.star[b]
    if len(both) == 1:
        return _drop(patch, i, a, b, c)
    j = min(both - {i})
    d = next(vertex for vertex in patch.faces[j].tolist() if vertex not in (a, b))
    if patch.star[c] & patch.star[d]:
        return False
    patch.put(i, (a, d, c))
    patch.put(j, (d, b, c))
    return True


def _drop(patch: _Patch, i: int, a: int, b: int, c: int) -> bool:
    """Drop face i, whose side ab is open, unless the boundary already passes c."""
    star = patch.star
    hangs = min(len(star[b] & star[c]), len(star[a] & star[c])) == 1
    if not hangs and _is_open(patch.around(c), c):
        return False
    patch.put(i, DROPPED)
    return True
