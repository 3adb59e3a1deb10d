"""Scenes of a fitted model: USD with an OpenPBR material, this material in MaterialX, and
Mitsuba 3 with a program that evaluates the exact BRDFs.
"""

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from string import Template
from xml.etree import ElementTree

import numpy as np
import xarray as xr

from skindb import __version__
from skindb.export.textures import Skin, unit_normals
from skindb.files import make_private, private_file
from skindb.schema import variables
from skindb.types import Array

STAGE = "face.usda"
MATERIAL = "face.mtlx"
MEAN_FREE_PATH = "../maps/mean_free_path.exr"
RELATIVE = "subsurface_radius_scale"
MESH = "face.ply"
PROGRAM = "skin.py"


def export_usd(
    model: xr.DataTree, folder: Path, skin: Skin, *, longest_path: float
) -> None:
    """Write `face.usda`, `face.mtlx` and their textures into a folder.

    Lengths are in mm (`metersPerUnit` is 0.001). `subsurface_radius` is the longest
    mean free path in mm, and `subsurface_radius_scale` the ratio of that of a texel and
    channel to it, which is at most 1. OpenPBR has one index of refraction for the whole
    face, which is from the mean reflectance at normal incidence over all points,
    weighted by their specular factor. Renderers without MaterialX use a
    UsdPreviewSurface. It has no specular factor, so that its index of refraction is
    from the mean reflectance at normal incidence including that factor.

    Parameters
    ----------
    model
        Version of kind "model".
    folder
        New folder beside the maps of a bundle.
    skin
        Textures and constants of the material.
    longest_path
        Largest value of `../maps/mean_free_path.exr` [mm]. With 0, light leaves where it enters.
    """
    make_private(folder)
    for name, data in skin.files().items():
        private_file(folder / f"{name}.png").write_bytes(data)
    inputs = _inputs(index_of(skin.mean_f0), longest_path)
    private_file(folder / MATERIAL).write_text(_materialx(inputs), encoding="utf-8")
    private_file(folder / STAGE).write_text(
        _usda(model, inputs, index_of(skin.mean_reflection)), encoding="utf-8"
    )


def index_of(f0: float) -> float:
    """Index of refraction with this reflectance at normal incidence."""
    return float((1 + np.sqrt(f0)) / (1 - np.sqrt(f0)))


def _inputs(ior: float, radius: float) -> dict[str, tuple[str, str | float]]:
    """Inputs of the node open_pbr_surface by name: their type, and a value or the path of an image.

    Light leaves where it enters if `radius`, the longest mean free path [mm], is zero.
    """
    inputs: dict[str, tuple[str, str | float]] = {
        "base_color": ("color3", "baseColor.png"),
        "specular_color": ("color3", "specularFactor.png"),
        "specular_roughness": ("float", "roughness.png"),
        "specular_ior": ("float", ior),
        "geometry_normal": ("vector3", "normal.png"),
    }
    if radius > 0:
        inputs |= {
            "subsurface_weight": ("float", 1.0),
            "subsurface_color": ("color3", "baseColor.png"),
            "subsurface_radius": ("float", radius),
            RELATIVE: ("color3", MEAN_FREE_PATH),
        }
    return inputs


def _per_length(inputs: Mapping[str, tuple[str, str | float]]) -> float:
    """Factor from a length of the map to `subsurface_radius_scale`."""
    return 1 / float(inputs["subsurface_radius"][1])


def _space(file: str) -> str:
    """Colour space of an image, in the names of MaterialX."""
    return "srgb_texture" if file == "baseColor.png" else "lin_rec709"


def _materialx(inputs: Mapping[str, tuple[str, str | float]]) -> str:
    """The OpenPBR material as a MaterialX document."""
    root = ElementTree.Element("materialx", version="1.39", colorspace="lin_rec709")
    root.append(ElementTree.Comment(f" skindb {__version__}: skin, lengths in mm "))
    place = ElementTree.SubElement(root, "texcoord", name="st", type="vector2")
    _add_input(place, "index", "integer", value="0")
    surface = ElementTree.Element(
        "open_pbr_surface", name="skin_surface", type="surfaceshader"
    )
    for name, (kind, value) in inputs.items():
        node = _add_input(surface, name, kind)
        if isinstance(value, float):
            node.set("value", f"{value:.6g}")
            continue
        source = _add_image(root, f"{name}_image", kind, value)
        if name == "geometry_normal":
            bent = ElementTree.SubElement(
                root, "normalmap", name="bent_normal", type="vector3"
            )
            _add_input(bent, "in", "vector3", nodename=source)
            source = "bent_normal"
        elif name == RELATIVE:
            ratio = ElementTree.SubElement(
                root, "multiply", name="relative_length", type="color3"
            )
            _add_input(ratio, "in1", "color3", nodename=source)
            _add_input(ratio, "in2", "float", value=f"{_per_length(inputs):.6g}")
            source = "relative_length"
        node.set("nodename", source)
    root.append(surface)
    material = ElementTree.SubElement(
        root, "surfacematerial", name="skin", type="material"
    )
    _add_input(material, "surfaceshader", "surfaceshader", nodename="skin_surface")
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0"?>\n{text}\n'


def _add_input(
    node: ElementTree.Element, name: str, kind: str, **attributes: str
) -> ElementTree.Element:
    """Add an input to a node of MaterialX."""
    named = {"name": name, "type": kind, **attributes}
    return ElementTree.SubElement(node, "input", named)


def _add_image(root: ElementTree.Element, name: str, kind: str, path: str) -> str:
    """Add a node that reads an image, and return its name."""
    image = ElementTree.SubElement(root, "image", name=name, type=kind)
    file = _add_input(image, "file", "filename", value=path)
    if kind == "color3":
        file.set("colorspace", _space(path))
    _add_input(image, "texcoord", "vector2", nodename="st")
    for axis in "uv":
        _add_input(image, f"{axis}addressmode", "string", value="clamp")
    return name


def _usda(
    model: xr.DataTree, inputs: Mapping[str, tuple[str, str | float]], ior: float
) -> str:
    fitted = model["fitted"].to_dataset()
    mesh = model["mesh"].to_dataset()
    place = fitted[variables.SURFEL_POSITION].values.astype(np.float32)
    triangles = mesh[variables.TRIANGLE].values
    # v increases upwards in USD
    uv = fitted[variables.SURFEL_UV].values.astype(float) * [1, -1] + [0, 1]
    return _template("usd", STAGE).substitute(
        version=__version__,
        extent=_vectors(np.stack([place.min(axis=0), place.max(axis=0)])),
        counts=", ".join(["3"] * len(triangles)),
        indices=", ".join(map(str, triangles.ravel().tolist())),
        normals=_vectors(unit_normals(fitted, variables.SURFEL_NORMAL)),
        points=_vectors(place),
        uv=_vectors(uv),
        shaders="\n".join([*_openpbr(inputs), *_preview(ior)]),
    )


def _template(folder: str, name: str) -> Template:
    """A text of the package, with markers such as ``$version``."""
    file = resources.files("skindb.export") / folder / f"{name}.txt"
    return Template(file.read_text(encoding="utf-8"))


def _openpbr(inputs: Mapping[str, tuple[str, str | float]]) -> list[str]:
    """MaterialX shaders: coordinates, images and the surface."""
    path = "/Face/Materials/Skin"
    shaders = [_shader("Coordinates", "ND_texcoord_vector2", ["float2 outputs:out"])]
    lines = []
    for name, (kind, value) in inputs.items():
        declared = {"color3": "color3f", "vector3": "float3"}.get(kind, kind)
        if isinstance(value, float):
            lines.append(f"{declared} inputs:{name} = {value:.6g}")
            continue
        node = "".join(part.capitalize() for part in name.split("_"))
        space = (
            f' (\n                    colorSpace = "{_space(value)}"\n                )'
            if kind == "color3"
            else ""
        )
        image = [
            f"asset inputs:file = @{value}@{space}",
            f"float2 inputs:texcoord.connect = <{path}/Coordinates.outputs:out>",
            *(f'string inputs:{axis}addressmode = "clamp"' for axis in "uv"),
            f"{declared} outputs:out",
        ]
        shaders.append(_shader(node, f"ND_image_{kind}", image))
        if name == "geometry_normal":
            bent = [
                f"float3 inputs:in.connect = <{path}/{node}.outputs:out>",
                "float3 outputs:out",
            ]
            shaders.append(_shader("BentNormal", "ND_normalmap_float", bent))
            node = "BentNormal"
        elif name == RELATIVE:
            ratio = [f"color3f inputs:in1.connect = <{path}/{node}.outputs:out>"]
            ratio += [
                f"float inputs:in2 = {_per_length(inputs):.6g}",
                "color3f outputs:out",
            ]
            shaders.append(_shader("RelativeLength", "ND_multiply_color3FA", ratio))
            node = "RelativeLength"
        lines.append(f"{declared} inputs:{name}.connect = <{path}/{node}.outputs:out>")
    return [
        *shaders,
        _shader(
            "OpenPbr",
            "ND_open_pbr_surface_surfaceshader",
            [*lines, "token outputs:out"],
        ),
    ]


def _preview(ior: float) -> list[str]:
    """Shaders for renderers without MaterialX."""
    path = "/Face/Materials/Skin"
    reader = ['string inputs:varname = "st"', "float2 outputs:result"]
    shaders = [_shader("PreviewCoordinates", "UsdPrimvarReader_float2", reader)]
    for name, file, space, output in (
        ("PreviewColor", "baseColor.png", "sRGB", "float3 outputs:rgb"),
        ("PreviewRoughness", "roughness.png", "raw", "float outputs:r"),
        ("PreviewNormal", "normal.png", "raw", "float3 outputs:rgb"),
    ):
        lines = [
            f"asset inputs:file = @{file}@",
            f'token inputs:sourceColorSpace = "{space}"',
            *(f'token inputs:wrap{axis} = "clamp"' for axis in "ST"),
            f"float2 inputs:st.connect = <{path}/PreviewCoordinates.outputs:result>",
        ]
        if name == "PreviewNormal":
            lines += [
                "float4 inputs:scale = (2, 2, 2, 1)",
                "float4 inputs:bias = (-1, -1, -1, 0)",
            ]
        shaders.append(_shader(name, "UsdUVTexture", [*lines, output]))
    surface = [
        f"color3f inputs:diffuseColor.connect = <{path}/PreviewColor.outputs:rgb>",
        f"float inputs:ior = {ior:.6g}",
        f"normal3f inputs:normal.connect = <{path}/PreviewNormal.outputs:rgb>",
        f"float inputs:roughness.connect = <{path}/PreviewRoughness.outputs:r>",
        "token outputs:surface",
    ]
    return [*shaders, _shader("Preview", "UsdPreviewSurface", surface)]


def _shader(name: str, kind: str, lines: list[str]) -> str:
    body = "\n".join(
        f"                {line}"
        for line in [f'uniform token info:id = "{kind}"', *lines]
    )
    return f'            def Shader "{name}"\n            {{\n{body}\n            }}\n'


def _vectors(values: Array) -> str:
    tuples = (", ".join(f"{x:.7g}" for x in row) for row in values.tolist())
    return f"[{', '.join(f'({numbers})' for numbers in tuples)}]"


def export_mitsuba(model: xr.DataTree, folder: Path) -> None:
    """Write `face.ply` and `skin.py` into a new folder beside the maps and bases of a bundle.

    Parameters
    ----------
    model
        Version of kind "model".
    folder
        New folder. `skin.py` reads `../manifest.json`, `../maps` and `../bases`.
    """
    make_private(folder)
    program = _template("mitsuba", PROGRAM).template
    private_file(folder / PROGRAM).write_text(program, encoding="utf-8")
    fitted = model["fitted"].to_dataset()
    triangles = model["mesh"].to_dataset()[variables.TRIANGLE].values
    columns = [
        fitted[variables.SURFEL_POSITION].values,
        unit_normals(fitted, variables.SHADING_NORMAL),
        fitted[variables.SURFEL_UV].values,
    ]
    vertices = np.concatenate(columns, axis=1).astype("<f4")
    names = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment skindb: mm; v = 0 is the top row of the maps",
    ]
    header += [
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in names),
    ]
    header += [
        f"element face {len(triangles)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    faces = np.empty(
        len(triangles), np.dtype([("count", "u1"), ("corner", "<i4", (3,))])
    )
    faces["count"], faces["corner"] = 3, triangles
    head = "\n".join([*header, ""]).encode("ascii")
    private_file(folder / MESH).write_bytes(head + vertices.tobytes() + faces.tobytes())
