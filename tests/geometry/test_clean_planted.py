"""Twenty defects of each kind, alone and together: the report distinguishes them and
the original mesh returns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
import trimesh
from test_clean import assert_sound, cap, face_set, in_scan

from skindb.geometry.clean import PLACES, clean_mesh
from skindb.geometry.mesh import boundary_loops, simple_loops

N = 20


@dataclass
class Spoilt:
    """A mesh to damage: faces may be dropped or changed, vertices and faces are added
    at the end.
    """

    vertices: np.ndarray
    faces: np.ndarray
    more_vertices: list[np.ndarray] = field(default_factory=list)
    more_faces: list[np.ndarray] = field(default_factory=list)
    dropped: list[int] = field(default_factory=list)

    def point(self, position: np.ndarray) -> int:
        self.more_vertices.append(position)
        return len(self.vertices) + len(self.more_vertices) - 1

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        kept = np.delete(self.faces, self.dropped, axis=0)
        return (
            np.concatenate([self.vertices, *[p[None] for p in self.more_vertices]]),
            np.concatenate(
                [
                    kept,
                    *[np.asarray(f, np.int64).reshape(-1, 3) for f in self.more_faces],
                ]
            ),
        )


def duplicate(s: Spoilt, i: int) -> None:
    s.more_faces.append(np.roll(s.faces[i], 1))


def flipped_duplicate(s: Spoilt, i: int) -> None:
    s.more_faces.append(s.faces[i][::-1])


def degenerate(s: Spoilt, i: int) -> None:
    s.more_faces.append(s.faces[i][[0, 1, 1]])


def fin(s: Spoilt, i: int) -> None:
    a, b, _ = s.faces[i]
    s.more_faces.append([a, b, s.point(s.vertices[s.faces[i]].mean(axis=0) * 1.05)])


def flat_on_edge(s: Spoilt, i: int) -> None:
    a, b, _ = s.faces[i]
    s.more_faces.append([a, b, s.point((s.vertices[a] + s.vertices[b]) / 2)])


def hanging(s: Spoilt, i: int) -> None:
    a = s.faces[i, 0]
    s.more_faces.append(
        [a, s.point(s.vertices[a] * 1.03), s.point(s.vertices[a] * 1.03 + [0, 2, 0])]
    )


def island(s: Spoilt, i: int) -> None:
    centre = s.vertices[s.faces[i]].mean(axis=0) * 1.1
    corners = [
        s.point(centre + p)
        for p in np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    ]
    s.more_faces.append(np.array(corners)[[[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]])


def needle(s: Spoilt, i: int, height: float = 2e-4) -> None:
    """Insert a vertex near a on the edge ab of two faces, which divides each of them
    into a needle and the rest.
    """
    a, b, _ = s.faces[i]
    m = s.point(s.vertices[a] + height * (s.vertices[b] - s.vertices[a]))
    for j in np.flatnonzero(((s.faces == a) | (s.faces == b)).sum(axis=1) == 2):
        s.more_faces += [np.where(s.faces[j] == old, m, s.faces[j]) for old in (a, b)]
        s.dropped.append(int(j))


def pin_hole(s: Spoilt, i: int) -> None:
    s.dropped.append(i)


def touching_holes(s: Spoilt, i: int) -> None:
    """Make two holes that meet in a vertex, which becomes a bow-tie."""
    a = s.faces[i, 0]
    shared = np.isin(s.faces, s.faces[i]).sum(axis=1)
    s.dropped += [i, int(np.flatnonzero((s.faces == a).any(axis=1) & (shared == 1))[0])]


def turned(s: Spoilt, i: int) -> None:
    s.faces[i] = s.faces[i][::-1]


def seam(s: Spoilt, i: int) -> None:
    a = s.faces[i, 0]
    s.faces[i, 0] = s.point(s.vertices[a])


PLANTED: dict[str, tuple[Callable[[Spoilt, int], None], dict[str, int]]] = {
    "duplicates": (duplicate, {"duplicate_faces": N}),
    "flipped duplicates": (flipped_duplicate, {"flipped_duplicates": N}),
    "degenerate": (degenerate, {"degenerate_faces": N}),
    "fins": (
        fin,
        {"non_manifold_edges": N, "non_manifold_faces": N, "dropped_vertices": N},
    ),
    "flat on an edge": (
        flat_on_edge,
        {"non_manifold_edges": N, "non_manifold_faces": N, "dropped_vertices": N},
    ),
    "hanging at a vertex": (hanging, {"hanging_faces": N, "dropped_vertices": 2 * N}),
    "islands": (
        island,
        {"islands": N, "island_faces": 4 * N, "dropped_vertices": 4 * N},
    ),
    "slivers": (needle, {"slivers": N, "dropped_vertices": N}),
    "pin holes": (pin_hole, {"pin_holes": N, "filled_faces": N}),
    "touching pin holes": (touching_holes, {"pin_holes": 2 * N, "filled_faces": 2 * N}),
    "turned": (turned, {"turned_faces": N}),
    "seams": (seam, {"welded_vertices": N, "dropped_vertices": N}),
}


def sites(v: np.ndarray, f: np.ndarray, count: int, seed: int) -> list[int]:
    """Faces so far apart that no vertex of one is joined to a vertex of another."""
    rng = np.random.default_rng(seed)
    inner = v[f].min(axis=1)[:, 2] > 0
    taken = np.zeros(len(v), bool)
    found = []
    for i in rng.permutation(np.flatnonzero(inner)):
        ring = f[np.isin(f, f[i]).any(axis=1)]
        if not taken[ring].any():
            taken[ring] = True
            found.append(int(i))
        if len(found) == count:
            return found
    raise AssertionError("the mesh is too small")


@pytest.mark.parametrize("kind", PLANTED)
def test_clean_mesh__twenty_of_a_kind(kind):
    v, f = cap(4)
    spoilt = Spoilt(v, f.copy())
    plant, expected = PLANTED[kind]
    for i in sites(v, f, N, seed=3):
        plant(spoilt, i)
    mesh = clean_mesh(*spoilt.mesh())
    assert_sound(mesh)
    assert in_scan(mesh) == face_set(f)
    np.testing.assert_array_equal(mesh.vertices, v)
    counts = {name: count for name, count in mesh.report.items() if count}
    assert counts == {
        name: count for name, count in (expected | {"open_loops": 1}).items() if count
    }


# consequences of other defects
WITHOUT_PLACES = {"island_faces", "filled_faces", "dropped_vertices"}


@pytest.mark.parametrize("kind", PLANTED)
def test_clean_mesh__says_where(kind):
    """Seen from the centre of the sphere, every defect is within an edge length of the
    face where it was planted.
    """
    v, f = cap(4)
    spoilt = Spoilt(v, f.copy())
    plant, expected = PLANTED[kind]
    planted = sites(v, f, N, seed=3)
    for i in planted:
        plant(spoilt, i)
    mesh = clean_mesh(*spoilt.mesh())
    assert set(mesh.places) == set(expected) - WITHOUT_PLACES | {"open_loops"}
    ways = v[f[planted]].mean(axis=1)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    side = np.linalg.norm(v[f[0, 0]] - v[f[0, 1]]) / np.linalg.norm(v[0])
    for name in set(mesh.places) - {"open_loops"}:
        places = np.array(mesh.places[name])
        gap = np.linalg.norm(
            (places / np.linalg.norm(places, axis=1, keepdims=True))[:, None] - ways,
            axis=2,
        )
        # longest sides are 1.2 times the first one
        assert gap.min(axis=1).max() < 1.5 * side
        assert len(places) == min(expected[name], PLACES)
        assert expected[name] > N or set(gap.argmin(axis=1)) == set(range(N))
    (middle,) = mesh.places["open_loops"]
    np.testing.assert_allclose(middle, v[boundary_loops(f)[0]].mean(axis=0), atol=1e-9)


def test_clean_mesh__twenty_of_each_kind_together():
    v, f = cap(5)
    spoilt = Spoilt(v, f.copy())
    total = {"open_loops": 1}
    where = iter(sites(v, f, N * len(PLANTED), seed=1))
    for plant, expected in PLANTED.values():
        for _ in range(N):
            plant(spoilt, next(where))
        total |= {name: total.get(name, 0) + count for name, count in expected.items()}
    mesh = clean_mesh(*spoilt.mesh())
    assert_sound(mesh)
    assert in_scan(mesh) == face_set(f)
    np.testing.assert_array_equal(mesh.vertices, v)
    assert {name: count for name, count in mesh.report.items() if count} == total
    assert {name: len(places) for name, places in mesh.places.items()} == {
        name: min(count, PLACES)
        for name, count in total.items()
        if name not in WITHOUT_PLACES
    }
    again = clean_mesh(mesh.vertices, mesh.faces)
    np.testing.assert_array_equal(again.faces, mesh.faces)


def test_clean_mesh__hole_that_touches_the_outline():
    """Outline and hole form one boundary, which passes their common vertex twice; only
    the hole is filled.
    """
    v, f = cap(3)
    outline = boundary_loops(f)[0]
    touching = np.flatnonzero(np.isin(f, outline).sum(axis=1) == 1)
    mesh = clean_mesh(v, np.delete(f, touching[0], axis=0))
    assert in_scan(mesh) == face_set(f)
    assert (
        mesh.report["pin_holes"],
        mesh.report["bow_ties"],
        mesh.report["open_loops"],
    ) == (1, 0, 1)


def test_clean_mesh__openings_that_touch_and_stay_are_parted():
    v, f = cap(3)
    spoilt = Spoilt(v, f.copy())
    touching_holes(spoilt, int(v[f].min(axis=1)[:, 2].argmax()))
    mesh = clean_mesh(*spoilt.mesh(), hole_edges=2)
    assert_sound(mesh)
    # both openings are one boundary of the surface that is parted between them
    assert (
        mesh.report["bow_ties"],
        mesh.report["pin_holes"],
        mesh.report["open_loops"],
    ) == (1, 0, 2)
    assert in_scan(mesh) == face_set(spoilt.mesh()[1])


@pytest.mark.parametrize(
    ("loop", "parts"),
    [
        ([0, 1, 2], [[0, 1, 2]]),
        ([0, 1, 2, 0, 3, 4], [[0, 1, 2], [0, 3, 4]]),
        ([5, 0, 1, 2, 0, 3, 4, 6], [[0, 1, 2], [5, 0, 3, 4, 6]]),
        ([0, 1, 2, 3, 4, 2, 5, 6, 2, 7], [[2, 3, 4], [2, 5, 6], [0, 1, 2, 7]]),
        ([0, 1, 2, 3, 1, 4, 5, 0, 6, 7], [[1, 2, 3], [0, 1, 4, 5], [0, 6, 7]]),
    ],
)
def test_simple_loops__pass_no_vertex_twice(loop, parts):
    assert [part.tolist() for part in simple_loops(np.array(loop))] == parts


def test_simple_loops__long_paths_agree_with_a_search_of_the_path():
    rng = np.random.default_rng(0)
    loop = rng.integers(0, 300, 2000)
    parts = []
    path = []
    for vertex in loop.tolist():
        if vertex in path:
            parts.append(path[path.index(vertex) :])
            path = path[: path.index(vertex)]
        path.append(vertex)
    found = simple_loops(loop)
    assert [part.tolist() for part in found] == [*parts, path]
    assert sum(map(len, found)) == len(loop)


def test_clean_mesh__cropped_faces_are_counted():
    v, f = cap(3)
    keep = v[f].mean(axis=1)[:, 1] > 0
    mesh = clean_mesh(v, f, keep=keep)
    assert in_scan(mesh) == face_set(f[keep])
    assert mesh.report["cropped_faces"] == (~keep).sum()


def test_clean_mesh__icosphere_of_any_orientation_is_left_alone():
    ball = trimesh.creation.icosphere(3, radius=90.0)
    mesh = clean_mesh(np.asarray(ball.vertices), np.asarray(ball.faces))
    np.testing.assert_array_equal(mesh.faces, ball.faces)
    assert not any(mesh.report.values())
