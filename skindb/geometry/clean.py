"""Repair of scanned meshes: the result is one oriented manifold surface without slivers
or small holes. Slivers are collapsed (needles) or flipped away (caps), and holes are
filled with the triangulation of least area.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from skindb.errors import require
from skindb.geometry.mesh import (
    boundary_loops,
    edge_table,
    face_components,
    face_crosses,
    fans,
    outline_first,
    pair_components,
    simple_loops,
    winding_flips,
)
from skindb.types import Faces, Float64, Index, Mask, float64, lengths

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
# height over longest side: 4 um on a scan, a tenth of its noise; valid scans have 1e-2
MIN_HEIGHT_RATIO = 1e-3
MIN_FILL_HEIGHT_RATIO = 1e-4  # of a triangle that closes a slit, which may be thinner
MAX_FLIP_ROUNDS = 10  # a flip can create a sliver in the neighbour
DROPPED = (-1, -1, -1)
MAX_NEEDLE_RATIO = 0.01  # shortest over longest side of a sliver that is collapsed


@dataclass(frozen=True)
class CleanMesh:
    """A repaired mesh and where its vertices came from."""

    vertices: Float64  # (v', 3) mm
    faces: Index  # (f', 3) wound outwards
    source_vertex: Index  # (v',) number in the scan; twice where a bow-tie was split
    # (v,) number here of each vertex of the scan (welded ones share it); -1 if it is
    # gone
    clean_vertex: Index
    report: dict[str, int]  # what was found and repaired
    # (3,) mm, positions of the first PLACES of each kind, without crops
    places: dict[str, list[Float64]]


@dataclass(frozen=True)
class _Report:
    """Findings so far: number of each kind, and centres of the first PLACES."""

    count: dict[str, int] = field(default_factory=lambda: dict.fromkeys(KINDS, 0))
    places: dict[str, list[Float64]] = field(default_factory=dict)

    def add(self, kind: str, points: Float64, parts: Sequence[Index] | Index) -> None:
        """Add parts, each of which is a set of vertices: faces (n, 3), edges (n, 2),
        vertices (n, 1), or loops.
        """
        self.count[kind] += len(parts)
        places = self.places.get(kind, [])
        if centres := [
            points[part].mean(axis=0) for part in parts[: PLACES - len(places)]
        ]:
            self.places[kind] = places + centres


def clean_mesh(
    vertices: Float64,
    faces: Faces,
    *,
    hole_edges: int = MAX_HOLE_EDGES,
    keep: Mask | None = None,
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
    points = float64(vertices)
    current = np.asarray(faces, np.int64)
    report = _Report()
    if keep is not None:
        report.count["cropped_faces"] = int((~keep).sum())
        current = current[keep]
    current = _drop_repeated(points, current, report)
    current, weld = _weld(points, current, report)
    current = _drop_overfull(points, current, report)
    current = _orient(points, current, report)
    current, repaired, remaining = repair_slivers(points, current)
    report.add("slivers", points, repaired)
    report.add("slivers_left", points, remaining)
    current = _largest_component(points, current, report)
    require(
        len(current),
        "mesh",
        "a scan must have a surface",
        "no non-degenerate face",
        "export it again",
    )
    current = _fill_small_holes(points, current, hole_edges, report)
    current, source = _split_bow_ties(current, len(points))
    report.add("bow_ties", points, source[len(points) :, None])
    points = points[source]
    current = _outwards(points, current, report)
    return _compact(points, current, source, weld, report)


def _drop_repeated(points: Float64, faces: Index, report: _Report) -> Index:
    degenerate = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    report.add("degenerate_faces", points, faces[degenerate])
    faces = faces[~degenerate]
    _, index, inverse = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True
    )
    original = index[inverse.ravel()]
    repeated = original != np.arange(len(faces))
    # an odd permutation of ascending corners
    odd = np.prod(np.sign(np.roll(faces, -1, axis=1) - faces), axis=1) > 0
    flipped = repeated & (odd != odd[original])
    report.add("duplicate_faces", points, faces[repeated & ~flipped])
    report.add("flipped_duplicates", points, faces[flipped])
    return faces[~repeated]


def _weld(points: Float64, faces: Index, report: _Report) -> tuple[Index, Index]:
    """Join coinciding vertices of open boundaries (seams of a texture, unconnected triangles)."""
    table = edge_table(faces)
    rim = np.unique(table.edges[table.count == 1])
    weld = np.arange(len(points))
    if len(rim):
        diagonal = float(np.linalg.norm(np.ptp(points[np.unique(faces)], axis=0)))
        reach = WELD_DISTANCE_RATIO * diagonal
        pairs = cKDTree(points[rim]).query_pairs(reach, output_type="ndarray")
        label = pair_components(pairs[:, 0], pairs[:, 1], len(rim))
        _, index = np.unique(label, return_index=True)
        weld[rim] = rim[index[label]]
    welded = np.flatnonzero(weld != np.arange(len(points)))
    report.add("welded_vertices", points, welded[:, None])
    if len(welded):
        faces = _drop_repeated(points, weld[faces], report)
    return faces, weld


def _drop_overfull(points: Float64, faces: Index, report: _Report) -> Index:
    """Keep two faces at every edge: fins and flaps are removed before the surface to
    which they are attached.
    """
    table = edge_table(faces)
    report.add("non_manifold_edges", points, table.edges[table.count > 2])
    while len(faces):
        table = edge_table(faces)
        face, side = np.nonzero(table.count[table.of_face] > 2)
        if not len(face):
            break
        label = face_components(faces)
        free = (table.count[table.of_face] == 1).sum(axis=1)
        area = lengths(face_crosses(points, faces))
        edge = table.of_face[face, side]
        size = np.bincount(label)[label]
        order = np.lexsort((area[face], -free[face], size[face], edge))
        _, index = np.unique(edge[order], return_index=True)
        extra = np.unique(face[order[index]])
        report.add("non_manifold_faces", points, faces[extra])
        faces = np.delete(faces, extra, axis=0)
    return faces


def _orient(points: Float64, faces: Index, report: _Report) -> Index:
    flip = winding_flips(faces) if len(faces) else np.zeros(0, bool)
    turned = np.where(flip[:, None], faces[:, ::-1], faces)
    report.add("turned_faces", points, faces[flip])
    # a one-sided strip has no consistent winding: cut it where two faces still traverse
    # an edge in the same direction
    key = turned * (len(points) + 1) + np.roll(turned, -1, axis=1)
    _, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    drop = (count[inverse].reshape(-1, 3) > 1).any(axis=1)
    report.add("one_sided_faces", points, faces[drop])
    return turned[~drop]


def _largest_component(points: Float64, faces: Index, report: _Report) -> Index:
    label = face_components(faces) if len(faces) else np.zeros(0, np.int64)
    area = lengths(face_crosses(points, faces))
    keep = label == np.bincount(label, area, minlength=1).argmax()
    touching = np.isin(faces, faces[keep]).any(axis=1)
    hanging = ~keep & np.isin(label, label[touching])
    island = ~keep & ~hanging
    report.add("hanging_faces", points, faces[hanging])
    report.count["island_faces"] = int(island.sum())
    order = np.argsort(label[island], kind="stable")
    _, start = np.unique(label[island][order], return_index=True)
    islands = [part.ravel() for part in np.split(faces[island][order], start)[1:]]
    report.add("islands", points, islands)
    return faces[keep]


def _split_bow_ties(faces: Index, n: int) -> tuple[Index, Index]:
    """One vertex per fan; the first fan keeps the vertex, the others get new ones at the end."""
    label = fans(faces).ravel()
    _, index, inverse = np.unique(label, return_index=True, return_inverse=True)
    vertex = faces.ravel()[index]  # vertex of each fan
    extra = np.ones(len(vertex), bool)
    extra[np.unique(vertex, return_index=True)[1]] = False
    number = vertex.copy()
    number[extra] = n + np.arange(int(extra.sum()))
    source = np.concatenate([np.arange(n), vertex[extra]])
    return number[inverse].reshape(-1, 3), source


def _fill_small_holes(
    points: Float64, faces: Index, hole_edges: int, report: _Report
) -> Index:
    """Fill small holes; holes that touch in a vertex form one boundary, which is split
    into them.
    """
    split, source = _split_bow_ties(faces, len(points))
    loops = list[Index]()
    for loop in boundary_loops(split):
        loops += simple_loops(source[loop])
    edges = set(map(tuple, edge_table(faces).edges.tolist()))
    patches = [faces]
    holes = []
    for loop in outline_first(points, loops)[1:]:
        patch = fill_hole(points, loop, edges) if len(loop) <= hole_edges else None
        if patch is not None:
            patches.append(patch)
            holes.append(loop)
            edges |= set(map(tuple, edge_table(patch).edges.tolist()))
    filled = np.concatenate(patches)
    report.add("pin_holes", points, holes)
    report.count["filled_faces"] = len(filled) - len(faces)
    return filled


def _outwards(points: Float64, faces: Index, report: _Report) -> Index:
    """Turn the mesh over if it encloses negative volume after its longest boundary is
    closed by a fan.
    """
    loops = outline_first(points, boundary_loops(faces))
    report.add("open_loops", points, loops)
    # seen from the middle of the boundary, the fan that closes it adds no volume
    origin = points[loops[0]].mean(axis=0) if loops else points[faces[0, 0]]
    cross = face_crosses(points, faces)
    volume = float(np.einsum("fi,fi->", points[faces[:, 0]] - origin, cross)) / 6
    scale = (float(lengths(cross).sum()) / 2) ** 1.5
    inside_out = volume < -MIN_VOLUME_RATIO * scale
    report.count["turned_mesh"] = int(inside_out)
    return faces[:, ::-1] if inside_out else faces


def _compact(
    points: Float64,
    faces: Index,
    source: Index,
    weld: Index,
    report: _Report,
) -> CleanMesh:
    corners, inverse = np.unique(faces, return_inverse=True)
    number = np.full(len(points), -1, np.int64)
    number[corners] = np.arange(len(corners))
    report.count["dropped_vertices"] = len(weld) - len(np.unique(source[corners]))
    return CleanMesh(
        vertices=points[corners],
        faces=inverse.reshape(-1, 3).astype(np.int64),
        source_vertex=source[corners],
        clean_vertex=number[weld],
        report=report.count,
        places=report.places,
    )


def sliver_mask(
    vertices: Float64, faces: Faces, min_ratio: float = MIN_HEIGHT_RATIO
) -> Mask:
    """Mask (f,) of triangles with a height below `min_ratio` of their longest side, or
    with coinciding corners.
    """
    p = float64(vertices)[faces]
    sides = p - np.roll(p, -1, axis=1)
    longest = np.einsum("fki,fki->fk", sides, sides).max(axis=1, initial=0.0)
    double_area = lengths(np.cross(sides[:, 0], sides[:, 1]))
    return double_area <= min_ratio * longest


def fill_hole(
    vertices: Float64, loop: Index, edges: set[tuple[int, int]]
) -> Index | None:
    """Triangles that close a boundary loop (Barequet and Sharir 1995, weight: area).

    Parameters
    ----------
    vertices
        (v, 3) mm.
    loop
        (n,) vertices along the faces of the mesh (as `boundary_loops` returns).
    edges
        Edges (lower, higher) of the mesh, which no new diagonal may repeat.

    Returns
    -------
    ndarray or None
        (n - 2, 3) wound like the mesh; None where every triangulation has a sliver or
        repeats an edge.
    """
    # the mesh follows the loop, so that the patch follows its reverse
    ring = loop[::-1]
    n = len(ring)
    p = float64(vertices)[ring]
    cost = np.full((n, n), np.inf)
    split = np.zeros((n, n), np.int64)
    cost[np.arange(n - 1), np.arange(1, n)] = 0.0
    for span in range(2, n):
        for i in range(n - span):
            k = i + span
            diagonal = min(ring[i], ring[k]), max(ring[i], ring[k])
            if span < n - 1 and diagonal in edges:
                continue
            middle = np.arange(i + 1, k)
            ends = np.full((k - i - 1, 2), [i, k])
            corners = np.column_stack([ends[:, 0], middle, ends[:, 1]])
            area = lengths(np.cross(p[middle] - p[i], p[k] - p[i]))
            area[sliver_mask(p, corners, MIN_FILL_HEIGHT_RATIO)] = np.inf
            total = cost[i, middle] + cost[middle, k] + area
            split[i, k] = middle[total.argmin()]
            cost[i, k] = total.min()
    if not np.isfinite(cost[0, n - 1]):
        return None
    triangles = []
    sides = [(0, n - 1)]
    while sides:
        i, k = sides.pop()
        if k - i > 1:
            j = int(split[i, k])
            triangles.append((ring[i], ring[j], ring[k]))
            sides += [(i, j), (j, k)]
    return np.array(triangles, np.int64)


def repair_slivers(vertices: Float64, faces: Index) -> tuple[Index, Index, Index]:
    """Faces (f', 3) without slivers, the repaired slivers (r, 3), and those that could
    not be repaired (s, 3).

    The short edge of a needle is collapsed. The long edge of a cap is replaced by the
    other diagonal of the quadrilateral that it forms with its neighbour, or the cap is
    dropped if that edge is open.
    """
    current = np.array(faces, np.int64)
    repaired: list[Index] = []
    for _ in range(MAX_FLIP_ROUNDS):
        slivers = sliver_mask(vertices, current)
        # the neighbourhood that a repair needs
        near = np.flatnonzero(np.isin(current, current[slivers]).any(axis=1))
        patch = _Patch.of(current[near])
        before = len(repaired)
        for i in np.flatnonzero(slivers[near]).tolist():
            corners = patch.faces[i].copy()
            if _repair(vertices, patch, i):
                repaired.append(corners)
        current[near] = patch.faces
        current = current[current[:, 0] >= 0]
        if len(repaired) == before:
            break
    remaining = current[sliver_mask(vertices, current)]
    return current, np.array(repaired, np.int64).reshape(-1, 3), remaining


@dataclass(frozen=True)
class _Patch:
    """Faces under repair, -1 where dropped, and which of them are at each vertex."""

    faces: Index
    star: defaultdict[int, set[int]]

    @classmethod
    def of(cls, faces: Index) -> _Patch:
        star = defaultdict[int, set[int]](set)
        for i, corners in enumerate(faces.tolist()):
            for vertex in corners:
                star[vertex].add(i)
        return cls(faces, star)

    def put(self, i: int, corners: Sequence[int]) -> None:
        """Replace the corners of face i."""
        for vertex in self.faces[i].tolist():
            self.star[vertex].discard(i)
        self.faces[i] = corners
        for vertex in corners:
            self.star[vertex].add(i)

    def around(self, vertex: int) -> Index:
        """Faces (k, 3) at a vertex."""
        return self.faces[list(self.star[vertex])]


def _repair(vertices: Float64, patch: _Patch, i: int) -> bool:
    """Repair face i in place, and return whether it was changed."""
    corner = patch.faces[i]
    if corner[0] < 0 or not sliver_mask(vertices, corner[None])[0]:
        return False  # removed by an earlier repair
    side = lengths(vertices[np.roll(corner, -1)] - vertices[corner])
    short = int(side.argmin())
    long = int(side.argmax())
    ends = int(corner[short]), int(corner[(short + 1) % 3])
    is_needle = side[short] <= MAX_NEEDLE_RATIO * side[long]
    if is_needle and _collapse(patch, min(ends), max(ends)):
        return True
    return _flip(patch, i, long)


def _collapse(patch: _Patch, keep: int, gone: int) -> bool:
    """Move a vertex onto another unless that would pinch the surface (link condition)."""
    at_keep = patch.around(keep)
    at_gone = patch.around(gone)
    between = patch.star[keep] & patch.star[gone]
    common = set(at_keep.ravel().tolist()) & set(at_gone.ravel().tolist())
    common -= {keep, gone}
    open_ends = _is_open(at_keep, keep) and _is_open(at_gone, gone)
    if len(common) != len(between) or (open_ends and len(between) == 2):
        return False
    for i in patch.star[gone] - between:
        corners = patch.faces[i]
        patch.put(i, np.where(corners == gone, keep, corners).tolist())
    for i in between:
        patch.put(i, DROPPED)
    return True


def _is_open(around: Index, vertex: int) -> bool:
    """Whether a vertex lies on the boundary: some neighbour is in only one of its faces."""
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
