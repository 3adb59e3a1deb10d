"""The hero: one virtual head with pores, wrinkles, ears, closed eyes and cropped hair, sculpted
by formulas, photographed at 0.3 mm per pixel, fitted, and rendered from its model.

    python -m benchmarks hero --out FOLDER

writes the capture, a database, the page of the viewer and the pictures of the documentation into
FOLDER. A capture that exists is not photographed again.
"""

from __future__ import annotations

import io
import json
import resource
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import trimesh
import xarray as xr
from numpy.typing import ArrayLike
from PIL import Image
from scipy.interpolate import make_interp_spline
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

import skindb
from skindb import workflow
from skindb.demo.page import map_pictures
from skindb.geometry.mesh import edge_table, subdivide, vertex_areas, vertex_normals
from skindb.parameters import FitParameters
from skindb.reflectance.mixture import Mixture
from skindb.render.image import shown_part, tone_map
from skindb.render.photographs import (
    Comparison,
    compare_photographs,
)
from skindb.render.scene import Surface
from skindb.types import Array, Index, lengths, unit
from skindb.virtual.capture import (
    SCAN_REGIONS,
    _materials,
    capture_record,
    dome_record,
    session_time,
)
from skindb.virtual.dome import CENTRE, Dome, Sensor, build_dome, photograph
from skindb.virtual.face import FaceShape, region_membership
from skindb.virtual.head import Head
from skindb.virtual.person import Person
from skindb.virtual.probe import write_probe
from skindb.virtual.skin import Site, skin_of, skin_tables, smooth_noise

SHAPE = FaceShape(lip_fullness=0.3, brow=0.6, nose_width=11.5, mouth_width=25.5)
PERSON = Person(
    "H001",
    age=38,
    gender="male",
    ancestry="european",
    seed=7,
    freckles=0.25,
    blood=0.4,
)
LOW = np.array(
    [-104.0, -150.0, -104.0]
)  # mm, corner of the sculpted box: the neck is cut
HIGH = np.array([104.0, 160.0, 134.0])
EYE = np.array([31.0, 32.0, 76.5])
EYE_RADIUS = 13.0
EAR = np.array([73.0, 22.0, -6.0])
GRADIENT_MM = 0.02
SAMPLES = 200  # of a wrinkle
ETA = 1.3
HAIR_MM = 1.6
OPACITY = {"cut": 0.85, "brow": 0.8, "lash": 0.75, "stubble": 0.62}
PORES = {"nose": 0.9, "cheek": 0.5, "forehead": 0.3, "chin": 0.4}  # mm^-2
FRAME_MM = (222.0, 318.0)  # of a picture, on the face
MIDDLE = np.array([0.0, 2.0, 10.0])  # of the pictures
SCAN_MM = 2.4
MAX_BYTES = 150_000  # of a picture of the documentation
EXPOSED = 1.1  # brightness of the figures
LIGHTS_FROM = ("70,25", "10,30")  # azimuth and elevation [degrees]
DARK = 8  # of 255: background
VIEWER_MS = 8000  # until the page has drawn its final picture
KEPT = 4  # photographs that ingest keeps
HAIR_COLOUR = np.array([0.040, 0.029, 0.022])


def ellipsoid(p: Array, centre: Array | tuple, radii: tuple) -> Array:
    """Approximate signed distance (n,) of points (3, n)."""
    scale = np.array(radii, float)[:, None]
    q = (p - np.array(centre, float)[:, None]) / scale
    length = np.sqrt((q**2).sum(axis=0) + 1e-9)
    return length * (length - 1) / np.sqrt(((q / scale) ** 2).sum(axis=0) + 1e-12)


def cone(p: Array, a: tuple, b: tuple, ra: float, rb: float) -> Array:
    """A capsule from `a` to `b` whose radius runs from ra to rb."""
    start = np.array(a, float)[:, None]
    axis = np.array(b, float)[:, None] - start
    along = np.clip(((p - start) * axis).sum(axis=0) / (axis**2).sum(), 0, 1)
    along = along * along * (3 - 2 * along)
    return (
        np.sqrt(((p - start - along * axis) ** 2).sum(axis=0)) - ra - along * (rb - ra)
    )


def join(a: Array, b: Array, blend: float) -> Array:
    """Smooth union."""
    h = np.maximum(blend - np.abs(a - b), 0) / blend
    return np.minimum(a, b) - h**3 * blend / 6


def carve(a: Array, b: Array, blend: float) -> Array:
    """Smooth difference: `a` without `b`."""
    return -join(-a, b, blend)


def bell(*distances: Array) -> Array:
    """Gaussian of the distance with these components."""
    return np.exp(-0.5 * sum(distance**2 for distance in distances))


def step(value: Array, width: float) -> Array:
    """Smooth step from 0 at -width to 1 at width."""
    t = np.clip(0.5 + 0.5 * value / width, 0, 1)
    return t * t * (3 - 2 * t)


def even(points: Array) -> Array:
    """Coordinates (3, n) in which the face is symmetric; no face is."""
    x, y, z = points.T
    x = x - 0.7 * np.cos(y / 35 + 1) - 0.5 * np.sin(y / 23 + z / 40)
    y = y - 0.7 * np.sin(x / 45 + 0.4) - 0.4 * np.sin(x / 17 + z / 31)
    z = z - 0.5 * np.sin(x / 38 + y / 50)
    return np.stack([x, y, z])


def field(points: Array) -> Array:
    """Approximate signed distance (n,) mm of points (n, 3) to the smooth head."""
    p = even(points)
    p[0] = np.sqrt(p[0] ** 2 + 1.0)
    return ears(p, mouth(p, nose(p, eyes(p, cheeks(p, skull(p))))))


def skull(p: Array) -> Array:
    """Cranium, jaw and neck."""
    d = ellipsoid(p, (0, 54, 2), (75, 94, 92))
    d = join(d, ellipsoid(p, (0, 78, 42), (60, 48, 52)), 40)
    d = join(d, ellipsoid(p, (0, -5, 20), (61, 88, 72)), 40)
    d += 2.0 * bell((p[0] - 70) / 14, (p[1] - 58) / 22, (p[2] - 56) / 18)  # temple
    neck = cone(p, (0, -30, -8), (0, -210, -30), 50, 56)
    neck = join(neck, cone(p, (48, -25, -18), (12, -175, 26), 9, 8), 16)
    neck = join(neck, ellipsoid(p, (0, -112, 25), (10, 16, 12)), 24)
    d = join(d, neck, 16)
    d = join(d, cone(p, (39, -40, 12), (14, -68, 72), 16, 15), 22)
    d = join(d, ellipsoid(p, (0, -68, 50), (34, 15, 36)), 22)
    return join(d, ellipsoid(p, (0, -70, 80), (20, 14, 17.5)), 22)


def cheeks(p: Array, d: Array) -> Array:
    """Muzzle, cheekbones, cheeks and their folds."""
    d = join(d, ellipsoid(p, (0, -30, 72), (34, 34, 34)), 26)
    d = join(d, ellipsoid(p, (45, 13, 58), (20, 14, 23)), 30)
    d = join(d, cone(p, (50, 13, 54), (66, 14, 12), 8, 6), 22)
    d = join(d, ellipsoid(p, (37, -18, 62), (20, 28, 24)), 30)
    d = join(d, ellipsoid(p, (27, -50, 70), (18, 18, 20)), 24)
    d += 0.6 * bell(p[0] / 18, (p[1] + 54) / 5.5, (p[2] - 102) / 20)  # above the chin
    fold = 17.5 - 0.42 * (p[1] + 1) + 0.004 * (p[1] + 1) ** 2
    across = (p[0] - fold) * 0.85
    along = step(p[1] + 40, 10) * step(4 - p[1], 6) * step(p[2] - 70, 8)
    d += along * (0.6 * bell(across / 2.6) - 0.7 * bell((across - 7) / 5))
    lower = (p[0] - 29 + 0.15 * (p[1] + 52)) / 3
    return d + 0.25 * bell(lower, (p[1] + 50) / 9, (p[2] - 90) / 16)


def lid_line(x: Array) -> Array:
    """Height of the line between the closed lids at |x|."""
    u = (x - EYE[0]) / 14
    return EYE[1] - 3.6 + 2.6 * u**2 + 0.5 * u


def eyes(p: Array, d: Array) -> Array:
    """Brow, orbits, and closed lids."""
    d = join(d, cone(p, (8, 53, 85.5), (42, 55, 63), 9.5, 8), 28)
    d = carve(d, ellipsoid(p, (31, 33, 106.5), (17.5, 12, 19.5)), 16)
    d = carve(d, ellipsoid(p, (15.5, 36, 105), (6.5, 9, 12)), 12)
    d = join(d, ellipsoid(p, (33, 45, 79), (18, 8, 11)), 16)  # fat above the lid
    x, y, z = p
    u = (x - EYE[0]) / 14
    line = lid_line(x)
    inside = step(1 - np.abs(u), 0.12) * step(z - 70, 8)
    ball = np.sqrt((0.93 * (x - EYE[0])) ** 2 + (y - EYE[1]) ** 2 + (z - EYE[2]) ** 2)
    lids = ball - EYE_RADIUS - 0.9 * step(y - line + 0.2, 0.9) * inside
    d = join(d, lids, 9)
    d += inside * 0.5 * bell((y - line + 0.5) / 0.5)
    outer = step(1 - np.abs(u) * 0.86, 0.25) * step(z - 62, 8)
    crease = EYE[1] + 6.6 - 3.4 * u**2 + 0.6 * u
    d += outer * (0.35 * bell((y - crease) / 0.9) - 0.4 * bell((y - crease - 3) / 2.4))
    bag = EYE[1] - 12.5 + 3.4 * (u + 0.1) ** 2
    return d + outer * (0.4 * bell((y - bag) / 1.8) - 0.4 * bell((y - bag - 4) / 2.5))


def nose(p: Array, d: Array) -> Array:
    """Bridge, tip, wings and nostrils."""
    d = join(d, cone(p, (0, 43, 88), (0, 12, 108), 7, 7.5), 16)
    d = join(d, ellipsoid(p, (0, 14, 94), (14, 22, 14)), 12)
    d = join(d, ellipsoid(p, (0, 5.5, 111), (9.5, 8.5, 9.5)), 11)
    d = join(d, ellipsoid(p, (10.5, 0.5, 101), (6.6, 7.2, 10)), 10)
    d = join(d, cone(p, (0, -0.5, 112), (0, -10, 102), 4.4, 4.6), 7)
    nostril = ellipsoid(p, (6.2, -9, 104), (2.4, 5.5, 4.4))
    d = carve(d, nostril, 3)
    wing = np.hypot(p[0] - 10.5, (p[1] - 0.5) * 0.95) - 8.2
    return d + 0.6 * bell(wing / 1.5, (p[2] - 98) / 5) * step(p[0] - 11, 4)


def mouth_line(x: Array) -> Array:
    """Height of the line between the lips at |x|."""
    return -33.5 - 0.5 * bell(x / 4) + 0.7 * bell((x - 9) / 6) - 0.0028 * x**2


def mouth(p: Array, d: Array) -> Array:
    """Lips and philtrum."""
    x = p[0]
    bow = -0.0045 * x**2 + 1.2 * bell((x - 6) / 4)
    q = np.stack([x, p[1] - bow, p[2] + 0.014 * x**2])
    d = join(d, ellipsoid(q, (0, -30.0, 101.5), (25, 6.8, 11.6)), 6)
    d = join(d, ellipsoid(q, (0, -39.4, 99.5), (21.5, 8.4, 12.2)), 11)
    inside = step(26 - x, 3) * step(p[2] - 80, 8)
    d += inside * 1.7 * bell((p[1] - mouth_line(x)) / 1.0)
    d += 1.0 * bell((x - 27) / 3.5, (p[1] + 36) / 4, (p[2] - 95) / 12)
    philtrum = bell(x / 2.6) - 0.5 * bell((x - 5) / 1.8)
    return d + 1.0 * philtrum * bell((p[1] + 19) / 5, (p[2] - 108) / 9)


def ear_frame(p: Array) -> Array:
    """Coordinates (3, n) of the ear: forward, up and outward."""
    q = p - EAR[:, None]
    tilt, flare = np.radians([12, 22])
    up = np.array([0, np.cos(tilt), -np.sin(tilt)])
    ahead = np.array([0, np.sin(tilt), np.cos(tilt)])
    out = np.cos(flare) * np.array([1.0, 0, 0]) + np.sin(flare) * ahead
    forward = np.cos(flare) * ahead - np.sin(flare) * np.array([1.0, 0, 0])
    return np.stack([forward @ q, up @ q, out @ q])


def ear(p: Array) -> Array:
    """Distance (n,) to the ear alone."""
    u, v, w = q = ear_frame(p)
    narrow = u + 0.0 * v
    turn = np.hypot(narrow / 15.5, (v - 3) / 28)
    around = (turn - 1) * 18
    d = ellipsoid(q, (0, 1, 4), (15, 28, 3.2))
    d = join(d, ellipsoid(q, (6, -3, -2), (10, 22, 9)), 6)
    front = step(u - 3, 5) * step(6 - v, 8)  # the rim ends above the ear canal
    helix = np.hypot(around, w - 6.5) - 2.6 + 4 * front
    d = join(d, helix, 3)
    inner = (np.hypot((u - 2) / 9.5, (v - 2) / 17) - 1) * 12
    d = join(d, np.hypot(inner, w - 6) - 2.0 + 5 * step(u - 3, 3), 3)
    d = carve(d, ellipsoid(q, (3.5, -3, 9), (6.5, 10.5, 8)), 4)
    d = join(d, ellipsoid(q, (3.5, -22.5, 4), (8, 8.5, 3.8)), 5)
    return join(d, ellipsoid(q, (11.5, -4, 4), (3.2, 5.5, 4)), 3)


def ears(p: Array, d: Array) -> Array:
    """The head with its ears."""
    near = (np.abs(p[1] - EAR[1]) < 50) & (np.abs(p[2] - EAR[2]) < 45) & (p[0] > 50)
    out = d.copy()
    out[near] = join(d[near], ear(p[:, near]), 5)
    return out


def normals(points: Array) -> Array:
    """Unit gradients (n, 3) of the field."""
    shifts = GRADIENT_MM * np.eye(3)
    return unit(
        np.stack([field(points + e) - field(points - e) for e in shifts], axis=1)
    )


def settled(points: Array, rounds: int = 3) -> Array:
    """Points moved onto the surface by Newton's method with bounded steps."""
    for _ in range(rounds):
        value = field(points)
        shifts = GRADIENT_MM * np.eye(3)
        slope = (
            np.stack([field(points + e) - value for e in shifts], axis=1) / GRADIENT_MM
        )
        steep = np.maximum((slope**2).sum(axis=1), 0.09)
        move = (value / steep)[:, None] * slope
        size = np.sqrt((move**2).sum(axis=1, keepdims=True))
        points = points - move * np.minimum(1, 0.6 / np.maximum(size, 1e-9))
        points[:, 1] = np.maximum(points[:, 1], LOW[1])
    return points


def sculpt(spacing: float, levels: int = 0) -> tuple[Array, Index]:
    """Vertices (n, 3) mm and triangles (f, 3) of the smooth head, open at the cut of the neck,
    `spacing` mm apart before `levels` subdivisions.
    """
    axes = [np.arange(a, b, spacing) for a, b in zip(LOW, HIGH, strict=True)]
    slabs = []
    for x in axes[0]:
        y, z = np.meshgrid(axes[1], axes[2], indexing="ij")
        points = np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1)
        slabs.append(field(points).reshape(y.shape))
    vertices, faces, _, _ = marching_cubes(np.array(slabs), 0.0, spacing=(spacing,) * 3)
    vertices = vertices.astype(float) + LOW
    faces = faces.astype(np.int64)
    if (vertex_normals(vertices, faces) * vertices).sum() < 0:
        faces = faces[:, ::-1]
    vertices = relaxed(vertices, faces, 6)
    if levels:
        vertices, faces, _ = subdivide(vertices, faces, levels)
        vertices = settled(vertices)
    return vertices, faces


def relaxed(vertices: Array, faces: Index, rounds: int) -> Array:
    """Vertices moved towards the mean of their neighbours within the surface."""
    edges = edge_table(faces).edges
    count = np.bincount(edges.ravel(), minlength=len(vertices))[:, None]
    fixed = vertices[:, 1] < LOW[1] + 0.01
    for _ in range(rounds):
        total = np.zeros_like(vertices)
        np.add.at(total, edges[:, 0], vertices[edges[:, 1]])
        np.add.at(total, edges[:, 1], vertices[edges[:, 0]])
        move = total / count - vertices
        across = normals(vertices)
        move -= (move * across).sum(axis=1, keepdims=True) * across
        move[fixed] = 0
        vertices = settled(vertices + 0.6 * move, 2)
    return vertices


def hair_line(points: Array) -> Array:
    """Fraction (n,) of the skin that cropped hair covers."""
    x, y, z = p = even(points)
    p[0] = np.abs(x)
    height = [-60, -45, -25, -6, 16, 30, 45, 66, 80, 92, 102, 112, 130]
    front = [-70, -42, -28, -26, 22, 24, 31, 47, 54, 60, 80, 110, 140]
    recess = 9 * bell((p[0] - 40) / 13) - 3 * bell(p[0] / 14)
    behind = np.interp(y - recess, height, front) - z
    cover = step(behind + 1.5 * np.sin(y / 3.1 + x / 2.7), 5)
    q = ear_frame(p)
    around = np.hypot(q[0] / 19, (q[1] - 3) / 32) - 1
    outside = np.where(p[0] > 55, step(around * 20 - 1.5, 4), 1.0)
    return cover * outside


def broad_relief(points: Array) -> Array:
    """Height (n,) mm that the scan shows too: unevenness, and hair."""
    rng = np.random.default_rng([PERSON.seed, 20])
    lumps = [(40, 0.30), (16, 0.10), (7, 0.03)]
    total = sum(a * smooth_noise(points, w, rng=rng) for w, a in lumps)
    return total + HAIR_MM * hair_line(points) ** 3  # the rim is in the hair


def curve(places: ArrayLike, depth: float, width: float) -> tuple[Array, float, float]:
    """A wrinkle through places (x, y) mm of the front, with its depth and width."""
    places = np.asarray(places, float)
    at = np.linspace(0, 1, len(places))
    fine = np.linspace(0, 1, SAMPLES)
    spline = make_interp_spline(at, places, k=min(2, len(places) - 1))
    return spline(fine), depth, width


def wrinkles(rng: np.random.Generator) -> list[tuple[Array, float, float]]:
    """Curves (SAMPLES, 2), depth and width [mm] of all wrinkles."""
    lines = []
    for y, reach, depth in (
        (74, 30, 0.22),
        (83, 37, 0.34),
        (92, 36, 0.30),
        (99, 25, 0.16),
    ):
        x = np.linspace(-reach, reach, 9) + rng.normal(0, 1, 9)
        lift = 2.2 * np.cos(x / 8 + rng.uniform(-0.5, 0.5)) - 0.0012 * x**2
        lines.append(
            curve(np.column_stack([x, y + lift + rng.normal(0, 0.5, 9)]), depth, 0.9)
        )
    for x, top in ((-6.5, 62), (5.5, 60), (8, 55)):
        lines.append(curve([(x, 47), (0.85 * x, 53), (x, top)], 0.22, 0.8))
    for side in (-1, 1):
        for angle in (-38, -20, -2, 14, 33):
            way = np.radians(angle + rng.normal(0, 4))
            far = rng.uniform(9, 14)
            t = np.linspace(0, 1, 4)
            x = 46.5 + far * t * np.cos(way)
            y = 29 + 0.16 * angle + far * t * np.sin(way) - 3 * t**2
            lines.append(
                curve(np.column_stack([side * x, y]), rng.uniform(0.12, 0.24), 0.55)
            )
        for i in range(5):  # below the eyes
            x = np.linspace(19 + 1.5 * i, 46 - 1.2 * i, 6) + rng.normal(0, 0.4, 6)
            y = 22.5 - 1.9 * i + 0.014 * (x - 31) ** 2 + rng.normal(0, 0.25, 6)
            lines.append(
                curve(np.column_stack([side * x, y]), rng.uniform(0.06, 0.13), 0.45)
            )
        for i in range(4):  # upper lids
            x = np.linspace(21, 42, 6)
            y = lid_line(x) + 2.6 + 1.3 * i - 0.008 * i * (x - 31) ** 2
            lines.append(curve(np.column_stack([side * x, y]), 0.045, 0.35))
        fold = [(17.5, 1), (21, -9), (26, -21), (29.5, -33), (30, -39)]
        lines.append(curve([(side * x, y) for x, y in fold], 0.26, 0.8))
        corner = [(27.5, -36), (29.5, -44), (29, -53)]
        lines.append(curve([(side * x, y) for x, y in corner], 0.2, 0.8))
    for x in np.arange(-22, 22.1, 1.25) + rng.normal(0, 0.25, 36):
        upper = [(x, -26.5 + 0.004 * x**2), (0.98 * x, -33)]
        lower = [(0.98 * x, -35.5), (x, -44 + 0.02 * x**2)]
        lines.append(curve(upper, rng.uniform(0.03, 0.09), 0.32))
        lines.append(curve(lower, rng.uniform(0.04, 0.12), 0.34))
    for y in (-101, -118, -131):  # neck
        x = np.linspace(-42, 42, 9)
        height = y + 0.004 * x**2 + rng.normal(0, 0.8, 9)
        lines.append(curve(np.column_stack([x, height]), 0.35, 1.2))
    return lines


def furrows(points: Array, rng: np.random.Generator) -> Array:
    """Height (n,) mm of the wrinkles: grooves between low ridges, deepest in the middle."""
    front = np.flatnonzero(points[:, 2] > np.where(points[:, 1] < -85, 0, 30))
    tree = cKDTree(points[front, :2])
    lines = wrinkles(rng)
    flat = np.concatenate([line for line, _, _ in lines])
    taper = np.tile(np.sin(np.pi * np.linspace(0.06, 0.94, SAMPLES)) ** 0.6, len(lines))
    depth = np.repeat([line[1] for line in lines], SAMPLES) * taper
    depth *= 1 + 0.35 * np.sin(np.arange(len(depth)) / 17.0)
    width = np.repeat([line[2] for line in lines], SAMPLES)
    # of the vertices in front of a place, the foremost
    _, near = tree.query(flat, k=8)
    near = near.clip(max=len(front) - 1)
    chosen = near[np.arange(len(near)), points[front[near], 2].argmax(axis=1)]
    place = np.column_stack([flat, points[front[chosen], 2]])
    distance, sample = cKDTree(place).query(points, distance_upper_bound=5.0)
    hit = np.flatnonzero(np.isfinite(distance))
    at = distance[hit] / width[sample[hit]]
    out = np.zeros(len(points))
    out[hit] = -depth[sample[hit]] * (bell(at) - 0.4 * bell((at - 2.6) / 1.3))
    return out


def spread(
    points: Array, area: Array, density: Array, apart: float, rng: np.random.Generator
):
    """Indices of vertices drawn with `density` [mm^-2], no two nearer than `apart` mm."""
    drawn = np.flatnonzero(rng.random(len(points)) < density * area)
    drawn = rng.permutation(drawn)
    pairs = cKDTree(points[drawn]).query_pairs(apart, output_type="ndarray")
    return np.delete(drawn, np.unique(pairs.max(axis=1))) if len(pairs) else drawn


def pore_depth(points: Array, centre: Array, rng: np.random.Generator) -> Array:
    """Depth (n,) in [0, 1] of pores around centres (p, 3)."""
    radius = rng.uniform(0.24, 0.42, len(centre))
    strength = rng.uniform(0.35, 1.0, len(centre))
    distance, nearest = cKDTree(centre).query(points, distance_upper_bound=1.5)
    hit = np.flatnonzero(np.isfinite(distance))
    out = np.zeros(len(points))
    pore = nearest[hit]
    out[hit] = strength[pore] * bell(distance[hit] / radius[pore])
    return out


def strands(
    points: Array,
    root: Index,
    way: Array,
    length: float,
    width: float,
    rng: np.random.Generator,
) -> Array:
    """Cover (n,) in [0, 1] by hairs that leave their roots (r,) along directions (r, 3)."""
    count = max(round(length / (1.2 * width)), 1)
    along = np.linspace(0, length, count)[:, None, None]
    reach = rng.uniform(0.6, 1.2, len(root))[:, None]
    samples = (points[root] + along * reach * way).reshape(-1, 3)
    distance, _ = cKDTree(samples).query(points, distance_upper_bound=1.2 + length / 20)
    return bell(np.minimum(distance, 9.0) / width)


@dataclass(frozen=True)
class Hero:
    """The true head."""

    vertices: Array  # (n, 3) mm
    faces: Index  # (f, 3)
    normals: Array  # (n, 3)
    diffuse: Array  # (n, 3) R_d
    weights: Array  # (n, k) of the materials of the virtual dome
    sites: tuple[Site, ...]  # of the contact probe


class Place:
    """Where the vertices (n,) of the smooth head are on the face."""

    def __init__(self, smooth: Array, faces: Index) -> None:
        self.points = smooth
        self.normals = normals(smooth)
        self.area = vertex_areas(smooth, faces)
        at = even(smooth)
        self.side = np.sign(at[0])
        self.member = region_membership(at.T, SHAPE)
        at[0] = np.abs(at[0])
        self.x, self.y, self.z = at
        self.hair = hair_line(smooth)
        self.ear = np.where(self.x > 60, step(2.5 - ear(at), 2), 0.0)
        self.beard = self.member["beard"] * (1 - self.hair) * (1 - self.ear)

    @property
    def bare(self) -> Array:
        """Fraction (n,) that pores may cover."""
        free = (1 - self.hair) * (1 - self.ear) * (1 - self.member["lips"])
        return free * (1 - 0.8 * self.member["eyelid"])

    def around(
        self, x: float, y: float, wide: float, high: float, front: float
    ) -> Array:
        """Gaussian (n,) around (|x|, y), in front of a plane."""
        near = bell((self.x - x) / wide, (self.y - y) / high)
        return near * (self.z > front)

    def grown(
        self,
        density: Array,
        apart: float,
        way: Array,
        length: float,
        width: float,
        rng: np.random.Generator,
    ) -> Array:
        """Cover (n,) by hairs of a density [mm^-2] that lie along directions (n, 3)."""
        root = spread(self.points, self.area, density, apart, rng)
        lying = way[root]
        across = self.normals[root]
        lying = unit(lying - (lying * across).sum(axis=1, keepdims=True) * across)
        lying = unit(lying + rng.normal(0, 0.35, lying.shape))
        return strands(self.points, root, lying, length, width, rng)


def hairs(place: Place, rng: np.random.Generator) -> dict[str, Array]:
    """Cover (n,) of the skin by each kind of hair."""
    member = place.member
    down = np.broadcast_to([0.0, -1.0, 0.0], place.points.shape)
    from_crown = place.points - np.array([4.0, 168.0, -71.0])
    lid = (np.abs(place.x - EYE[0]) < 13.5) & (place.z > 70)
    at_lid = 9.0 * bell((place.y - lid_line(place.x) - 0.1) / 0.35) * lid
    outward = (place.x - 14) / 36
    along_brow = np.stack([place.side, 0.9 - 1.5 * outward, -0.9 * outward], axis=1)
    over_lid = np.stack(
        [place.side * 0.05 * (place.x - 27), -np.ones_like(place.x), 0 * place.x],
        axis=1,
    )
    cut = place.grown(1.1 * place.hair, 0.45, from_crown, 2.6, 0.2, rng)
    in_brow = 1.6 * member["brow"] * (place.z > 40)
    return {
        "cut": cut * step(place.hair - 0.1, 0.1),
        "brow": place.grown(in_brow, 0.35, along_brow, 6.0, 0.2, rng),
        "lash": place.grown(at_lid, 0.3, over_lid, 3.2, 0.16, rng),
        "stubble": place.beard
        * place.grown(0.45 * place.beard, 0.6, down, 0.5, 0.17, rng),
    }


def pores_of(place: Place, rng: np.random.Generator) -> Array:
    """Depth (n,) in [0, 1] of the pores, which are dense on the nose."""
    density = 0.25 + sum(PORES[name] * place.member[name] for name in PORES)
    centre = spread(place.points, place.area, density * place.bare, 0.75, rng)
    return pore_depth(place.points, place.points[centre], rng)


def build_hero(spacing: float = 1.6, levels: int = 2) -> Hero:
    """The head with its relief and skin; the vertices are `spacing` / 2^levels mm apart."""
    smooth, faces = sculpt(spacing, levels)
    rng = np.random.default_rng([PERSON.seed, 21])
    place = Place(smooth, faces)
    pores = pores_of(place, rng)
    lines = furrows(smooth, rng)
    net = sum(bell(smooth_noise(smooth, wave, rng=rng) / 0.3) for wave in (2.2, 3.4))
    net = net * (1 - place.hair)
    cover = hairs(place, rng)
    height = broad_relief(smooth) + lines - 0.10 * pores - 0.018 * net
    height += 0.22 * cover["cut"] + 0.18 * cover["brow"] + 0.08 * cover["stubble"]
    vertices = smooth + height[:, None] * place.normals
    parts = {"brow": 0.7, "lash": 0.7, "lips": 0.75, "neck": 0.4}
    member = {name: parts.get(name, 1.0) * m for name, m in place.member.items()}
    head = Head(vertices, faces, place.normals, {}, member)
    _, albedo = _materials()
    skin = skin_of(head, PERSON, material_albedo=albedo, eta=ETA)
    dark = 0.26 * pores + 0.035 * net * place.bare - 0.55 * np.minimum(lines, 0)
    gloss = 1 - 0.85 * np.max([place.hair, cover["brow"], 0.4 * pores], axis=0)
    return Hero(
        vertices,
        faces,
        vertex_normals(vertices, faces),
        painted(place, skin.diffuse, np.clip(dark, 0, 0.6), cover),
        skin.weights * gloss[:, None],
        skin.sites,
    )


def painted(
    place: Place, diffuse: Array, dark: Array, cover: dict[str, Array]
) -> Array:
    """R_d (n, 3) of skin with redder parts, what pores and wrinkles darken, and hair."""
    red = (
        0.14 * place.ear
        + 0.16 * place.around(40, 2, 13, 13, 30)
        + 0.18 * place.around(0, 4, 13, 9, 95)
        + 0.22 * place.around(30, 22, 12, 6, 60)
        + 0.10 * place.around(12, 2, 5, 6, 80)
    )
    skin = diffuse * np.exp(-np.outer(red, skin_tables().haemoglobin))
    skin *= 1 - dark[:, None] * np.array([0.8, 1.0, 1.05])
    clear = (1 - 0.10 * place.beard) * (1 - 0.80 * place.hair)
    for name, opacity in OPACITY.items():
        clear = clear * (1 - opacity * cover[name])
    mixed = skin * clear[:, None] + HAIR_COLOUR * (1 - clear[:, None])
    return np.clip(mixed, 0.008, 0.95)


def surface_of(hero: Hero) -> Surface:
    """The surface that the dome photographs."""
    dictionary, _ = _materials()
    model = Mixture(
        dictionary.table, disc_angular_radius=dictionary.disc_angular_radius
    )
    return Surface(
        hero.vertices, hero.faces, hero.normals, hero.diffuse, hero.weights, model
    )


def close_dome(lights: int, cameras: int, pixel_mm: float) -> Dome:
    """The virtual dome with lenses that frame the head at `pixel_mm`."""
    dome = build_dome(lights, cameras, rng=np.random.default_rng(2005))
    width, height = (int(side / pixel_mm) for side in FRAME_MM)
    closer = []
    for camera in dome.cameras:
        focal = float(lengths(camera.centre - CENTRE)) / pixel_mm
        seen = camera.R @ MIDDLE + camera.t
        x, y = np.array([width, height]) / 2 - focal * seen[:2] / seen[2]
        K = np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])
        lens = replace(camera, K=K, distortion=np.zeros(5), width=width, height=height)
        closer.append(replace(lens, vignette=np.zeros(3)))
    return Dome(tuple(closer), dome.lights)


def write_capture(out: Path, hero: Hero, dome: Dome) -> None:
    """Write the capture folder `out`: contact with the probe, scan, and photographs."""
    sensor = Sensor()
    for site in hero.sites:
        (out / "contact" / site.name).mkdir(parents=True)
    write_probe(out, hero.sites, eta=ETA, rng=np.random.default_rng([PERSON.seed, 2]))
    vertices, faces = sculpt(SCAN_MM)
    vertices += broad_relief(vertices)[:, None] * normals(vertices)
    trimesh.Trimesh(vertices, faces, process=False).export(out / "scan.ply")
    member = region_membership(even(vertices).T, SHAPE)
    regions = {
        name: [np.flatnonzero(member[name] > 0.5).tolist()] for name in SCAN_REGIONS
    }
    (out / "dome").mkdir()
    photograph(
        out,
        surface_of(hero),
        dome,
        sensor=sensor,
        device_rng=np.random.default_rng(2005),
        rng=np.random.default_rng([PERSON.seed, 1]),
        step=lambda: None,
    )
    for name, content in (
        ("regions.json", regions),
        ("dome/dome.json", dome_record(dome, sensor, session_time(PERSON))),
        ("capture.json", capture_record(PERSON, contact=True, landmarks=False)),
    ):
        (out / name).write_text(json.dumps(content), encoding="utf-8")


def print_errors(kind: str, comparisons: Sequence[Comparison]) -> None:
    """Print how well a model predicts each photograph."""
    names = ("fine_contrast", "fine_gain", "relative_rmse", "ssim")
    for one in comparisons:
        numbers = [f"{name} {one.error[name]:.3f}" for name in names]
        seen = "held out" if one.held_out else "fitted"
        print(kind, one.light, one.camera, seen, *numbers, sep="  ")


def write_pictures(
    out: Path, model: xr.DataTree, comparisons: Sequence[Comparison]
) -> None:
    """Write the figures of the documentation."""
    part = shown_part([one.mask for one in comparisons], 12)
    exposure = EXPOSED * min(one.error["exposure"] for one in comparisons)

    def panel(image: Array) -> Array:
        return tone_map(np.nan_to_num(image[part]), exposure=exposure)

    held_out = [one for one in comparisons if one.held_out]
    held_out = sorted(held_out, key=lambda one: one.error["relative_rmse"])[:3]
    rows = [
        np.concatenate([panel(getattr(one, kind)) for one in held_out], axis=1)
        for kind in ("photographed", "rendered")
    ]
    save(out / "hero.webp", np.concatenate(rows), 900)
    best = held_out[0]
    maps = [image for image, _ in map_pictures({PERSON.take: model})[PERSON.take][:4]]
    height = 2 * min(len(image) for image in maps)
    small = [resized(image, height // 2) for image in maps]
    width = min(image.shape[1] for image in small)
    small = [image[:, :width] for image in small]
    grid = np.concatenate(
        [np.concatenate(small[:2], axis=1), np.concatenate(small[2:], axis=1)]
    )
    large = [
        resized(panel(image), height) for image in (best.photographed, best.rendered)
    ]
    save(out / "overview.webp", np.concatenate([*large, grid], axis=1), 1000)


def render_head(db: skindb.Database, out: Path) -> None:
    """Write pictures of the head from another side, with light under the skin."""
    pictures = []
    for direction in LIGHTS_FROM:
        path = out / f"light_{direction}.png"
        options: dict[str, Any] = {"view": "three-quarter", "light_from": direction}
        options |= {"size": 450, "exposure": "auto", "subsurface": True}
        workflow.render_take(db, path, PERSON.take, **options)
        pictures.append(np.asarray(Image.open(path).convert("RGB")))
    part = shown_part([picture.max(axis=2) > DARK for picture in pictures], 12)
    pictures = [picture[part] for picture in pictures]
    save(out / "render.webp", np.concatenate(pictures, axis=1), 900)


def photograph_viewer(page: Path, picture: Path) -> None:
    """Write a picture of the viewer's page in Chromium with software rendering."""
    from playwright.sync_api import sync_playwright  # an extra

    from benchmarks.viewer import FLAGS

    with sync_playwright() as running:
        browser = running.chromium.launch(
            executable_path=shutil.which("chromium"), args=FLAGS
        )
        tab = browser.new_page(
            viewport={"width": 900, "height": 560}, reduced_motion="reduce"
        )
        tab.set_default_timeout(0)
        tab.goto(page.resolve().as_uri())
        tab.evaluate("skindb.ready")
        tab.wait_for_timeout(VIEWER_MS)
        shot = tab.screenshot()
        browser.close()
    save(picture, np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")), 900)


def resized(picture: Array, height: int) -> Array:
    """A picture (h, w, 3) of 8 bits with another height."""
    width = round(picture.shape[1] * height / len(picture))
    small = Image.fromarray(picture).resize((width, height), Image.Resampling.LANCZOS)
    return np.asarray(small)


def save(path: Path, picture: Array, width: int) -> None:
    """Write a picture of at most `width` pixels and 150 kB."""
    image = Image.fromarray(picture)
    image.thumbnail((width, 4 * width), Image.Resampling.LANCZOS)
    for quality in range(90, 40, -5):
        image.save(path, quality=quality, method=6)
        if path.stat().st_size <= MAX_BYTES:
            break


def main(
    *,
    out: Annotated[Path, "Folder of the capture, the database and the pictures."],
    lights: Annotated[int, "Number of lights."] = 32,
    cameras: Annotated[int, "Number of cameras."] = 8,
    pixel: Annotated[float, "Width of a pixel on the face [mm]."] = 0.3,
    spacing: Annotated[float, "Distance of the surfels [mm]."] = 1.0,
) -> None:
    """Photograph the hero unless its capture exists, fit it, and print how well its model
    predicts the photographs that it was not made from.
    """
    begin = time.perf_counter()

    def report(stage: str) -> None:
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        seconds = time.perf_counter() - begin
        print(
            f"{stage}: {seconds:.0f} s, {time.process_time():.0f} s of CPU time, at most "
            f"{memory:.2f} GiB",
            flush=True,
        )

    folder = out / PERSON.take
    if not (folder / "capture.json").exists():
        hero = build_hero(min(4.67 * pixel, SCAN_MM))
        report(f"head of {len(hero.vertices):,} vertices")
        write_capture(folder, hero, close_dome(lights, cameras, pixel))
        report("photographs")
    db = skindb.open(out / "db", create=True)
    workflow.ingest_take(db, folder, spacing_mm=spacing)
    report("ingest")
    held_out = FitParameters(hold_out_lights=(KEPT + 0.5) / lights)
    workflow.fit_take(db, PERSON.take, held_out)
    report("fit")
    model = db.read("model", PERSON.take)
    capture = db.read("capture", PERSON.take)
    comparisons = compare_photographs(model, capture)
    print_errors("detail", comparisons)
    surfels = model.copy()
    del surfels["detail"]
    print_errors("surfels", compare_photographs(surfels, capture))
    report("comparison")
    write_pictures(out, model, comparisons)
    render_head(db, out)
    report("pictures")
    workflow.view_takes(db, [PERSON.take], out / "viewer.html")
    photograph_viewer(out / "viewer.html", out / "viewer.webp")
    report("viewer")
