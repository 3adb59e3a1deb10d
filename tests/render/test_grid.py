"""Grids of pictures with one exposure."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.render.figures import write_grid
from skindb.render.image import read_png


def radiance(level):
    """A lit square on black."""
    image = np.zeros((40, 30, 3), np.float32)
    image[10:30, 5:25] = level
    return image


def cells(picture, columns):
    """Brightest value of each column of pictures: labels are black on white, pictures
    are on black.
    """
    lit = (picture[..., :3] < 250).any(axis=2) & (picture[..., :3] > 5).any(axis=2)
    found = np.flatnonzero(lit.sum(axis=0) > 50)  # labels are not that tall
    parts = np.split(found, np.flatnonzero(np.diff(found) > 1) + 1)
    assert len(parts) == columns
    return [float(np.median(picture[:, part][lit[:, part]])) for part in parts]


def test_write_grid__one_exposure_for_all(tmp_path):
    path = tmp_path / "grid.png"
    write_grid(
        path,
        {"lotion": [radiance(0.5), radiance(0.25), radiance(0.5)]},
        ["A", r"$\x$", "full"],
        exposure=1.5,
    )
    first, half, full = cells(read_png(path), 3)
    assert first == full
    assert first == pytest.approx(255 * (1.055 * 0.75 ** (1 / 2.4) - 0.055), abs=2)
    assert half == pytest.approx(255 * (1.055 * 0.375 ** (1 / 2.4) - 0.055), abs=2)


@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_write_grid__formats_and_dark_pictures(tmp_path, ending):
    path = tmp_path / f"grid.{ending}"
    write_grid(path, {"a": [radiance(0.0)], "b": [radiance(0.0)]}, ["X"])
    assert path.stat().st_size > 500
