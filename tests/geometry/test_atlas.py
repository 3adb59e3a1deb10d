"""The atlas never folds, keeps areas, stands upright; a flat disc comes back as itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import Delaunay

from skindb.errors import InputError
from skindb.geometry.atlas import disc_atlas, signed_areas
from skindb.geometry.clean import clean_mesh
from skindb.geometry.subdivide import subdivide
from skindb.geometry.surfels import face_crosses

EVEN = 0.2  # sd of log2 area; measured 0.1 or less (0.14 on the rough one), 0.67 to 1.9 before equalisation


def front(level: int = 3, below: float = -10.0, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(level, radius=80.0)
    v, f = np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)
    f = f[v[f].mean(axis=1)[:, 2] > below]
    used, inverse = np.unique(f, return_inverse=True)
    return v[used] + noise * np.random.default_rng(0).normal(size=(len(used), 3)), inverse.reshape(-1, 3)


def twisted(uv: np.ndarray, faces: np.ndarray) -> int:
    """Triangles not seen from outside, one by one with v turned up."""
    x, y = uv[:, 0], 1 - uv[:, 1]
    return sum((x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a]) <= 0 for a, b, c in faces)


@pytest.mark.parametrize(("below", "noise"), [(-10, 0), (-10, 3.0), (-70, 0)], ids=["front", "rough", "nearly closed"])
def test_disc_atlas__no_flips_and_even_areas(below, noise):
    v, f = front(below=below, noise=noise)
    uv, report = disc_atlas(v, f)
    assert report["flips"] == twisted(uv, f) == 0
    assert uv.min() >= 0
    assert uv.max() <= 1
    assert report["area_log2_sd"] < EVEN


def test_disc_atlas__sliver_triangles_do_not_flip():
    rng = np.random.default_rng(0)
    angle = 2 * np.pi * np.arange(40) / 40
    flat = np.concatenate([np.stack([np.cos(angle), np.sin(angle)], 1) * 80, rng.normal(size=(400, 2)) * [25, 1.0]])
    f = Delaunay(flat).simplices.astype(np.int64)
    f = np.where((face_crosses(np.pad(flat, ((0, 0), (0, 1))), f)[:, 2] > 0)[:, None], f, f[:, ::-1])
    v = np.column_stack([flat, rng.normal(size=len(flat))])
    uv, report = disc_atlas(v, f)
    assert report["flips"] == twisted(uv, f) == 0


def test_disc_atlas__flat_disc_comes_back_as_itself():
    v, f = front(4)
    plane = np.column_stack([v[:, :2], np.zeros(len(v))])
    rim = np.linalg.norm(v[:, :2], axis=1).max()
    # flatten radially, so that the outline is a circle with even steps
    uv, report = disc_atlas(plane, f)
    np.testing.assert_allclose(uv[:, 0], 0.5 + 0.5 * plane[:, 0] / rim, atol=0.02)
    np.testing.assert_allclose(uv[:, 1], 0.5 - 0.5 * plane[:, 1] / rim, atol=0.02)
    assert report["area_log2_sd"] < EVEN


def test_disc_atlas__upright_and_not_mirrored():
    v, f = front()
    turned = v @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # the subject lies on a side: y is another axis
    for points in (v, turned):
        uv, _ = disc_atlas(points, f)
        assert np.corrcoef(uv[:, 0], points[:, 0])[0, 1] > 0.95
        assert np.corrcoef(uv[:, 1], points[:, 1])[0, 1] < -0.95


def test_disc_atlas__inner_holes_stay_open_and_do_not_fold():
    v, f = front(4)
    middle = v[f].mean(axis=1)
    eye = np.hypot(np.abs(middle[:, 0]) - 25, middle[:, 1] - 20) < 9
    kept = f[~(eye & (middle[:, 2] > 0))]
    used, inverse = np.unique(kept, return_inverse=True)
    uv, report = disc_atlas(v[used], inverse.reshape(-1, 3))
    assert uv.shape == (len(used), 2)
    assert report["flips"] == twisted(uv, inverse.reshape(-1, 3)) == 0


def test_disc_atlas__stays_unfolded_through_subdivision():
    v, f = front(2)
    uv, _ = disc_atlas(v, f)
    _, fine, matrix = subdivide(v, f, 2)
    assert (signed_areas(matrix @ uv, fine) > 0).all()


@pytest.mark.parametrize("caps", [True, False], ids=["closed eyes and mouth", "open"])
def test_disc_atlas__whole_head_with_ears_nostrils_and_mouth(caps):
    file = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "face" / "face_population.npz"
    if not file.exists():
        pytest.skip("the head model is not beside the repository")
    with np.load(file) as model:
        quads = model["quads"].astype(np.int64)
        faces = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
        head = clean_mesh(model["v0"], np.concatenate([faces, model["caps"].astype(np.int64)]) if caps else faces)
    uv, report = disc_atlas(head.vertices, head.faces)
    assert (head.report["open_loops"] == 1) == caps
    assert report["flips"] == twisted(uv, head.faces) == 0
    assert report["area_log2_sd"] < EVEN
    _, fine, matrix = subdivide(head.vertices, head.faces, 1)
    assert (signed_areas((matrix @ uv).astype(np.float32), fine) > 0).all()


@pytest.mark.parametrize(
    ("vertices", "faces", "rule"),
    [
        (trimesh.creation.icosphere(1).vertices, trimesh.creation.icosphere(1).faces, "with a boundary"),
        (np.random.default_rng(0).normal(size=(6, 3)), np.array([[0, 1, 2], [3, 4, 5]]), "one piece"),
        (np.random.default_rng(0).normal(size=(4, 3)), np.array([[0, 1, 2]]), "one piece"),
    ],
    ids=["closed", "pieces", "unused"],
)
def test_disc_atlas__refuses_what_is_no_disc(vertices, faces, rule):
    with pytest.raises(InputError, match=rule):
        disc_atlas(np.asarray(vertices), np.asarray(faces))


def test_disc_atlas__refuses_handles():
    torus = trimesh.creation.torus(50, 20, major_sections=16, minor_sections=12)
    faces = np.asarray(torus.faces)[1:]
    with pytest.raises(InputError, match="1 handles"):
        disc_atlas(np.asarray(torus.vertices), faces)


def test_disc_atlas__single_triangle():
    uv, report = disc_atlas(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float), np.array([[0, 1, 2]]))
    assert report["flips"] == twisted(uv, np.array([[0, 1, 2]])) == 0
