"""Kernel that looks up many positions in several pictures."""

from __future__ import annotations

from typing import Any

from skindb._compiled import kernel


@kernel
def interpolate(images: Any, pixels: Any, out: Any) -> None:
    """Bilinear values (picture, n) of pictures (picture, h, w) at pixels (n, 2); 0 outside, also where these are NaN.

    Positions are the outer loop: where they lie in a picture is computed once for all pictures.
    """
    count, height, width = images.shape
    for k in range(len(pixels)):
        x, y = pixels[k, 0], pixels[k, 1]
        if not (x >= 0 and x <= width and y >= 0 and y <= height and width > 0 and height > 0):
            out[:, k] = 0.0
            continue
        column, row = min(max(x - 0.5, 0.0), width - 1.0), min(max(y - 0.5, 0.0), height - 1.0)
        left, top = min(int(column), max(width - 2, 0)), min(int(row), max(height - 2, 0))
        right, below = min(left + 1, width - 1), min(top + 1, height - 1)
        a, b = column - left, row - top
        for i in range(count):
            upper = images[i, top, left] * (1 - a) + images[i, top, right] * a
            lower = images[i, below, left] * (1 - a) + images[i, below, right] * a
            out[i, k] = upper * (1 - b) + lower * b
