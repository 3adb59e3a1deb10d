"""Error of Monte Carlo pictures by time, by samples, by the opening of the octree, and
compared with Mitsuba 3.

python -m benchmarks rendering DB [--take NAME] [--picture FILE]

DB contains a fitted model. If Mitsuba is installed (pip install mitsuba), the diffuse
term without Fresnel factors is compared for an environment and for a point light, which
both programs support, with the time that each takes for an error of 2 %.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np

import skindb
from skindb.geometry.rays import RayScene
from skindb.render.image import write_exr
from skindb.render.monte_carlo import Quality, render_monte_carlo
from skindb.render.plan import plan_scene
from skindb.render.rendering import chosen_camera
from skindb.render.scene import (
    Environment,
    Lighting,
    Lights,
    from_model,
    lights_from_dome,
)

REFERENCE = 512  # rays per pixel
SAMPLES = (16, 32, 128)
MITSUBA_VARIANT = "scalar_rgb"  # compiled for the CPU, without a just-in-time compiler
EQUAL_ERROR = 0.02  # at which the times of both programs are compared
OPENINGS = (1.0, 0.5, 0.2, 0.1, 0.05)


def sky() -> Environment:
    """An overcast sky that is bluer towards the zenith, with a sun of 12 texels."""
    row, column = np.mgrid[:64, :128]
    theta = np.pi * (row + 0.5) / 64
    phi = 2 * np.pi * ((column + 0.5) / 128 - 0.5)
    way = np.stack(
        [np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)],
        axis=-1,
    )
    dome = 0.3 + 0.7 * np.clip(way[..., 1:2], 0, 1) * np.array([0.6, 0.8, 1.2])
    return Environment(
        dome
        + 400
        * (way @ np.array([0.6, 0.6, 0.53]) > 0.9985)[..., None]
        * np.array([1.2, 1.0, 0.8])
    )


def difference(picture, reference):
    """RMS difference over RMS of the reference, where both pictures show skin."""
    seen = (picture.coverage > 0.999) & (reference.coverage > 0.999)
    square = np.mean((picture.radiance - reference.radiance)[seen] ** 2) / np.mean(
        reference.radiance[seen] ** 2
    )
    return float(np.sqrt(square))


def by_samples(surface, camera, lighting, **options):
    """Rows of samples, CPU time [s], error relative to a long run, and stated error."""

    scene = RayScene(surface.vertices, surface.faces)
    plan = plan_scene(surface, camera, lighting, scene, **options)

    def made(samples, seed):
        quality = Quality(samples=samples, **options)
        rng = np.random.default_rng(seed)
        started = time.process_time()
        picture = render_monte_carlo(
            plan.surface,
            camera,
            plan.lighting,
            quality,
            rng=rng,
            scene=scene,
            pixels=plan.pixels,
        )
        return picture, time.process_time() - started

    reference, _ = made(REFERENCE, 99)
    for samples in SAMPLES:
        picture, seconds = made(samples, samples)
        yield (
            samples,
            seconds,
            difference(picture, reference),
            picture.relative_error,
        )


def by_opening(surface, lighting):
    """Rows of opening, CPU time [s] of a tree walk, RMS difference from the sum over all pairs."""
    from skindb.geometry.mesh import vertex_areas
    from skindb.optics.dipole_tree import subsurface_exitance
    from skindb.render.shading import transmitted_irradiance

    scene = RayScene(surface.vertices, surface.faces)
    received = (
        transmitted_irradiance(surface, lighting.lights, scene)
        @ lighting.lights.intensity
    )
    receivers = np.zeros(len(surface.vertices), bool)
    # all pairs of all surfels would take hours
    receivers[:: max(len(receivers) // 2000, 1)] = True
    carried = partial(
        subsurface_exitance,
        surface.vertices,
        vertex_areas(surface.vertices, surface.faces),
        received,
        surface.s,
        surface.sigma_tr,
        eta=surface.eta,
        receivers=receivers,
    )
    started = time.process_time()
    exact = carried(tolerance=0.0)[:, receivers]
    yield 0.0, time.process_time() - started, 0.0
    for opening in OPENINGS:
        started = time.process_time()
        exitance = carried(tolerance=opening)[:, receivers]
        error = np.sqrt(np.mean((exitance - exact) ** 2) / np.mean(exact**2))
        yield opening, time.process_time() - started, float(error)


def mitsuba_sensor(camera, transform):
    """The camera as Mitsuba describes it."""
    to_world = np.eye(4)
    # Mitsuba: +x left, +y up, +z forward
    to_world[:3, :3] = camera.R.T @ np.diag([-1.0, -1.0, 1.0])
    to_world[:3, 3] = camera.centre
    K = camera.K
    width = camera.width
    height = camera.height
    film = {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": "box"},
    }
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(width / 2 / K[0, 0]))),
        "fov_axis": "x",
        "principal_point_offset_x": float((width / 2 - K[0, 2]) / width),
        "principal_point_offset_y": float((height / 2 - K[1, 2]) / height),
        "near_clip": 1.0,
        "far_clip": 1e5,
        "to_world": transform(to_world),
        "film": film,
        "sampler": {"type": "independent", "sample_count": REFERENCE},
    }


def mitsuba_light(lighting, folder):
    """The environment, or else the first light, as Mitsuba describes it."""
    if lighting.environment is not None:
        path = f"{folder}/sky.exr"
        # Mitsuba's columns have the opposite order
        write_exr(path, np.float32(lighting.environment.radiance[:, ::-1]))
        return {"type": "envmap", "filename": path}
    intensity = lighting.lights.intensity[0].tolist()
    return {
        "type": "point",
        "position": lighting.lights.position[0].tolist(),
        "intensity": {"type": "rgb", "value": intensity},
    }


def mitsuba_pictures(surface, camera, lighting, bounces):
    """Radiance (h, w, 3) and CPU time [s] of Mitsuba for a diffuse surface of reflectance 0.5, with
    each number of rays per pixel.
    """
    import mitsuba
    import trimesh

    mitsuba.set_variant(MITSUBA_VARIANT)
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/mesh.ply"
        mesh = trimesh.Trimesh(
            surface.vertices,
            surface.faces,
            vertex_normals=surface.normals,
            process=False,
        )
        mesh.export(path, vertex_normal=True)
        matte = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
        scene = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2 + bounces},
            "sensor": mitsuba_sensor(camera, mitsuba.ScalarTransform4f),
            "face": {"type": "ply", "filename": path, "bsdf": matte},
            "light": mitsuba_light(lighting, folder),
        }
        loaded = mitsuba.load_dict(scene)
        for samples in (*SAMPLES, REFERENCE):
            started = time.process_time()
            radiance = np.array(mitsuba.render(loaded, spp=samples, seed=samples))
            yield radiance[..., :3], time.process_time() - started


def time_at(error, rows):
    """Time [s] at an error, of rows of time and error, by the power law between them."""
    seconds, errors = np.log(rows).T
    slope, level = np.polyfit(errors, seconds, 1)
    return float(np.exp(level + slope * np.log(error)))


def against_mitsuba(surface, camera, lighting, bounces):
    """CPU times [s] of both programs at EQUAL_ERROR, difference of their means over skin, and RMS
    difference.
    """
    *theirs, (best, _) = mitsuba_pictures(surface, camera, lighting, bounces)
    matte = replace(
        surface,
        eta=1.0,
        diffuse=np.full_like(surface.diffuse, 0.5),
        parameters=0 * surface.parameters,
        detail=None,
        inter_reflection=bounces > 0,
    )
    ours = []
    spent = []
    for samples in (*SAMPLES, REFERENCE):
        started = time.process_time()
        ours += [
            render_monte_carlo(
                matte,
                replace(camera, distortion=np.zeros(5)),
                lighting,
                Quality(samples=samples, terms=("diffuse",)),
                rng=np.random.default_rng(samples),
            )
        ]
        spent += [time.process_time() - started]
    skin = ours[-1].coverage > 0.999
    level = np.sqrt(np.mean(best[skin] ** 2))

    def off(picture, reference):
        return np.sqrt(np.mean((picture - reference)[skin] ** 2)) / level

    own = ours[-1].radiance
    rows = (
        [
            (seconds, off(picture.radiance, own))
            for picture, seconds in zip(ours[:-1], spent[:-1], strict=True)
        ],
        [(seconds, off(picture, best)) for picture, seconds in theirs],
    )
    apart = np.abs(best[skin].mean(axis=0) / own[skin].mean(axis=0) - 1).max()
    times = [time_at(EQUAL_ERROR, each) for each in rows]
    return *times, float(apart), float(off(own, best))


def print_mitsuba(surface, camera, lights):
    """Print the comparison with Mitsuba for a point light and for an environment."""
    point = Lights(
        lights.position[:1],
        lights.intensity[:1],
        0 * lights.disc_radius[:1],
        lights.axis[:1],
        0 * lights.falloff[:1],
    )
    cases = {
        "point light": (Lighting(point), 0),
        "point light, one bounce": (Lighting(point), 1),
        "sky": (Lighting(None, sky()), 0),
        "sky, one bounce": (Lighting(None, sky()), 1),
    }
    for name, (lighting, bounces) in cases.items():
        ours, theirs, mean, rms = against_mitsuba(surface, camera, lighting, bounces)
        print(
            f"Mitsuba, {name}: means differ by {mean:.3%}, pixels by {rms:.2%}; "
            f"at an error of {EQUAL_ERROR:.0%} skindb {ours:.2f} s, Mitsuba {theirs:.2f} s"
        )


def main(db: str, *, take: str | None = None, picture: Path | None = None) -> None:
    """Print the results, and plot them."""
    database = skindb.open(db)
    model = database.read("model", take or database.takes("model")[0])
    dome = model["dome"].to_dataset().load()
    surface = from_model(model)
    camera, _ = chosen_camera(dome, None)
    lights = lights_from_dome(dome)
    one_light = Lighting(lights.select([0]))
    cases = {
        "one light": (one_light, {}),
        f"{len(lights)} lights": (Lighting(lights), {}),
        "sky": (Lighting(None, sky()), {}),
        "one light, subsurface light": (one_light, {"subsurface": True}),
        "sky, subsurface light": (Lighting(None, sky()), {"subsurface": True}),
    }
    curves = {}
    print(f"{camera.width} x {camera.height} pixels, {len(surface.vertices)} surfels")
    for name, (lighting, options) in cases.items():
        curves[name] = list(by_samples(surface, camera, lighting, **options))
        for samples, seconds, error, stated in curves[name]:
            print(
                f"{name}: {samples} rays per pixel {seconds:.1f} s, error "
                f"{error:.2%}, stated {stated:.2%}"
            )
    for opening, seconds, error in by_opening(surface, one_light):
        print(f"opening {opening}: {seconds:.2f} s, error {error:.3%}")
    if find_spec("mitsuba"):
        print_mitsuba(surface, camera, lights)
    else:
        print("The comparison with Mitsuba is skipped: pip install mitsuba")
    if picture:
        draw(curves, picture)


def draw(curves, path: Path) -> None:
    """Plot error against time for each case."""
    from matplotlib import pyplot

    figure, axis = pyplot.subplots(figsize=(5, 3.5), layout="constrained")
    for name, rows in curves.items():
        axis.loglog(
            [row[1] for row in rows], [100 * row[2] for row in rows], "o-", label=name
        )
    axis.set(xlabel="CPU time [s]", ylabel="relative RMS error [%]")
    axis.legend(fontsize=8)
    figure.savefig(path, dpi=110)
