"""Connectivity, order, normals and areas of meshes, and Loop subdivision compared with an
implementation by dictionaries.
"""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest
import scipy.sparse as sp
import trimesh

from skindb.geometry._mesh_kernels import grown, mixed
from skindb.geometry.mesh import (
    MORTON_BITS,
    boundary_loops,
    closest_on_mesh,
    edge_table,
    face_components,
    fans,
    loop_matrix,
    morton_order,
    split_longest,
    subdivide,
    vertex_areas,
    vertex_normals,
    winding_flips,
    winding_number,
)

SQUARE = np.array([[0, 1, 2], [0, 2, 3]])  # counter-clockwise, 0 1 2 3 around
TWO_SQUARES = np.concatenate([SQUARE, SQUARE + 4])


def test_edge_table__square():
    table = edge_table(SQUARE)
    assert table.edges.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]
    assert table.count.tolist() == [1, 2, 1, 1, 1]
    assert table.edges[table.of_face].tolist() == [
        [[0, 1], [1, 2], [0, 2]],
        [[0, 2], [2, 3], [0, 3]],
    ]


def test_boundary_loops__run_along_the_faces_longest_first():
    assert [loop.tolist() for loop in boundary_loops(SQUARE)] == [[0, 1, 2, 3]]
    both = boundary_loops(np.concatenate([SQUARE, [[4, 5, 6]]]))
    assert [loop.tolist() for loop in both] == [[0, 1, 2, 3], [4, 5, 6]]


def test_boundary_loops__none_on_a_closed_surface():
    assert boundary_loops(np.asarray(trimesh.creation.icosphere(1).faces)) == []


@pytest.mark.parametrize(
    "faces",
    [[[0, 1, 2], [0, 3, 4]], [[0, 1, 2], [0, 3, 2]]],
    ids=["bow-tie", "winding"],
)
def test_boundary_loops__refuse_what_has_no_loops(faces):
    with pytest.raises(ValueError, match="clean the mesh first"):
        boundary_loops(np.array(faces))


def test_face_components__need_an_edge():
    assert len(set(face_components(TWO_SQUARES))) == 2
    assert len(set(face_components(np.array([[0, 1, 2], [0, 3, 4]])))) == 2
    assert len(set(face_components(SQUARE))) == 1


def test_winding_flips__turn_the_fewer_in_each_piece():
    sphere = np.asarray(trimesh.creation.icosphere(2).faces)
    turned = np.random.default_rng(0).random(2 * len(sphere)) < 0.3
    faces = np.concatenate([sphere, sphere + sphere.max() + 1])
    spoilt = np.where(turned[:, None], faces[:, ::-1], faces)
    np.testing.assert_array_equal(winding_flips(spoilt), turned)


def test_fans__tell_bow_ties():
    bow = fans(np.array([[0, 1, 2], [0, 3, 4]]))
    assert bow[0, 0] != bow[1, 0]
    label = fans(SQUARE)
    assert (label[0, 0], label[0, 2]) == (label[1, 0], label[1, 1])
    assert len(np.unique(label)) == 4


@pytest.mark.parametrize("turn", [False, True])
def test_fans__do_not_depend_on_the_winding(turn):
    sphere = np.array(trimesh.creation.icosphere(2).faces)
    if turn:
        sphere[::3] = sphere[::3, ::-1]
    label = fans(sphere)
    assert len(np.unique(label)) == sphere.max() + 1
    assert all(
        len(set(sphere.ravel()[label.ravel() == fan])) == 1 for fan in np.unique(label)
    )


ROUNDING = 1e-12


def sphere(level: int = 3, radius: float = 80.0) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(level, radius=radius)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)


def morton_key(point: np.ndarray, low: np.ndarray, side: float) -> int:
    cells = [
        min(int((x - a) / side * 2**MORTON_BITS), 2**MORTON_BITS - 1)
        for x, a in zip(point, low, strict=True)
    ]
    return int(
        "".join(
            a + b + c
            for a, b, c in zip(
                *(f"{cell:0{MORTON_BITS}b}" for cell in cells), strict=True
            )
        ),
        2,
    )


def test_morton_order__sorts_interleaved_bits():
    points = np.random.default_rng(0).normal(size=(300, 3)) * [1, 5, 0.1]
    low = points.min(axis=0)
    keys = [morton_key(p, low, float(np.ptp(points, axis=0).max())) for p in points]
    assert morton_order(points).tolist() == sorted(range(300), key=keys.__getitem__)


def test_morton_order__keeps_neighbours_together():
    points = sphere(4)[0]
    shuffled = np.random.default_rng(0).permutation(points)
    step = np.linalg.norm(np.diff(shuffled[morton_order(shuffled)], axis=0), axis=1)
    assert np.median(step) < 0.1 * np.median(
        np.linalg.norm(np.diff(shuffled, axis=0), axis=1)
    )


def test_morton_order__equal_and_no_points():
    assert morton_order(np.ones((4, 3))).tolist() == [0, 1, 2, 3]
    assert morton_order(np.zeros((0, 3))).tolist() == []


def test_vertex_normals__of_a_sphere_are_radial():
    v, f = sphere()
    # the area weight is off the radius by less than the angle a face spans squared, (0.15 rad)^2
    np.testing.assert_allclose(vertex_normals(v, f), v / 80, atol=0.15**2)


def test_vertex_normals__weigh_by_area():
    v = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 1]], float)
    normal = vertex_normals(v, np.array([[0, 1, 2], [0, 2, 3]]))[0]
    np.testing.assert_allclose(normal, np.array([1, 0, 2]) / 5**0.5, atol=ROUNDING)


def test_vertex_normals__nan_without_a_face():
    v = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [5, 5, 5]], float)
    normal = vertex_normals(v, np.array([[0, 1, 2]]))
    assert np.isnan(normal).any(axis=1).tolist() == [False, False, False, True]


def test_vertex_areas__give_each_corner_a_third():
    v, f = sphere(2)
    expected = np.zeros(len(v))
    for a, b, c in f:
        sides = [
            float(np.linalg.norm(v[i] - v[j])) for i, j in ((a, b), (b, c), (c, a))
        ]
        half = sum(sides) / 2
        # Heron
        area = (half * (half - sides[0]) * (half - sides[1]) * (half - sides[2])) ** 0.5
        expected[[a, b, c]] += area / 3
    np.testing.assert_allclose(vertex_areas(v, f), expected, rtol=1e-10)


def every_distance(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n, f): trimesh answers for pairs of triangle and point, by another algorithm
    (Ericson's regions).
    """
    nearest = [
        trimesh.triangles.closest_point(triangles, np.tile(p, (len(triangles), 1)))
        for p in points
    ]
    return np.linalg.norm(np.stack(nearest) - points[:, None], axis=2)


def test_closest_on_mesh__agrees_with_trimesh():
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(2, radius=50.0)
    points = rng.normal(size=(60, 3)) * 50
    faces = np.asarray(ball.faces)
    face, weight, distance = closest_on_mesh(np.asarray(ball.vertices), faces, points)
    np.testing.assert_allclose(
        distance, every_distance(ball.triangles, points).min(axis=1), rtol=1e-12
    )
    np.testing.assert_allclose(weight.sum(axis=1), 1, rtol=1e-14)
    assert weight.min() >= 0
    there = np.einsum("nk,nki->ni", weight, ball.vertices[faces[face]])
    np.testing.assert_allclose(
        np.linalg.norm(there - points, axis=1), distance, rtol=1e-12
    )


def test_closest_on_mesh__corner_side_plane_and_degenerate_triangles():
    v = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [9, 9, 9.0]])
    points = np.array([[1, 1, 2], [-3, -4, 0], [2, -5, 0], [4, 4, 0]], float)
    face, weight, distance = closest_on_mesh(
        v, np.array([[3, 3, 3], [0, 1, 2]]), points
    )
    assert face.tolist() == [1] * 4
    np.testing.assert_allclose(
        weight, [[0.5, 0.25, 0.25], [1, 0, 0], [0.5, 0.5, 0], [0, 0.5, 0.5]], atol=1e-15
    )
    np.testing.assert_allclose(distance, [2, 5, 5, np.sqrt(8)])
    assert closest_on_mesh(v, np.array([[0, 1, 2]]), np.zeros((0, 3)))[1].shape == (
        0,
        3,
    )


@pytest.mark.parametrize(
    ("height", "expected"),
    [(0.0, 0.5), (30.0, 0.5 - 0.5 * 30 / 50), (-30.0, 0.5 + 0.5 * 30 / 50)],
)
def test_winding_number__of_an_open_cap_is_the_solid_angle_of_its_rim(height, expected):
    """A hemisphere of radius r seen from the axis: the rim as a disc in closed form."""
    ball = trimesh.creation.icosphere(5, radius=40.0)
    keep = (ball.vertices[ball.faces][..., 2] < 1e-9).all(axis=1)
    found = winding_number(
        np.asarray(ball.vertices),
        np.asarray(ball.faces)[keep],
        np.array([[0, 0, height]]),
    )
    # chords: the rim lies 1 % inside
    assert found == pytest.approx([expected], abs=5e-3)


def test_winding_number__closed():
    ball = trimesh.creation.icosphere(2, radius=40.0)
    points = np.array([[1, 2, 3], [0, 0, 45], [500, 0, 0.0]])
    found = winding_number(np.asarray(ball.vertices), np.asarray(ball.faces), points)
    np.testing.assert_allclose(found, [1, 0, 0], atol=1e-12)


def test_closest_on_mesh__a_large_triangle_whose_middle_is_far():
    big = [[0, 0, 0], [100, 0, 0], [0, 100, 0]]
    small = [[97, 1, 3], [98, 1, 3], [97, 2, 3]]
    face, _, distance = closest_on_mesh(
        np.array(big + small, float),
        np.array([[3, 4, 5], [0, 1, 2]]),
        np.array([[97, 1, 1.0]]),
    )
    assert (face[0], distance[0]) == (1, pytest.approx(1))


@pytest.mark.parametrize("reach", [1e-6, 1e-3, 1.0])
def test_closest_on_mesh__needles_down_to_no_height(reach):
    """The distance is that to the foot of a perpendicular, or less; and no edge is nearer."""
    rng = np.random.default_rng(2)
    for height in 10 ** rng.uniform(-17, -1, 500):
        along, across, up = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        v = np.outer([0, *rng.uniform(0, 5, 2)], along) + np.outer(
            [0, 0, height], across
        )
        v = rng.permutation(v)
        foot = rng.dirichlet([0.3, 0.3, 0.3]) @ v
        point = foot + rng.normal(scale=reach) * up
        _, weight, distance = closest_on_mesh(v, np.array([[0, 1, 2]]), point[None])
        edge = np.roll(v, -1, axis=0) - v
        away = point - v
        t = np.clip((away * edge).sum(axis=1) / (edge**2).sum(axis=1), 0, 1)
        others = [
            np.linalg.norm(point - foot),
            *np.linalg.norm(t[:, None] * edge - away, axis=1),
        ]
        assert distance[0] <= min(others) + 1e-14  # ten roundings of 5 mm
        assert weight.min() >= 0


def test_closest_on_mesh__triangles_of_all_sizes():
    rng = np.random.default_rng(1)
    size = 10 ** rng.uniform(-3, 2, (200, 1, 1))
    triangles = rng.normal(size=(200, 1, 3)) * 20 + size * rng.normal(size=(200, 3, 3))
    points = rng.normal(size=(50, 3)) * 20
    face, _, distance = closest_on_mesh(
        triangles.reshape(-1, 3), np.arange(600).reshape(-1, 3), points
    )
    every = every_distance(triangles, points)
    np.testing.assert_array_equal(face, every.argmin(axis=1))  # none touch: no ties
    # small triangles at 20 mm: 1e-14 mm of 1e-3
    np.testing.assert_allclose(distance, every.min(axis=1), rtol=1e-9)


def test_closest_on_mesh__one_long_triangle_costs_the_others_nothing():
    side = np.meshgrid(*2 * [np.arange(100.0)])
    step = np.arange(100 * 100).reshape(100, 100)
    a, b, c, d = (
        step[i : i + 99, j : j + 99].ravel()
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1))
    )
    plain = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    v = np.stack([*(x.ravel() / 2 for x in side), np.zeros(100 * 100)], axis=1)
    v = np.concatenate([v, [[-60, 0, 0], [0, -60, 0]]])
    points = np.random.default_rng(0).uniform(5, 45, (20, 3)) * [1, 1, 0] + [0, 0, 1]
    peak = []
    for faces in (plain, plain, np.concatenate([plain, [[0, len(v) - 2, len(v) - 1]]])):
        tracemalloc.start()
        closest_on_mesh(v, faces, points)
        peak.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # 40 times if all are searched up to the longest distance
    assert peak[2] < 1.2 * peak[1]


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 1.0])
def test_grown_and_mixed__as_by_the_matrix_of_neighbours(share):
    """Compared with a count of the vertices in the mask among each vertex and its neighbours."""
    rng = np.random.default_rng(8)
    faces = rng.integers(0, 200, (150, 3))
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    a, b, c = faces.T
    edges = sp.coo_matrix(
        (np.ones(3 * len(a)), (np.r_[a, b, c], np.r_[b, c, a])), shape=(210, 210)
    ).tocsr()
    near = ((edges + edges.T + sp.eye(210)) > 0).astype(int)
    mask = rng.random(210) < share
    found = near @ mask.astype(int)
    np.testing.assert_array_equal(grown(faces, mask), found > 0)
    np.testing.assert_array_equal(
        mixed(faces, mask), (found > 0) & (found < np.asarray(near.sum(1)).ravel())
    )


def open_sphere() -> tuple[np.ndarray, np.ndarray]:
    """A bumpy sphere with a hole, so valences of 5 and 6 and a ragged boundary with corners."""
    mesh = trimesh.creation.icosphere(2, radius=80.0)
    v = np.asarray(mesh.vertices) + np.random.default_rng(0).normal(size=(162, 3))
    f = np.asarray(mesh.faces, np.int64)
    f = f[v[f].mean(axis=1)[:, 2] > -20]
    used, inverse = np.unique(f, return_inverse=True)
    return v[used], inverse.reshape(-1, 3)


def grid(n: int = 4) -> tuple[np.ndarray, np.ndarray]:
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    v = np.stack([j.ravel(), i.ravel(), np.zeros(n * n)], axis=1).astype(float)
    a = (i * n + j)[:-1, :-1].ravel()
    return v, np.concatenate(
        [np.stack([a, a + 1, a + n + 1], 1), np.stack([a, a + n + 1, a + n], 1)]
    )


def loop_twin(v: np.ndarray, f: np.ndarray) -> dict[frozenset[int], np.ndarray]:
    """Loop 1987 vertex by vertex; keys are {i} for old vertices and {i, j} for edges."""
    across: dict[frozenset[int], list[int]] = {}
    for a, b, c in f.tolist():
        for i, j, k in ((a, b, c), (b, c, a), (c, a, b)):
            across.setdefault(frozenset((i, j)), []).append(k)
    new = {}
    for edge, opposite in across.items():
        i, j = edge
        if len(opposite) == 2:
            new[edge] = (3 * v[i] + 3 * v[j] + v[opposite[0]] + v[opposite[1]]) / 8
        else:
            new[edge] = (v[i] + v[j]) / 2
    for i in range(len(v)):
        ring = [(edge - {i}).__iter__().__next__() for edge in across if i in edge]
        rim = [
            (edge - {i}).__iter__().__next__()
            for edge, o in across.items()
            if i in edge and len(o) == 1
        ]
        n = len(ring)
        if n == 2:  # the corner of a single face
            new[frozenset((i,))] = v[i]
        elif rim:
            new[frozenset((i,))] = 3 / 4 * v[i] + (v[rim[0]] + v[rim[1]]) / 8
        else:
            beta = (5 / 8 - (3 / 8 + math.cos(2 * math.pi / n) / 4) ** 2) / n
            new[frozenset((i,))] = (1 - n * beta) * v[i] + beta * sum(
                v[k] for k in ring
            )
    return new


@pytest.mark.parametrize("mesh", [open_sphere(), grid()], ids=["sphere", "grid"])
def test_loop_matrix__agrees_with_the_twin(mesh):
    v, f = mesh
    matrix, children = loop_matrix(f, len(v))
    positions = matrix @ v
    twin = loop_twin(v, f)
    assert matrix.shape == (len(twin), len(v))
    for i in range(len(v)):
        np.testing.assert_allclose(
            positions[i], twin[frozenset((i,))], atol=ROUNDING * 80
        )
    for i, (a, b, c) in enumerate(f.tolist()):
        middle = children[3 * len(f) + i]
        for at, edge in zip(middle, ((a, b), (b, c), (c, a)), strict=True):
            np.testing.assert_allclose(
                positions[at], twin[frozenset(edge)], atol=ROUNDING * 80
            )


def bumpy(
    mesh: trimesh.Trimesh, faces: slice = slice(None)
) -> tuple[np.ndarray, np.ndarray]:
    v = np.asarray(mesh.vertices)
    return v + np.random.default_rng(1).normal(size=v.shape), np.asarray(
        mesh.faces, np.int64
    )[faces]


@pytest.mark.parametrize(
    "mesh",
    [
        bumpy(trimesh.creation.icosphere(2, radius=80.0)),  # valences 5 and 6
        # open
        bumpy(
            trimesh.creation.icosphere(0, radius=80.0).subdivide_loop(1), slice(0, -9)
        ),
        bumpy(trimesh.creation.box([80, 80, 80])),  # 4 and 5
        bumpy(
            trimesh.Trimesh(
                [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]],
                [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]],
            )
        ),  # 3
    ],
    ids=["sphere", "open", "box", "tetrahedron"],
)
def test_loop_matrix__agrees_with_libigl_in_the_interior(mesh):
    """libigl has Warren's even weights: those of Loop at valences 3 and 6, 3/8 for the
    ring at every other.
    """
    igl = pytest.importorskip("igl")
    v, f = mesh
    theirs, their_faces = igl.loop_matrix(f, len(v))
    theirs = theirs.toarray()
    ours = loop_matrix(f, len(v))[0].toarray()
    assert theirs.shape == ours.shape
    edges, count = np.unique(
        np.sort(f[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1),
        axis=0,
        return_counts=True,
    )
    rim = np.unique(edges[count == 1])
    valence = np.bincount(edges.ravel(), minlength=len(v))
    for i in np.setdiff1d(np.unique(f), rim):
        ring = np.setdiff1d(np.flatnonzero(ours[i]), i)
        expected = ours[i].copy()
        if valence[i] not in (3, 6):
            expected[ring], expected[i] = 3 / 8 / valence[i], 5 / 8
        np.testing.assert_allclose(theirs[i], expected, atol=1e-15)
    # new vertices in any order: rows of the matrices as sets, boundary and interior alike
    key = [np.lexsort(rows[len(v) :].round(6).T) for rows in (ours, theirs)]
    np.testing.assert_allclose(
        ours[len(v) :][key[0]], theirs[len(v) :][key[1]], atol=1e-15
    )
    assert len(their_faces) == 4 * len(f)


def test_split_longest__tiles_the_surface_and_keeps_its_winding():
    """Every number of split edges, so that all kinds of triangles occur; middles do not
    change the surface.
    """
    v, f = grid()
    edges = len(edge_table(f).edges)
    rng = np.random.default_rng(0)
    # edges of different lengths
    bent = v + rng.uniform(-0.1, 0.1, v.shape) * (1, 1, 0)
    area = vertex_areas(bent, f).sum()
    for count in range(edges + 1):
        faces, matrix = split_longest(bent, f, count)
        points = matrix @ bent
        assert len(points) == len(v) + count
        assert vertex_areas(points, faces).sum() == pytest.approx(area)
        table = edge_table(faces)
        assert table.count.max() == 2
        assert not winding_flips(faces).any()
        assert len(points) - len(table.edges) + len(faces) == 1
    sides = np.linalg.norm(np.diff(bent[edge_table(f).edges], axis=1)[:, 0], axis=1)
    _, one = split_longest(bent, f, 1)
    np.testing.assert_array_equal(
        np.flatnonzero(one[-1].toarray()), edge_table(f).edges[sides.argmax()]
    )


def test_loop_matrix__children_tile_the_parent_and_keep_its_winding():
    v, f = grid()
    matrix, children = loop_matrix(f, len(v))
    flat = matrix @ v
    a, b, c = (flat[children[:, i]] for i in range(3))
    area = np.cross(b - a, c - a)[:, 2] / 2
    assert (area > 0).all()
    # the two ears with one face keep their corners; the two with two faces are rounded
    # by a known amount
    assert area.sum() == pytest.approx(9 - 2 * loss_at_a_rounded_corner())
    assert np.unique(np.sort(children, axis=1), axis=0).shape == children.shape


def loss_at_a_rounded_corner() -> float:
    """Area between a unit corner and the chain of its B-spline: (1/2, 0), (1/8, 1/8), (0, 1/2)."""
    return 0.5 * (0.5 * 0.125 + 0.125 * 0.5)


def test_loop_matrix__is_an_average():
    v, f = open_sphere()
    matrix, _ = loop_matrix(f, len(v))
    assert matrix.data.min() > 0
    np.testing.assert_allclose(np.asarray(matrix.sum(axis=1)).ravel(), 1, atol=ROUNDING)


def test_loop_matrix__boundary_depends_on_the_boundary_alone():
    v, f = open_sphere()
    matrix, children = loop_matrix(f, len(v))
    sides = np.sort(children[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edge, count = np.unique(sides, axis=0, return_counts=True)
    old = np.sort(f[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    old_edge, old_count = np.unique(old, axis=0, return_counts=True)
    rim = np.unique(edge[count == 1])
    inner = np.setdiff1d(np.arange(len(v)), old_edge[old_count == 1])
    assert matrix[rim][:, inner].nnz == 0


def test_loop_matrix__vertex_without_a_face_stays():
    matrix, _ = loop_matrix(np.array([[0, 1, 2]]), 5)
    np.testing.assert_array_equal(matrix.toarray()[3:5], np.eye(5)[3:5])


def test_loop_matrix__three_faces_at_an_edge():
    with pytest.raises(ValueError, match="more than two faces"):
        loop_matrix(np.array([[0, 1, 2], [0, 1, 3], [1, 0, 4]]), 5)


def test_subdivide__matrix_carries_any_attribute():
    v, f = open_sphere()
    new, children, matrix = subdivide(v, f, 2)
    assert len(children) == 16 * len(f)
    np.testing.assert_allclose(matrix @ v, new, atol=ROUNDING * 80)
    # e.g. texture coordinates affine in position
    linear = v @ np.array([[0.1, 0.2], [-0.3, 0.1], [0.2, 0.5]]) + 3
    np.testing.assert_allclose(
        matrix @ linear,
        new @ np.array([[0.1, 0.2], [-0.3, 0.1], [0.2, 0.5]]) + 3,
        atol=1e-10,
    )


def test_subdivide__no_level_changes_nothing():
    v, f = open_sphere()
    new, children, matrix = subdivide(v, f, 0)
    np.testing.assert_array_equal(new, v)
    np.testing.assert_array_equal(children, f)
    assert matrix.shape == (len(v), len(v))


def test_subdivide__closed_surface_stays_closed_and_smooth():
    mesh = trimesh.creation.icosphere(1, radius=80.0)
    new, children, _ = subdivide(np.asarray(mesh.vertices), np.asarray(mesh.faces), 3)
    assert len(new) - len(children) // 2 == 2  # Euler: v - e + f = 2 with e = 3 f / 2
    radius = np.linalg.norm(new, axis=1)
    assert np.ptp(radius) < 0.02 * radius.mean()
