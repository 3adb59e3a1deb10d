"""One small face from a simulated capture to files for other programs."""

from __future__ import annotations

import json

import numpy as np
import trimesh
from test_cli import _run

import skindb
from skindb.virtual.capture import recovered_against_true

SIMULATE = "--takes 1 --cameras 3 --lights 12 --width 48 --height 60".split()
# median errors; a surfel of 6 mm is two pixels wide here
ALBEDO_PERCENT = 8
NORMAL_DEGREES = 2


def test_commands__from_capture_to_export(tmp_path):
    db = str(tmp_path / "db")
    capture = tmp_path / "captures" / "V001"
    out = tmp_path / "exports"
    for command in (
        ["simulate", str(capture.parent), *SIMULATE],
        ["ingest", db, str(capture), "--spacing", "6"],
        ["fit", db],
        ["export", db, "V001", "--out", str(out), "--size", "64", "--no-merl"],
        ["verify", db],
    ):
        done = _run(*command)
        assert done.returncode == 0, done.stderr
    model = skindb.open(db).read("model", "V001")
    with np.load(capture.with_name("V001.truth.npz")) as truth:
        errors = recovered_against_true(model, dict(truth)).summary()
    assert max(errors["diffuse_median_percent"]) < ALBEDO_PERCENT
    assert errors["normal_median_deg"] < NORMAL_DEGREES
    assert json.loads((out / "V001" / "manifest.json").read_text())
    face = trimesh.load(out / "V001" / "model.glb", force="mesh")
    assert len(face.faces) > 500
    assert face.visual.material.baseColorTexture.size == (64, 64)
