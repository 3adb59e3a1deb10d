"""Distortion of the atlas of a scan in each round, and time and memory of maps in its layout.

    python -m benchmarks atlas CAPTURE [--levels 3] [--size 2048] [--channels 10]

`chosen` is the result of `disc_atlas` on the mesh after `--levels` subdivisions. Maps have
random values at 95 % of the vertices; memory is the peak of the process.
"""

from __future__ import annotations

import resource
import time
from pathlib import Path

import numpy as np

from skindb.geometry import atlas
from skindb.geometry.atlas import atlas_values, distortion, push_pull, rasterise_atlas
from skindb.geometry.clean import clean_mesh
from skindb.geometry.mesh import boundary_loops, morton_order, outline_first, subdivide
from skindb.geometry.scan import read_scan


def main(
    capture: Path, *, levels: int = 3, size: int = 2048, channels: int = 10
) -> None:
    scan = read_scan(next(capture.glob("scan.*")))
    mesh = clean_mesh(scan.vertices, scan.faces)
    rounds(mesh.vertices, mesh.faces)
    vertices, faces, matrix = subdivide(mesh.vertices, mesh.faces, levels)
    start = time.process_time()
    uv, _ = atlas.disc_atlas(mesh.vertices, mesh.faces, finer=(matrix, faces))
    print(f"chosen: {time.process_time() - start:.1f} CPU s")
    print_distortion("chosen", vertices, faces, uv)
    order = morton_order(vertices)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    maps(uv[order], rank[faces], size, channels)


def rounds(vertices: np.ndarray, faces: np.ndarray) -> None:
    """Print the distortion of every round."""
    loops = outline_first(vertices, boundary_loops(faces))
    capped = atlas._cap_holes(vertices, faces, loops[1:])
    rim = atlas._circle(vertices[loops[0]])
    surface = atlas.Surface(*capped, len(faces), loops[0], rim)
    for place, (uv, _) in enumerate(atlas._equalised(surface)):
        print_distortion(f"round {place}", vertices, faces, uv[: len(vertices)])


def print_distortion(
    name: str, vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray
) -> None:
    measures = distortion(vertices, faces, uv, np.zeros((len(vertices), 0), bool))
    print(
        f"{name:22}",
        {key: round(float(value[0]), 3) for key, value in measures.items()},
        f"{len(faces)} triangles",
    )


def maps(uv: np.ndarray, faces: np.ndarray, size: int, channels: int) -> None:
    """Print time and memory of one pass over a map, without compilation."""
    rng = np.random.default_rng(0)
    values = rng.random((len(uv), channels), np.float32)
    trust = (rng.random(len(uv)) > 0.05).astype(np.float32)
    for pixels in (16, size):
        start = [time.process_time()]
        raster = rasterise_atlas(uv, faces, pixels)
        start.append(time.process_time())
        image, confidence = atlas_values(values, trust, faces, raster)
        start.append(time.process_time())
        push_pull(image, confidence)
        start.append(time.process_time())
    names = ("rasterise", "interpolate and average", "push-pull")
    print(
        {
            name: round(b - a, 2)
            for name, a, b in zip(names, start[:-1], start[1:], strict=True)
        },
        "CPU s",
    )
    print(
        f"peak {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} "
        "GiB, for the whole process"
    )
