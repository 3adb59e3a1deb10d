"""Differences between pictures of the viewer and of the renderer, for a model under single lights
of its dome, in headless Chromium.

python -m benchmarks viewer_error DB V001
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np
from pictures import render_view
from playwright.sync_api import sync_playwright
from view.test_viewer_page import compared, lamp, opened, square

import skindb
from benchmarks.viewer import FLAGS
from skindb.render.scene import Camera, from_model, lights_from_dome
from skindb.render.shading import trace_view
from skindb.types import unit
from skindb.view.face import face_record
from skindb.view.page import PagedFace, write_page

SIDE = 512  # px
DISTANCE_MM = 700.0
TANGENT = 0.2  # of half the angle of the picture
LIGHTS = {
    "front": (0, 0, 1),
    "left": (6, 3, 7),
    "right": (-7, 2, 5),
    "above": (0, 8, 5),
}


def main(db: Path, take: str) -> None:
    """Print the RMS difference over the RMS of the picture, where rays of all sub-pixels meet
    the face, with the disc of the light sampled by the renderer.
    """
    model = skindb.open(str(db)).read("model", take).load()
    record = face_record(model, take=take, attributes={})
    surface = from_model(model)
    middle = (surface.vertices.min(axis=0) + surface.vertices.max(axis=0)) / 2
    eye = middle + np.array([0, 0, DISTANCE_MM])
    half = SIDE / 2
    K = np.array([[half / TANGENT, 0, half], [0, half / TANGENT, half], [0, 0, 1]])
    R = np.diag([1.0, -1, -1])
    camera = Camera(K, R, -R @ eye, np.zeros(5), SIDE, SIDE)
    view = trace_view(surface, camera, samples=2)
    lights = lights_from_dome(model["dome"].to_dataset())
    with sync_playwright() as running, tempfile.TemporaryDirectory() as folder:
        browser = running.chromium.launch(
            executable_path=shutil.which("chromium"), args=FLAGS
        )
        file = Path(folder) / "face.html"
        write_page(file, [PagedFace.of(record, "")])
        page = opened(browser, file.as_uri())
        for name, direction in LIGHTS.items():
            nearest = np.argmax(unit(lights.position) @ unit(np.array(direction)))
            light = lights.select([int(nearest)])
            expected = record["about"]["exposure"] * render_view(
                surface, camera, light, samples=2, disc_samples=4
            ).sum(axis=0)
            level = 0.8 / np.quantile(expected[view.coverage == 1], 0.995)
            found = square(
                page,
                pixels=SIDE,
                lights=[lamp(light.position[0], light.intensity[0])],
                exposure=float(level),
                withDiffuse=True,
                withSurface=True,
                glow=False,
                softness=0.5,
                eye=eye.tolist(),
                target=middle.tolist(),
                tangent=TANGENT,
            )
            error, _ = compared(found, level * expected, view)
            print(f"light from {name}: {100 * error:.1f} %")
