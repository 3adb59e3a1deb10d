"""Visibility: time for all lights and cameras, and error relative to the truth.

    python -m benchmarks visibility CAPTURE [--truth] [--spacing 0.4] [--stride 10]

With `--truth`, what the lights see of the true surface in CAPTURE.truth.npz is compared
with what they see of the scan. Cameras are enlarged to 1300 x 1030 pixels. Every result
is one line of JSON, with wall time and CPU time, since other programs may be running.
"""

from __future__ import annotations

import json
import resource
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.truth import TrueVisibility, Truth, read_truth, regions
from skindb.format.dome import CameraRecord, LightRecord
from skindb.format.folder import read_capture
from skindb.geometry.rays import RayScene
from skindb.ingest.surfels import (
    SurfelSet,
    build_surfels,
    camera_visibility,
    disc_points,
    light_visibility,
)

STEEP = 0.1  # cosine above which pairs are compared
DENSE = 200  # points of a disc for the reference
UNDERSIDE = -0.5  # y of a normal that points down
# mm and cosine between a surfel and the true vertex with which it is compared
NEAREST = 1.0
TURNED = 0.85
WIDTH = 1300
HEIGHT = 1030


def main(
    capture: Path,
    *,
    truth: Annotated[bool, "Compare with the true surface."] = False,
    spacing: float = 0.4,
    stride: Annotated[int, "Compare every N-th light."] = 10,
) -> None:
    record = read_capture(capture)
    dome = record.dome
    surfels = build_surfels(record, spacing_mm=spacing)
    scene = RayScene(surfels.position, surfels.faces)
    scene.occluded(surfels.position[:1], np.zeros((1, 3)))  # builds the tree
    cameras = [enlarged(camera) for camera in dome.cameras]
    timings(surfels, scene, dome.lights, cameras)
    compare(surfels, scene, dome.lights[::stride])
    if truth:
        against_truth(surfels, scene, dome.lights, stride, read_truth(capture))


def say(**figures: Any) -> None:
    print(
        json.dumps(
            {
                k: float(f"{v:.6g}") if isinstance(v, float) else v
                for k, v in figures.items()
            }
        ),
        flush=True,
    )


@contextmanager
def clock(name: str, **figures: Any) -> Iterator[None]:
    wall = time.perf_counter()
    cpu = time.process_time()
    yield
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    say(
        what=name,
        wall=time.perf_counter() - wall,
        cpu=time.process_time() - cpu,
        peak_gib=peak,
        **figures,
    )


def enlarged(camera: CameraRecord) -> CameraRecord:
    scale = np.diag([WIDTH / camera.width, HEIGHT / camera.height, 1.0])
    return replace(camera, width=WIDTH, height=HEIGHT, K=scale @ camera.K)


def timings(
    surfels: SurfelSet,
    scene: RayScene,
    lights: tuple[LightRecord, ...],
    cameras: list[CameraRecord],
) -> None:
    """Time all lights and cameras on two threads, after a small run that compiles the kernels."""
    points = [replace(light, disc_radius=0.0) for light in lights]
    small = replace(cameras[0], width=8, height=8)
    size = {"surfels": len(surfels.position), "lights": len(lights)}
    with ThreadPoolExecutor(2) as pool:
        light_visibility(surfels, points[:1], scene, pool)
        camera_visibility(surfels, [small], scene, pool)
        with clock("centres of the lights", **size):
            light_visibility(surfels, points, scene, pool)
        with clock("cameras, depth maps, clear views", cameras=len(cameras)):
            camera_visibility(surfels, cameras, scene, pool)
        with clock("discs of the lights", **size):
            light_visibility(surfels, lights, scene, pool)


def facing(surfels: SurfelSet, place: Any) -> Any:
    way = place - surfels.position
    return np.einsum("ni,ni->n", way, surfels.normal) / np.linalg.norm(way, axis=1)


def compare(
    surfels: SurfelSet, scene: RayScene, lights: tuple[LightRecord, ...]
) -> None:
    """Compare the five points of a disc with DENSE points."""
    differing = 0
    faced = 0
    errors = []
    with ThreadPoolExecutor(1) as pool:
        fractions = light_visibility(surfels, lights, scene, pool)
    for light, fraction in zip(lights, fractions.T, strict=True):
        front = np.flatnonzero(facing(surfels, light.position) > 0)
        by_point = [
            ~scene.occluded(
                surfels.position[front], p[None], normal=surfels.normal[front]
            )
            for p in disc_points(light)
        ]
        expected = np.mean(by_point, axis=0).astype(np.float16)
        differing += int((fraction[front] != expected).sum())
        faced += len(front)
        penumbra = front[(expected > 0) & (expected < 1)]
        dense = dense_fraction(scene, surfels, penumbra, light)
        errors.append(fraction[penumbra].astype(float) - dense)
    error = np.concatenate(errors)
    say(
        what="pairs that differ from five points everywhere",
        share=differing / faced,
        count=differing,
        of=faced,
    )
    say(
        what="five points in penumbrae",
        error=float(np.abs(error).mean()),
        bias=float(error.mean()),
        soft=len(error) / faced,
    )


def dense_fraction(
    scene: RayScene, surfels: SurfelSet, chosen: Any, light: LightRecord
) -> Any:
    """Visible fraction of the disc from DENSE points on a spiral."""
    k = np.arange(DENSE) + 0.5
    centre, *ring = disc_points(light)
    u, v = (np.asarray(p - centre) / np.sqrt(0.6) for p in ring[:2])
    radius = np.sqrt(k / DENSE)
    angle = k * np.pi * (3 - np.sqrt(5))
    points = (
        centre
        + (radius * np.cos(angle))[:, None] * u
        + (radius * np.sin(angle))[:, None] * v
    )
    return np.mean(
        [
            ~scene.occluded(
                surfels.position[chosen], p[None], normal=surfels.normal[chosen]
            )
            for p in points
        ],
        axis=0,
    )


def region_masks(true: TrueVisibility) -> dict[str, Any]:
    """Masks (v,) of true vertices by region, and of places that are often in shadow."""
    region = regions(true.truth)
    down = true.normals[:, 1] < UNDERSIDE
    masks = {"all": np.ones(len(region), bool)}
    masks |= {str(name): region == name for name in np.unique(region)}
    masks["nose, underside"] = (region == "nose") & down
    below = np.isin(region, ("chin", "jaw", "neck_beard", "neck"))
    masks["under the chin"] = below & down
    return masks


def against_truth(
    surfels: SurfelSet,
    scene: RayScene,
    lights: tuple[LightRecord, ...],
    stride: int,
    truth: Truth,
) -> None:
    """Compare with the truth by region, at the surfels nearest to true vertices that face
    the light.
    """
    true = TrueVisibility(truth)
    distance, nearest = cKDTree(surfels.position).query(true.vertices, workers=1)
    cosine = np.einsum("ni,ni->n", surfels.normal[nearest], true.normals)
    good = (distance < NEAREST) & (cosine > TURNED)
    taken = np.unique(nearest[good])
    place = np.searchsorted(taken, nearest)
    masks = region_masks(true)
    wrong = {name: np.zeros(2) for name in masks}  # errors, pairs
    false = np.zeros(2)  # false visible and false hidden
    for j in range(0, len(lights), stride):
        eye = lights[j].position
        compared = good & (true.cosine(eye) > STEEP)
        front = facing(surfels, eye)[taken] > 0
        rays = front & ~scene.occluded(
            surfels.position[taken], eye[None], normal=surfels.normal[taken]
        )
        traced = rays[place[compared]]
        seen = true.of("light", j, eye)[compared]
        off = traced != seen
        false += (traced & ~seen).sum(), (~traced & seen).sum()
        for name, mask in masks.items():
            inside = mask[compared]
            wrong[name] += off[inside].sum(), inside.sum()
    visible, hidden = false / wrong["all"][1]
    say(what="truth", false_visible=float(visible), false_hidden=float(hidden))
    for name, (errors, pairs) in wrong.items():
        if pairs:
            say(what="truth", region=name, pairs=int(pairs), right=1 - errors / pairs)
