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
from skindb.export.textures import fit_material
from skindb.reflectance.tables import kernel_tables
from skindb.render.image import encode_srgb
from skindb.schema import FitStatus
from tests.pictures import decode_srgb

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
    view = document["bufferViews"][
        document["images"][document["textures"][index]["source"]]["bufferView"]
    ]
    return np.asarray(
        Image.open(
            io.BytesIO(
                body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
            )
        )
    )


@pytest.mark.slow
def test_export_gltf__another_reader_gets_the_mesh_in_metres(
    model: xr.DataTree, tmp_path: Path
) -> None:
    export_gltf(model, tmp_path / "a.glb", size=SIZE)
    scene = trimesh.load(tmp_path / "a.glb", process=False)
    (mesh,) = scene.geometry.values()
    fitted = model["fitted"].to_dataset()
    np.testing.assert_allclose(
        mesh.vertices * 1000, fitted["surfel_position"], atol=1e-4
    )
    np.testing.assert_array_equal(mesh.faces, model["mesh/triangle"])
    # trimesh turns v upside down: its rows start at the bottom
    np.testing.assert_allclose(
        mesh.visual.uv * [1, -1] + [0, 1], fitted["surfel_uv"], atol=1e-6
    )
    np.testing.assert_allclose(mesh.vertex_normals, fitted["surfel_normal"], atol=1e-5)
    assert mesh.visual.material.baseColorTexture.size == (SIZE, SIZE)


def test_export_gltf__obeys_the_container_and_accessor_rules(
    model: xr.DataTree, tmp_path: Path
) -> None:
    export_gltf(model, tmp_path / "a.glb", size=SIZE)
    document, body = chunks(tmp_path / "a.glb")
    assert document["asset"]["version"] == "2.0"
    sizes = {"VEC4": 16, "VEC3": 12, "VEC2": 8, "SCALAR": 4}
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        assert accessor["count"] * sizes[accessor["type"]] == view["byteLength"]
    assert (
        max(v["byteOffset"] + v["byteLength"] for v in document["bufferViews"])
        <= document["buffers"][0]["byteLength"]
    )
    assert document["buffers"][0]["byteLength"] <= len(body)
    assert all(view["byteOffset"] % 4 == 0 for view in document["bufferViews"])
    assert len(body) % 4 == 0
    position = np.frombuffer(
        body, np.float32, document["accessors"][0]["count"] * 3
    ).reshape(-1, 3)
    np.testing.assert_array_equal(
        position.min(axis=0), np.float32(document["accessors"][0]["min"])
    )
    assert set(document["materials"][0]["extensions"]) == set(
        document["extensionsUsed"]
    )


def test_export_gltf__textures_hold_the_material(
    model: xr.DataTree, tmp_path: Path
) -> None:
    export_gltf(model, tmp_path / "a.glb", size=SIZE)
    document, body = chunks(tmp_path / "a.glb")
    material = document["materials"][0]
    base, rough, specular, colour, bent = (picture(document, body, i) for i in range(5))
    i = j = SIZE // 2  # u = v = 0.508
    u = v = (i + 0.5) / SIZE
    weights = np.array([[0.4 + 0.2 * u, 0.3 * v]])
    diffuse = 0.2 + 0.5 * np.array([[u, v, u * v]])
    tables = kernel_tables(model["basis"].to_dataset())
    expected = fit_material(tables, diffuse, weights, eta=1.3)
    # values are fitted at the surfels and interpolated between them; steps of eight bits
    np.testing.assert_allclose(
        base[i, j], encode_srgb(expected.base_color[0]) * 255, atol=3
    )
    assert rough[i, j, 1] / 255 == pytest.approx(expected.roughness[0], abs=0.021)
    assert rough[i, j, 2] == 0  # not metallic
    assert specular[i, j, 3] / 255 == pytest.approx(expected.specular[0], abs=0.03)
    ior = material["extensions"]["KHR_materials_ior"]["ior"]
    top = ((ior - 1) / (ior + 1)) ** 2
    assert top * decode_srgb(colour[i, j, 0] / 255) == pytest.approx(
        expected.f0[0], rel=0.15
    )
    # the shading normals are those of the mesh
    np.testing.assert_allclose(bent[i, j], [127.5, 127.5, 255], atol=1)


def test_export_gltf__normals_come_back_from_tangent_space(
    model: xr.DataTree, tmp_path: Path
) -> None:
    """Bent by up to 20 degrees: the texture of eight bits gives them back within a degree."""
    fitted = model["fitted"].to_dataset()
    u, v = fitted["surfel_uv"].values.T
    wave = 0.3 * np.stack([np.sin(9 * u), np.cos(7 * v), 0 * u], axis=1)
    bent = fitted["surfel_normal"].values + wave
    bent /= np.linalg.norm(bent, axis=1, keepdims=True)
    unseen = ~np.isfinite(fitted["shading_normal"].values)
    model["fitted/shading_normal"].values[:] = np.where(unseen, np.nan, bent)
    export_gltf(model, tmp_path / "a.glb", size=256)
    document, body = chunks(tmp_path / "a.glb")
    attributes = document["meshes"][0]["primitives"][0]["attributes"]

    def read(name: str, width: int) -> np.ndarray:
        accessor = document["accessors"][attributes[name]]
        view = document["bufferViews"][accessor["bufferView"]]
        return np.frombuffer(
            body, np.float32, accessor["count"] * width, view["byteOffset"]
        ).reshape(-1, width)

    normal = read("NORMAL", 3)
    tangent = read("TANGENT", 4)
    uv = read("TEXCOORD_0", 2)
    image = picture(document, body, 4)
    at = np.clip((uv * 256).astype(int), 0, 255)
    local = image[at[:, 1], at[:, 0]] / 127.5 - 1
    across = np.cross(normal, tangent[:, :3]) * tangent[:, 3:]
    found = (
        local[:, :1] * tangent[:, :3] + local[:, 1:2] * across + local[:, 2:] * normal
    )
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    seen = ~unseen.any(axis=1)
    angle = np.degrees(np.arccos(np.clip((found * bent).sum(axis=1), -1, 1)))[seen]
    assert np.median(angle) < 1.0  # of the nearest texel


def test_export_gltf__names_contain_the_take(
    model: xr.DataTree, tmp_path: Path
) -> None:
    """Programs that import several files into one project merge meshes, materials and
    textures of the same name.
    """
    model.attrs["take"] = "S01.lotion"
    export_gltf(model, tmp_path / "a.glb", size=SIZE)
    document = chunks(tmp_path / "a.glb")[0]
    names = [
        one["name"]
        for kind in ("nodes", "meshes", "materials", "images")
        for one in document[kind]
    ]
    assert all(name.startswith("S01.lotion") for name in names), names
    assert len({one["name"] for one in document["images"]}) == len(document["images"])


@pytest.mark.slow
def test_export_gltf__states_its_error(model: xr.DataTree, tmp_path: Path) -> None:
    error = export_gltf(model, tmp_path / "a.glb", size=SIZE)
    extras = chunks(tmp_path / "a.glb")[0]["materials"][0]["extras"]
    assert extras["approximation_error"] == error
    assert 0 < error["relative_rms"] < 0.2
    assert "subsurface transport" in extras["skipped"]


def test_export_gltf__a_black_model_is_a_black_file(
    model: xr.DataTree, tmp_path: Path
) -> None:
    """Nothing reflected, nothing approximated: an error relative to nothing is none."""
    for name in ("diffuse_reflectance", "basis_weight"):
        model[f"fitted/{name}"].values[:] *= 0  # NaN stays where nothing was seen
    error = export_gltf(model, tmp_path / "a.glb", size=SIZE)
    assert {value for name, value in error.items() if name.startswith("relative")} == {
        0.0
    }
    document, body = chunks(tmp_path / "a.glb")
    assert not picture(document, body, 0).any()  # base colour
    assert not picture(document, body, 2)[..., 3].any()  # specular
    (mesh,) = trimesh.load(tmp_path / "a.glb", process=False).geometry.values()
    assert len(mesh.vertices) == model["fitted"].sizes["surfel"]


def test_export_gltf__needs_fitted_surfels(model: xr.DataTree, tmp_path: Path) -> None:
    model["fitted/fit_status"].values[:] = int(FitStatus.UNSEEN)
    with pytest.raises(
        InputError, match="at least one surfel must be fitted for an export; found none"
    ):
        export_gltf(model, tmp_path / "a.glb", size=SIZE)
    assert not (tmp_path / "a.glb").exists()


def test_export_gltf__needs_consent(model: xr.DataTree, tmp_path: Path) -> None:
    model.attrs["consent_scope"] = ["fit"]
    with pytest.raises(
        InputError,
        match="S01: consent_scope: this step needs the scope 'export'; found only fit",
    ):
        export_gltf(model, tmp_path / "a.glb", size=SIZE)
    assert not (tmp_path / "a.glb").exists()
