"""What plans of pictures and pages skip, what it gains, and what it would not gain.

python -m benchmarks omissions DB [--take NAME]

DB contains a fitted model with translucency. CPU times are of pictures with and without
their plan; both have the same random numbers. The other lines are about what is not
skipped: bases of small weight, parts of an environment below the horizon, surfels that
no view shows, and nodes of the BRDF tables of the viewer's page.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

import skindb
from benchmarks.rendering import sky
from skindb.geometry.rays import RayScene
from skindb.optics.angles import directions
from skindb.reflectance.mixture import Mixture
from skindb.render.monte_carlo import Quality, render_monte_carlo
from skindb.render.plan import plan_scene
from skindb.render.rendering import chosen_camera
from skindb.render.scene import (
    Camera,
    Environment,
    Lighting,
    from_model,
    lights_from_dome,
)
from skindb.render.shading import trace_view

DIRECTIONS = 300  # of views around the face


def made(surface, camera, lighting, scene, quality, *, planned):
    """CPU time [s], the picture, and what was skipped."""
    started = time.process_time()
    pixels = None
    omissions = ()
    if planned:
        options = {"subsurface": quality.subsurface, "error": quality.error}
        plan = plan_scene(surface, camera, lighting, scene, **options)
        surface = plan.surface
        lighting = plan.lighting
        pixels = plan.pixels
        omissions = plan.omissions
    picture = render_monte_carlo(
        surface,
        camera,
        lighting,
        quality,
        rng=np.random.default_rng(1),
        scene=scene,
        pixels=pixels,
    )
    return time.process_time() - started, picture, omissions


def pictures(surface, camera, lights, scene) -> None:
    """Pictures with and without their plan."""
    complete = Lighting(lights)
    room = Lighting(None, sky())
    cases = {
        "one light": (Lighting(lights.select([0])), Quality(64)),
        "dome": (complete, Quality(64)),
        "dome, error 2 %": (complete, Quality(4096, 0.02)),
        "sky": (room, Quality(64)),
        "dome, subsurface": (complete, Quality(32, subsurface=True)),
    }
    for name, (lighting, quality) in cases.items():
        runs = [
            [
                made(surface, camera, lighting, scene, quality, planned=p)
                for p in (False, True)
            ]
            for _ in range(3)
        ]
        seconds_before, seconds_after = (min(run[i][0] for run in runs) for i in (0, 1))
        (_, without, _), (_, picture, omissions) = runs[0]
        gap = np.sqrt(
            np.mean((picture.radiance - without.radiance) ** 2)
            / np.mean(without.radiance**2)
        )
        print(
            f"{name}: {seconds_before:.1f} s, with its plan {seconds_after:.1f} s; pictures differ "
            f"by {gap:.2%}, noise "
            f"{picture.relative_error:.2%}"
        )
        print("".join(f"    {line}\n" for line in omissions), end="")


def bases(surface, camera, lights, scene) -> None:
    """Time with all bases, and with the first one alone."""
    changed = replace(
        surface,
        parameters=surface.parameters[:, :1],
        model=Mixture(np.ascontiguousarray(surface.model.table[..., :1])),
    )
    for name, lighting in (
        ("one light", Lighting(lights.select([0]))),
        ("sky", Lighting(None, sky())),
    ):
        times = [
            [
                made(face, camera, lighting, scene, Quality(64), planned=True)[0]
                for face in (surface, changed)
            ]
            for _ in range(3)
        ]
        many, few = np.min(times, axis=0)
        print(
            f"{name}: {surface.parameters.shape[1]} bases {many:.1f} s, one {few:.1f} s"
        )


def behind(surface, scene) -> None:
    """Error of a close-up with the sun behind it, with and without the light below all horizons."""
    front = surface.vertices[surface.vertices[:, 2].argmax()] + [0, 60, 0]
    R = np.diag([1.0, -1, -1])
    K = np.array([[3000.0, 0, 100], [0, 3000, 100], [0, 0, 1]])
    camera = Camera(K, R, -R @ (front + np.array([0, 0, 300])), np.zeros(5), 200, 200)
    room = np.full((64, 128, 3), 0.3)
    room[32, :2] = 2e4
    dark = room.copy()
    dark[32, :2] = 0
    lowest = trace_view(surface, camera, scene=scene).normal[:, 2].min()
    images = [
        render_monte_carlo(
            surface,
            camera,
            Lighting(None, Environment(surrounding)),
            Quality(64),
            rng=np.random.default_rng(1),
            scene=scene,
        ).relative_error
        for surrounding in (room, dark)
    ]
    print(
        f"close-up, sun behind (normals face it by at most {-lowest:.2f}): noise "
        f"{images[0]:.2%}, without it "
        f"{images[1]:.2%}"
    )


def hidden(surface, scene) -> None:
    """Surfels that no direction shows, and directions that are below the horizon of all surfels."""
    k = np.arange(DIRECTIONS) + 0.5
    z = 1 - 2 * k / DIRECTIONS
    turn = k * np.pi * (3 - 5**0.5)
    way = np.stack(
        [np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z],
        axis=1,
    )
    seen = np.zeros(len(surface.vertices), bool)
    for direction in way:
        front = np.flatnonzero(surface.normals @ direction > 0)
        target = surface.vertices[front] + 2000 * direction
        seen[
            front[
                ~scene.occluded(
                    surface.vertices[front], target, normal=surface.normals[front]
                )
            ]
        ] = True
    below = (way @ surface.normals.T).max(axis=1) <= 0
    print(
        f"{(~seen).sum()} of {len(seen)} surfels are hidden in {DIRECTIONS} views; "
        f"{below.sum()} of them show none"
    )


def nodes(tables) -> None:
    """Relative RMS error of tables with half as many nodes along each axis, weighted as
    a picture sees them.
    """
    tables = tables.astype(np.float64)
    shape = tables.shape[:3]
    h = np.linspace(0, 1, shape[0]) ** 2 * np.pi / 2
    d = np.linspace(0, np.pi / 2, shape[1])
    p = np.arange(shape[2])
    angles = [x.ravel() for x in np.meshgrid(h, d, p * np.pi / shape[2], indexing="ij")]
    wi, wo = directions(*angles)
    weight = (
        np.clip(wi[:, 2], 0, 1) ** 2
        * np.clip(wo[:, 2], 0, 1)
        * np.sin(angles[0])
        * np.sqrt(angles[0])
    )
    weight = (weight * np.sin(angles[1]) * np.cos(angles[1])).reshape(*shape, 1)
    for axis, name in enumerate(("theta_h", "theta_d", "phi_d")):
        moved = np.moveaxis(tables, axis, 0)
        if name == "phi_d":
            moved = np.concatenate([moved, moved[:1]])
        count = len(moved)
        half = resampled(moved, np.linspace(0, count - 1, (count + 1) // 2))
        back = resampled(half, np.linspace(0, len(half) - 1, count))[: shape[axis]]
        error = np.moveaxis(back, 0, axis) - tables
        rms = np.sqrt(
            (weight * error**2).sum(axis=(0, 1, 2))
            / (weight * tables**2).sum(axis=(0, 1, 2))
        )
        print(
            f"half of the nodes of {name}: bases differ by {rms.min():.1%} to {rms.max():.1%}"
        )


def resampled(values, place):
    """Values along the first axis at fractional places, by linear interpolation."""
    low = np.minimum(place.astype(int), len(values) - 2)
    part = (place - low).reshape(-1, *[1] * (values.ndim - 1))
    return values[low] * (1 - part) + values[low + 1] * part


def main(db: str, *, take: str | None = None) -> None:
    """Print the results."""
    db = skindb.open(db)
    model = db.read("model", take or db.takes("model")[0])
    dome = model["dome"].to_dataset().load()
    surface, (camera, _), lights = (
        from_model(model),
        chosen_camera(dome, None),
        lights_from_dome(dome),
    )
    scene = RayScene(surface.vertices, surface.faces)
    print(
        f"{camera.width} x {camera.height} pixels, {len(surface.vertices)} "
        f"surfels, {len(lights)} lights"
    )
    pictures(surface, camera, lights, scene)
    bases(surface, camera, lights, scene)
    behind(surface, scene)
    hidden(surface, scene)
    nodes(surface.model.table)
