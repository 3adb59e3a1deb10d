"""Takes whose surfels lie on a sheet or on a face, with texture coordinates that differ
by planted warps.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from skindb.geometry.atlas import signed_areas
from skindb.geometry.warp import apply_warp, fit_warp
from skindb.schema import FitStatus, dataset

SIDE = 33
SIZE = 1.1  # of B's head to A's
NAMES = [f"point{i}" for i in range(9)]
STORED = 1e-6  # single precision of coordinates below 2
PLACES = (
    np.stack(np.meshgrid([0.2, 0.5, 0.8], [0.2, 0.5, 0.8]), axis=-1).reshape(-1, 2)
    + 0.01
)
FACE = {
    "forehead_centre": (0.50, 0.12),
    "forehead_right": (0.35, 0.15),
    "brow_right": (0.385, 0.25),
    "nasion": (0.5, 0.33),
    "nose_tip": (0.5, 0.43),
    "subnasale": (0.5, 0.53),
    "ala_right": (0.41, 0.52),
    "eye_outer_right": (0.32, 0.37),
    "eye_inner_right": (0.41, 0.355),
    "mouth_corner_right": (0.372, 0.595),
    "lip_upper": (0.5, 0.554),
    "chin": (0.5, 0.712),
    "jaw_right": (0.231, 0.676),
}
FACE |= {
    name.replace("right", "left"): (1 - u, v)
    for name, (u, v) in FACE.items()
    if "right" in name
}


def sheet() -> tuple[np.ndarray, np.ndarray]:
    """Regular (u, v) (n, 2) with v downwards, and triangles with the orientation of an
    outer surface.
    """
    side = np.linspace(0, 1, SIDE)
    uv = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    i = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).ravel()
    faces = np.concatenate(
        [
            np.column_stack([i, i + SIDE, i + 1]),
            np.column_stack([i + 1, i + SIDE, i + SIDE + 1]),
        ]
    )
    assert (signed_areas(uv, faces) > 0).all()
    return uv, faces


def lifted(uv: np.ndarray) -> np.ndarray:
    """Positions [mm] of a face at (u, v): a shallow cap 160 mm wide."""
    x = 160 * (uv[:, 0] - 0.5)
    y = -160 * (uv[:, 1] - 0.5)
    return np.column_stack([x, y, -(x**2 + y**2) / 400])


def sheet_take(
    uv: np.ndarray, landmarks: np.ndarray, names=NAMES, size=1.0, **attrs
) -> xr.DataTree:
    """A take with surfels at the points of the sheet, the given texture coordinates,
    and landmarks on the sheet.
    """
    plane, faces = sheet()
    fitted = {
        "surfel_position": lifted(plane) * size,
        "surfel_uv": uv,
        "surfel_area": np.ones(len(uv)),
        "fit_status": np.full(len(plane), FitStatus.FITTED),
        "diffuse_reflectance": plane[:, [0, 1, 0]] / 2 + 0.2,
        "shading_normal": np.tile([0.0, 0, 1], (len(plane), 1)),
        "basis_weight": np.full((len(plane), 1), 0.1),
    }
    groups = {
        "basis": dataset({"disc_angular_radius": 0.0}),
        "fitted": dataset(fitted),
        "mesh": dataset(
            {"triangle": faces, "landmark_position": landmarks},
            coords={"landmark": list(names)},
        ),
    }
    tree = xr.DataTree.from_dict(groups)
    tree.attrs = {"consent_scope": ["statistics"], "condition": "normal", **attrs}
    return tree


def on_sheet(places: np.ndarray) -> np.ndarray:
    """Positions of the sheet's nodes nearest to these (u, v)."""
    plane, _ = sheet()
    at = [np.linalg.norm(plane - p, axis=1).argmin() for p in places]
    return lifted(plane[at])


def nodes() -> np.ndarray:
    return np.rint(PLACES * (SIDE - 1)) / (SIDE - 1)


def planted_uv(seed: int, by: float = 0.03) -> np.ndarray:
    """Texture coordinates of the sheet's points after a warp that moves the landmarks
    but not the rim.
    """
    plane = sheet()[0]
    moved = nodes() + np.random.default_rng(seed).normal(size=(9, 2)) * by
    window = 4 * np.sqrt((plane * (1 - plane)).prod(axis=1, keepdims=True))
    return plane + window * (apply_warp(fit_warp(nodes(), moved), plane) - plane)


def sheet_pair() -> dict[str, xr.DataTree]:
    points = on_sheet(nodes())
    return {
        "A": sheet_take(sheet()[0], points),
        "B": sheet_take(planted_uv(1), points * SIZE, size=SIZE),
    }


def face_take(own: bool = False, seed: int = 1) -> xr.DataTree:
    """A take with the landmarks of a face, and if `own` with a region mask whose beard
    is the forehead.
    """
    names = list(FACE)
    take = sheet_take(
        planted_uv(seed, 0.01), lifted(np.array([FACE[n] for n in names])), names=names
    )
    if own:
        upper = (sheet()[0][:, 1] < 0.4)[:, None]
        mask = dataset({"region_mask": upper}, coords={"region": ["beard"]})
        take["fitted"] = take["fitted"].to_dataset().merge(mask)
    return take
