"""Repair of scanned meshes: the result is one oriented manifold surface without slivers
or small holes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from skindb.errors import Fault, InputError
from skindb.geometry.holes import fill_hole
from skindb.geometry.slivers import repair_slivers
from skindb.geometry.surfels import face_crosses
from skindb.geometry.topology import (
    boundary_loops,
    edge_table,
    face_components,
    fans,
    outline_first,
    simple_loops,
    winding_flips,
)

Float = NDArray[np.floating[Any]]
Faces = NDArray[np.integer[Any]]
Index = NDArray[np.int64]
# of the diagonal of the mesh: 0.3 um on a face, far below any scanner's spacing
WELD_DISTANCE_RATIO = 1e-6
# longer loops are openings (neck, hair line, mouth), not scanner faults
MAX_HOLE_EDGES = 16
KINDS = (  # of the report, in the order of the repairs
    "cropped_faces",
    "degenerate_faces",  # that name a vertex twice
    "duplicate_faces",
    "flipped_duplicates",  # the same three vertices, wound the other way
    "welded_vertices",
    "non_manifold_edges",  # of more than two faces
    "non_manifold_faces",  # dropped there: fins, flaps
    "turned_faces",
    "one_sided_faces",  # dropped to cut a one-sided strip
    "slivers",
    "slivers_left",
    "hanging_faces",  # that touch the surface in vertices only
    "islands",
    "island_faces",
    "pin_holes",
    "filled_faces",
    # vertices of more than one fan, one split for each fan beyond the first
    "bow_ties",
    "open_loops",
    "turned_mesh",
    "dropped_vertices",
)
PLACES = 20  # positions of each kind that are kept for inspection
# enclosed volume over area^1.5 below which the outside of a sheet is undetermined, and
# it keeps its winding
MIN_VOLUME_RATIO = 1e-3


@dataclass(frozen=True)
class CleanMesh:
    """A repaired mesh and where its vertices came from."""

    vertices: NDArray[np.float64]  # (v', 3) mm
    faces: Index  # (f', 3) wound outwards
    source_vertex: Index  # (v',) number in the scan; twice where a bow-tie was split
    # (v,) number here of each vertex of the scan (welded ones share it); -1 if it is
    # gone
    clean_vertex: Index
    report: dict[str, int]  # what was found and repaired
    # (3,) mm, positions of the first PLACES of each kind, without crops
    places: dict[str, list[NDArray[np.float64]]]


@dataclass(frozen=True)
class _Found:
    """Findings so far: number of each kind, and centres of the first ones."""

    count: dict[str, int] = field(default_factory=lambda: dict.fromkeys(KINDS, 0))
    places: dict[str, list[NDArray[np.float64]]] = field(default_factory=dict)

    def note(
        self, kind: str, points: NDArray[np.float64], parts: Iterable[Index], count: int
    ) -> None:
        """Add `count` of a kind, each a set of vertices; `parts` may be the first ones only."""
        self.count[kind] += count
        known = self.places.get(kind, [])
        if more := [
            points[part].mean(axis=0) for part in islice(parts, PLACES - len(known))
        ]:
            self.places[kind] = known + more

    def note_all(
        self, kind: str, points: NDArray[np.float64], parts: Sequence[Index] | Index
    ) -> None:
        """Add every one of `parts`: faces (n, 3), edges (n, 2), vertices (n, 1), loops."""
        self.note(kind, points, parts, len(parts))


def clean_mesh(
    vertices: Float,
    faces: Faces,
    *,
    hole_edges: int = MAX_HOLE_EDGES,
    keep: NDArray[np.bool_] | None = None,
) -> CleanMesh:
    """Make one oriented manifold of a scan.

    Drops faces that repeat a vertex, repeated faces, extra faces at edges of more than
    two, and all but the largest component; welds open seams; turns faces so that all
    wind alike, outwards; collapses or flips slivers; fills holes of at most
    `hole_edges` edges, never the longest boundary; splits bow-ties.

    Parameters
    ----------
    vertices, faces
        (v, 3) mm and (f, 3), as read.
    hole_edges
        Longest boundary loop that is closed.
    keep
        (f,) False for faces that are cropped before anything else.

    Returns
    -------
    CleanMesh
        Positions are those of the file: nothing is moved. The report counts each of
        `KINDS`; places are kept for all but those that follow from others (faces of
        islands, faces that fill holes, vertices dropped).

    Raises
    ------
    InputError
        If nothing is left.
    """
    points = np.asarray(vertices, np.float64)
    current = np.asarray(faces, np.int64)
    found = _Found()
    if keep is not None:
        found.count["cropped_faces"] = int((~keep).sum())
        current = current[keep]
    current, weld = _weld(points, _drop_repeated(points, current, found), found)
    current = _drop_overfull(points, current, found)
    current = _orient(points, current, found)
    current, repaired, left = repair_slivers(points, current)
    found.note_all("slivers", points, repaired)
    found.note_all("slivers_left", points, left)
    current = _largest_component(points, current, found)
    if not len(current):
        raise InputError(
            Fault(
                "mesh",
                "a scan must have a surface",
                "no non-degenerate face",
                "export it again",
            )
        )
    current, source = _split_bow_ties(
        _fill_small_holes(points, current, hole_edges, found), len(points)
    )
    found.note_all("bow_ties", points, source[len(points) :, None])
    points = points[source]
    return _compact(points, _outwards(points, current, found), source, weld, found)


def _drop_repeated(points: NDArray[np.float64], faces: Index, found: _Found) -> Index:
    degenerate = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    found.note_all("degenerate_faces", points, faces[degenerate])
    faces = faces[~degenerate]
    _, first, inverse = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True
    )
    original = first[inverse.ravel()]
    again = original != np.arange(len(faces))
    # an odd permutation of ascending corners
    odd = np.prod(np.sign(np.roll(faces, -1, axis=1) - faces), axis=1) > 0
    flipped = again & (odd != odd[original])
    found.note_all("duplicate_faces", points, faces[again & ~flipped])
    found.note_all("flipped_duplicates", points, faces[flipped])
    return np.asarray(faces[~again])


def _weld(
    points: NDArray[np.float64], faces: Index, found: _Found
) -> tuple[Index, Index]:
    """Join coinciding vertices of open boundaries (seams of a texture, unconnected triangles)."""
    table = edge_table(faces)
    rim = np.unique(table.edges[table.count == 1])
    to = np.arange(len(points))
    if len(rim):
        tolerance = WELD_DISTANCE_RATIO * float(
            np.linalg.norm(np.ptp(points[np.unique(faces)], axis=0))
        )
        pairs = cKDTree(points[rim]).query_pairs(tolerance, output_type="ndarray")
        graph = sp.coo_matrix(
            (np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])),
            shape=(len(rim), len(rim)),
        )
        label = connected_components(graph, directed=False)[1]
        _, first = np.unique(label, return_index=True)
        to[rim] = rim[first[label]]
    welded = np.flatnonzero(to != np.arange(len(points)))
    found.note_all("welded_vertices", points, welded[:, None])
    return _drop_repeated(points, to[faces], found) if len(welded) else faces, to


def _drop_overfull(points: NDArray[np.float64], faces: Index, found: _Found) -> Index:
    """Keep two faces at every edge: fins and flaps are removed before the surface to
    which they are attached.
    """
    table = edge_table(faces)
    found.note_all("non_manifold_edges", points, table.edges[table.count > 2])
    while len(faces):
        table = edge_table(faces)
        face, side = np.nonzero(table.count[table.of_face] > 2)
        if not len(face):
            break
        label = face_components(faces)
        free = (table.count[table.of_face] == 1).sum(axis=1)
        area = np.linalg.norm(face_crosses(points, faces), axis=1)
        edge = table.of_face[face, side]
        size = np.bincount(label)[label]
        order = np.lexsort((area[face], -free[face], size[face], edge))
        _, first = np.unique(edge[order], return_index=True)
        extra = np.unique(face[order[first]])
        found.note_all("non_manifold_faces", points, faces[extra])
        faces = np.delete(faces, extra, axis=0)
    return faces


def _orient(points: NDArray[np.float64], faces: Index, found: _Found) -> Index:
    flip = winding_flips(faces) if len(faces) else np.zeros(0, bool)
    turned = np.where(flip[:, None], faces[:, ::-1], faces)
    found.note_all("turned_faces", points, faces[flip])
    # a one-sided strip has no consistent winding: cut it where two faces still traverse
    # an edge in the same direction
    key = turned * (len(points) + 1) + np.roll(turned, -1, axis=1)
    _, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    drop = np.asarray((count[inverse].reshape(-1, 3) > 1).any(axis=1))
    found.note_all("one_sided_faces", points, faces[drop])
    return np.asarray(turned[~drop])


def _largest_component(
    points: NDArray[np.float64], faces: Index, found: _Found
) -> Index:
    label = face_components(faces) if len(faces) else np.zeros(0, np.int64)
    area = np.linalg.norm(face_crosses(points, faces), axis=1)
    keep = np.asarray(label == np.bincount(label, area, minlength=1).argmax(), bool)
    touching = np.isin(faces, faces[keep]).any(axis=1)
    hanging = ~keep & np.isin(label, label[touching])
    island = ~keep & ~hanging
    found.note_all("hanging_faces", points, faces[hanging])
    found.count["island_faces"] = int(island.sum())
    names = np.unique(label[island])
    found.note(
        "islands", points, (faces[label == name].ravel() for name in names), len(names)
    )
    return np.asarray(faces[keep])


def _split_bow_ties(faces: Index, n: int) -> tuple[Index, Index]:
    """One vertex per fan; the first fan keeps the vertex, the others get new ones at the end."""
    label = fans(faces).ravel()
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    vertex = faces.ravel()[first]  # vertex of each fan
    _, lead = np.unique(vertex, return_index=True)
    extra = np.ones(len(vertex), bool)
    extra[lead] = False
    name = vertex.copy()
    name[extra] = n + np.arange(int(extra.sum()))
    return name[inverse].reshape(-1, 3), np.concatenate([np.arange(n), vertex[extra]])


def _fill_small_holes(
    points: NDArray[np.float64], faces: Index, hole_edges: int, found: _Found
) -> Index:
    """Fill small holes; holes that touch in a vertex form one boundary, which is split
    into them.
    """
    split, source = _split_bow_ties(faces, len(points))
    parts = [
        part for loop in boundary_loops(split) for part in simple_loops(source[loop])
    ]
    taken = {(int(a), int(b)) for a, b in edge_table(faces).edges}
    patches = [faces]
    holes = []
    for loop in outline_first(points, parts)[1:]:
        patch = fill_hole(points, loop, taken) if len(loop) <= hole_edges else None
        if patch is not None:
            patches.append(patch)
            holes.append(loop)
            taken |= {(int(a), int(b)) for a, b in edge_table(patch).edges}
    filled = np.concatenate(patches)
    found.note_all("pin_holes", points, holes)
    found.count["filled_faces"] = len(filled) - len(faces)
    return filled


def _outwards(points: NDArray[np.float64], faces: Index, found: _Found) -> Index:
    """Turn the mesh over if it encloses negative volume after its longest boundary is
    closed by a fan.
    """
    loops = outline_first(points, boundary_loops(faces))
    found.note_all("open_loops", points, loops)
    # seen from the middle of the boundary, the fan that closes it adds no volume
    origin = points[loops[0]].mean(axis=0) if loops else points[faces[0, 0]]
    cross = face_crosses(points, faces)
    volume = float(np.einsum("fi,fi->", points[faces[:, 0]] - origin, cross)) / 6
    scale = (float(np.linalg.norm(cross, axis=1).sum()) / 2) ** 1.5
    inside_out = volume < -MIN_VOLUME_RATIO * scale
    found.count["turned_mesh"] = int(inside_out)
    return np.asarray(faces[:, ::-1] if inside_out else faces)


def _compact(
    points: NDArray[np.float64], faces: Index, source: Index, weld: Index, found: _Found
) -> CleanMesh:
    used, inverse = np.unique(faces, return_inverse=True)
    back = np.full(len(points), -1, np.int64)
    back[used] = np.arange(len(used))
    found.count["dropped_vertices"] = len(weld) - len(np.unique(source[used]))
    faces = inverse.reshape(-1, 3).astype(np.int64)
    return CleanMesh(
        points[used], faces, source[used], back[weld], found.count, found.places
    )
