"""Fine detail of skin: a patch with pores and wrinkles finer than the surfels, photographed by
the virtual dome, and what its model shows of them in photographs that it was not made from.

The peer is Lambert's law fitted at every texel to the same photographs by least squares.
"""

from __future__ import annotations

import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import imagecodecs
import numpy as np
import trimesh
import xarray as xr
from scipy.ndimage import gaussian_filter

from skindb.fit import fit_model
from skindb.format.folder import read_capture
from skindb.geometry.atlas import bilinear, rasterise_atlas
from skindb.geometry.rays import RayScene
from skindb.ingest import ingest_capture
from skindb.reflectance.dictionary import embedded_dictionary
from skindb.reflectance.mixture import Mixture
from skindb.render.photographs import FINE_MM, Comparison, compare_photographs
from skindb.render.scene import Surface, cameras_from_dome, from_model
from skindb.render.shading import trace_view
from skindb.types import Array, dots, lengths, unit
from skindb.virtual.capture import dome_record, session_time
from skindb.virtual.dome import (
    CENTRE,
    FRAMES,
    SECONDS,
    Dome,
    Sensor,
    build_dome,
    photograph,
)
from skindb.virtual.person import default_people

MATERIAL = "ggx 0.37"  # gloss of the patch, beside its diffuse reflectance
TRUE_MM = 0.2  # spacing of the photographed surface
SCAN_MM = 2.4
PIXEL_MM = 0.3
CURVATURE = 1 / 27.0  # mm^-1, of the middle of the patch
COLOUR = (0.55, 0.36, 0.26)
PORES_PER_MM2 = 0.35
PORE_MM = 0.4  # standard deviation
PORE_DEPTH = 0.45  # part of the diffuse reflectance that the middle of a pore lacks
WRINKLE_SLOPE = 0.12
WRINKLE_MM = 1.6  # wavelength


def height(x: Array, y: Array) -> Array:
    """Height [mm] of the smooth shape."""
    return -CURVATURE * (x**2 + y**2) / 2


def smooth_normals(x: Array, y: Array) -> Array:
    """Unit normals (..., 3) of the smooth shape."""
    return unit(np.stack([CURVATURE * x, CURVATURE * y, np.ones_like(x)], axis=-1))


class Patch:
    """True diffuse reflectance and normals of a patch of skin, functions of x and y [mm]."""

    def __init__(self, side: float, seed: int) -> None:
        rng = np.random.default_rng(seed)
        count = int(PORES_PER_MM2 * side**2)
        self.pores = rng.uniform(-side / 2, side / 2, (count, 2))
        angle = rng.uniform(0, np.pi, 6)
        wave = 2 * np.pi / (WRINKLE_MM * rng.uniform(0.8, 1.6, 6))
        self.waves = wave[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        self.phases = rng.uniform(0, 2 * np.pi, 6)

    def diffuse(self, x: Array, y: Array) -> Array:
        """R_d (n, 3)."""
        dark = np.zeros(x.shape)
        for pore in self.pores:
            near = (np.abs(x - pore[0]) < 4 * PORE_MM) & (
                np.abs(y - pore[1]) < 4 * PORE_MM
            )
            square = (x[near] - pore[0]) ** 2 + (y[near] - pore[1]) ** 2
            dark[near] += np.exp(-square / (2 * PORE_MM**2))
        blotches = 1 + 0.08 * np.sin(x / 6) * np.cos(y / 5)
        grey = blotches * (1 - PORE_DEPTH * np.minimum(dark, 1))
        return np.array(COLOUR) * grey[:, None]

    def normals(self, x: Array, y: Array) -> Array:
        """Unit normals (n, 3) with wrinkles."""
        place = np.stack([x, y], axis=1)
        turn = np.cos(place @ self.waves.T + self.phases) @ self.waves
        turn *= WRINKLE_SLOPE / np.sqrt((turn**2).mean())
        return unit(smooth_normals(x, y) - np.pad(turn, [(0, 0), (0, 1)]))


def grid(side: float, spacing: float) -> tuple[Array, Array]:
    """Vertices (n, 3) mm of the smooth shape around the origin, and triangles (f, 3)."""
    line = np.arange(-side / 2, side / 2 + spacing / 2, spacing)
    x, y = (plane.ravel() for plane in np.meshgrid(line, line))
    n = len(line)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    squares = [(i, i + 1, i + n), (i + 1, i + n + 1, i + n)]
    faces = np.concatenate([np.stack(corners, axis=1) for corners in squares])
    return np.stack([x, y, height(x, y)], axis=1), faces


def close_dome(side: float, lights: int, cameras: int) -> Dome:
    """The virtual dome with lenses that show the patch alone, at `PIXEL_MM`."""
    dome = build_dome(lights, cameras, rng=np.random.default_rng(2005))
    pixels = int(1.15 * side / PIXEL_MM)
    closer = []
    for camera in dome.cameras:
        focal = lengths(camera.centre - CENTRE) / PIXEL_MM
        seen = camera.R @ CENTRE + camera.t
        x, y = pixels / 2 - focal * seen[:2] / seen[2]
        K = np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])
        lens = replace(camera, K=K, distortion=np.zeros(5), width=pixels, height=pixels)
        closer.append(replace(lens, vignette=np.zeros(3)))
    return Dome(tuple(closer), dome.lights)


def write_patch(
    out: Path,
    *,
    side: float = 44.0,
    seed: int = 0,
    lights: int = 24,
    cameras: int = 4,
) -> Patch:
    """Write a capture of a patch of `side` mm, and return its truth."""
    patch = Patch(side, seed)
    vertices, faces = grid(side, TRUE_MM)
    x, y, _ = vertices.T
    whole = embedded_dictionary()
    table = np.ascontiguousarray(whole.table[..., [whole.names.index(MATERIAL)]])
    surface = Surface(
        vertices + CENTRE,
        faces,
        patch.normals(x, y),
        patch.diffuse(x, y),
        np.ones((len(x), 1)),
        Mixture(table),
    )
    dome = close_dome(side, lights, cameras)
    sensor = Sensor()
    rng = np.random.default_rng([seed, 1])
    (out / "dome").mkdir(parents=True)
    photograph(
        out,
        surface,
        dome,
        sensor=sensor,
        device_rng=np.random.default_rng(2005),
        rng=rng,
        step=lambda: None,
    )
    vertices, faces = grid(side, SCAN_MM)
    scan = trimesh.Trimesh(vertices + CENTRE, faces, process=False)
    scan.export(out / "scan.ply")
    start = session_time(default_people()[0])
    record = {
        "format": "skindb-capture",
        "version": 1,
        "subject": f"P{seed:03d}",
        "session": start.isoformat(),
        "condition": "normal",
        "consent": {
            "scope": ["fit", "statistics", "export", "publish"],
            "reference": "virtual-no-person",
        },
        "mesh": "scan.ply",
        "dome": "dome/dome.json",
        "virtual": True,
    }
    for name, content in (
        ("dome/dome.json", dome_record(dome, sensor, start)),
        ("capture.json", record),
    ):
        (out / name).write_text(json.dumps(content), encoding="utf-8")
    return patch


def lambert_predictions(
    folder: Path, capture: xr.DataTree, model: xr.DataTree, photographs: set[str]
) -> dict[str, Array]:
    """The peer's pictures (h, w, 3) of the photographs "light camera", by Lambert's law at each
    texel from all other frames: no noise model, no gloss, no surfels.
    """
    dome = capture["dome"].to_dataset()
    maps = capture["detail"].sizes["v"]
    surface = from_model(model)
    uv = model["fitted"]["surfel_uv"].values
    face, weight = rasterise_atlas(uv, surface.faces, maps)
    on = face >= 0
    place = np.einsum(
        "nk,nkc->nc", weight[on], surface.vertices[surface.faces[face[on]]]
    )
    smooth = smooth_normals(*(place - CENTRE).T[:2])
    gram = np.zeros((len(place), 3, 3))
    right = np.zeros((len(place), 3, 3))
    lights = dome["light_position"].values
    intensity = dome["light_intensity"].values
    cameras = cameras_from_dome(dome)
    scene = RayScene(surface.vertices, surface.faces)
    views = {}
    for c, camera in enumerate(cameras):
        name = str(dome["camera"].values[c])
        pixel = camera.project(place)
        seen = dots(unit(camera.centre - place), smooth) > 0.3
        for j, light in enumerate(map(str, dome["light"].values)):
            if f"{light} {name}" in photographs:
                views[f"{light} {name}"] = (j, camera)
                continue
            frame = folder / FRAMES.format(exposure="e1", light=light, camera=name)
            values = imagecodecs.png_decode(frame.read_bytes()).astype(float)
            radiance = (
                (values - Sensor.black) / (Sensor.white - Sensor.black) / SECONDS[1]
            )
            way = lights[j] - place
            towards = unit(way)
            used = seen & (dots(towards, smooth) > 0.3)
            rho = bilinear(radiance, pixel) * dots(way, way)[:, None] / intensity[j]
            used &= np.isfinite(rho).all(axis=1)
            gram[used] += towards[used, :, None] * towards[used, None, :]
            right[used] += towards[used, :, None] * rho[used, None, :]
    solved = np.linalg.solve(gram + 1e-6 * np.eye(3), right)
    image = np.zeros((maps, maps, 9))
    image[on] = solved.reshape(-1, 9)
    pictures = {}
    for key, (j, camera) in views.items():
        view = trace_view(surface, camera, samples=2, scene=scene)
        at = bilinear(image, view.interpolate(uv) * maps).reshape(-1, 3, 3)
        way = lights[j] - view.position
        rho = np.maximum(np.einsum("nkc,nk->nc", at, unit(way)), 0)
        pictures[key] = view.image(rho * intensity[j] / dots(way, way)[:, None])
    return pictures


def fine_rmse(rendered: Array, photograph: Comparison) -> float:
    """Relative RMS error of what is finer than `FINE_MM`, away from rim and shadows."""
    sigma = FINE_MM / PIXEL_MM
    mask = photograph.mask
    theirs, ours = (
        np.where(mask, np.nan_to_num(image.mean(axis=2, dtype=float)), 0)
        for image in (photograph.photographed, rendered)
    )
    cover = gaussian_filter(mask.astype(float), sigma)
    level = gaussian_filter(theirs, sigma)
    inside = (cover > 0.999) & (level > 0.1 * np.quantile(level[mask], 0.95))
    error = ours - theirs
    fine = (error - gaussian_filter(error, sigma)) / np.maximum(level, 1e-9)
    return float(np.sqrt((fine[inside] ** 2).mean()))


def print_recovery(seed: int, patch: Patch, model: xr.DataTree) -> None:
    """Print the errors of R_d and normals at the texels, by surfels alone and with detail, and
    how many true values are in the 95 % intervals.
    """
    fitted = model["fitted"].to_dataset()
    detail = model["detail"].to_dataset()
    surface = from_model(model)
    face, weight = rasterise_atlas(
        fitted["surfel_uv"].values, surface.faces, detail.sizes["v"]
    )
    errors = detail["diffuse_detail_error"].values.astype(float)
    on = (face >= 0) & np.isfinite(errors).all(axis=2)
    corners = surface.faces[face[on]]

    def at_texels(values: Array) -> Array:
        return np.einsum("nk,nkc->nc", weight[on], values[corners])

    x, y = (at_texels(surface.vertices) - CENTRE).T[:2]
    smooth = at_texels(surface.diffuse)
    sharp = smooth * (1 + detail["diffuse_detail"].values[on])
    total = np.hypot(
        smooth * errors[on],
        at_texels(fitted["diffuse_reflectance_total_error"].values),
    )
    true = patch.diffuse(x, y)
    bent = at_texels(surface.normals)
    moved = bent + detail["normal_detail"].values[on]
    normal = patch.normals(x, y)
    angles = [
        np.degrees(np.arccos(np.clip(dots(unit(one), normal), -1, 1)))
        for one in (bent, moved)
    ]
    spread = np.sqrt(
        (detail["normal_detail_error"].values[on].astype(float) ** 2).sum(1)
    )
    own = at_texels(fitted["normal_total_error"].values[:, None])[:, 0]
    allowed = 1.73 * np.hypot(np.degrees(spread), own)  # of an angle of two axes
    rms = [np.sqrt(((one / true - 1) ** 2).mean()) for one in (smooth, sharp)]
    print(
        f"seed {seed}: R_d at texels, relative RMS error {rms[0]:.3f} by surfels, "
        f"{rms[1]:.3f} with detail; normals, median {np.median(angles[0]):.2f} and "
        f"{np.median(angles[1]):.2f} degrees; in the 95 % intervals with the total errors of "
        f"the surfels {(np.abs(sharp - true) < 1.96 * total).mean():.3f} and "
        f"{(angles[1] < allowed).mean():.3f}, with the detail's alone "
        f"{(np.abs(sharp - true) < 1.96 * smooth * errors[on]).mean():.3f}"
    )


def main(
    *,
    seeds: Annotated[int, "Number of patches."] = 3,
    lights: Annotated[int, "Number of lights."] = 24,
    cameras: Annotated[int, "Number of cameras."] = 4,
    side: Annotated[float, "Side of the patches [mm]."] = 44.0,
) -> int:
    """Print fine contrast and errors at kept photographs, with and without the detail."""
    print("seed  photograph  model     fine_contrast  fine_gain  fine_rmse  rmse")
    for seed in range(seeds):
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch) / "patch"
            patch = write_patch(
                folder, side=side, seed=seed, lights=lights, cameras=cameras
            )
            begin = time.perf_counter()
            with ingest_capture(read_capture(folder), scratch=scratch) as tree:
                capture = tree.load()
            seconds = time.perf_counter() - begin
            model = fit_model(capture)
            detail = compare_photographs(model, capture)
            keys = {f"{one.light} {one.camera}" for one in detail}
            peer = lambert_predictions(folder, capture, model, keys)
            print_recovery(seed, patch, model)
            del model["detail"]
            surfels = compare_photographs(model, capture)
        for kind, pictures in (("surfels", surfels), ("detail", detail)):
            for one in pictures:
                numbers = [
                    one.error["fine_contrast"],
                    one.error["fine_gain"],
                    fine_rmse(one.rendered, one),
                    one.error["relative_rmse"],
                ]
                print(seed, one.light, one.camera, kind, *np.round(numbers, 3))
        for one in detail:
            rendered = peer[f"{one.light} {one.camera}"]
            error = np.nan_to_num(rendered - one.photographed)[one.mask]
            level = one.photographed[one.mask]
            whole = np.sqrt((error**2).mean() / (level**2).mean())
            numbers = [fine_rmse(rendered, one), whole]
            print(seed, one.light, one.camera, "lambert", *np.round(numbers, 3))
        stored = sum(values.nbytes for values in capture["detail"].values())
        print(f"seed {seed}: ingest {seconds:.1f} s; detail {stored / 1e6:.1f} MB")
    return 0
