"""Transfer of light from all directions to the surfels of the viewer: spherical harmonics of
the irradiance under the boundary, with visibility (Sloan et al. 2002).
"""

import numpy as np

from skindb.geometry.rays import RayScene
from skindb.optics.fresnel import fresnel_transmittance
from skindb.render.scene import Surface
from skindb.render.subsurface import FAR
from skindb.types import Array

# rays of each surfel; tests/view/test_surroundings.py compares them with 16 times as many
DIRECTIONS = 256


def even_directions(count: int) -> Array:
    """Unit directions (count, 3) that are evenly spread (Fibonacci lattice)."""
    step = np.arange(count) + 0.5
    height = 1 - 2 * step / count
    azimuth = np.pi * (3 - np.sqrt(5)) * step
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(azimuth), height, radius * np.sin(azimuth)], 1)


def harmonics(direction: Array) -> Array:
    """Real spherical harmonics (n, 16) of the orders 0 to 3 at unit directions (n, 3)."""
    x, y, z = direction.T
    columns = [
        0.5 + 0 * x,
        *(np.sqrt(3 / 4) * axis for axis in (x, y, z)),
        *(np.sqrt(15 / 4) * pair for pair in (x * y, y * z, x * z)),
        np.sqrt(5 / 16) * (3 * z**2 - 1),
        np.sqrt(15 / 16) * (x**2 - y**2),
        np.sqrt(35 / 32) * y * (3 * x**2 - y**2),
        np.sqrt(105 / 4) * x * y * z,
        np.sqrt(21 / 32) * y * (5 * z**2 - 1),
        np.sqrt(7 / 16) * z * (5 * z**2 - 3),
        np.sqrt(21 / 32) * x * (5 * z**2 - 1),
        np.sqrt(105 / 16) * z * (x**2 - y**2),
        np.sqrt(35 / 32) * x * (x**2 - 3 * y**2),
    ]
    values: Array = np.stack(columns, axis=1) / np.sqrt(np.pi)
    return values


def sky_transfer(surface: Surface, count: int = DIRECTIONS) -> Array:
    """Coefficients (n, 16) of the visible cosine times the Fresnel transmittance at the
    vertices of a surface, from `count` rays of each vertex.

    The irradiance under the boundary by distant light is their product with the
    coefficients of its radiance.
    """
    scene = RayScene(surface.vertices, surface.faces)
    transfer = np.zeros((len(surface.vertices), 16))
    towards = even_directions(count)
    for direction, basis in zip(towards, harmonics(towards), strict=True):
        cosine = surface.normals @ direction
        facing = np.flatnonzero(cosine > 0)
        hidden = scene.occluded(
            surface.vertices,
            surface.vertices[facing] + FAR * direction,
            normal=surface.normals,
            chosen=facing,
        )
        lit = facing[~hidden]
        enters = cosine[lit] * fresnel_transmittance(cosine[lit], surface.eta)
        transfer[lit] += enters[:, None] * basis
    return transfer * (4 * np.pi / count)
