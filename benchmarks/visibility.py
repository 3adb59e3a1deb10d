"""Visibility by rays and by splats: time for all lights and cameras, agreement, and
error relative to the truth.

    python -m benchmarks visibility CAPTURE [--truth] [--spacing 0.4] [--stride 10]
    [--picture FILE.png]

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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.truth import TrueVisibility, Truth, read_truth, regions
from skindb.format.dome import CameraRecord, LightRecord
from skindb.format.folder import read_capture
from skindb.geometry._mesh_kernels import grown, mixed
from skindb.geometry.rays import RayScene
from skindb.geometry.splats import PIXEL, THRESHOLD, SplatScene
from skindb.ingest.surfels import (
    SurfelSet,
    build_surfels,
    camera_visibility,
    disc_points,
    light_visibility,
)

# cosine, and neighbours from the edge of a shadow, beyond which the methods should agree
STEEP = 0.1
RINGS = 3
DENSE = 200  # points of a disc for the reference
UNDERSIDE = -0.5  # y of a normal that points down
# mm and cosine between a surfel and the true vertex with which it is compared
NEAREST = 1.0
TURNED = 0.85
# from above and the side, so that nose, brow and ear cast shadows
FROM_SIDE = np.array([0.75, 0.45, 0.5])
WIDTH = 1300
HEIGHT = 1030


def main(
    capture: Path,
    *,
    truth: Annotated[bool, "Compare with the true surface."] = False,
    spacing: float = 0.4,
    stride: Annotated[int, "Compare every N-th light."] = 10,
    picture: Path | None = None,
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
    if picture:
        draw(surfels, scene, dome.lights, picture)


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
        for method in ("rays", "splats"):
            light_visibility(surfels, points[:1], scene, pool, method=method)
            camera_visibility(surfels, [small], scene, pool, method=method)
            with clock(f"{method}: centres of the lights", **size):
                light_visibility(surfels, points, scene, pool, method=method)
            with clock(
                f"{method}: cameras, depth maps, clear views", cameras=len(cameras)
            ):
                camera_visibility(surfels, cameras, scene, pool, method=method)
        with clock("rays: discs of the lights", **size):
            light_visibility(surfels, lights, scene, pool)


def facing(surfels: SurfelSet, place: Any) -> Any:
    way = place - surfels.position
    return np.einsum("ni,ni->n", way, surfels.normal) / np.linalg.norm(way, axis=1)


@dataclass(frozen=True)
class SeenByRays:
    """What a light sees by rays, and where splats should agree."""

    light: LightRecord
    visible: Any  # (n,) of the centre
    steep: Any  # (n,) cosines above STEEP
    certain: Any  # (n,) of these, away from the edges of shadows


def compare(
    surfels: SurfelSet, scene: RayScene, lights: tuple[LightRecord, ...]
) -> None:
    """Compare splats with rays for several map sizes, and the five points of a disc
    with DENSE points.
    """
    differing = 0
    faced = 0
    errors = []
    views = []
    with ThreadPoolExecutor(1) as pool:
        fractions = light_visibility(surfels, lights, scene, pool)
    for light, fraction in zip(lights, fractions.T, strict=True):
        cosine = facing(surfels, light.position)
        front = np.flatnonzero(cosine > 0)
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
        visible = np.zeros(len(cosine), bool)
        visible[front] = by_point[0]
        edge = mixed(surfels.faces, visible)
        for _ in range(RINGS):
            edge = grown(surfels.faces, edge)
        steep = cosine > STEEP
        views.append(SeenByRays(light, visible, steep, steep & ~edge))
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
    compare_splats(surfels, views)


def compare_splats(surfels: SurfelSet, views: list[SeenByRays]) -> None:
    """Agreement of splats with rays by the size of a pixel of their map."""
    for factor in (0.3, PIXEL, 0.5, 0.7):
        splats = SplatScene(
            surfels.position,
            surfels.normal,
            surfels.radius,
            pixel_mm=factor * float(np.median(surfels.radius)),
        )
        begin = time.process_time()
        fractions = [splats.visible_fraction(view.light.position) for view in views]
        cpu = (time.process_time() - begin) / len(views)
        for threshold in (THRESHOLD, 0.5):
            away = []
            with_edges = []
            for fraction, view in zip(fractions, views, strict=True):
                same = (fraction >= threshold) == view.visible
                away.append(same[view.certain].mean())
                with_edges.append(same[view.steep].mean())
            say(
                what="splats as rays",
                pixel_of_radius=factor,
                threshold=threshold,
                cpu_a_view=cpu,
                mean=float(np.mean(away)),
                worst=float(min(away)),
                with_edges=float(np.mean(with_edges)),
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
    """Compare both methods with the truth by region, at the surfels nearest to true
    vertices that face the light.
    """
    true = TrueVisibility(truth)
    distance, nearest = cKDTree(surfels.position).query(true.vertices, workers=1)
    cosine = np.einsum("ni,ni->n", surfels.normal[nearest], true.normals)
    good = (distance < NEAREST) & (cosine > TURNED)
    taken = np.unique(nearest[good])
    place = np.searchsorted(taken, nearest)
    masks = region_masks(true)
    splats = SplatScene(surfels.position, surfels.normal, surfels.radius)
    # errors of rays, errors of splats, differences between both, pairs
    wrong = {name: np.zeros(4) for name in masks}
    false = np.zeros((2, 2))  # method, false visible and false hidden
    for j in range(0, len(lights), stride):
        eye = lights[j].position
        compared = good & (true.cosine(eye) > STEEP)
        front = facing(surfels, eye)[taken] > 0
        rays = front & ~scene.occluded(
            surfels.position[taken], eye[None], normal=surfels.normal[taken]
        )
        drawn = front & (splats.visible_fraction(eye, taken) >= THRESHOLD)
        both = np.stack([rays, drawn])[:, place[compared]]
        seen = true.of("light", j, eye)[compared]
        off = both != seen
        false += np.stack([(both & ~seen).sum(axis=1), (~both & seen).sum(axis=1)], 1)
        differ = both[0] != both[1]
        for name, mask in masks.items():
            inside = mask[compared]
            counts = [differ[inside].sum(), inside.sum()]
            wrong[name] += [*off[:, inside].sum(axis=1), *counts]
    total = wrong["all"][3]
    for method, (visible, hidden) in zip(
        ("rays", "splats"), false / total, strict=True
    ):
        figures = {"false_visible": float(visible), "false_hidden": float(hidden)}
        say(what="truth", method=method, **figures)
    for name, (of_rays, of_splats, differing, pairs) in wrong.items():
        if pairs:
            say(
                what="truth",
                region=name,
                pairs=int(pairs),
                rays=1 - of_rays / pairs,
                splats=1 - of_splats / pairs,
                each_other=1 - differing / pairs,
            )


def draw(
    surfels: SurfelSet, scene: RayScene, lights: tuple[LightRecord, ...], path: Path
) -> None:
    """Draw the head under one light from the side: by rays, by splats, and the difference."""
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt

    towards = np.array([light.position for light in lights])
    towards -= surfels.position.mean(axis=0)
    cosine = towards @ FROM_SIDE / np.linalg.norm(towards, axis=1)
    light = lights[int(cosine.argmax())]
    with ThreadPoolExecutor(1) as pool:
        fractions = [
            light_visibility(surfels, [light], scene, pool, method=m)[:, 0].astype(
                float
            )
            for m in ("rays", "splats")
        ]
    differing = 100 * np.mean(fractions[0] != fractions[1])
    titles = ("rays", "splats", f"difference ({differing:.2f} % of the surfels)")
    figure, axes = plt.subplots(1, 3, figsize=(11, 5.1))
    images = painted(surfels, scene, light, fractions)
    for axis, image, title in zip(axes, images, titles, strict=True):
        axis.imshow(image)
        axis.set_title(title, fontsize=10)
        axis.axis("off")
    axes[2].text(
        0.5,
        -0.03,
        "red: visible only by splats; blue: only by rays",
        transform=axes[2].transAxes,
        ha="center",
        fontsize=8,
    )
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def painted(
    surfels: SurfelSet, scene: RayScene, light: LightRecord, fractions: list[Any]
) -> list[Any]:
    """Images (h, w, 3) of the shaded head by both methods, and of their difference."""
    low = surfels.position.min(axis=0)
    high = surfels.position.max(axis=0)
    middle = (low + high) / 2
    eye = np.array([middle[0] + 250, middle[1], high[2] + 700])
    x, y = np.meshgrid(
        np.linspace(low[0] - 20, high[0] + 40, 640),
        np.linspace(high[1] + 5, low[1] - 5, 720),
    )
    depth = np.full(x.shape, surfels.position[:, 2].mean())
    target = np.stack([x, y, depth], axis=-1).reshape(-1, 3)
    face, weight, _ = scene.first_hit(np.broadcast_to(eye, target.shape), target - eye)
    corner = surfels.faces[face]

    def at_pixels(values: Any) -> Any:
        return np.einsum("nk,nk->n", weight, values[corner])

    shade = 0.25 + 0.75 * np.maximum(facing(surfels, light.position), 0)
    images = [
        np.repeat(at_pixels((0.15 + 0.85 * fraction) * shade)[:, None], 3, axis=1)
        for fraction in fractions
    ]
    off = at_pixels(fractions[1] - fractions[0])
    base = 0.75 + 0.2 * at_pixels(shade)
    lost = (np.maximum(-off, 0), np.abs(off), np.maximum(off, 0))
    images.append(np.clip(np.stack([base - colour for colour in lost], -1), 0, 1))
    for image in images:
        image[face < 0] = 1
    return [image.reshape(*x.shape, 3) for image in images]
