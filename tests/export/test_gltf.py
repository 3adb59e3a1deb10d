from __future__ import annotations

import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
import xarray as xr
from PIL import Image

from skindb.errors import InputError
from skindb.export.gltf import export_gltf
from skindb.render.image import encode_srgb
from skindb.schema import FitStatus

SIZE = 64


def chunks(path: Path) -> tuple[dict, bytes]:
    raw = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", raw)
    assert (magic, version, length) == (b"glTF", 2, len(raw))
    size, kind = struct.unpack_from("<I4s", raw, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    body_size, body_kind = struct.unpack_from("<I4s", raw, 20 + size)
    assert body_kind == b"BIN\0"
    assert 28 + size + body_size == len(raw)
    return json.loads(raw[20 : 20 + size]), raw[28 + size :]


def picture(document: dict, body: bytes, index: int) -> np.ndarray:
    view = document["bufferViews"][document["images"][document["textures"][index]["source"]]["bufferView"]]
    return np.asarray(Image.open(io.BytesIO(body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]])))


def test_export_gltf__another_reader_gets_the_mesh_in_metres(model: xr.DataTree, tmp_path: Path) -> None:
    export_gltf(model, tmp_path / "a.glb", size=SIZE)
    scene = trimesh.load(tmp_path / "a.glb", process=False)
    (mesh,) = scene.geometry.values()
    fitted = model["fitted"].to_dataset()
    np.testing.assert_allclose(mesh.vertices * 1000, fitted["surfel_position"], atol=1e-4)
    np.testing.assert_array_equal(mesh.faces, model["mesh/triangle"])
    # trimesh turns v upside down: its rows start at the bottom
    np.testing.assert_allclose(mesh.visual.uv * [1, -1] + [0, 1], fitted["surfel_uv"], atol=1e-6)
    np.testing.assert_allclose(mesh.vertex_normals, fitted["surfel_normal"], atol=1e-5)
    assert mesh.visual.material.baseColorTexture.size == (SIZE, SIZE)


def test_export_gltf__obeys_the_container_and_accessor_rules(model: xr.DataTree, tmp_path: Path) -> None:
    export_gltf(model, tmp_path / "a.glb", size=SIZE)
    document, body = chunks(tmp_path / "a.glb")
    assert document["asset"]["version"] == "2.0"
    sizes = {"VEC3": 12, "VEC2": 8, "SCALAR": 4}
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        assert accessor["count"] * sizes[accessor["type"]] == view["byteLength"]
    assert (
        max(v["byteOffset"] + v["byteLength"] for v in document["bufferViews"]) <= document["buffers"][0]["byteLength"]
    )
    assert document["buffers"][0]["byteLength"] <= len(body)
    assert all(view["byteOffset"] % 4 == 0 for view in document["bufferViews"])
    assert len(body) % 4 == 0
    position = np.frombuffer(body, np.float32, document["accessors"][0]["count"] * 3).reshape(-1, 3)
    np.testing.assert_array_equal(position.min(axis=0), np.float32(document["accessors"][0]["min"]))
    used = {document["materials"][0]["extensions"].popitem()[0]}
    assert used == set(document["extensionsUsed"])


def test_export_gltf__textures_hold_the_material(model: xr.DataTree, tmp_path: Path) -> None:
    export_gltf(model, tmp_path / "a.glb", size=SIZE)
    document, body = chunks(tmp_path / "a.glb")
    extras = document["materials"][0]["extras"]
    base, rough, specular = (picture(document, body, i) for i in range(3))
    i = j = SIZE // 2  # u = v = 0.508
    u = v = (i + 0.5) / SIZE
    weights = np.array([0.4 + 0.2 * u, 0.3 * v])
    # R_d times a gain near one, plus the bases' diffuse part; 8-bit steps
    expected = encode_srgb((0.2 + 0.5 * u) * 1.0 + weights @ extras["component_diffuse"]) * 255
    assert base[i, j, 0] == pytest.approx(expected, abs=4)
    strength = weights * extras["component_specular"]
    peak = strength @ np.array(extras["component_roughness"]) ** -4.0
    assert rough[i, j, 1] / 255 == pytest.approx((strength.sum() / peak) ** 0.25, abs=0.005)
    assert rough[i, j, 2] == 0  # not metallic
    assert specular[i, j, 3] / 255 == pytest.approx(strength.sum(), abs=0.005)


def test_export_gltf__states_its_error(model: xr.DataTree, tmp_path: Path) -> None:
    error = export_gltf(model, tmp_path / "a.glb", size=SIZE)
    extras = chunks(tmp_path / "a.glb")[0]["materials"][0]["extras"]
    assert extras["approximation_error"] == error
    assert 0 < error["relative_rms"] < 0.2
    assert "subsurface transport" in extras["skipped"]


def test_export_gltf__a_black_model_is_a_black_file(model: xr.DataTree, tmp_path: Path) -> None:
    """Nothing reflected, nothing approximated: an error relative to nothing is none."""
    for name in ("diffuse_reflectance", "basis_weight"):
        model[f"fitted/{name}"].values[:] *= 0  # NaN stays where nothing was seen
    error = export_gltf(model, tmp_path / "a.glb", size=SIZE)
    assert set(error.values()) == {0.0}
    document, body = chunks(tmp_path / "a.glb")
    assert not picture(document, body, 0).any()  # base colour
    assert not picture(document, body, 2)[..., 3].any()  # specular
    (mesh,) = trimesh.load(tmp_path / "a.glb", process=False).geometry.values()
    assert len(mesh.vertices) == model["fitted"].sizes["surfel"]


def test_export_gltf__needs_fitted_surfels(model: xr.DataTree, tmp_path: Path) -> None:
    model["fitted/fit_status"].values[:] = int(FitStatus.UNSEEN)
    with pytest.raises(InputError, match="an export needs fitted surfels; found none"):
        export_gltf(model, tmp_path / "a.glb", size=SIZE)
    assert not (tmp_path / "a.glb").exists()


def test_export_gltf__needs_consent(model: xr.DataTree, tmp_path: Path) -> None:
    model.attrs["consent_scope"] = ["fit"]
    with pytest.raises(InputError, match="S01: consent_scope: this step needs the scope 'export'; found only fit"):
        export_gltf(model, tmp_path / "a.glb", size=SIZE)
    assert not (tmp_path / "a.glb").exists()


def test_export_gltf__textures_do_not_depend_on_their_bands(
    model: xr.DataTree, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    export_gltf(model, tmp_path / "whole.glb", size=SIZE)
    monkeypatch.setattr("skindb.export.gltf.TEXTURE_ROWS_PER_BLOCK", 10)
    export_gltf(model, tmp_path / "bands.glb", size=SIZE)
    assert (tmp_path / "bands.glb").read_bytes() == (tmp_path / "whole.glb").read_bytes()
