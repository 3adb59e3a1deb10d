import numpy as np
import pytest
import trimesh

from skindb.errors import InputError
from skindb.virtual.head import head_of_file, load_head


def _grid(n=6):
    x, y = np.meshgrid(np.linspace(-30, 30, n), np.linspace(-30, 30, n))
    vertices = np.stack(
        [x.ravel(), y.ravel(), 90 - 0.01 * (x**2 + y**2).ravel()], axis=1
    )
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (q.ravel() for q in (i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]))
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def test_load_head__reads_a_plain_npz(tmp_path):
    vertices, faces = _grid()
    region = (vertices[:, 1] > 0).astype(int)
    np.savez(
        tmp_path / "head.npz",
        vertices=vertices,
        faces=faces,
        landmark_names=["nose_tip"],
        landmark_vertex=[14],
        region=region,
        region_names=["cheek", "forehead"],
    )
    model = load_head(tmp_path / "head.npz")
    assert model.landmarks == {"nose_tip": 14}
    np.testing.assert_array_equal(
        model.regions["forehead"], np.flatnonzero(region == 1)
    )
    true, scan = head_of_file(tmp_path / "head.npz")
    np.testing.assert_array_equal(scan.vertices, true.vertices[: len(vertices)])
    np.testing.assert_array_equal(scan.faces, faces)
    assert len(true.faces) == 4 * len(faces)
    assert scan.region("forehead")[vertices[:, 1] > 25].all()
    assert not scan.region("forehead")[vertices[:, 1] < -25].any()


@pytest.mark.parametrize("suffix", ["ply", "obj"])
def test_load_head__reads_meshes_in_the_file_s_order(tmp_path, suffix):
    vertices, faces = _grid()
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / f"head.{suffix}")
    model = load_head(tmp_path / f"head.{suffix}")
    np.testing.assert_allclose(model.vertices, vertices, atol=1e-4)
    np.testing.assert_array_equal(model.faces, faces)


@pytest.mark.parametrize(
    ("arrays", "match"),
    [
        ({"points": np.zeros((3, 3))}, "needs the arrays vertices and faces"),
        ({"vertices": np.full((3, 3), np.nan), "faces": [[0, 1, 2]]}, "finite"),
        ({"vertices": np.zeros((3, 3)), "faces": [[0, 1, 7]]}, "existing vertices"),
    ],
)
def test_load_head__says_what_is_wrong(tmp_path, arrays, match):
    np.savez(tmp_path / "head.npz", **arrays)
    with pytest.raises(InputError, match=match):
        load_head(tmp_path / "head.npz")


def test_load_head__refuses_what_is_no_archive(tmp_path):
    (tmp_path / "head.npz").write_bytes(b"nothing of the kind")
    with pytest.raises(InputError, match="readable npz"):
        load_head(tmp_path / "head.npz")
    with pytest.raises(InputError, match="must exist"):
        load_head(tmp_path / "absent.npz")
