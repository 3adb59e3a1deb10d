"""Scenes of a fitted model: USD with an OpenPBR material, this material in MaterialX, and
Mitsuba 3 with a program that evaluates the exact BRDFs.
"""

from pathlib import Path

import numpy as np
import trimesh
import xarray as xr

from skindb import __version__
from skindb.export.textures import Skin, index_of, unit_normals
from skindb.files import filled_template, make_private, private_file
from skindb.render.image import write_png
from skindb.schema import fitted_of, variables
from skindb.types import Array

STAGE = "face.usda"
MATERIAL = "face.mtlx"
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
    planes = {
        "baseColor": skin.pictures["baseColor"],
        "roughness": skin.pictures["metallicRoughness"][..., 1],
        "specularFactor": skin.pictures["specular"][..., 3],
        "normal": skin.pictures["normal"],
    }
    for name, plane in planes.items():
        grey_or_colour = plane if plane.ndim == 3 else np.stack([plane] * 3, axis=-1)
        write_png(folder / f"{name}.png", grey_or_colour)
    radius = f"{longest_path:.6g}" if longest_path > 0 else ""
    material = {
        "version": __version__,
        "ior": f"{index_of(skin.mean_f0):.6g}",
        "preview_ior": f"{index_of(skin.mean_reflection):.6g}",
        "radius": radius,
        # factor from a length of the map to `subsurface_radius_scale`
        "per_length": f"{1 / longest_path:.6g}" if radius else "",
    }
    for name, mesh in ((MATERIAL, {}), (STAGE, _mesh(model))):
        text = filled_template("skindb.export", f"usd/{name}.jinja", **material, **mesh)
        private_file(folder / name).write_text(text, encoding="utf-8")


def _mesh(model: xr.DataTree) -> dict[str, str]:
    """The mesh as texts of a USD stage."""
    fitted = fitted_of(model)
    place = fitted[variables.SURFEL_POSITION].values.astype(np.float32)
    triangles = model["mesh"].dataset[variables.TRIANGLE].values
    # v increases upwards in USD
    uv = fitted[variables.SURFEL_UV].values.astype(float) * [1, -1] + [0, 1]
    return {
        "extent": _vectors(np.stack([place.min(axis=0), place.max(axis=0)])),
        "counts": ", ".join(["3"] * len(triangles)),
        "indices": ", ".join(map(str, triangles.ravel().tolist())),
        "normals": _vectors(unit_normals(fitted, variables.SURFEL_NORMAL)),
        "points": _vectors(place),
        "uv": _vectors(uv),
    }


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
    program = filled_template("skindb.export", f"mitsuba/{PROGRAM}.txt")
    private_file(folder / PROGRAM).write_text(program, encoding="utf-8")
    fitted = fitted_of(model)
    u, v = fitted[variables.SURFEL_UV].values.astype(np.float32).T
    mesh = trimesh.Trimesh(
        fitted[variables.SURFEL_POSITION].values,
        model["mesh"].dataset[variables.TRIANGLE].values,
        vertex_normals=unit_normals(fitted, variables.SHADING_NORMAL),
        vertex_attributes={"u": u, "v": v},
        process=False,
    )
    mesh.export(private_file(folder / MESH), vertex_normal=True)
