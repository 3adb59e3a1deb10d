"""Pictures of a matt hemisphere on a black background under distant lights, with known
normals.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from skindb.format.frames import write_frame

SIZE = 48
RADIUS = 20.0  # px
ALBEDO = (0.5, 0.4, 0.3)


def directions(count: int, *, elevation: float = 50.0) -> NDArray[np.float64]:
    """Unit directions (count, 3) around the view, the first one along it."""
    angle = 2 * np.pi * np.arange(count - 1) / (count - 1)
    tilt = np.radians(90 - elevation)
    ring = np.stack(
        [
            np.sin(tilt) * np.cos(angle),
            np.sin(tilt) * np.sin(angle),
            np.full(count - 1, np.cos(tilt)),
        ],
        axis=1,
    )
    return np.concatenate([[[0.0, 0.0, 1.0]], ring])


def sphere_normals() -> NDArray[np.float64]:
    """Normals (SIZE, SIZE, 3), x to the right, y up, z to the camera; NaN beside the sphere."""
    row, column = np.mgrid[:SIZE, :SIZE] + 0.5
    x = (column - SIZE / 2) / RADIUS
    y = (SIZE / 2 - row) / RADIUS
    square = x * x + y * y
    z = np.sqrt(np.where(square < 1, 1 - square, np.nan))
    return np.stack([x, y, z], axis=-1) * np.where(np.isfinite(z), 1, np.nan)[..., None]


def radiance(
    light: NDArray[np.float64], albedo: tuple[float, ...] = ALBEDO
) -> NDArray[np.float64]:
    """Radiance (SIZE, SIZE, 3) below 1 under a distant light."""
    cosine = np.nan_to_num(sphere_normals() @ light)
    return np.maximum(cosine, 0)[..., None] * np.array(albedo) * 1.6


def encoded(
    linear: NDArray[np.float64], dtype: str, *, srgb: bool
) -> NDArray[np.generic]:
    """Values of a file, or float radiance."""
    if dtype == "float32":
        return linear.astype(np.float32)
    level = linear
    if srgb:
        level = np.where(
            linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055
        )
    return np.rint(level * np.iinfo(dtype).max).astype(dtype)


def write_pictures(
    folder: Path,
    lights: NDArray[np.float64],
    *,
    suffix: str = ".png",
    dtype: str = "uint16",
    srgb: bool = False,
    albedo: tuple[float, ...] = ALBEDO,
    gains: NDArray[np.float64] | float = 1.0,
) -> list[str]:
    """Write a picture for each light, whose brightness is a gain; their names."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"picture {k}{suffix}" for k in range(len(lights))]
    gains = np.broadcast_to(gains, len(lights))
    for name, light, gain in zip(names, lights, gains, strict=True):
        picture = gain * radiance(light, albedo)
        write_frame(folder / name, encoded(picture, dtype, srgb=srgb))
    return names


def write_table(
    path: Path, names: list[str], lights: NDArray[np.float64], *, separator: str = ","
) -> None:
    """Write lights.csv, or an .lp file with its number of pictures."""
    rows = [
        separator.join([name, *(f"{x:.9g}" for x in light)])
        for name, light in zip(names, lights, strict=True)
    ]
    head = [str(len(rows))] if path.suffix == ".lp" else ["picture,x,y,z"]
    path.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")
