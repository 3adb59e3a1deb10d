"""Light that enters the skin in one place and leaves it in another."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.geometry.rays import RayScene
from skindb.geometry.surfels import vertex_areas
from skindb.optics.fresnel import fresnel_transmittance
from skindb.render.scene import Lights, Surface

Float = NDArray[np.floating[Any]]


def transmitted_irradiance(surface: Surface, light: Lights, scene: RayScene) -> Float:
    """Irradiance under the boundary, F_t(w_i) E cos(theta_i), at every vertex (v, 3) from the centre of one light.

    Zero where the vertex faces away from the light, does not see it, or has no known normal.
    """
    known = surface.known
    points, normals = surface.vertices[known], surface.normals[known]
    towards = light.position[0] - points
    square = np.einsum("nc,nc->n", towards, towards)
    cosine = np.einsum("nc,nc->n", towards, normals) / np.sqrt(square)
    front = np.flatnonzero(cosine > 0)
    lit = front[~scene.occluded(points[front], light.position, normal=normals[front])]
    along = np.maximum(-(towards[lit] @ light.axis[0]) / np.sqrt(square[lit]), 0) ** float(light.falloff[0])
    received = np.zeros(len(points))
    received[lit] = cosine[lit] / square[lit] * along * fresnel_transmittance(np.minimum(cosine[lit], 1), surface.eta)
    out = np.zeros((len(surface.vertices), 3))
    out[known] = received[:, None] * light.intensity[0]
    return out


def exitance(surface: Surface, light: Lights, scene: RayScene) -> Float:
    """Radiant exitance under the boundary by the dipole octree (eq. 9; Jensen and Buhler 2002).

    Parameters
    ----------
    surface
        With `s` and `sigma_tr`; vertices without known values neither receive nor send light.
    light
        Record of one light.
    scene
        Rays of the surface.

    Returns
    -------
    ndarray
        (v, 3); the kernel is divided by its own sum, so that uniform light gives R_d exactly.
    """
    from skindb.optics.dipole_tree import subsurface_exitance

    if surface.s is None or surface.sigma_tr is None:
        raise ValueError("subsurface transport needs s and sigma_tr of the surface")
    known = surface.known & np.isfinite(surface.s).all(axis=1) & np.isfinite(surface.sigma_tr).all(axis=1)
    out = np.zeros((len(surface.vertices), 3))
    out[known] = subsurface_exitance(
        surface.vertices[known], vertex_areas(surface.vertices, surface.faces)[known],
        transmitted_irradiance(surface, light, scene)[known], surface.s[known], surface.sigma_tr[known],
        eta=surface.eta, normalise=True,
    )  # fmt: skip
    return out


def exitances(surface: Surface, lights: Lights, scene: RayScene) -> NDArray[np.float32]:
    """(l, v, 3) `exitance` of every light: one octree walk per light, used by all cameras."""
    return np.stack([exitance(surface, lights.select(i), scene).astype(np.float32) for i in range(len(lights))])
