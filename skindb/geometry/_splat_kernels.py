"""Compiled EWA splatting of oriented discs into a depth map; see `skindb.geometry.splats`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from skindb.jit import fast_kernel, inline_fast_kernel
from skindb.types import IntVector, Matrix32, Real, Vector32

ZERO = np.float32(0.0)
HALF = np.float32(0.5)
ONE = np.float32(1.0)
MIN_DEPTH_MM = np.float32(1.0)  # mm in front of the eye
# tangent planes closer to the line of sight are not extrapolated
LEVEL = np.float32(-0.01)
MAX_DISC_SLOPE = np.float32(50.0)  # depth of a disc per width at most


@inline_fast_kernel
def _project(
    p: Vector32, n: Vector32, frame: Matrix32, eye: Vector32
) -> tuple[Any, ...]:
    """Point and normal in the frame of the eye, and the height of the eye over the
    disc: negative from behind.
    """
    dx = p[0] - eye[0]
    dy = p[1] - eye[1]
    dz = p[2] - eye[2]
    height = -(n[0] * dx + n[1] * dy + n[2] * dz)
    x = frame[0, 0] * dx + frame[0, 1] * dy + frame[0, 2] * dz
    y = frame[1, 0] * dx + frame[1, 1] * dy + frame[1, 2] * dz
    z = frame[2, 0] * dx + frame[2, 1] * dy + frame[2, 2] * dz
    a = frame[0, 0] * n[0] + frame[0, 1] * n[1] + frame[0, 2] * n[2]
    b = frame[1, 0] * n[0] + frame[1, 1] * n[1] + frame[1, 2] * n[2]
    c = frame[2, 0] * n[0] + frame[2, 1] * n[1] + frame[2, 2] * n[2]
    return x, y, z, a, b, c, height


@inline_fast_kernel
def _ellipse(
    x: Real,
    y: Real,
    z: Real,
    a: Real,
    b: Real,
    c: Real,
    radius: Real,
    focal: Real,
) -> tuple[Any, ...]:
    """Conic (3,) in px^-2 and half widths (2,) in px of a disc's picture, wider by a
    pixel (Zwicker et al. 2001).
    """
    side = ONE if c >= 0 else -ONE
    q = -ONE / (side + c)
    w = a * b * q
    scale = focal / z * radius
    # tangents by Duff et al. 2017
    ux = ONE + side * a * a * q
    uy = side * w
    uz = -side * a
    vx = w
    vy = side + b * b * q
    vz = -b
    sx = x / z
    sy = y / z
    j00 = scale * (ux - sx * uz)
    j10 = scale * (uy - sy * uz)
    j01 = scale * (vx - sx * vz)
    j11 = scale * (vy - sy * vz)
    xx = j00 * j00 + j01 * j01 + ONE
    xy = j00 * j10 + j01 * j11
    yy = j10 * j10 + j11 * j11 + ONE
    determinant = xx * yy - xy * xy
    qa = yy / determinant
    qb = -xy / determinant
    qc = xx / determinant
    return qa, qb, qc, math.sqrt(xx), math.sqrt(yy)


@fast_kernel
def splat(
    position: Matrix32,
    normal: Matrix32,
    radius: Vector32,
    chosen: IntVector,
    frame: Matrix32,
    eye: Vector32,
    focal: np.float32,
    corner: Vector32,
    slope: np.float32,
    bias: np.float32,
    depth: Matrix32,
    fraction: Vector32,
    counting: bool,
) -> None:
    """Draw the chosen discs into `depth` (h, w), or compute the fraction of each that
    the depth map leaves visible.

    Parameters
    ----------
    position, normal, radius
        (n, 3) and (n,) of the discs, mm.
    chosen
        (m,) discs to draw or to count.
    frame, eye
        Rows right, down, forwards; and the centre of projection in mm.
    focal, corner
        px; place (2,) of the first pixel's outer corner in px from the axis.
    slope, bias
        Allowed depth of a disc behind the map: `slope` pixels along its own tilt, and `bias` mm.
    depth
        (h, w) mm along the axis; written when drawing.
    fraction
        (m,) blended over rasterised pixels; written when counting, for centres inside the map.
    counting
        Whether to count instead of to draw.
    """
    height, width = depth.shape
    for k in range(len(chosen)):
        i = chosen[k]
        x, y, z, a, b, c, over = _project(position[i], normal[i], frame, eye)
        if not z > MIN_DEPTH_MM or over == 0 or (counting and over < 0):
            continue
        if over < 0:  # an open mesh also hides from behind
            a = -a
            b = -b
            c = -c
            over = -over
        px = focal * x / z - corner[0]
        py = focal * y / z - corner[1]
        # the linear approximation fails for discs larger than half of a map
        beside = ZERO if counting else HALF
        if abs(px - HALF * width) > (HALF + beside) * width:
            continue
        if abs(py - HALF * height) > (HALF + beside) * height:
            continue
        qa, qb, qc, wide, high = _ellipse(x, y, z, a, b, c, radius[i], focal)
        # clamped before the conversion to integers, as a disc beside the eye may project anywhere
        x0 = math.ceil(min(max(px - wide - HALF, ZERO), np.float32(width)))
        x1 = math.floor(min(max(px + wide - HALF, -ONE), np.float32(width - 1)))
        y0 = math.ceil(min(max(py - high - HALF, ZERO), np.float32(height)))
        y1 = math.floor(min(max(py + high - HALF, -ONE), np.float32(height - 1)))
        lean = math.sqrt(a * a + b * b)
        creep = slope * z / focal * min(lean * z / over, MAX_DISC_SLOPE)
        # the depth is valid only within the rim of the disc
        reach = radius[i] * lean + creep
        behind = bias + creep
        plane = a * x + b * y + c * z
        rasterised = 0
        blended = 0
        for row in range(y0, y1 + 1):
            fy = row + HALF - py
            for column in range(x0, x1 + 1):
                fx = column + HALF - px
                if qa * fx * fx + 2 * qb * fx * fy + qc * fy * fy > ONE:
                    continue
                across = (
                    a * (column + HALF + corner[0]) + b * (row + HALF + corner[1])
                ) / focal + c
                surface = plane / across if across < LEVEL else z
                surface = min(max(surface, z - reach), z + reach)
                if counting:
                    rasterised += 1
                    blended += surface <= depth[row, column] + behind
                elif surface < depth[row, column]:
                    depth[row, column] = surface
        if counting and rasterised > 0:
            fraction[k] = np.float32(blended) / np.float32(rasterised)
