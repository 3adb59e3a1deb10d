"""A small model for the viewer: a dome of skin with a nose that casts a shadow."""

from __future__ import annotations

import numpy as np
import xarray as xr

from skindb.optics.diffusion import dipole_s
from skindb.reflectance.tables import TableGrid, stored_brdf, tabulate
from skindb.schema import dataset

# vertices and mm along each axis
SIDE = 120
SIZE = 60.0
LIGHTS = np.array([[200.0, 150, 500], [-300, 50, 400], [0, -350, 350]])


def lobes(wi, wo):
    h = wi + wo
    h /= np.maximum(np.linalg.norm(h, axis=-1, keepdims=True), 1e-9)
    cosine = np.clip(h[..., 2], 0, 1)
    return np.stack([0.05 + 0 * cosine, 2 * cosine**20, 20 * cosine**200], axis=-1)


def small_face(albedo=(0.6, 0.4, 0.3), components=3) -> xr.DataTree:
    line = np.linspace(-1, 1, SIDE)
    u, v = (a.ravel() for a in np.meshgrid(line, line))
    nose = 18 * np.exp(-((u / 0.15) ** 2 + (v / 0.3) ** 2))
    z = 25 * np.sqrt(np.maximum(2.2 - u**2 - v**2, 0)) + nose
    position = np.stack([SIZE * u, SIZE * v, z], axis=1)
    i = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([i, i + 1, i + SIDE], 1),
            np.stack([i + 1, i + SIDE + 1, i + SIDE], 1),
        ]
    )
    normal = np.zeros_like(position)
    a, b, c = (position[faces[:, k]] for k in range(3))
    for k in range(3):
        np.add.at(normal, faces[:, k], np.cross(b - a, c - a))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    count = len(position)
    rng = np.random.default_rng(0)
    colour = np.array(albedo) * (1 + 0.15 * np.sin(12 * u) * np.cos(9 * v))[:, None]
    grid = TableGrid(30, 30, 8)
    tables = tabulate(lobes, grid)[..., :components]
    values = {
        "surfel_position": position,
        "shading_normal": normal,
        "diffuse_reflectance": colour,
        "dipole_s": dipole_s(colour, eta=1.3)[0],
        "sigma_tr": np.tile([0.5, 0.9, 1.4], (count, 1)),
        "basis_weight": rng.uniform(0.1, 0.3, (1, components)) * np.ones((count, 1)),
        "surfel_uv": np.stack([(u + 1) / 2, (v + 1) / 2], axis=1),
        "fit_status": np.zeros(count),
        "refractive_index": 1.3,
    }
    K = np.array([[400.0, 0, 128], [0, 400, 128], [0, 0, 1]])
    R = np.diag([1.0, -1, -1])
    dome = {
        "camera_matrix": K[None],
        "camera_rotation": R[None],
        "camera_translation": np.array([[0.0, 0, 400]]),
        "camera_distortion": np.zeros((1, 5)),
        "camera_size": np.array([[256, 256]]),
        "camera_position": np.array([[0.0, 0, 400]]),
        "light_position": LIGHTS,
        "light_intensity": np.full((3, 3), 5e5) * [1.0, 0.95, 0.9],
        "light_disc_radius": np.full(3, 3.0),
        "light_axis": -LIGHTS / np.linalg.norm(LIGHTS, axis=1, keepdims=True),
        "light_falloff": np.zeros(3),
    }
    groups = {
        "/fitted": dataset(values),
        "/mesh": dataset({"triangle": faces}),
        "/basis": dataset(
            {"basis_brdf": stored_brdf(tables), "disc_angular_radius": 0.0}
        ),
        "/dome": dataset(dome, coords={"light": ["l0", "l1", "l2"], "camera": ["c0"]}),
    }
    tree = xr.DataTree.from_dict(groups)
    tree.attrs |= {"consent_scope": ["fit", "export"], "take": "S1"}
    return tree
