"""Export of a fitted model to glTF 2.0: one .glb file with mesh, textures and the error
of the approximation.
"""

import json
import struct
from pathlib import Path

import imagecodecs
import numpy as np
import xarray as xr

from skindb import __version__
from skindb.export.inputs import describe_edit
from skindb.export.textures import Shape, Skin, index_of, skin_of
from skindb.files import Json, private_file
from skindb.schema.consent import require_consent

FLOAT = 5126
UNSIGNED_INT = 5125
VERTEX_BUFFER = 34962
INDEX_BUFFER = 34963
MM = 1e-3  # glTF's unit is the metre


def export_gltf(
    model: xr.DataTree,
    out: str | Path,
    *,
    size: int | None = None,
    skin: Skin | None = None,
) -> dict[str, float]:
    """Write a binary glTF 2.0 file of a model.

    The material is metallic-roughness with KHR_materials_specular and
    KHR_materials_ior. The base colour is from R_d and the flat part of the measured
    BRDFs; roughness, specular factor and specular colour are from the reduced basis,
    such that pictures differ as little as possible (`fit_material`). Shading normals
    are a texture in tangent space. glTF has neither measured BRDFs nor subsurface
    transport over a distance. The resulting error is written to `extras` of the
    material and returned.

    Parameters
    ----------
    model
        Version of kind "model" whose consent covers export.
    out
        Path of the .glb file.
    size
        Texels along each side of the textures; default `texture_size`.
    skin
        `skin_of(model, size=size)`, if already computed.

    Returns
    -------
    dict
        The error of the material, see `Skin`.
    """
    require_consent(model.attrs, "export")
    skin = skin or skin_of(model, size=size)
    files = {
        name: bytes(imagecodecs.png_encode(picture))
        for name, picture in skin.pictures.items()
    }
    document, body = _document(files, _extras(model, skin), skin)
    private_file(out).write_bytes(_glb(document, body))
    return skin.error


def _document(
    textures: dict[str, bytes], extras: Json, skin: Skin
) -> tuple[Json, bytes]:
    """The JSON document of the scene, and the binary data to which it refers."""
    material = _material(extras, skin)
    # in all names, because programs merge what has the same name in several files
    take = str(extras["take"])
    views: list[dict[str, int]] = []
    body, accessors, attributes = _mesh_data(skin.shape, views)
    images = []
    for name, png in textures.items():
        image = {"mimeType": "image/png", "name": f"{take}_{name}"}
        images.append({"bufferView": len(views), **image})
        body = _append(body, views, png)
    primitive = {
        "attributes": attributes,
        "indices": len(attributes),
        "material": 0,
        "mode": 4,
    }
    document = {
        "asset": {"version": "2.0", "generator": f"skindb {__version__}"},
        "extensionsUsed": sorted(material["extensions"]),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": take}],
        "meshes": [{"primitives": [primitive], "name": take}],
        "materials": [material],
        "samplers": [
            {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}
        ],
        "textures": [{"sampler": 0, "source": i} for i in range(len(images))],
        "images": images,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }
    return document, body


def _mesh_data(
    shape: Shape, views: list[dict[str, int]]
) -> tuple[bytes, list[Json], dict[str, int]]:
    """Binary data of the mesh, its accessors, and the accessor of each attribute; views
    of the data are appended to `views`.
    """
    position = shape.position * np.float32(MM)
    indices = shape.triangles.astype(np.uint32).reshape(-1)
    arrays = {
        "POSITION": (position, "VEC3"),
        "NORMAL": (shape.normal.astype(np.float32), "VEC3"),
        "TEXCOORD_0": (shape.uv, "VEC2"),
        "TANGENT": (shape.tangent.astype(np.float32), "VEC4"),
        "indices": (indices, "SCALAR"),
    }
    body = b""
    accessors = []
    for name, (array, kind) in arrays.items():
        is_index = name == "indices"
        accessors.append(
            {
                "bufferView": len(views),
                "componentType": UNSIGNED_INT if is_index else FLOAT,
                "count": len(array),
                "type": kind,
            }
        )
        target = INDEX_BUFFER if is_index else VERTEX_BUFFER
        body = _append(body, views, array.tobytes(), target=target)
    accessors[0] |= {
        "min": position.min(axis=0).tolist(),
        "max": position.max(axis=0).tolist(),
    }
    attributes = {name: i for i, name in enumerate(arrays) if name != "indices"}
    return body, accessors, attributes


def _material(extras: Json, skin: Skin) -> Json:
    pbr = {
        "baseColorTexture": {"index": 0},
        "metallicRoughnessTexture": {"index": 1},
        "metallicFactor": 0.0,
    }
    specular = {
        "specularFactor": 1.0,
        "specularTexture": {"index": 2},
        "specularColorTexture": {"index": 3},
    }
    extensions = {
        "KHR_materials_ior": {"ior": index_of(skin.top_f0)},
        "KHR_materials_specular": specular | {"specularColorFactor": [1.0, 1.0, 1.0]},
    }
    return {
        "name": f"{extras['take']}_skin",
        "doubleSided": True,
        "pbrMetallicRoughness": pbr | {"roughnessFactor": 1.0},
        "normalTexture": {"index": 4},
        "extensions": extensions,
        "extras": extras,
    }


def _extras(model: xr.DataTree, skin: Skin) -> Json:
    return {
        "take": str(model.attrs.get("take", model.attrs.get("subject", "face"))),
        "source": "measured skin reflectance (Weyrich et al. 2005), approximated",
        "conventions": (
            "metres, +x to the subject's left, +y up, +z out of the face; Rec. 709 "
            "primaries, D65"
        ),
        "edited": describe_edit(model.attrs),
        "approximation_error": skin.error,
        "skipped": [
            "subsurface transport",
            "retro-reflection and other details of the measured lobes",
        ],
    }


def _append(
    body: bytes, views: list[dict[str, int]], data: bytes, *, target: int | None = None
) -> bytes:
    view = {"buffer": 0, "byteOffset": len(body), "byteLength": len(data)}
    views.append(view if target is None else view | {"target": target})
    return body + data + b"\0" * (-len(data) % 4)


def _glb(document: Json, body: bytes) -> bytes:
    """Container of a JSON chunk and a binary chunk, each padded to four bytes (glTF
    2.0, section 4.4).
    """
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(body), b"BIN\0")
        + body
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
