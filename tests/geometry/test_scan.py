"""Files written by hand and by trimesh are read with their vertices in order; broken
files are named.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from skindb.errors import InputError
from skindb.geometry.scan import Crop, crop_faces, read_scan

OBJ = """# units mm
mtllib ../../elsewhere.mtl
o face
v 0 0 0
v 1 0 0 0.5 0.5 0.5
v 1 1 0
v 0 1 0
v 9 9 9
vt 0 0
vt 1 0
vt 1 1
vt 0.5 0.5
vn 0 0 1
usemtl skin
f 1/1/1 2/2/1 3/3/1
s 1
usemtl lip
f 1/4 3/3 \\
4/2
f -5 -4 -3 -2
"""
PLY_QUADS = """ply
format ascii 1.0
element vertex 5
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
1 1 0
0 1 0
5 5 5
4 0 1 2 3
3 0 1 2
"""


def save(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_read_scan__obj_with_texture_seams_keeps_order_and_count(tmp_path):
    scan = read_scan(save(tmp_path, "scan.obj", OBJ))
    np.testing.assert_array_equal(
        scan.vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [9, 9, 9]]
    )
    assert scan.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 2, 3]]


def test_read_scan__ply_polygons_are_cut_and_unused_vertices_kept(tmp_path):
    scan = read_scan(save(tmp_path, "scan.ply", PLY_QUADS))
    assert len(scan.vertices) == 5
    corners = sorted(sorted(face) for face in scan.faces.tolist())
    assert [0, 1, 2] in corners
    assert len(corners) == 3


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_read_scan__ply_in_any_encoding(tmp_path, encoding):
    mesh = trimesh.creation.icosphere(2, radius=80.0)
    (tmp_path / "SCAN.PLY").write_bytes(
        trimesh.exchange.ply.export_ply(mesh, encoding=encoding)
    )
    scan = read_scan(tmp_path / "SCAN.PLY")
    # float32 in the file, 8 digits as text
    np.testing.assert_allclose(scan.vertices, mesh.vertices, atol=1e-5)
    np.testing.assert_array_equal(scan.faces, mesh.faces)


def test_read_scan__ply_with_texture_per_face_keeps_order_and_count(tmp_path):
    body = PLY_QUADS.replace(
        "vertex_indices\n", "vertex_indices\nproperty list uchar float texcoord\n"
    )
    body = body.replace(
        "4 0 1 2 3\n3 0 1 2\n", "3 0 1 2 6 0 0 1 0 1 1\n3 0 2 3 6 .1 .1 .9 .9 0 1\n"
    )
    scan = read_scan(save(tmp_path, "scan.ply", body))
    assert len(scan.vertices) == 5
    assert scan.faces.tolist() == [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize(
    ("name", "text", "rule"),
    [
        ("scan.ply", "", "complete mesh file"),
        ("scan.ply", "solid rock", "complete mesh file"),
        ("scan.ply", PLY_QUADS[:-30], "scan"),
        (
            "scan.ply",
            PLY_QUADS.split("4 0 1")[0].replace("element face 2", "element face 0"),
            "must have triangles",
        ),
        ("scan.obj", "", "must have triangles"),
        ("scan.obj", "v 0 0 0\nv 1 0\nv 1 1 0\nf 1 2 3\n", "complete mesh file"),
        ("scan.obj", "v 0 zero 0\n", "complete mesh file"),
        (
            "scan.obj",
            "v 0 0 0\nv 1 0 0\nf 1 2 3\n",
            "faces must refer to vertices of the file",
        ),
        ("scan.obj", "v 0 0 0\nv 1 0 nan\nv 1 1 0\nf 1 2 3\n", "finite numbers"),
        ("scan.stl", "solid", r"\.ply or \.obj"),
    ],
)
def test_read_scan__names_the_fault(tmp_path, name, text, rule):
    with pytest.raises(InputError, match=rule) as caught:
        read_scan(save(tmp_path, name, text))
    assert all(
        str(fault).startswith(str(tmp_path / name)) for fault in caught.value.faults
    )


def test_read_scan__binary_ply_cut_short(tmp_path):
    whole = trimesh.exchange.ply.export_ply(
        trimesh.creation.icosphere(2), encoding="binary"
    )
    for cut in (len(whole) // 2, len(whole) - 5, 40):
        (tmp_path / "scan.ply").write_bytes(whole[:cut])
        with pytest.raises(InputError, match="scan"):
            read_scan(tmp_path / "scan.ply")


def test_read_scan__all_faults_together(tmp_path):
    with pytest.raises(InputError) as caught:
        read_scan(
            save(
                tmp_path, "scan.obj", "v 0 0 0\nv 1 0 inf\nv 1 1 0\nf 1 2 7\nf 1 2 3\n"
            )
        )
    assert len(caught.value.faults) == 2


def test_read_scan__absent_file(tmp_path):
    with pytest.raises(InputError, match="the file must exist; found no such file"):
        read_scan(tmp_path / "scan.ply")


def test_read_scan__quads_are_cut_along_the_shorter_diagonal(tmp_path):
    """A dart: cut along the longer diagonal, which runs outside, it would fold over itself."""
    corners = "v 0 0 0\nv 10 1 0\nv 2 2 0\nv 1 10 0\n"
    for start in range(4):
        order = " ".join(str((start + k) % 4 + 1) for k in range(4))
        scan = read_scan(save(tmp_path, f"q{start}.obj", f"{corners}f {order}\n"))
        a, b, c = (scan.vertices[scan.faces[:, k]] for k in range(3))
        doubled = np.cross(b - a, c - a)[:, 2]
        assert (doubled > 0).all()
        # of the dart, by the shoelace formula
        assert doubled.sum() / 2 == pytest.approx(18)


def test_read_scan__colours_of_a_file_with_and_without(tmp_path):
    ball = trimesh.creation.icosphere(1)
    ball.export(tmp_path / "plain.ply")
    assert read_scan(tmp_path / "plain.ply").colours is None
    assert read_scan(save(tmp_path, "scan.obj", OBJ)).colours is None
    colours = (
        np.random.default_rng(0)
        .integers(0, 256, (len(ball.vertices), 4))
        .astype(np.uint8)
    )
    path = tmp_path / "coloured.ply"
    trimesh.Trimesh(
        ball.vertices, ball.faces, vertex_colors=colours, process=False
    ).export(path)
    np.testing.assert_array_equal(read_scan(path).colours, colours[:, :3])


def test_read_scan__colours_that_are_not_of_eight_bits(tmp_path):
    head = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float "
        "y\nproperty float z\n"
    )
    for kind, value in (("float", "0.5"), ("ushort", "300"), ("short", "-1")):
        colour = "".join(
            f"property {kind} {name}\n" for name in ("red", "green", "blue")
        )
        rows = "".join(
            f"{x} {y} 0 {value} {value} {value}\n" for x, y in ((0, 0), (1, 0), (0, 1))
        )
        path = tmp_path / f"{kind}.ply"
        path.write_text(
            f"{head}{colour}element face 1\nproperty list uchar int "
            f"vertex_indices\nend_header\n{rows}3 0 1 2\n"
        )
        scan = read_scan(path)
        assert len(scan.faces) == 1
        assert scan.colours is None


BALL = trimesh.creation.icosphere(2, radius=80.0)
V = np.asarray(BALL.vertices)
F = np.asarray(BALL.faces)
MARKS = np.array([[0.0, 0, 80], [60, 0, 50]])


def inside(p, crop):
    low_ok = crop.low is None or all(p[i] >= crop.low[i] for i in range(3))
    high_ok = crop.high is None or all(p[i] <= crop.high[i] for i in range(3))
    near = (
        crop.reach_mm is None
        or min(np.linalg.norm(p - m) for m in MARKS) <= crop.reach_mm
    )
    return low_ok and high_ok and near


@pytest.mark.parametrize(
    "crop",
    [
        Crop((-30, -99, 0), (99, 40, 99)),
        Crop(low=(-99, -99, 10.0)),
        Crop(high=(99, 0, 99.0)),
        Crop(reach_mm=35.0),
        Crop((-99, -99, 60), None, 35.0),
    ],
)
def test_crop_faces__keeps_faces_with_all_corners_inside(crop):
    expected = [all(inside(V[c], crop) for c in face) for face in F]
    assert 0 < sum(expected) < len(F)
    assert crop_faces(V, F, crop, landmarks=MARKS).tolist() == expected


@pytest.mark.parametrize(
    ("limits", "match"),
    [
        ({"low": (0, 0, 0), "high": (1, 0, 1)}, "lower corner must lie below"),
        ({"reach_mm": 0.0}, "must be positive"),
        ({"reach_mm": float("nan")}, "must be positive"),
        ({"low": (0, 0, 0), "high": (1, float("nan"), 1)}, "lower corner"),
    ],
)
def test_crop__refuses_what_keeps_nothing(limits, match):
    with pytest.raises(InputError, match=match):
        Crop(**limits)


def test_crop_faces__around_no_landmarks():
    with pytest.raises(ValueError, match="needs landmarks"):
        crop_faces(V, F, Crop(reach_mm=30.0))
