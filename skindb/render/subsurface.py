"""Subsurface transport: light that enters the skin in one place and leaves it in another."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.geometry.mesh import vertex_areas
from skindb.geometry.rays import RayScene
from skindb.optics.dipole_tree import subsurface_exitance
from skindb.optics.fresnel import fresnel_transmittance
from skindb.render.scene import Lights, Surface

DEFAULT_OPENING = 0.1  # of the octree
# range of openings: below it, the tree takes longer than it saves; above it, pictures
# do not become faster
OPENINGS = (0.02, 0.4)
# maximum relative error of the exitance against all pairs (docs/performance.md)
ERROR_PER_OPENING = 0.015

Float = NDArray[np.floating[Any]]


def require_translucency(surface: Surface) -> None:
    """Raise `InputError` if there are channels in which no vertex has sigma_tr."""
    finite = np.isfinite(
        np.zeros((0, 3)) if surface.sigma_tr is None else surface.sigma_tr
    )
    if missing := [
        channel for c, channel in enumerate("RGB") if not finite[:, c].any()
    ]:
        rule = "must have sigma_tr in R, G and B for subsurface transport"
        missing_text = f"no probe site with a valid fit in {', '.join(missing)}"
        raise InputError(
            Fault(
                "model",
                rule,
                missing_text,
                "omit --subsurface, or repeat the probe measurement",
            )
        )


def transmitted_irradiance(
    surface: Surface, lights: Lights, scene: RayScene
) -> NDArray[np.float32]:
    """Irradiance (v, l) under the boundary per radiant intensity, F_t(w_i) cos(theta_i)
    / d^2 [mm-2].

    It is computed from the centre of each light, with its fall-off. It is zero if the
    vertex faces away from the light, is in its shadow, or has no known normal.
    """
    vertices = np.flatnonzero(surface.known)
    points = surface.vertices[vertices]
    normals = surface.normals[vertices]
    out = np.zeros((len(surface.vertices), len(lights)), np.float32)
    for i in range(len(lights)):
        towards = lights.position[i] - points
        square = np.einsum("nc,nc->n", towards, towards)
        cosine = np.einsum("nc,nc->n", towards, normals) / np.sqrt(square)
        front = np.flatnonzero(cosine > 0)
        lit = front[
            ~scene.occluded(
                points[front], lights.position[i : i + 1], normal=normals[front]
            )
        ]
        along = np.maximum(
            -(towards[lit] @ lights.axis[i]) / np.sqrt(square[lit]), 0
        ) ** float(lights.falloff[i])
        passed = fresnel_transmittance(np.minimum(cosine[lit], 1), surface.eta)
        out[vertices[lit], i] = cosine[lit] / square[lit] * along * passed
    return out


def exitances(
    surface: Surface,
    lights: Lights,
    scene: RayScene,
    *,
    wanted: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """Radiant exitance under the boundary for each light, by the dipole octree (eq. 9;
    Jensen and Buhler 2002).

    Parameters
    ----------
    surface
        Surface with `s` and `sigma_tr`; vertices without known values neither receive
        nor send light.
    lights
        Lights, which are all computed in one traversal of the octree.
    scene
        Ray tracer of the surface.
    wanted
        (v,) vertices whose exitance is needed; default all. It is 0 at the others.

    Returns
    -------
    ndarray
        (l, v, 3), valid for all cameras. The kernel is divided by its sum, so that
        uniform light gives exactly R_d.
    """
    out = _exitances_from_irradiance(
        surface, transmitted_irradiance(surface, lights, scene), wanted
    )
    out *= lights.intensity[:, None].astype(np.float32)
    return out


def total_exitance(
    surface: Surface,
    lights: Lights,
    scene: RayScene,
    *,
    wanted: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """Sum (v, 3) of `exitances` over the lights; as it is linear, irradiances are
    summed before the traversal.
    """
    return exitance_from_irradiance(
        surface,
        transmitted_irradiance(surface, lights, scene) @ lights.intensity,
        wanted,
    )


def tree_opening(error: float | None) -> tuple[float, float]:
    """Opening of the octree for a picture with this relative error, and the bound on
    its own relative error.

    The octree may contribute a tenth of the target error. Without a target error, the
    opening is 0.1.
    """
    opening = (
        DEFAULT_OPENING
        if error is None
        else float(np.clip(error / 10 / ERROR_PER_OPENING, *OPENINGS))
    )
    return opening, ERROR_PER_OPENING * opening


def exitance_from_irradiance(
    surface: Surface,
    received: Float,
    wanted: NDArray[np.bool_] | None = None,
    *,
    tolerance: float = DEFAULT_OPENING,
) -> NDArray[np.float32]:
    """Radiant exitance (v, 3) under the boundary at the wanted vertices, from
    irradiance (v, 3) under the boundary.
    """
    exitance = _exitances_from_irradiance(
        surface, received, wanted, tolerance=tolerance
    )
    # each column is the light of one channel, so only this channel of its result is used
    return np.stack([exitance[c, :, c] for c in range(3)], axis=-1)


def _exitances_from_irradiance(
    surface: Surface,
    irradiance: Float,
    wanted: NDArray[np.bool_] | None,
    *,
    tolerance: float = DEFAULT_OPENING,
) -> NDArray[np.float32]:
    """Exitance (l, v, 3) at the wanted vertices, 0 at the others, from irradiance (v, l)."""
    if surface.s is None or surface.sigma_tr is None:
        raise ValueError(
            "the surface must have s and sigma_tr for subsurface transport, found None"
        )
    finite = (
        surface.known
        & np.isfinite(surface.s).all(axis=1)
        & np.isfinite(surface.sigma_tr).all(axis=1)
    )
    out = np.zeros((irradiance.shape[1], len(surface.vertices), 3), np.float32)
    out[:, finite] = subsurface_exitance(
        surface.vertices[finite],
        vertex_areas(surface.vertices, surface.faces)[finite],
        irradiance[finite],
        surface.s[finite],
        surface.sigma_tr[finite],
        eta=surface.eta,
        tolerance=tolerance,
        receivers=None if wanted is None else wanted[finite],
    )
    return out
