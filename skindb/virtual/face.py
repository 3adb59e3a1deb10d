"""The virtual face as one smooth function of space, zero on the skin: smooth unions of
simple solids; and its landmarks and regions.
"""

from dataclasses import dataclass

import numpy as np

from skindb.types import Float64, float64, unit

STEP = 0.02  # mm, of the central differences that give the normal
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


@dataclass(frozen=True)
class FaceShape:
    """Parameters of a face: lengths in mm, others are factors or amounts in [0, 1]."""

    width: float = 1.0  # scale of the whole head along x
    height: float = 1.0  # along y
    jaw_width: float = 53.0
    chin_forward: float = 0.0
    chin_width: float = 17.0
    nose_length: float = 0.0  # added to the tip's distance below the nasion
    nose_height: float = 0.0  # added to the tip's distance in front of the face
    nose_width: float = 11.0
    bridge_depth: float = 0.0  # how far the bridge lies back
    brow: float = 0.4
    eye_distance: float = 31.0
    eye_size: float = 12.6
    cheekbone: float = 0.5
    fullness: float = 0.5
    lip_fullness: float = 0.5
    mouth_width: float = 25.0
    sagging: float = 0.0
    neck_width: float = 50.0
    asymmetry: float = 0.0  # mm, sideways bend of the midline

    @property
    def nose_tip(self) -> Float64:
        """Centre of the tip's ball."""
        return np.array([0.0, 7.0 - self.nose_length, 113.0 + self.nose_height])

    @property
    def mouth_height(self) -> float:
        """Height of the line between the lips."""
        return -33.5 - 0.4 * self.nose_length


def field(points: Float64, shape: FaceShape) -> Float64:
    """Approximate signed distance (n,) mm of `points` (n, 3) to the skin, negative
    inside; smooth near the skin.
    """
    # one row per axis, as NumPy is slow for sums over a short last axis
    x = points[:, 0] / shape.width
    y = points[:, 1] / shape.height
    z = points[:, 2]
    x = x - shape.asymmetry * np.cos(y / 35.0 + 1.0)
    q = np.stack([np.sqrt(x * x + 1.0), y, z])  # mirrored, and smooth at the midline
    distance = _skull(q, shape)
    distance = _middle(q, distance, shape)
    distance = _eyes(q, distance, shape)
    distance = _nose(q, distance, shape)
    return _mouth(q, distance, shape)


def normals(points: Float64, shape: FaceShape) -> Float64:
    """Unit outward normals (n, 3) at points on the skin: the field's gradient."""
    step = STEP * np.eye(3)
    slope = np.stack(
        [field(points + d, shape) - field(points - d, shape) for d in step], axis=1
    )
    return unit(slope)


def _ellipsoid(
    p: Float64, centre: tuple[float, ...] | Float64, radii: tuple[float, ...]
) -> Float64:
    scale = float64(radii)[:, None]
    q = (p - float64(centre)[:, None]) / scale
    length = np.sqrt((q**2).sum(axis=0) + 1e-9)
    return length * (length - 1) / np.sqrt(((q / scale) ** 2).sum(axis=0) + 1e-12)


def _cone(
    p: Float64,
    a: tuple[float, ...] | Float64,
    b: tuple[float, ...] | Float64,
    ra: float,
    rb: float,
) -> Float64:
    """Round cone: a capsule from `a` to `b` whose radius runs from ra to rb."""
    start = float64(a)[:, None]
    axis = float64(b)[:, None] - start
    q = p - start
    along = np.clip((q * axis).sum(axis=0) / (axis**2).sum(), 0, 1)
    along = along * along * (3 - 2 * along)  # soft at both ends
    return np.sqrt(((q - along * axis) ** 2).sum(axis=0)) - ra - along * (rb - ra)


def _join(a: Float64, b: Float64, blend: float) -> Float64:
    """Smooth union: cubic polynomial minimum, twice differentiable."""
    h = np.maximum(blend - np.abs(a - b), 0) / blend
    return np.minimum(a, b) - h**3 * blend / 6


def _carve(a: Float64, b: Float64, blend: float) -> Float64:
    """Smooth difference: `a` without `b`."""
    return -_join(-a, b, blend)


def _bell(*distances: Float64) -> Float64:
    """Gaussian of the distance whose components are given."""
    return np.exp(-0.5 * sum(distance**2 for distance in distances))


def _press(
    p: Float64,
    distance: Float64,
    centre: tuple[float, ...],
    width: tuple[float, ...],
    depth: float,
) -> Float64:
    """Push the skin in by `depth` under a Gaussian (a negative depth lifts it)."""
    q = (p - float64(centre)[:, None]) / float64(width)[:, None]
    return distance + depth * _bell(*q)


def _skull(p: Float64, s: FaceShape) -> Float64:
    d = _ellipsoid(p, (0, 50, 4), (76, 100, 93))
    d = _join(d, _ellipsoid(p, (0, 84, 42), (58, 44, 50)), 40)
    d = _join(d, _ellipsoid(p, (0, -8, 22), (65, 92, 78)), 40)
    d = _join(
        d,
        _cone(p, (s.jaw_width - 14, -38, 18), (10, -70 + 2 * s.sagging, 74), 20, 17),
        30,
    )
    neck = _cone(p, (0, -40, -8), (0, -230, -22), s.neck_width, s.neck_width + 6)
    return _join(d, neck, 24)


def _middle(p: Float64, d: Float64, s: FaceShape) -> Float64:
    d = _join(d, _ellipsoid(p, (0, -29, 74), (35, 34, 34.5)), 26)  # around the teeth
    d = _join(d, _ellipsoid(p, (44, 10, 62), (20, 17, 22 + 4 * s.cheekbone)), 34)
    d = _join(
        d,
        _ellipsoid(p, (37, -22 - 5 * s.sagging, 66), (18, 26, 19 + 6 * s.fullness)),
        32,
    )
    d = _join(
        d,
        _ellipsoid(p, (0, -70, 80 + s.chin_forward), (s.chin_width + 3, 15, 19.5)),
        26,
    )
    d = _press(p, d, (0, -52, 102), (16, 5, 20), 2.6)  # between lower lip and chin
    furrow = np.sin(2 * np.pi * (p[1] + 0.0015 * p[0] ** 2) / 10.5) * np.exp(
        -0.5 * (p[0] / 30) ** 4
    )
    d = d + 0.45 * s.sagging * furrow * np.exp(-0.5 * ((p[1] - 84) / 11) ** 4)
    fold = _cone(p, (19, -6, 104), (34, -42, 92), 3.0, 2.0)
    return _carve(d, fold + 4.0 - 3.0 * s.sagging, 7)


def _eyes(p: Float64, d: Float64, s: FaceShape) -> Float64:
    ridge = _cone(p, (6, 54, 88 + 3 * s.brow), (40, 58, 74 + 2 * s.brow), 10, 8)
    d = _join(d, ridge, 30)
    x = s.eye_distance
    d = _carve(d, _ellipsoid(p, (x, 33, 108), (19, 12.5, 21)), 16)
    d = _carve(d, _ellipsoid(p, (x - 14, 35, 106), (7, 9, 12)), 12)
    ball = (
        np.sqrt((0.9 * (p[0] - x)) ** 2 + (p[1] - 32.5) ** 2 + (p[2] - 78.5) ** 2)
        - s.eye_size
    )
    d = _join(d, ball, 5)
    arc = 37.5 - 0.012 * (p[0] - x) ** 2
    crease = (
        np.hypot((p[1] - arc) / 1.0, (p[2] - 91) / 12)
        + np.maximum(np.abs(p[0] - x) - 13, 0) ** 2 / 12
    )
    d = d + 0.9 * _bell(crease)
    slit = np.hypot((p[1] - lid_height(p[0], s)) / 0.9, (p[2] - 90) / 12)
    d = d + 0.7 * _bell(slit, np.maximum(np.abs(p[0] - x) - 13, 0) / 2)
    # below the eye
    return _press(p, d, (x - 3, 18, 92), (11, 3.5, 14), 1.6 * s.sagging)


def lid_height(x: Float64, s: FaceShape) -> Float64:
    """Height of the closed lids' line at |x|."""
    return 29.0 + 0.012 * (x - s.eye_distance) ** 2


def _nose(p: Float64, d: Float64, s: FaceShape) -> Float64:
    tip = s.nose_tip
    bridge = _cone(
        p, (0, 44, 91 - s.bridge_depth), tip + np.array([0.0, 4.0, -3.0]), 8.0, 9.5
    )
    d = _join(d, bridge, 18)
    d = _join(d, _ellipsoid(p, tip - np.array([0.0, 0.5, 0.0]), (11.0, 9.5, 11.5)), 12)
    w = s.nose_width
    d = _join(d, _ellipsoid(p, (w, tip[1] - 11, tip[2] - 12), (6.5, 7.5, 10.5)), 9)
    # columella
    d = _join(
        d,
        _cone(p, tip - np.array([0.0, 7.0, 2.0]), (0, tip[1] - 15, tip[2] - 12), 6, 5),
        8,
    )
    groove = np.hypot((p[0] - w + 4.5) / 2.6, (p[1] - tip[1] + 16) / 3.5)
    nostril = np.hypot(groove, (p[2] - tip[2] + 6) / 6)
    d = d + 2.4 * _bell(nostril)
    alar = np.hypot(p[0] - w, (p[1] - tip[1] + 9) * 0.9) - 10.5
    return d + 0.9 * _bell(alar / 2.0, (p[2] - tip[2] + 14) / 7)


def _mouth(p: Float64, d: Float64, s: FaceShape) -> Float64:
    y = s.mouth_height
    w = s.mouth_width
    full = s.lip_fullness
    bow = -0.0045 * p[0] ** 2 + 1.2 * _bell((p[0] - 6) / 4)
    q = np.stack([p[0], p[1] - bow, p[2] + 0.014 * p[0] ** 2])
    upper = _ellipsoid(q, (0, y + 3.2, 102.0), (w, 5.6 + 3.4 * full, 9.2 + 3.4 * full))
    d = _join(d, upper, 8)
    lower = _ellipsoid(
        q, (0, y - 5.2, 100.8), (w - 4, 6.6 + 3.8 * full, 10.0 + 3.6 * full)
    )
    d = _join(d, lower, 9)
    line = y + mouth_line(p[0])
    inside = np.maximum(np.abs(p[0]) - w + 1, 0) / 2.0
    d = d + 2.6 * _bell((p[1] - line) / 1.5, inside, (p[2] - 108) / 16)
    # corners
    d = _press(p, d, (w + 2.0, y - 1.5, 96), (4.5, 5, 12), 1.0 + 0.5 * s.sagging)
    return _press(p, d, (0, y + 14, 110), (3.0, 6, 10), 1.3)  # philtrum


def mouth_line(x: Float64) -> Float64:
    """Height of the line between the lips at |x|, above `mouth_height`."""
    return -0.6 * _bell(x / 4) + 0.8 * _bell((np.abs(x) - 8) / 5) - 0.003 * x**2


def landmark_directions(shape: FaceShape, centre: Float64) -> dict[str, Float64]:
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


def _front(flat: Float64, shape: FaceShape) -> Float64:
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


def _soft(value: Float64, width: float) -> Float64:
    """Smooth step: 0 below -width, 0.5 at 0, 1 above width."""
    t = np.clip(0.5 + 0.5 * value / width, 0, 1)
    return t * t * (3 - 2 * t)


def region_membership(points: Float64, shape: FaceShape) -> dict[str, Float64]:
    """Membership in [0, 1] of points (n, 3) in each region of `REGIONS`."""
    s = shape
    x = np.abs(points[:, 0]) / s.width
    y = points[:, 1] / s.height
    z = points[:, 2]
    nose = _nose_region(x, y, z, s)
    lips = _lips(x, y, z, s)
    neck = _soft(-88 + 0.62 * (95 - z) * 0.5 - y, 6)
    chin = _soft(22 - np.hypot(x * 0.85, (y + 72) * 1.0), 5) * _soft(z - 70, 8)
    eyelid = _soft(1 - np.hypot((x - s.eye_distance) / 17, (y - 32) / 9), 0.25)
    eyelid = eyelid * _soft(z - 60, 8)
    oval = 1 - np.hypot((y + 14) / 38, (z - 72) / 52)
    cheek = _soft(oval, 0.2) * _soft(x - 19 - 0.22 * np.maximum(-8 - y, 0), 5)
    height = 58.0 + 2.0 * s.brow - 0.012 * (x - 34) ** 2
    brow = _soft(3.6 - np.abs(y - height), 2.2)
    lower = _soft(-12 - y + 0.35 * np.maximum(x - 40, 0), 7) * _soft(y + 100, 10)
    # the centre of the cheeks and below the outer sides of the nose, where no beard grows
    hairless = _soft(16 - np.hypot((x - 36) * 0.8, y - s.mouth_height - 16), 6)
    fields = {
        "forehead": _soft(y - 66, 6) * _soft(66 - x, 10) * _soft(z - 20, 12),
        "nose": nose,
        "cheek": cheek * (1 - nose) * (1 - eyelid),
        "lips": lips,
        "chin": chin * (1 - neck) * (1 - lips),
        "neck": neck,
        "beard": lower * (1 - lips) * (1 - nose) * _soft(z - 25, 10) * (1 - hairless),
        "brow": brow * _soft(19.5 - np.abs(x - 32), 5) * _soft(z - 50, 8),
        "eyelid": eyelid,
        "lash": _lashes(points, s),
    }
    return {name: fields[name] for name in REGIONS}


def _nose_region(x: Float64, y: Float64, z: Float64, s: FaceShape) -> Float64:
    """The nose, which widens from its root to the wings."""
    tip = s.nose_tip[1]
    down = np.clip((44 - y) / (44 - tip + 14), 0, 1)
    half_width = 7.0 + (s.nose_width - 0.5) * down**1.6
    return (
        _soft(half_width - x, 3)
        * _soft(46 - y, 5)
        * _soft(y - tip + 17.0, 2)
        * _soft(z - 90, 6)
    )


def _lips(x: Float64, y: Float64, z: Float64, s: FaceShape) -> Float64:
    """The red of the lips: between two arcs that meet in the corners."""
    line = s.mouth_height + mouth_line(x)
    taper = np.sqrt(np.clip(1 - (x / (s.mouth_width - 0.5)) ** 2, 0, 1))
    bow = 1.0 + 0.22 * _bell((x - 6) / 4) - 0.1 * _bell(x / 3)
    upper = (5.2 + 3.2 * s.lip_fullness) * taper * bow
    lower = (6.6 + 3.6 * s.lip_fullness) * taper
    return (
        _soft(upper - (y - line), 0.9)
        * _soft(lower + (y - line), 0.9)
        * _soft(taper - 0.08, 0.08)
        * _soft(z - 70, 8)
    )


def _lashes(points: Float64, shape: FaceShape) -> Float64:
    """How dark the closed lids' lashes make each point, 0 to 1."""
    x = np.abs(points[:, 0]) / shape.width
    y = points[:, 1] / shape.height
    across = _bell((y - lid_height(x, shape) + 0.6) / 1.3)
    return (
        across
        * _soft(14.5 - np.abs(x - shape.eye_distance), 2)
        * _soft(points[:, 2] - 60, 8)
    )
