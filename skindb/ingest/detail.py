"""Albedo and normals at the texels of the atlas, where photographs are finer than the surfels.

Lambert's law is fitted by least squares at every texel and, in the same way, at every surfel.
What a texel differs by from the interpolated surfels is its detail: it is 0 at the surfels,
whose values are those of the fit, and what Lambert's law ignores cancels in the difference.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Self

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter

from skindb.format.dome import CameraRecord
from skindb.geometry.atlas import rasterise_atlas, signed_areas
from skindb.ingest._detail_kernels import add_samples
from skindb.ingest.surfels import SurfelSet
from skindb.schema import dataset, variables
from skindb.types import (
    Bytes,
    Float32,
    Float64,
    Index,
    Mask,
    Values16,
    unit,
)

# spacing of the surfels over the width of a pixel, from which on detail is estimated
MIN_SPACING_PIXELS = 2.0
# along a side of the atlas: a whole head at 0.3 mm; each texel takes 0.6 kB of memory while
# views are sampled
MAX_TEXELS = 1536
MIN_COSINE = (
    0.25  # to light and camera, as farther away pixels and shadows are too wide
)
# half vectors nearer to the normal show highlights
MIN_HALF_ANGLE = np.radians(20.0)
# of lights, det(A) / (trace(A) / 3)^3: 1 for lights from all sides, 0 in a plane
MIN_SPREAD = 1e-3
# standard deviation of what a bilinear sample of square pixels averages, sqrt(1/6 + 1/12)
BLUR_PIXELS = 0.5
# texels; standard deviation of the window in which noise and detail are compared
WINDOW = 6.0
BLOCK = 1 << 17  # points whose equations are in memory together


def pixel_width(surfels: SurfelSet, cameras: Sequence[CameraRecord]) -> float:
    """Median width [mm] of a pixel on the surface."""
    middle = surfels.position.mean(axis=0)
    return float(np.median([camera.pixel_width(middle) for camera in cameras]))


class CameraSampling(NamedTuple):
    """Where and how one camera samples the surfels, the same under every light."""

    surfels: Mask  # (n,) those that it samples
    pixels: Float32  # (n, 2)


@dataclass(frozen=True)
class Detail:
    """Points whose samples are collected view by view: the texels on the surface, row by row,
    and then the surfels.
    """

    size: int  # texels along a side of the atlas
    blur: float  # texels; standard deviation of what a sample averages
    texel: Index  # (t,) flat index
    corners: Index  # (n, 3) surfels around a point
    weight: Float32  # (n, 3) barycentric
    position: Float64  # (n, 3) mm
    normal: Float64  # (n, 3) unit, of the scan
    pixels: Sequence[Float32]  # (n, 2) by camera
    # (2, n, 15) of `add_samples`: views of lights with even and with odd index
    sums: Float32 = field(repr=False)

    @classmethod
    def of(cls, surfels: SurfelSet, cameras: Sequence[CameraRecord]) -> Self | None:
        """The points of a capture; None if its photographs are not finer than its surfels."""
        pixel = pixel_width(surfels, cameras)
        if surfels.spacing() < MIN_SPACING_PIXELS * pixel:
            return None
        in_map = np.abs(signed_areas(surfels.uv, surfels.faces)).sum()
        width = np.sqrt(surfels.area.sum() / in_map)  # mm of the map
        size = min(64 * int(np.ceil(width / pixel / 64)), MAX_TEXELS)
        face, weight = rasterise_atlas(surfels.uv, surfels.faces, size)
        texel = np.flatnonzero(face >= 0)
        count = len(surfels.position)
        corners = np.concatenate(
            [
                surfels.faces[face.ravel()[texel]],
                np.repeat(np.arange(count)[:, None], 3, axis=1),
            ]
        )
        at_surfels = np.tile(np.array([1, 0, 0], np.float32), (count, 1))
        weights = np.concatenate([weight.reshape(-1, 3)[texel], at_surfels])
        position, normal = (
            np.einsum("nk,nkc->nc", weights, values[corners])
            for values in (surfels.position, surfels.normal)
        )
        pixels = [camera.project(position).astype(np.float32) for camera in cameras]
        sums = np.zeros((2, len(corners), 15), np.float32)
        blur = float(BLUR_PIXELS * pixel / width * size)
        return cls(
            size, blur, texel, corners, weights, position, unit(normal), pixels, sums
        )

    def shot(self, surfels: Mask, camera: int) -> CameraSampling:
        """The points between surfels (n,) that a camera samples."""
        within = surfels[self.corners].all(axis=1)
        return CameraSampling(np.asarray(within), self.pixels[camera])

    def add(
        self,
        samples: Values16,
        outcome: Bytes,
        j: int,
        light: Float64,
        camera: Float64,
    ) -> None:
        """Add the samples (3, n) of the view of light j (3,) in a camera (3,)."""
        add_samples(
            samples,
            outcome,
            self.position,
            self.normal,
            light,
            camera,
            MIN_COSINE,
            float(np.cos(MIN_HALF_ANGLE)),
            self.sums[j % 2],
        )

    def group(self) -> xr.Dataset | None:
        """Group "detail": the differences and their errors; None if none is determined.

        The noise is that of half the difference between the estimates by every other light.
        In a window, the part of the variance that is not noise is the factor by which the
        differences are shrunk towards 0 (Lee 1980). What pixels blur is added once (Van
        Cittert 1931), and is the error by blur.
        """
        estimates = [self.sums.sum(axis=0), *self.sums]
        values = np.stack([self._differences(sums) for sums in estimates])
        known = np.isfinite(values).all(axis=(0, 2))
        if not known.any():
            return None
        at = np.unravel_index(self.texel[known], (self.size, self.size))
        cover = self._image(at, np.float32(1))
        # infinite outside, where means are 0
        near, window = (
            np.where(cover > 0, gaussian_filter(cover, sigma), np.float32(np.inf))
            for sigma in (self.blur, WINDOW)
        )
        detail, error = np.empty((2, self.size, self.size, 6), np.float32)
        # images of all channels would take most of the memory
        for channel in range(6):
            seen, even, odd = (self._image(at, v) for v in values[:, known, channel])
            lost = seen - gaussian_filter(seen, self.blur) / near
            sharp = seen + lost
            noise = even - odd
            noise = (2 * noise - gaussian_filter(noise, self.blur) / near) ** 2 / 4
            noise = gaussian_filter(noise, WINDOW) / window
            total = gaussian_filter(sharp**2, WINDOW) / window
            kept = np.clip(1 - noise / np.maximum(total, 1e-12), 0, 1)
            detail[..., channel] = kept * sharp
            unknown = np.where(cover > 0, noise + lost**2, np.nan)
            error[..., channel] = np.sqrt(kept * unknown)
        return dataset(
            {
                variables.DIFFUSE_DETAIL: detail[..., :3],
                variables.DIFFUSE_DETAIL_ERROR: error[..., :3],
                variables.NORMAL_DETAIL: detail[..., 3:],
                variables.NORMAL_DETAIL_ERROR: error[..., 3:],
            },
            coords={"channel": ["R", "G", "B"]},
        )

    def _image(self, at: tuple[Index, ...], values: Float32 | np.float32) -> Float32:
        """Image of the values at these texels, 0 elsewhere."""
        image = np.zeros((self.size, self.size), np.float32)
        image[at] = values
        return image

    def _differences(self, sums: Float32) -> Float32:
        """Relative difference of R_d and difference of the unit normal (t, 6) of the texels
        from the interpolated surfels; NaN where they are not determined.
        """
        blocks = np.array_split(sums, len(sums) // BLOCK + 1)
        values = np.concatenate([_lambert(block) for block in blocks])
        count = len(self.texel)
        texels, surfels = np.split(values, [count])
        smooth = np.einsum(
            "nk,nkc->nc", self.weight[:count], surfels[self.corners[:count]]
        )
        difference = texels - smooth
        difference[:, :3] /= np.where(smooth[:, :3] > 0, smooth[:, :3], np.nan)
        return difference


def _lambert(sums: Float32) -> Float32:
    """R_d and the unit normal (n, 6) that the equations (n, 15) of points determine, or NaN."""
    gram = sums[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3).astype(float)
    trace = np.maximum(np.trace(gram, axis1=1, axis2=2), 1e-9)
    determined = np.linalg.det(gram) > MIN_SPREAD * (trace / 3) ** 3
    values = np.full((len(sums), 6), np.nan, np.float32)
    right = sums[determined, 6:].reshape(-1, 3, 3).astype(float)
    scaled = np.linalg.solve(gram[determined], right)  # (n, axis, channel)
    normal = unit(scaled.sum(axis=2))
    albedo = np.einsum("nkc,nk->nc", scaled, normal)
    values[determined] = np.concatenate([albedo, normal], axis=1)
    return values
