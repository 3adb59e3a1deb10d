"""Kernel that looks up many positions in several pictures."""

from __future__ import annotations

from typing import Any

from skindb.jit import kernel


@kernel
def interpolate(images: Any, pixels: Any, out: Any) -> None:
    """Bilinear values (picture, n) of pictures (picture, h, w) at pixels (n, 2); 0
    outside, also where these are NaN.

    Positions are the outer loop: where they lie in a picture is computed once for all pictures.
    """
    count, height, width = images.shape
    for k in range(len(pixels)):
        x = pixels[k, 0]
        y = pixels[k, 1]
        if not (
            x >= 0
            and x <= width
            and y >= 0
            and y <= height
            and width > 0
            and height > 0
        ):
            out[:, k] = 0.0
            continue
        column = min(max(x - 0.5, 0.0), width - 1.0)
        row = min(max(y - 0.5, 0.0), height - 1.0)
        left = min(int(column), max(width - 2, 0))
        top = min(int(row), max(height - 2, 0))
        right = min(left + 1, width - 1)
        below = min(top + 1, height - 1)
        a = column - left
        b = row - top
        for i in range(count):
            upper = images[i, top, left] * (1 - a) + images[i, top, right] * a
            lower = images[i, below, left] * (1 - a) + images[i, below, right] * a
            out[i, k] = upper * (1 - b) + lower * b
