"""The validator of the Khronos Group accepts exported files; `.ci/run` installs it
where npm is there.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest
import xarray as xr

from skindb.export.gltf import export_gltf

PROGRAM = """
const validator = require('gltf-validator');
const bytes = new Uint8Array(require('fs').readFileSync(process.argv[1]));
const print = (report) => console.log(JSON.stringify(report));
validator.validateBytes(bytes).then(print);
"""


@pytest.fixture
def folder() -> Path:
    found = os.environ.get("SKINDB_GLTF_VALIDATOR", "")
    if not found or shutil.which("node") is None:
        pytest.skip(
            "SKINDB_GLTF_VALIDATOR must name a folder with the npm package "
            "gltf-validator, and node is needed"
        )
    return Path(found)


def report(folder: Path, file: Path) -> dict:
    command = ["node", "-e", PROGRAM, str(file)]
    return json.loads(
        subprocess.run(
            command, cwd=folder, capture_output=True, text=True, check=True, timeout=60
        ).stdout
    )


def test_export_gltf__passes_the_validator(
    model: xr.DataTree, tmp_path: Path, folder: Path
) -> None:
    export_gltf(model, tmp_path / "a.glb", size=64)
    found = report(folder, tmp_path / "a.glb")
    assert found["issues"]["messages"] == []
    assert found["info"]["extensionsUsed"] == [
        "KHR_materials_ior",
        "KHR_materials_specular",
    ]


def test_validator__finds_a_broken_file(
    model: xr.DataTree, tmp_path: Path, folder: Path
) -> None:
    export_gltf(model, tmp_path / "a.glb", size=64)
    raw = (tmp_path / "a.glb").read_bytes().replace(b'"mode":4', b'"mode":9')
    (tmp_path / "a.glb").write_bytes(raw)
    assert report(folder, tmp_path / "a.glb")["issues"]["numErrors"] > 0
