"""Light that enters the skin in one place and leaves it in another."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.geometry.rays import RayScene
from skindb.geometry.surfels import vertex_areas
from skindb.optics.dipole_tree import subsurface_exitance
from skindb.optics.fresnel import fresnel_transmittance
from skindb.render.scene import Lights, Surface

DEFAULT_OPENING = 0.1  # of the octree
OPENINGS = (0.02, 0.4)  # below, the tree costs more than it gains; above, pictures take no less time
ERROR_PER_OPENING = 0.015  # relative error of the exitance, at most, against all pairs (docs/performance.md)

Float = NDArray[np.floating[Any]]


def require_translucency(surface: Surface) -> None:
    """`InputError` that names the channels in which no vertex has sigma_tr: light cannot be carried in them."""
    known = np.isfinite(np.zeros((0, 3)) if surface.sigma_tr is None else surface.sigma_tr)
    if missing := [channel for c, channel in enumerate("RGB") if not known[:, c].any()]:
        rule = "subsurface transport needs sigma_tr in R, G and B"
        found = f"no site of a probe gave it in {', '.join(missing)}"
        raise InputError(Fault("model", rule, found, "leave --subsurface out, or measure with the probe again"))


def transmitted_irradiance(surface: Surface, lights: Lights, scene: RayScene) -> NDArray[np.float32]:
    """Irradiance under the boundary per radiant intensity, F_t(w_i) cos(theta_i) / d^2 [mm-2], (v, l).

    From the centre of each light, with its fall-off. Zero where the vertex faces away from the light, does not see
    it, or has no known normal.
    """
    known = np.flatnonzero(surface.known)
    points, normals = surface.vertices[known], surface.normals[known]
    out = np.zeros((len(surface.vertices), len(lights)), np.float32)
    for i in range(len(lights)):
        towards = lights.position[i] - points
        square = np.einsum("nc,nc->n", towards, towards)
        cosine = np.einsum("nc,nc->n", towards, normals) / np.sqrt(square)
        front = np.flatnonzero(cosine > 0)
        lit = front[~scene.occluded(points[front], lights.position[i : i + 1], normal=normals[front])]
        along = np.maximum(-(towards[lit] @ lights.axis[i]) / np.sqrt(square[lit]), 0) ** float(lights.falloff[i])
        passed = fresnel_transmittance(np.minimum(cosine[lit], 1), surface.eta)
        out[known[lit], i] = cosine[lit] / square[lit] * along * passed
    return out


def exitances(
    surface: Surface, lights: Lights, scene: RayScene, *, wanted: NDArray[np.bool_] | None = None
) -> NDArray[np.float32]:
    """Radiant exitance under the boundary of every light by the dipole octree (eq. 9; Jensen and Buhler 2002).

    Parameters
    ----------
    surface
        With `s` and `sigma_tr`; vertices without known values neither receive nor send light.
    lights
        All are carried in one walk over the octree.
    scene
        Rays of the surface.
    wanted
        (v,) vertices whose exitance is needed, default all; 0 at the others.

    Returns
    -------
    ndarray
        (l, v, 3), used by all cameras; the kernel is divided by its own sum, so that uniform light gives R_d exactly.
    """
    out = _carried(surface, transmitted_irradiance(surface, lights, scene), wanted)
    out *= lights.intensity[:, None].astype(np.float32)
    return out


def total_exitance(
    surface: Surface, lights: Lights, scene: RayScene, *, wanted: NDArray[np.bool_] | None = None
) -> NDArray[np.float32]:
    """The sum over the lights of `exitances`, (v, 3): it is linear, so their irradiance is summed before the walk."""
    return carry_under_skin(surface, transmitted_irradiance(surface, lights, scene) @ lights.intensity, wanted)


def tree_opening(error: float | None) -> tuple[float, float]:
    """The opening of the octree for a picture with this relative error, and what it changes at most (relative).

    The tree may cost a tenth of the error that is asked for. Without one the opening is 0.1.
    """
    opening = DEFAULT_OPENING if error is None else float(np.clip(error / 10 / ERROR_PER_OPENING, *OPENINGS))
    return opening, ERROR_PER_OPENING * opening


def carry_under_skin(
    surface: Surface, received: Float, wanted: NDArray[np.bool_] | None = None, *, tolerance: float = DEFAULT_OPENING
) -> NDArray[np.float32]:
    """Radiant exitance (v, 3) under the boundary of irradiance (v, 3) that entered there, at the wanted vertices."""
    carried = _carried(surface, received, wanted, tolerance=tolerance)
    # a column is the light of one channel, of use in that channel only
    return np.stack([carried[c, :, c] for c in range(3)], axis=-1)


def _carried(
    surface: Surface, irradiance: Float, wanted: NDArray[np.bool_] | None, *, tolerance: float = DEFAULT_OPENING
) -> NDArray[np.float32]:
    """Exitance (l, v, 3) of irradiance (v, l) at the wanted vertices, 0 at the others."""
    if surface.s is None or surface.sigma_tr is None:
        raise ValueError("subsurface transport needs s and sigma_tr of the surface")
    known = surface.known & np.isfinite(surface.s).all(axis=1) & np.isfinite(surface.sigma_tr).all(axis=1)
    out = np.zeros((irradiance.shape[1], len(surface.vertices), 3), np.float32)
    out[:, known] = subsurface_exitance(
        surface.vertices[known], vertex_areas(surface.vertices, surface.faces)[known], irradiance[known],
        surface.s[known], surface.sigma_tr[known], eta=surface.eta, tolerance=tolerance,
        receivers=None if wanted is None else wanted[known],
    )  # fmt: skip
    return out
