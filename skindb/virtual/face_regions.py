"""Positions of the landmarks and regions of a parametric face."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from skindb.virtual.face_field import FaceShape, field, lid_height, mouth_line

Array = NDArray[np.float64]
REGIONS = (
    "forehead",
    "nose",
    "cheek",
    "lips",
    "chin",
    "neck",
    "beard",
    "brow",
    "eyelid",
    "lash",
)


def landmark_directions(shape: FaceShape, centre: Array) -> dict[str, Array]:
    """Unit directions from `centre` to the 20 landmarks, which lie on the skin in these
    directions.
    """
    flat = _landmarks(shape)
    points = dict(zip(flat, _front(np.array(list(flat.values())), shape), strict=True))
    jaw = np.array([shape.width * shape.jaw_width, -54.0 * shape.height, 34.0])
    points |= {"jaw_right": jaw * (-1, 1, 1), "jaw_left": jaw}
    return {
        name: (p - centre) / np.linalg.norm(p - centre) for name, p in points.items()
    }


def _landmarks(s: FaceShape) -> dict[str, tuple[float, float]]:
    tip = s.nose_tip
    y = s.mouth_height
    e = s.eye_distance
    w = s.mouth_width
    middle = {
        "forehead_centre": 96.0,
        "nasion": 42.0,
        "nose_tip": tip[1] + 1.0,
        "subnasale": tip[1] - 17.5,
        "lip_upper": y + 4.0,
        "chin": -72.0,
    }
    pairs = {
        "forehead": (46.0, 88.0),
        "brow": (37.0, 59.0),
        "ala": (s.nose_width + 5.5, tip[1] - 12.0),
        "eye_outer": (e + 13.5, 31.5),
        "eye_inner": (e - 13.5, 31.5),
        "mouth_corner": (w + 0.5, y - 2.0),
    }
    scale = (s.width, s.height)
    out = {name: (0.0, height * scale[1]) for name, height in middle.items()}
    for name, (x, height) in pairs.items():
        out[f"{name}_right"], out[f"{name}_left"] = (
            (-x * scale[0], height * scale[1]),
            (x * scale[0], height * scale[1]),
        )
    return out


def _front(flat: Array, shape: FaceShape) -> Array:
    """The foremost points (n, 3) of the skin at x, y (n, 2), by bisection after a coarse march."""
    depth = np.linspace(150, 20, 131)
    line = np.concatenate(
        [np.repeat(flat, len(depth), axis=0), np.tile(depth, len(flat))[:, None]],
        axis=1,
    )
    inside = np.argmax((field(line, shape) < 0).reshape(len(flat), -1), axis=1)
    low = depth[inside]
    high = depth[inside - 1]
    for _ in range(30):
        middle = (low + high) / 2
        below = field(np.column_stack([flat, middle]), shape) < 0
        low = np.where(below, middle, low)
        high = np.where(below, high, middle)
    return np.column_stack([flat, low])


def _soft(value: Array, width: float) -> Array:
    """Smooth step: 0 below -width, 0.5 at 0, 1 above width."""
    t = np.clip(0.5 + 0.5 * value / width, 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def region_membership(points: Array, shape: FaceShape) -> dict[str, Array]:
    """Membership in [0, 1] of points (n, 3) in each region of `REGIONS`."""
    s = shape
    x = np.abs(points[:, 0]) / s.width
    y = points[:, 1] / s.height
    z = points[:, 2]
    tip = s.nose_tip
    mouth = s.mouth_height
    front = _soft(z - 20, 12)
    down = np.clip((44 - y) / (44 - tip[1] + 14), 0, 1)
    nose_half = 7.0 + (s.nose_width - 0.5) * down**1.6
    nose = (
        _soft(nose_half - x, 3)
        * _soft(46 - y, 5)
        * _soft(y - tip[1] + 17.0, 2)
        * _soft(z - 90, 6)
    )
    lips = _lips(x, y, z, s)
    neck = _soft(-88 + 0.62 * (95 - z) * 0.5 - y, 6) * front**0
    chin = (
        _soft(22 - np.hypot(x * 0.85, (y + 72) * 1.0), 5)
        * _soft(z - 70, 8)
        * (1 - neck)
        * (1 - lips)
    )
    forehead = _soft(y - 66, 6) * _soft(66 - x, 10) * front
    oval = 1 - np.hypot((y + 14) / 38, (z - 72) / 52)
    cheek = _soft(oval, 0.2) * _soft(x - 19 - 0.22 * np.maximum(-8 - y, 0), 5)
    brow = (
        _soft(3.6 - np.abs(y - _brow_height(x, s)), 2.2)
        * _soft(19.5 - np.abs(x - 32), 5)
        * _soft(z - 50, 8)
    )
    eyelid = _soft(1 - np.hypot((x - s.eye_distance) / 17, (y - 32) / 9), 0.25) * _soft(
        z - 60, 8
    )
    lower = (
        _soft(-12 - y + 0.35 * np.maximum(x - 40, 0), 7)
        * _soft(-26 - mouth + 0 * x + 90, 1)
        * _soft(y + 100, 10)
    )
    beard = (
        lower * (1 - lips) * (1 - nose) * _soft(z - 25, 10) * _moustache(x, y, mouth)
    )
    cheek = cheek * (1 - nose) * (1 - eyelid)
    fields = (
        forehead,
        nose,
        cheek,
        lips,
        chin,
        neck,
        beard,
        brow,
        eyelid,
        _lashes(points, s),
    )
    return dict(zip(REGIONS, fields, strict=True))


def _lips(x: Array, y: Array, z: Array, s: FaceShape) -> Array:
    """The red of the lips: between two arcs that meet in the corners."""
    line = s.mouth_height + mouth_line(x)
    taper = np.sqrt(np.clip(1 - (x / (s.mouth_width - 0.5)) ** 2, 0, 1))
    bow = (
        1.0
        + 0.22 * np.exp(-0.5 * ((x - 6) / 4) ** 2)
        - 0.1 * np.exp(-0.5 * (x / 3) ** 2)
    )
    upper = (5.2 + 3.2 * s.lip_fullness) * taper * bow
    lower = (6.6 + 3.6 * s.lip_fullness) * taper
    return (
        _soft(upper - (y - line), 0.9)
        * _soft(lower + (y - line), 0.9)
        * _soft(taper - 0.08, 0.08)
        * _soft(z - 70, 8)
    )


def _brow_height(x: Array, s: FaceShape) -> Array:
    return np.asarray(58.0 + 2.0 * s.brow - 0.012 * (x - 34) ** 2)


def _moustache(x: Array, y: Array, mouth: float) -> Array:
    """1 where hair grows, which excludes the centre of the cheeks and the area below
    the outer sides of the nose.
    """
    free = _soft(16 - np.hypot((x - 36) * 0.8, (y - mouth - 16) * 1.0), 6)
    return np.asarray(1 - free)


def _lashes(points: Array, shape: FaceShape) -> Array:
    """How dark the closed lids' lashes make each point, 0 to 1."""
    x = np.abs(points[:, 0]) / shape.width
    y = points[:, 1] / shape.height
    across = np.exp(-0.5 * ((y - lid_height(x, shape) + 0.6) / 1.3) ** 2)
    return np.asarray(
        across
        * _soft(14.5 - np.abs(x - shape.eye_distance), 2)
        * _soft(points[:, 2] - 60, 8)
    )
