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
from dataclasses import replace
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


def compare(
    surfels: SurfelSet, scene: RayScene, lights: tuple[LightRecord, ...]
) -> None:
    """Compare splats with rays for several map sizes, and the five points of a disc
    with DENSE points.
    """
    differing = 0
    faced = 0
    errors = []
    soft = 0
    seen = []
    sure = []
    steep = []
    with ThreadPoolExecutor(1) as pool:
        shares = light_visibility(surfels, lights, scene, pool)
    for light, share in zip(lights, shares.T, strict=True):
        cosine = facing(surfels, light.position)
        facing_light = np.flatnonzero(cosine > 0)
        rays = np.zeros(len(cosine), bool)
        by_point = [
            ~scene.occluded(
                surfels.position[facing_light],
                p[None],
                normal=surfels.normal[facing_light],
            )
            for p in disc_points(light)
        ]
        rays[facing_light] = by_point[0]
        expected = np.mean(by_point, axis=0).astype(np.float16)
        differing = differing + int((share[facing_light] != expected).sum())
        faced = faced + len(facing_light)
        inside = facing_light[(expected > 0) & (expected < 1)]
        soft += len(inside)
        errors.append(
            share[inside].astype(float) - dense_share(scene, surfels, inside, light)
        )
        edge = mixed(surfels.faces, rays)
        for _ in range(RINGS):
            edge = grown(surfels.faces, edge)
        seen.append(rays)
        steep.append(cosine > STEEP)
        sure.append(steep[-1] & ~edge)
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
        soft=soft / faced,
    )
    for factor in (0.3, PIXEL, 0.5, 0.7):
        splats = SplatScene(
            surfels.position,
            surfels.normal,
            surfels.radius,
            pixel_mm=factor * float(np.median(surfels.radius)),
        )
        begin = time.process_time()
        share = [splats.visible_fraction(light.position) for light in lights]
        cpu = (time.process_time() - begin) / len(lights)
        for threshold in (THRESHOLD, 0.5):
            same = [(s >= threshold) == r for s, r in zip(share, seen, strict=True)]
            away = [a[w].mean() for a, w in zip(same, sure, strict=True)]
            with_edges = np.mean(
                [a[w].mean() for a, w in zip(same, steep, strict=True)]
            )
            figures = {
                "mean": float(np.mean(away)),
                "worst": float(min(away)),
                "with_edges": float(with_edges),
            }
            say(
                what="splats as rays",
                pixel_of_radius=factor,
                threshold=threshold,
                cpu_a_view=cpu,
                **figures,
            )


def dense_share(
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

    middle = surfels.position.mean(axis=0)
    towards = np.array([light.position for light in lights]) - middle
    # from above and the side, so that nose, brow and ear cast shadows
    from_side = np.array([0.75, 0.45, 0.5])
    light = lights[
        int((towards @ from_side / np.linalg.norm(towards, axis=1)).argmax())
    ]
    with ThreadPoolExecutor(1) as pool:
        shares = [
            light_visibility(surfels, [light], scene, pool, method=m)[:, 0]
            for m in ("rays", "splats")
        ]
    low = surfels.position.min(axis=0)
    high = surfels.position.max(axis=0)
    eye = np.array(
        [(low[0] + high[0]) / 2 + 250, (low[1] + high[1]) / 2, high[2] + 700]
    )
    x, y = np.meshgrid(
        np.linspace(low[0] - 20, high[0] + 40, 640),
        np.linspace(high[1] + 5, low[1] - 5, 720),
    )
    target = np.stack([x, y, np.full(x.shape, middle[2])], axis=-1).reshape(-1, 3)
    face, weight, _ = scene.first_hit(np.broadcast_to(eye, target.shape), target - eye)
    corner = surfels.faces[face]
    shade = 0.25 + 0.75 * np.maximum(facing(surfels, light.position), 0)
    lit = [
        (np.einsum("nk,nk->n", weight, (0.15 + 0.85 * s.astype(float) * shade)[corner]))
        for s in shares
    ]
    off = np.einsum(
        "nk,nk->n", weight, (shares[1].astype(float) - shares[0].astype(float))[corner]
    )
    base = 0.75 + 0.2 * np.einsum("nk,nk->n", weight, shade[corner])
    apart = np.clip(
        np.stack(
            [base - np.maximum(-off, 0), base - np.abs(off), base - np.maximum(off, 0)],
            -1,
        ),
        0,
        1,
    )
    count = int((np.abs(shares[0].astype(float) - shares[1]) > 0).sum())
    panels = [
        (np.repeat(i[:, None], 3, axis=1), t)
        for i, t in zip(lit, ("rays", "splats"), strict=True)
    ]
    panels.append(
        (apart, f"difference ({100 * count / len(shares[0]):.2f} % of the surfels)")
    )
    figure, axes = plt.subplots(1, 3, figsize=(11, 5.1))
    for axis, (image, title) in zip(axes, panels, strict=True):
        image[face < 0] = 1
        axis.imshow(image.reshape(*x.shape, 3))
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
