"""Write docs/pictures/overview.png and atlas.png from the database of `make demo`.

overview: photograph, prediction, maps of one take. atlas: a checker of the map on the face from the front and from the
side, and the map itself; red where the stretch exceeds 3 : 1.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import skindb
from skindb.demo_report import map_pictures
from skindb.geometry.distortion import stretches
from skindb.geometry.texture import rasterise_atlas
from skindb.render.image import write_png
from skindb.render.photographs import compare_photographs, side_by_side

HERE = Path(__file__).parent
TAKE = "V002"
CHECKS = 48  # squares along a side of the map
STRETCHED = 3.0


def main() -> None:
    """Put the pictures in one row of equal height."""
    db = skindb.open(str(HERE.parent / "demo" / "db"))
    model = db.read("model", TAKE)
    best = min(
        compare_photographs(model, db.read("capture", TAKE)), key=lambda c: (not c.held_out, c.error["relative_rmse"])
    )
    width = best.mask.shape[1]
    rows = np.flatnonzero(best.mask.any(axis=1))
    pair = side_by_side(best)[max(rows[0] - 8, 0) : rows[-1] + 8, : 2 * width]
    pictures = [pair[:, :width], pair[:, width:], *(image for image, _ in map_pictures(model)[:4])]
    atlas = atlas_picture(*_mesh(db))
    write_png(HERE / "pictures" / "atlas.png", atlas)
    height = 260
    resized = [_resize(p, height) for p in pictures]
    (HERE / "pictures").mkdir(exist_ok=True)
    write_png(HERE / "pictures" / "overview.png", np.concatenate(resized, axis=1))


def _mesh(db: skindb.Database) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    capture = db.read("capture", TAKE)
    surfels = capture["surfels"].to_dataset()
    return surfels["surfel_position"].values, capture["mesh/triangle"].values, surfels["surfel_uv"].values


def atlas_picture(position: np.ndarray, triangle: np.ndarray, uv: np.ndarray, size: int = 420) -> np.ndarray:
    """The checker on the face from the front and from the subject's left, and the map."""
    views = [_checked(position, triangle, uv, _view(position, turn), size) for turn in (0.0, 60.0)]
    flat = np.column_stack([uv, np.zeros(len(uv))])
    return np.concatenate([*views, _checked(position, triangle, uv, flat, size)], axis=1)


def _view(position: np.ndarray, degrees: float) -> np.ndarray:
    """Place in the picture (x right, y down, in its size) and depth towards the viewer, without perspective."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    x, y, z = position.T
    at = np.column_stack([c * x - s * z, -y, s * x + c * z])
    middle = (at.min(axis=0) + at.max(axis=0)) / 2
    return (at - middle) * 0.96 / np.ptp(position, axis=0).max() + 0.5


def _checked(position: np.ndarray, triangle: np.ndarray, uv: np.ndarray, at: np.ndarray, size: int) -> np.ndarray:
    """What lies nearest to the viewer: checker of the map, red where it is stretched, darker where it turns away."""
    corners = at[triangle]
    nearest = triangle[np.argsort(-corners[:, :, 2].mean(axis=1), kind="stable")]
    face, weight = rasterise_atlas(at[:, :2], nearest, 2 * size)
    seen = face >= 0
    of = nearest[face[seen]]
    place = np.einsum("tk,tkc->tc", weight[seen], uv[of])
    largest, smallest, _ = stretches(position, nearest, uv)
    dark = np.floor(place * CHECKS).astype(int).sum(axis=1) % 2 == 1
    colour = np.where(dark[:, None], [0.30, 0.33, 0.38], [0.92, 0.90, 0.86])
    colour = np.where((largest > STRETCHED * smallest)[face[seen], None], colour * [1.0, 0.45, 0.4], colour)
    p, q, r = (at[of[:, k]] for k in range(3))
    normal = np.cross(q - p, r - p)
    shade = 0.35 + 0.65 * np.abs(normal[:, 2]) / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    image = np.ones((2 * size, 2 * size, 3))
    image[seen] = colour * shade[:, None]
    half = image.reshape(size, 2, size, 2, 3).mean(axis=(1, 3))
    return (half * 255).astype(np.uint8)


def _resize(picture: np.ndarray, height: int) -> np.ndarray:
    from skimage.transform import resize

    shape = (height, round(picture.shape[1] * height / picture.shape[0]))
    return (resize(picture, shape, anti_aliasing=True) * 255).astype(np.uint8)


if __name__ == "__main__":
    main()
