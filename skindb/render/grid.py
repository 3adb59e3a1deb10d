"""Grids of pictures at one exposure, for comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from skindb.files import private_file
from skindb.plots import plain_text
from skindb.render.image import auto_exposure, tone_map

CELL = 2.0  # inches, the longer side of a picture
MARGIN = 4  # pixels around the lit part


@plain_text()
def write_grid(
    path: Path,
    rows: Mapping[str, Sequence[NDArray[np.floating]]],
    titles: Sequence[str],
    *,
    exposure: float | None = None,
) -> None:
    """Write pictures as a grid with labels (.png, .pdf, .svg).

    Parameters
    ----------
    path
        File to write.
    rows
        Linear pictures (h, w, 3) of one size, one per column, by the label of the row.
    titles
        Titles of the columns.
    exposure
        Factor on every picture before encoding; default `auto_exposure` of the first picture.
    """
    from matplotlib import pyplot

    every = [image for row in rows.values() for image in row]
    gain = auto_exposure(every[0]) if exposure is None else exposure
    shown = _lit(every)
    height, width = every[0][shown].shape[:2]
    size = (CELL * width / max(height, width), CELL * height / max(height, width))
    figure, axes = pyplot.subplots(
        len(rows),
        len(titles),
        figsize=(size[0] * len(titles) + 1.4, size[1] * len(rows) + 0.4),
        squeeze=False,
    )
    for line, (label, row) in zip(axes, rows.items(), strict=True):
        for ax, image in zip(line, row, strict=True):
            ax.imshow(tone_map(image[shown], exposure=gain), interpolation="none")
            ax.set(xticks=[], yticks=[])
            ax.set_frame_on(False)
        line[0].set_ylabel(label, rotation=0, ha="right", va="center", fontsize=8)
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title, fontsize=8)
    figure.subplots_adjust(wspace=0.02, hspace=0.02)
    figure.savefig(
        private_file(path),
        dpi=max(150.0, max(height, width) / CELL),
        bbox_inches="tight",
    )
    pyplot.close(figure)


def _lit(images: Sequence[NDArray[np.floating]]) -> tuple[slice, slice]:
    """Rows and columns of the part where any of the pictures is above zero."""
    lit = np.any([np.nan_to_num(image).max(axis=2) > 0 for image in images], axis=0)
    if not lit.any():
        return slice(None), slice(None)
    found = []
    for axis in (1, 0):
        at = np.flatnonzero(lit.any(axis=axis))
        found.append(slice(max(int(at[0]) - MARGIN, 0), int(at[-1]) + 1 + MARGIN))
    return found[0], found[1]
