"""Compiled shading of points under one light; see `skindb.reflectance.model` for shapes,
units and sources.
"""

from __future__ import annotations

import math

import numpy as np

from skindb.jit import fast_kernel, inline_fast_kernel
from skindb.reflectance._row_kernels import Triple, cells, interpolate
from skindb.types import Cube, Matrix, Matrix32, Tensor32, Vector, Vector32


@inline_fast_kernel
def transmittance(cosine: float, eta: float) -> float:
    """Fresnel transmittance F_t for light from outside, at the cosine to the normal."""
    g = math.sqrt(eta * eta - 1.0 + cosine * cosine)
    a = (g - cosine) / (g + cosine)
    b = (cosine * (g + cosine) - 1.0) / (cosine * (g - cosine) + 1.0)
    return 1.0 - 0.5 * a * a * (1.0 + b * b)


@inline_fast_kernel
def circular_reversal(cosine: float, eta: float) -> float:
    """As in `skindb.optics.fresnel`."""
    g = math.sqrt(eta * eta - 1.0 + cosine * cosine)
    ratio = (cosine * (g + cosine) - 1.0) / (cosine * (g - cosine) + 1.0)
    return 2.0 * ratio / (1.0 + ratio * ratio)


@inline_fast_kernel
def _surface(
    table: Tensor32,
    weight: Vector32,
    n: Triple,
    wi: Triple,
    wo: Triple,
    value: Vector32,
) -> float:
    """Sum over components of weight times the trilinear table value; n, wi, wo are unit
    3-tuples, and `value` is memory for the components.
    """
    x, y, z = cells(n, wi, wo, table.shape)
    interpolate(table, x, y, z, 1.0, value)
    total = 0.0
    for m in range(value.shape[0]):
        total += weight[m] * value[m]
    return total


@inline_fast_kernel
def to_lamp(position: Vector, place: Vector) -> tuple[float, float, float, float]:
    """Unit direction from a position to a place, and their squared distance."""
    x = place[0] - position[0]
    y = place[1] - position[1]
    z = place[2] - position[2]
    square = x * x + y * y + z * z
    inverse = 1.0 / math.sqrt(square)
    return x * inverse, y * inverse, z * inverse, square


@inline_fast_kernel
def fall_off(axis: Vector, x: float, y: float, z: float, exponent: float) -> float:
    """Radiant intensity of a lamp opposite to the direction x, y, z, over that along its
    axis.
    """
    if exponent == 0.0:
        return 1.0
    along = -(axis[0] * x + axis[1] * y + axis[2] * z)
    return float(max(along, 0.0) ** exponent)


@fast_kernel
def shade(
    position: Matrix,
    normal: Matrix,
    view: Matrix,
    diffuse: Matrix32,
    weight: Matrix32,
    table: Tensor32,
    lamp: Cube,
    lit: Matrix32,
    axis: Vector,
    falloff: float,
    eta: float,
    with_surface: bool,
    out: Matrix32,
) -> None:
    """Fill `out` (n, 3) with the radiance per unit of the light's radiant intensity."""
    n, points = lit.shape
    value = np.empty(table.shape[3], np.float32)
    for i in range(n):
        nx = float(normal[i, 0])
        ny = float(normal[i, 1])
        nz = float(normal[i, 2])
        vx = float(view[i, 0])
        vy = float(view[i, 1])
        vz = float(view[i, 2])
        cos_o = nx * vx + ny * vy + nz * vz
        matte = 0.0
        gloss = 0.0
        if cos_o > 0.0:
            out_transmittance = transmittance(min(cos_o, 1.0), eta)
            for p in range(points):
                if lit[i, p] <= 0.0:
                    continue
                dx, dy, dz, square = to_lamp(position[i], lamp[i, p])
                cos_i = dx * nx + dy * ny + dz * nz
                if cos_i <= 0.0:
                    continue
                # irradiance of the surface per unit of radiant intensity
                received = lit[i, p] * cos_i / square
                received *= fall_off(axis, dx, dy, dz, falloff)
                matte += (
                    received
                    * transmittance(min(cos_i, 1.0), eta)
                    * out_transmittance
                    / math.pi
                )
                if with_surface:
                    gloss += received * _surface(
                        table,
                        weight[i],
                        (nx, ny, nz),
                        (dx, dy, dz),
                        (vx, vy, vz),
                        value,
                    )
        for c in range(3):
            out[i, c] = (matte * diffuse[i, c] + gloss) / points
