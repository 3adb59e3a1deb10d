"""Pictures as tests read and make them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np

from skindb.geometry.rays import RayScene
from skindb.render.scene import Camera, Lights, Surface
from skindb.render.shading import shade_view, trace_view


def read_png(path: str | Path) -> np.ndarray:
    return np.asarray(imagecodecs.png_decode(Path(path).read_bytes()))


def decode_srgb(display: np.ndarray) -> np.ndarray:
    """Linear values of sRGB display values in [0, 1] (IEC 61966-2-1)."""
    y = np.asarray(display, np.float64)
    return np.where(y <= 0.04045, y / 12.92, ((y + 0.055) / 1.055) ** 2.4)


def render_view(
    surface: Surface,
    camera: Camera,
    lights: Lights,
    *,
    samples: int = 1,
    scene: RayScene | None = None,
    **options: Any,
) -> np.ndarray:
    """Images (l, h, w, 3), one per light, by `shade_view`."""
    rays = RayScene(surface.vertices, surface.faces) if scene is None else scene
    view = trace_view(surface, camera, samples=samples, scene=rays)
    return shade_view(view, surface, lights, rays, **options)
