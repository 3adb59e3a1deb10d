"""The atlas of a scan, and maps laid out by it: distortion of each round, then time and memory of maps.

    python benchmarks/atlas.py CAPTURE [--levels 3] [--size 2048] [--channels 10]

Rounds are those of both kinds of weights until one folds; `chosen` is what `disc_atlas` returns, on the mesh after
`--levels` of subdivision. Maps hold random values of 95 % of the vertices; memory is the peak of the process.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import numpy as np

from skindb.geometry import atlas
from skindb.geometry.clean import clean_mesh
from skindb.geometry.distortion import distortion
from skindb.geometry.scan import read_scan
from skindb.geometry.subdivide import subdivide
from skindb.geometry.surfels import morton_order
from skindb.geometry.texture import atlas_values, push_pull, rasterise_atlas
from skindb.geometry.topology import boundary_loops, outline_first


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    for name, value in (("levels", 3), ("size", 2048), ("channels", 10)):
        parser.add_argument(f"--{name}", type=int, default=value)
    args = parser.parse_args()
    scan = read_scan(next(args.capture.glob("scan.*")))
    mesh = clean_mesh(scan.vertices, scan.faces)
    rounds(mesh.vertices, mesh.faces)
    vertices, faces, matrix = subdivide(mesh.vertices, mesh.faces, args.levels)
    start = time.process_time()
    uv, report = atlas.disc_atlas(mesh.vertices, mesh.faces, finer=(matrix, faces))
    print(f"chosen: {'intrinsic' if report['intrinsic'] else 'mean-value'}, {time.process_time() - start:.1f} CPU s")
    tell("chosen", vertices, faces, uv)
    order = morton_order(vertices)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    maps(uv[order], rank[faces], args.size, args.channels)


def rounds(vertices: np.ndarray, faces: np.ndarray) -> None:
    """Distortion of every round of both kinds of weights."""
    loops = outline_first(vertices, boundary_loops(faces))
    capped, rim = atlas._cap_holes(vertices, faces, loops[1:]), atlas._circle(vertices[loops[0]])
    surface = atlas.Surface(*capped, len(faces), loops[0], rim)
    for kind in ("intrinsic", "mean_value"):
        weights = getattr(atlas, f"_{kind}_weights")(surface.points, surface.faces)
        for place, (uv, _) in enumerate(atlas._equalised(surface, weights)):
            tell(f"{kind}, place {place}", vertices, faces, uv[: len(vertices)])


def tell(name: str, vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> None:
    found = distortion(vertices, faces, uv, np.zeros((len(vertices), 0), bool))
    print(f"{name:22}", {key: round(float(value[0]), 3) for key, value in found.items()}, f"{len(faces)} triangles")


def maps(uv: np.ndarray, faces: np.ndarray, size: int, channels: int) -> None:
    """Time and memory of one pass over a map; compilation does not count."""
    rng = np.random.default_rng(0)
    values = rng.random((len(uv), channels), np.float32)
    trust = (rng.random(len(uv)) > 0.05).astype(np.float32)
    for pixels in (16, size):
        start = [time.process_time()]
        raster = rasterise_atlas(uv, faces, pixels)
        start.append(time.process_time())
        image, confidence = atlas_values(values, trust, uv, faces, raster)
        start.append(time.process_time())
        push_pull(image, confidence)
        start.append(time.process_time())
    names = ("rasterise", "interpolate and average", "push-pull")
    print({name: round(b - a, 2) for name, a, b in zip(names, start[:-1], start[1:], strict=True)}, "CPU s")
    print(f"peak {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB, before and after included")


if __name__ == "__main__":
    main()
