"""A fitted model as glTF 2.0: one .glb with mesh, textures and the error of the approximation."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb._version import __version__
from skindb.export.edited import describe_edit
from skindb.export.maps import TextureMap, texture_maps
from skindb.export.pbr import F0, Lobes, Material, approximation_error, fit_lobes, material
from skindb.render.image import encode_srgb
from skindb.render.texels import surfel_confidence
from skindb.schema.brdf import kernel_tables
from skindb.schema.consent import require_consent

FLOAT, UNSIGNED_INT = 5126, 5125
VERTEX_BUFFER, INDEX_BUFFER = 34962, 34963
ERROR_POINTS = 512  # surfels on which the approximation is compared with the model
MM = 1e-3  # glTF's unit is the metre
TEXTURE_ROWS_PER_BLOCK = 128  # of a texture at a time: 80 MB in double precision


def export_gltf(
    model: xr.DataTree, out: str | Path, *, size: int = 2048, maps: dict[str, TextureMap] | None = None
) -> dict[str, float]:
    """Write a binary glTF 2.0 file of a model.

    The material is metallic-roughness with KHR_materials_specular: base colour from R_d (and the diffuse part of the
    measured BRDFs), roughness and specular factor from the reduced basis. glTF has no measured BRDFs and no ratified
    subsurface transport; the difference is stated in `extras` of the material and returned.

    Parameters
    ----------
    model
        Version of kind "model" whose consent covers export.
    out
        Path of the .glb file.
    size
        Texels along each side of the textures.
    maps
        `texture_maps(model, size=size)`, if already made.

    Returns
    -------
    dict
        As `approximation_error`.
    """
    require_consent(model.attrs, "export")
    fitted, eta = model["fitted"].to_dataset(), float(model["fitted/refractive_index"])
    mesh, tables = model["mesh"].to_dataset(), kernel_tables(model["basis"].to_dataset())
    known = np.flatnonzero(surfel_confidence(fitted) > 0)
    lobes = fit_lobes(tables, fitted["basis_weight"].values[known], eta=eta)
    chosen = known[np.linspace(0, len(known) - 1, min(ERROR_POINTS, len(known))).astype(int)]
    diffuse, weights = (fitted[name].values[chosen] for name in ("diffuse_reflectance", "basis_weight"))
    error = approximation_error(tables, diffuse, weights, lobes, eta=eta)
    textures = _textures(texture_maps(model, size=size) if maps is None else maps, lobes)
    document, body = _document(fitted, mesh["triangle"].values, textures, _extras(model, lobes, error))
    Path(out).write_bytes(_glb(document, body))
    return error


def _textures(maps: dict[str, TextureMap], lobes: Lobes) -> dict[str, bytes]:
    """PNG files by their place in the material."""
    planes = [maps["albedo"].values, *(maps[f"weight_{k}"].values for k in range(len(lobes.strength)))]
    bands = [
        _pictures(lobes, np.concatenate([plane[row : row + TEXTURE_ROWS_PER_BLOCK] for plane in planes], axis=-1))
        for row in range(0, len(planes[0]), TEXTURE_ROWS_PER_BLOCK)
    ]
    return {name: bytes(imagecodecs.png_encode(np.concatenate([band[name] for band in bands]))) for name in bands[0]}


def _pictures(lobes: Lobes, values: NDArray[np.float32]) -> dict[str, NDArray[np.uint8]]:
    """Pictures (h, w, c) of R_d and weights (h, w, 3 + k)."""
    skin: Material = material(lobes, values[..., :3], values[..., 3:])
    zero, full = np.zeros_like(skin.roughness), np.ones_like(skin.roughness)
    pictures = {
        "baseColor": encode_srgb(skin.base_color),
        "metallicRoughness": np.stack([full, skin.roughness, zero], axis=-1),
        "specular": np.stack([full, full, full, skin.specular], axis=-1),
    }
    return {name: np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8) for name, picture in pictures.items()}


def _document(
    fitted: xr.Dataset, triangles: NDArray[Any], textures: dict[str, bytes], extras: dict[str, Any]
) -> tuple[dict[str, Any], bytes]:
    """The JSON of the scene and the bytes it points into."""
    position = fitted["surfel_position"].values.astype(np.float32) * np.float32(MM)
    blocks = {
        "POSITION": (position, VERTEX_BUFFER, FLOAT, "VEC3"),
        "NORMAL": (_normals(fitted), VERTEX_BUFFER, FLOAT, "VEC3"),
        "TEXCOORD_0": (fitted["surfel_uv"].values.astype(np.float32), VERTEX_BUFFER, FLOAT, "VEC2"),
        "indices": (triangles.astype(np.uint32).reshape(-1), INDEX_BUFFER, UNSIGNED_INT, "SCALAR"),
    }
    views: list[dict[str, int]] = []
    body, accessors = b"", []
    for array, target, component, kind in blocks.values():
        accessors.append({"bufferView": len(views), "componentType": component, "count": len(array), "type": kind})
        body = _append(body, views, array.tobytes(), target=target)
    accessors[0] |= {"min": position.min(axis=0).tolist(), "max": position.max(axis=0).tolist()}
    images = []
    for name, png in textures.items():
        images.append({"bufferView": len(views), "mimeType": "image/png", "name": name})
        body = _append(body, views, png)
    primitive = {"attributes": {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}, "indices": 3, "material": 0, "mode": 4}
    document = {
        "asset": {"version": "2.0", "generator": f"skindb {__version__}"},
        "extensionsUsed": ["KHR_materials_specular"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": str(extras.get("take", "face"))}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [_material(extras)],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "textures": [{"sampler": 0, "source": i} for i in range(len(images))],
        "images": images,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }
    return document, body


def _material(extras: dict[str, Any]) -> dict[str, Any]:
    pbr = {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 1}, "metallicFactor": 0.0}
    specular = {"specularFactor": 1.0, "specularTexture": {"index": 2}}
    return {
        "name": "skin",
        "doubleSided": True,
        "pbrMetallicRoughness": pbr | {"roughnessFactor": 1.0},
        "extensions": {"KHR_materials_specular": specular | {"specularColorFactor": [extras["f0"] / F0] * 3}},
        "extras": extras,
    }


def _extras(model: xr.DataTree, lobes: Lobes, error: dict[str, float]) -> dict[str, Any]:
    return {
        "take": str(model.attrs.get("take", model.attrs.get("subject", "face"))),
        "source": "measured skin reflectance (Weyrich et al. 2005), approximated; metres, +y up, +z out of the face",
        "edited": describe_edit(model.attrs),
        "approximation_error": error,
        "skipped": ["subsurface transport", "retro-reflection and other shapes of the measured lobes"],
        "f0": lobes.f0,
        "component_diffuse": lobes.diffuse.tolist(),
        "component_specular": lobes.strength.tolist(),
        "component_roughness": lobes.roughness.tolist(),
    }


def _normals(fitted: xr.Dataset) -> NDArray[np.float32]:
    """Shading normals; the scan's where the fit has none."""
    normal = fitted["shading_normal"].values.astype(np.float64)
    normal = np.where(np.isfinite(normal).all(axis=1, keepdims=True), normal, fitted["surfel_normal"].values)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.where(length > 1e-6, normal / np.maximum(length, 1e-6), [0.0, 0.0, 1.0]).astype(np.float32)


def _append(body: bytes, views: list[dict[str, int]], data: bytes, *, target: int | None = None) -> bytes:
    view = {"buffer": 0, "byteOffset": len(body), "byteLength": len(data)}
    views.append(view if target is None else view | {"target": target})
    return body + data + b"\0" * (-len(data) % 4)


def _glb(document: dict[str, Any], body: bytes) -> bytes:
    """Container of a JSON chunk and a binary chunk, each padded to four bytes (glTF 2.0, section 4.4)."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
