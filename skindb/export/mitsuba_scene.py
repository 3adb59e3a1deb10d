"""Export of a fitted model to Mitsuba 3: the mesh, and a program that evaluates the exact BRDFs."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np
import xarray as xr

from skindb.export.textures import shading_normals
from skindb.files import make_private, private_file

MESH = "face.ply"
PROGRAM = "skin.py"


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
    program = resources.files("skindb.export") / "mitsuba" / f"{PROGRAM}.txt"
    private_file(folder / PROGRAM).write_text(
        program.read_text(encoding="utf-8"), encoding="utf-8"
    )
    fitted = model["fitted"].to_dataset()
    triangles = model["mesh"].to_dataset()["triangle"].values
    columns = [
        fitted["surfel_position"].values,
        shading_normals(fitted),
        fitted["surfel_uv"].values,
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
