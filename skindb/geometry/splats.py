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

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skindb.geometry._splat_kernels import splat
from skindb.types import Array, Float64, Index, float64

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
_View = tuple[Float64, float, Float64, tuple[int, int]]


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
        position: Array,
        normal: Array,
        radius: Array,
        *,
        pixel_mm: float | None = None,
    ) -> None:
        """Discs at (n, 3) mm with unit normals (n, 3) and radii (n,) mm; those that are
        not finite are never visible.

        `pixel_mm` is the width of a pixel of the depth maps at the middle of the discs;
        by default PIXEL of their median radius.
        """
        columns = [position, normal, np.asarray(radius)[:, None]]
        discs = np.concatenate(columns, axis=1).astype(np.float64)
        self._valid = np.isfinite(discs).all(axis=1) & (discs[:, 6] >= 0)
        self._drawn = np.flatnonzero(self._valid)
        drawn = discs[self._drawn] if len(self._drawn) else np.zeros((1, 7))
        self._low = drawn[:, :3].min(axis=0)
        self._high = drawn[:, :3].max(axis=0)
        self._centre = (self._low + self._high) / 2  # float32 serves relative to it
        self._position = np.ascontiguousarray(discs[:, :3] - self._centre, np.float32)
        self._normal = np.ascontiguousarray(discs[:, 3:6], np.float32)
        self._radius = discs[:, 6].astype(np.float32)
        # discs without a size are points, which any map resolves
        self._extent = float(np.linalg.norm(self._high - self._low))
        intended = pixel_mm or PIXEL * float(np.median(drawn[:, 6]))
        self._pixel = intended or self._extent / MAX_MAP_SIDE_PX or 1.0

    def draw(self, eye: ArrayLike) -> list[DepthMap]:
        """Depth maps from an eye (3,) in mm: one that contains all discs, or six if the
        eye is among them.
        """
        maps = [_empty(*view) for view in self._layout(eye)[1]]
        for view in maps:
            unused = np.zeros(0, np.float32)
            self._splat(eye, self._drawn, view, unused, counting=False)
        return maps

    def visible_fraction(
        self,
        eye: ArrayLike,
        chosen: Index | None = None,
        *,
        maps: list[DepthMap] | None = None,
    ) -> NDArray[np.float32]:
        """Fraction of each disc's pixels that the other discs leave visible.

        Parameters
        ----------
        eye
            (3,) mm, of a light or a camera.
        chosen
            (m,) indices of the discs to test; default all. All discs occlude in any case.
        maps
            Result of `draw` for the eye; drawn here by default.

        Returns
        -------
        ndarray
            (m,) in [0, 1]; the paper calls a disc visible above a threshold. 0 for
            discs that face away.
        """
        if chosen is None:
            chosen = np.arange(len(self._radius))
        valid = self._valid[chosen]
        discs = chosen[valid]
        visible = np.zeros(len(discs), np.float32)
        for view in self.draw(eye) if maps is None else maps:
            self._splat(eye, discs, view, visible, counting=True)
        fraction = np.zeros(len(chosen), np.float32)
        fraction[valid] = visible
        return fraction

    def coarsening(self, eye: ArrayLike) -> float:
        """Width of the pixels of an eye's maps over the intended width: 1 if
        MAX_MAP_SIDE_PX is sufficient.
        """
        intended, views = self._layout(eye)
        return max((intended / focal for _, focal, _, _ in views), default=1.0)

    def _splat(
        self,
        eye: ArrayLike,
        chosen: Index,
        view: DepthMap,
        fraction: NDArray[np.float32],
        *,
        counting: bool,
    ) -> None:
        discs = (self._position, self._normal, self._radius, chosen)
        local = (float64(eye) - self._centre).astype(np.float32)
        projection = (view.frame, local, np.float32(view.focal), view.corner)
        tolerance = (np.float32(SLOPE_PX), np.float32(BIAS_MM))
        splat(*discs, *projection, *tolerance, view.depth, fraction, counting)

    def _layout(self, eye: ArrayLike) -> tuple[float, list[_View]]:
        """The intended focal length, and the views within the limit of pixels."""
        place = float64(eye)
        if not np.isfinite(place).all() or not len(self._drawn):
            return 1.0, []
        ends = np.stack([self._low, self._high], axis=1)
        corners = np.stack(np.meshgrid(*ends, indexing="ij"), -1).reshape(-1, 3)
        way = self._centre - place
        distance = float(np.linalg.norm(way))
        frame = _looking(way / distance if distance > 0 else np.array([0.0, 0, 1]))
        local = (corners - place) @ frame.T
        depth = local[:, 2]
        if depth.min() > MIN_DEPTH_RATIO * depth.max():
            plane = local[:, :2] / depth[:, None]
            low = plane.min(axis=0)
            high = plane.max(axis=0)
            intended = max(distance, self._pixel) / self._pixel
            span = max(float((high - low).max()), 1e-9)
            focal = min(intended, (MAX_MAP_SIDE_PX - 4) / span)
            corner = np.floor(low * focal) - 1
            width, height = (np.ceil(high * focal) + 1 - corner).astype(int)
            return intended, [(frame, focal, corner, (height, width))]
        intended = max(self._extent / 2 / self._pixel, 16)
        half = int(min(intended, MAX_MAP_SIDE_PX // 2))
        corner = np.full(2, -half, np.float64)
        axes = np.concatenate([np.eye(3), -np.eye(3)])
        size = (2 * half, 2 * half)
        views: list[_View] = [(_looking(axis), half, corner, size) for axis in axes]
        return int(intended), views


def _empty(
    frame: Array, focal: float, corner: Array, shape: tuple[int, int]
) -> DepthMap:
    depth = np.full(shape, np.float32(np.inf))
    return DepthMap(frame.astype(np.float32), focal, corner.astype(np.float32), depth)


def _looking(forwards: Array) -> Float64:
    """Rows right, down, forwards (3, 3) of a frame that looks along a unit vector."""
    helper = np.eye(3)[np.abs(forwards).argmin()]
    right = np.cross(helper, forwards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forwards, right), forwards])
