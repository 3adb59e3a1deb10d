"""Write docs/pictures/overview.png from the database of `make demo`: photograph, prediction, maps of one take."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import skindb
from skindb.demo_report import map_pictures
from skindb.render.image import write_png
from skindb.render.photographs import compare_photographs, side_by_side

HERE = Path(__file__).parent
TAKE = "V002"


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
    height = 260
    resized = [_resize(p, height) for p in pictures]
    (HERE / "pictures").mkdir(exist_ok=True)
    write_png(HERE / "pictures" / "overview.png", np.concatenate(resized, axis=1))


def _resize(picture: np.ndarray, height: int) -> np.ndarray:
    from skimage.transform import resize

    shape = (height, round(picture.shape[1] * height / picture.shape[0]))
    return (resize(picture, shape, anti_aliasing=True) * 255).astype(np.uint8)


if __name__ == "__main__":
    main()
