"""Visibility by splatting (Weyrich et al. 2005, section 5): discs are drawn into a
depth map and compared with it.

A map has at most MAX_MAP_SIDE_PX pixels per side; its pixels are wider than intended if
the discs need more (`SplatScene.coarsening`). On a face of 1.5 million discs 0.25 mm
apart, which needs 4,056, pixels twice as wide agree with rays on 0.1 to 0.25 % fewer
discs (99.45 to 99.72 of 99.53 to 99.90 %), four times as wide on 0.5 to 0.7 %. A
capture has at most 2.5 million surfels, for which the pixels of a face are 1.3 times
wider than intended. Larger maps would need too much memory: two threads hold ten (five
points of a light each), and ten of twice the side take 2.5 GiB.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skindb.geometry._splat_kernels import splat

Float = NDArray[np.floating[Any]]
# of blended over rasterised pixels; 0.5 was measured to hide 0.2 to 0.9 % more than
# rays
THRESHOLD = 0.25
# a constant bias alone leaves 91 to 93 % agreement with rays
SLOPE_PX = 1.0
BIAS_MM = 0.5
# of a disc's radius, a quarter of the spacing: 99.87 % as rays for the worst of 15
# lights (0.5: 99.76)
PIXEL = 0.4
MAX_MAP_SIDE_PX = 4096  # pixels a side: 64 MiB
# nearest over farthest depth; below it (an eye inside or close to the surface) six maps
# cover all directions
MIN_DEPTH_RATIO = 0.2


# frame, focal, corner as of a DepthMap; height and width
_View = tuple[Float, float, Float, tuple[int, int]]


@dataclass(frozen=True)
class DepthMap:
    """Depth of the nearest surface as seen from an eye; rows of the frame are right,
    down, forwards.
    """

    frame: NDArray[np.float32]  # (3, 3)
    focal: float  # px
    # (2,) px from the axis to the outer corner of the first pixel
    corner: NDArray[np.float32]
    depth: NDArray[np.float32]  # (h, w) mm along the axis; infinity for nothing


class SplatScene:
    """Oriented discs prepared for splatting; immutable, shared freely between threads
    (the kernels release the GIL).
    """

    def __init__(
        self,
        position: Float,
        normal: Float,
        radius: Float,
        *,
        pixel_mm: float | None = None,
    ) -> None:
        """Discs at (n, 3) mm with unit normals (n, 3) and radii (n,) mm; those that are
        not finite are never visible.

        `pixel_mm` is the width of a pixel of the depth maps at the middle of the discs;
        by default PIXEL of their median radius.
        """
        given = np.concatenate(
            [position, normal, np.asarray(radius)[:, None]], axis=1
        ).astype(np.float64)
        sound = np.isfinite(given).all(axis=1) & (given[:, 6] >= 0)
        used = given[sound, :3]
        self._low = used.min(axis=0) if len(used) else np.zeros(3)
        self._high = used.max(axis=0) if len(used) else np.zeros(3)
        self._centre = (self._low + self._high) / 2  # float32 serves relative to it
        self._position = np.ascontiguousarray(given[:, :3] - self._centre, np.float32)
        self._normal = np.ascontiguousarray(given[:, 3:6], np.float32)
        self._radius = given[:, 6].astype(np.float32)
        self._sound = sound
        self._drawn = np.flatnonzero(sound)
        wanted = PIXEL * float(np.median(given[sound, 6])) if len(used) else 1.0
        # discs without a size are points, which any map resolves
        self._pixel = (
            pixel_mm
            or wanted
            or float(np.linalg.norm(self._high - self._low)) / MAX_MAP_SIDE_PX
            or 1.0
        )

    def draw(self, eye: ArrayLike) -> list[DepthMap]:
        """Depth maps from an eye (3,) in mm: one that contains all discs, or six if the
        eye is among them.
        """
        place = np.asarray(eye, np.float64)
        maps = (
            self._maps(place) if np.isfinite(place).all() and len(self._drawn) else []
        )
        for view in maps:
            self._splat(
                place, self._drawn, view, np.zeros(0, np.float32), counting=False
            )
        return maps

    def visible_fraction(
        self,
        eye: ArrayLike,
        at: NDArray[np.integer[Any]] | None = None,
        *,
        maps: list[DepthMap] | None = None,
    ) -> NDArray[np.float32]:
        """Fraction of each disc's pixels that the other discs leave visible.

        Parameters
        ----------
        eye
            (3,) mm, of a light or a camera.
        at
            (m,) indices of the discs to test; default all. All discs occlude in any case.
        maps
            Result of `draw` for the eye; drawn here by default.

        Returns
        -------
        ndarray
            (m,) in [0, 1]; the paper calls a disc visible above a threshold. 0 for
            discs that face away.
        """
        chosen = (
            np.arange(len(self._radius)) if at is None else np.asarray(at, np.int64)
        )
        share = np.zeros(len(chosen), np.float32)
        asked = np.flatnonzero(self._sound[chosen])
        found = np.zeros(len(asked), np.float32)
        for view in self.draw(eye) if maps is None else maps:
            self._splat(
                np.asarray(eye, np.float64), chosen[asked], view, found, counting=True
            )
        share[asked] = found
        return share

    def coarsening(self, eye: ArrayLike) -> float:
        """Width of the pixels of an eye's maps over the intended width: 1 if
        MAX_MAP_SIDE_PX is sufficient.
        """
        place = np.asarray(eye, np.float64)
        wanted, layout = (
            self._layout(place)
            if np.isfinite(place).all() and len(self._drawn)
            else (1.0, [])
        )
        return max((wanted / focal for _, focal, _, _ in layout), default=1.0)

    def _splat(
        self,
        eye: Float,
        at: NDArray[np.int64],
        view: DepthMap,
        share: Float,
        *,
        counting: bool,
    ) -> None:
        discs = (self._position, self._normal, self._radius, at)
        local = (eye - self._centre).astype(np.float32)
        seen = (view.frame, local, np.float32(view.focal), view.corner)
        splat(
            *discs,
            *seen,
            np.float32(SLOPE_PX),
            np.float32(BIAS_MM),
            view.depth,
            share,
            counting,
        )

    def _maps(self, eye: Float) -> list[DepthMap]:
        """Empty maps."""
        return [_empty(*one) for one in self._layout(eye)[1]]

    def _layout(self, eye: Float) -> tuple[float, list[_View]]:
        """The intended focal length, and the views within the limit of pixels."""
        corners = np.stack(
            np.meshgrid(*np.stack([self._low, self._high], axis=1), indexing="ij"), -1
        ).reshape(-1, 3)
        way = self._centre - eye
        distance = float(np.linalg.norm(way))
        frame = _looking(way / distance if distance > 0 else np.array([0.0, 0, 1]))
        local = (corners - eye) @ frame.T
        depth = local[:, 2]
        if depth.min() > MIN_DEPTH_RATIO * depth.max():
            plane = local[:, :2] / depth[:, None]
            low = plane.min(axis=0)
            high = plane.max(axis=0)
            wanted = max(distance, self._pixel) / self._pixel
            focal = min(
                wanted, (MAX_MAP_SIDE_PX - 4) / max(float((high - low).max()), 1e-9)
            )
            corner = np.floor(low * focal) - 1
            width, height = (np.ceil(high * focal) + 1 - corner).astype(int)
            return wanted, [(frame, focal, corner, (height, width))]
        wanted = max(
            float(np.linalg.norm(self._high - self._low)) / 2 / self._pixel, 16
        )
        half = int(min(wanted, MAX_MAP_SIDE_PX // 2))
        axes = np.concatenate([np.eye(3), -np.eye(3)])
        return int(wanted), [
            (_looking(axis), half, np.full(2, -half), (2 * half, 2 * half))
            for axis in axes
        ]


def _empty(
    frame: Float, focal: float, corner: Float, shape: tuple[int, int]
) -> DepthMap:
    depth = np.full(shape, np.float32(np.inf))
    return DepthMap(frame.astype(np.float32), focal, corner.astype(np.float32), depth)


def _looking(forwards: Float) -> NDArray[np.float64]:
    """Rows right, down, forwards (3, 3) of a frame that looks along a unit vector."""
    helper = np.eye(3)[np.abs(forwards).argmin()]
    right = np.cross(helper, forwards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forwards, right), forwards])
