"""A scan in the frame of its scanner is moved into that of the dome."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from skindb import workflow
from skindb.calibration.setup import read_setup_dome
from skindb.cli import cli
from skindb.errors import InputError

CLICK_ERROR_PX = 1.0  # a pixel has 2 mm


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    """A capture, its scan in m in another frame, and landmarks in four photographs."""
    folder = tmp_path_factory.mktemp("laboratory")
    size = {"cameras": 6, "lights": 12, "width": 160, "height": 200}
    [capture] = workflow.simulate(folder / "captures", takes=1, **size)
    rng = np.random.default_rng(7)
    turn = Rotation.random(random_state=7)
    shift = rng.normal(0, 300, 3)

    def scanned(points):
        return (turn.apply(points) + shift) / 1000

    mesh = trimesh.load(capture / "scan.ply", process=False)
    points = json.loads((capture / "landmarks.json").read_text())
    trimesh.Trimesh(scanned(mesh.vertices), mesh.faces, process=False).export(
        folder / "scan.ply"
    )
    marks = {name: scanned(np.array(point)).tolist() for name, point in points.items()}
    (folder / "landmarks.json").write_text(json.dumps(marks))
    seen = {}
    for camera in read_setup_dome(capture, white=False, dark=False).cameras[:4]:
        pixels = camera.project(np.array([*points.values()]))
        pixels += rng.normal(0, CLICK_ERROR_PX, pixels.shape)
        seen[camera.id] = dict(zip(points, pixels.tolist(), strict=True))
    (folder / "seen.json").write_text(json.dumps(seen))
    return folder, capture, mesh.vertices


def _call(folder, capture, *more):
    names = ("scan.ply", "--landmarks", "landmarks.json", "--seen", "seen.json")
    words = [str(folder / name) if "." in name else name for name in names]
    words += ["--capture", str(capture), "--out", str(folder / "out"), *more]
    return CliRunner().invoke(cli, ["register-scan", *words])


@pytest.mark.slow
def test_register_scan__moves_it_to_where_the_photographs_show_the_face(laboratory):
    folder, capture, vertices = laboratory
    before = {path: path.stat().st_mtime_ns for path in capture.rglob("*")}
    done = _call(folder, capture)
    assert done.exit_code == 0, done.exception
    assert "out: the scan is in m; landmarks are 1." in done.output
    found = trimesh.load(folder / "out/scan.ply", process=False).vertices
    # of a pixel of 2 mm
    assert np.linalg.norm(found - vertices, axis=1).mean() < 0.6
    marks = json.loads((folder / "out/landmarks.json").read_text())
    truth = json.loads((capture / "landmarks.json").read_text())
    assert np.linalg.norm(np.subtract(marks["chin"], truth["chin"])) < 1.5
    matrix = np.array(json.loads((folder / "out/pose.json").read_text())["matrix"])
    assert np.cbrt(np.linalg.det(matrix[:3, :3])) == pytest.approx(1000)
    assert {path: path.stat().st_mtime_ns for path in capture.rglob("*")} == before
    assert [path.name for path in capture.parent.iterdir() if path.name[0] == "."] == []
    again = _call(folder, capture)
    assert isinstance(again.exception, InputError)
    assert "must not hold them; found scan.ply, landmarks.json" in str(again.exception)


@pytest.mark.slow
def test_register_scan__wrong_files_are_one_line(laboratory, tmp_path):
    folder, capture, _ = laboratory
    for seen, said in (
        ({"c99": {"chin": [1, 2]}}, "must be a camera of the dome; found c99"),
        ({"c00": {"chin": [1, 2, 3]}}, "must be 2 numbers"),
        ({"c00": 5}, "must be a JSON object"),
        ({"c00": {"nose_tp": [1, 2]}}, "found nose_tp; did you mean nose_tip"),
        ({}, "three points of the scan .* seen by two cameras each; found none"),
    ):
        (tmp_path / "seen.json").write_text(json.dumps(seen))
        with pytest.raises(InputError, match=said):
            workflow.register_scan(
                folder / "scan.ply",
                folder / "landmarks.json",
                tmp_path / "seen.json",
                capture,
                tmp_path / "new",
            )
