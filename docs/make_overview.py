"""Write docs/pictures/overview.png and atlas.png from the database of `make demo`.

The overview shows a photograph, its prediction, and maps of one take. The atlas picture
shows a checkerboard of the map on the face from the front and from the side, and the
map itself, red where the stretch exceeds 3 : 1.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import skindb
from skindb.demo.page import map_pictures
from skindb.geometry.atlas import stretches
from skindb.render.figures import trace_front
from skindb.render.image import write_png
from skindb.render.photographs import compare_photographs, side_by_side

HERE = Path(__file__).parent
TAKE = "V002"
CHECKS = 48  # squares along a side of the map
STRETCHED = 3.0


def main() -> None:
    """Write both pictures; those of the overview have the same height."""
    db = skindb.open(str(HERE.parent / "demo" / "db"))
    model = db.read("model", TAKE)
    best = min(
        compare_photographs(model, db.read("capture", TAKE)),
        key=lambda c: (not c.held_out, c.error["relative_rmse"]),
    )
    width = best.mask.shape[1]
    rows = np.flatnonzero(best.mask.any(axis=1))
    pair = side_by_side(best)[max(rows[0] - 8, 0) : rows[-1] + 8, : 2 * width]
    pictures = [
        pair[:, :width],
        pair[:, width:],
        *(image for image, _ in map_pictures({TAKE: model})[TAKE][:4]),
    ]
    atlas = atlas_picture(*_mesh(db))
    write_png(HERE / "pictures" / "atlas.png", atlas)
    height = 260
    resized = [_resize(p, height) for p in pictures]
    (HERE / "pictures").mkdir(exist_ok=True)
    write_png(HERE / "pictures" / "overview.png", np.concatenate(resized, axis=1))


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


def _resize(picture: np.ndarray, height: int) -> np.ndarray:
    from skimage.transform import resize

    shape = (height, round(picture.shape[1] * height / picture.shape[0]))
    return (resize(picture, shape, anti_aliasing=True) * 255).astype(np.uint8)


if __name__ == "__main__":
    main()
