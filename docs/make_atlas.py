"""Write docs/pictures/atlas.png from the database of `make demo`: a checkerboard of the map
on the face from the front and from the side, and the map itself, red where the stretch
exceeds 3 : 1.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import skindb
from skindb.geometry.atlas import stretches
from skindb.render.figures import trace_front
from skindb.render.image import write_png

HERE = Path(__file__).parent
TAKE = "V002"
CHECKS = 48  # squares along a side of the map
STRETCHED = 3.0


def main() -> None:
    """Write the picture."""
    db = skindb.open(str(HERE.parent / "demo" / "db"))
    write_png(HERE / "pictures" / "atlas.png", atlas_picture(*_mesh(db)))


def _mesh(db: skindb.Database) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    capture = db.read("capture", TAKE)
    surfels = capture["surfels"].to_dataset()
    return (
        surfels["surfel_position"].values,
        capture["mesh/triangle"].values,
        surfels["surfel_uv"].values,
    )


def atlas_picture(
    position: np.ndarray, triangle: np.ndarray, uv: np.ndarray, size: int = 420
) -> np.ndarray:
    """The checkerboard on the face from the front and from the subject's left, and the map."""
    flat = np.column_stack([uv[:, 0], 1 - uv[:, 1], np.zeros(len(uv))])
    views = [(position, 0.0), (position, 60.0), (flat, 0.0)]
    return np.concatenate(
        [_checked(position, triangle, uv, *view, size) for view in views], axis=1
    )


def _checked(
    position: np.ndarray,
    triangle: np.ndarray,
    uv: np.ndarray,
    at: np.ndarray,
    turn: float,
    size: int,
) -> np.ndarray:
    """Checkerboard of the mesh with vertices at `at`, red where the map is stretched,
    and shaded.
    """
    corner, weight, shade = trace_front(at, triangle, turn, size=2 * size)
    largest, smallest, _ = stretches(position, triangle, uv)
    red = np.zeros(len(position), bool)
    red[triangle[largest > STRETCHED * smallest]] = True
    place = np.einsum("...k,...kc->...c", weight, uv[corner])
    dark = np.floor(place * CHECKS).astype(int).sum(axis=-1) % 2 == 1
    image = np.where(dark[..., None], [0.30, 0.33, 0.38], [0.92, 0.90, 0.86])
    image = np.where(
        red[corner].all(axis=-1)[..., None], image * [1.0, 0.45, 0.4], image
    )
    image *= (0.35 + 0.65 * shade)[..., None]
    image[np.isnan(shade)] = 1
    image = image[:, : image.shape[1] // 2 * 2]
    half = image.reshape(size, 2, -1, 2, 3).mean(axis=(1, 3))
    return (half * 255).astype(np.uint8)


if __name__ == "__main__":
    main()
