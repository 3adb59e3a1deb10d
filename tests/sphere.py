"""A capture made by hand: a Lambertian sphere, its photographs from formulas; nothing
of skindb takes part.
"""

from __future__ import annotations

import json
from pathlib import Path

import imagecodecs
import numpy as np
import trimesh

RADIUS = 80.0
ALBEDO = np.array([0.6, 0.4, 0.3])
WIDTH = 72
HEIGHT = 64
FOCAL = 160.0
BLACK = 256
WHITE = 65535
ELECTRONS_PER_DN = 0.5
SECONDS = {"long": 1.0, "short": 0.1}
INTENSITY = np.array([1.0e6, 0.9e6, 0.8e6])
LIGHTS = {
    "l0": (0, 0, 500),
    "l1": (200, 50, 450),
    "l2": (-250, 100, 350),
    "l3": (50, -300, 300),
}
CAMERAS = {"c0": (0, 30, 400), "c1": (180, 0, 380)}
TARGET = {
    "reflectance": 0.99,
    "point": [0, 0, 60],
    "normal": [0, 0, 1],
    "half_size": 60,
}
FIBRES = 4
PROBE_SECONDS = {"b0": 4.0, "b1": 1.0, "b2": 0.25}
# mm^-2
PROBE_R = 0.02 * np.exp(-np.arange(1, FIBRES + 1)[:, None] * np.array([0.5, 0.8, 1.2]))
PROBE_SCALE = 0.05
PROBE_GAIN = [1.1, 0.9, 1.05, 0.8]


def look_at(eye):
    z = -np.asarray(eye, float) / np.linalg.norm(eye)
    x = np.cross(z, [0, 1, 0])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return R, -R @ np.asarray(eye, float)


def rays(eye, centre=(WIDTH / 2, HEIGHT / 2), lens=(0, 0, 0, 0, 0)):
    R, _ = look_at(eye)
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    x, y = straightened((column - centre[0]) / FOCAL, (row - centre[1]) / FOCAL, *lens)
    world = np.stack([x, y, np.ones_like(x)], -1) @ R
    return world / np.linalg.norm(world, axis=-1, keepdims=True)


def straightened(u, v, k1, k2, p1, p2, k3):
    """Where a lens would show (u, v) without its distortion: Brown's formula, repeated
    until it stands still.
    """
    x = u
    y = v
    for _ in range(60):
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x, y = (
            (u - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial,
            (v - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial,
        )
    return x, y


def face_radiance(eye, light, **camera):
    """The sphere, by the quadratic formula."""
    d = rays(eye, **camera)
    eye = np.asarray(eye, float)
    light = np.asarray(light, float)
    b = d @ eye
    inside = b * b - eye @ eye + RADIUS**2
    point = eye + (-b - np.sqrt(np.maximum(inside, 0)))[..., None] * d
    way = light - point
    square = (way**2).sum(-1)
    cosine = np.maximum((way * point).sum(-1) / RADIUS / np.sqrt(square), 0)
    return (
        np.where(inside > 0, cosine / square, 0)[..., None] * ALBEDO / np.pi * INTENSITY
    )


def target_radiance(eye, light, **camera):
    d = rays(eye, **camera)
    eye = np.asarray(eye, float)
    light = np.asarray(light, float)
    point = eye + ((60 - eye[2]) / d[..., 2])[..., None] * d
    way = light - point
    square = (way**2).sum(-1)
    on = np.abs(point[..., :2]).max(-1) < 60
    return (
        np.where(on, way[..., 2] / square**1.5, 0)[..., None] * 0.99 / np.pi * INTENSITY
    )


def expose(radiance, seconds, rng, bits=16):
    electrons = np.maximum(radiance * seconds, 0) * (WHITE - BLACK) * ELECTRONS_PER_DN
    noisy = electrons + np.sqrt(electrons + 25) * rng.standard_normal(radiance.shape)
    value = np.clip(np.rint(BLACK + noisy / ELECTRONS_PER_DN), 0, WHITE)
    return value.astype(np.uint16) if bits == 16 else (value / 257).astype(np.uint8)


def save(path, frame):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(imagecodecs.png_encode(frame))


def write_json(path, record):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record), encoding="utf-8")


def half_sphere():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    faces = ball.faces[(ball.vertices[ball.faces][..., 2] > -5).all(axis=1)]
    used, index = np.unique(faces, return_inverse=True)
    return ball.vertices[used], index.reshape(-1, 3)


def write_capture(folder: Path) -> None:
    rng = np.random.default_rng(1)
    vertices, faces = half_sphere()
    folder.mkdir()
    trimesh.Trimesh(vertices, faces, process=False).export(folder / "scan.ply")
    sensor = {
        "bit_depth": 16,
        "black_level": BLACK,
        "white_level": WHITE,
        "read_noise_e": 5.0,
    }
    sensor |= {"electrons_per_dn": ELECTRONS_PER_DN}
    K = [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
    cameras = []
    for name, eye in CAMERAS.items():
        R, t = look_at(eye)
        size = {"id": name, "width": WIDTH, "height": HEIGHT}
        cameras.append(size | {"K": K, "R": R.tolist(), "t": t.tolist()} | sensor)
        for e, seconds in SECONDS.items():
            for light, place in LIGHTS.items():
                save(
                    folder / f"dome/frames/{e}/{light}_{name}.png",
                    expose(face_radiance(eye, place), seconds, rng),
                )
                if name == "c0":
                    save(
                        folder / f"dome/white/{e}/{light}_c0.png",
                        expose(target_radiance(eye, place), seconds, rng),
                    )
    dome = {
        "cameras": cameras,
        "lights": [
            {"id": i, "position": list(p), "disc_radius": 5.0, "intensity": None}
            for i, p in LIGHTS.items()
        ],
        "exposures": [{"id": e, "seconds": s} for e, s in SECONDS.items()],
        "frames": "dome/frames/{exposure}/{light}_{camera}.png",
        "white": TARGET
        | {"frames": "dome/white/{exposure}/{light}_{camera}.png", "cameras": ["c0"]},
    }
    write_json(folder / "dome/dome.json", dome)
    write_probe(folder, sensor, rng)
    x = vertices[:, 0]
    y = vertices[:, 1]
    regions = {
        "forehead": y > 50,
        "cheek": np.hypot(np.abs(x) - 40, y) < 15,
        "nose": np.hypot(x, y) < 12,
    }
    write_json(
        folder / "regions.json",
        {k: [np.flatnonzero(v).tolist()] for k, v in regions.items()},
    )
    points = {
        "nose_tip": [0, 0, RADIUS],
        "forehead_centre": [0, 0.7 * RADIUS, RADIUS * np.sqrt(0.51)],
    }
    write_json(folder / "landmarks.json", points)
    write_json(
        folder / "capture.json",
        {
            "format": "skindb-capture",
            "version": 1,
            "subject": "T001",
            "session": "2005-01-10T09:00:00+00:00",
            "traits": {"age": 30, "gender": "male"},
            "consent": {"scope": ["fit", "statistics"], "reference": "none"},
            "mesh": "scan.ply",
            "landmarks": "landmarks.json",
            "regions": "regions.json",
            "dome": "dome/dome.json",
            "contact": "contact/probe.json",
            "studio": "by hand",
        },
    )


def write_probe(folder, sensor, rng):
    centres = [[10.0 + 12 * i, 8.0] for i in range(FIBRES)]
    y, x = np.mgrid[:16, :56] + 0.5
    for site in ("cheek", "forehead", "neck"):
        for e, seconds in PROBE_SECONDS.items():
            image = np.zeros((16, 56, 3))
            for (cx, cy), r, gain in zip(centres, PROBE_R, PROBE_GAIN, strict=True):
                image[np.hypot(x - cx, y - cy) <= 4] = r * gain / PROBE_SCALE
            save(folder / f"contact/{site}/{e}.png", expose(image, seconds, rng))
    fibres = [
        {"id": f"f{i}", "distance": i + 1.0, "centre": c, "radius": 3.5}
        for i, c in enumerate(centres)
    ]
    record = {
        "sites": ["cheek", "forehead", "neck"],
        "fibres": fibres,
        "exposures": [{"id": e, "seconds": s} for e, s in PROBE_SECONDS.items()],
        "frames": "contact/{site}/{exposure}.png",
        "scale": PROBE_SCALE,
        "gain": PROBE_GAIN,
    }
    write_json(folder / "contact/probe.json", record | sensor)
