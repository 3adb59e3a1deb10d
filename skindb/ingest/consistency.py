"""Check of a calibration against the photographs: poses of the cameras, and positions of
the lights by the shading.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from skindb.calibration.irradiance import light_falloff
from skindb.format.dome import CameraRecord, DomeRecord
from skindb.ingest.photo_offsets import (
    Brightness,
    Offset,
    ReducedView,
    bilinear,
    camera_offset,
    moved_pixels,
    reduced,
    reduction,
    relative_brightness,
    square_root_image,
    surfel_albedo,
    view_factors,
)
from skindb.ingest.surfels import SurfelSet
from skindb.numerics.statistics import correlation
from skindb.types import Float32, Float64, Half, Index, Mask, dots, float64

Pair = tuple[int, int]  # light, camera
LIGHTS_PER_CAMERA = 3  # those that illuminate the largest part of what the camera sees
MAX_SURFELS = 4_000  # surfels that are compared: 4 mm apart on a head
# mm; smaller scans, such as cropped ones, lack parts that cast shadows, and are shaded
# too evenly: measured agreements are 0.1 to 0.9 for patches of up to 180 mm, and at
# least 0.77 for parts of faces of 240 mm
MIN_DIAGONAL_MM = 200.0
MIN_SURFELS = 150  # surfels in a usable view: a patch of 50 x 50 mm
# relative, of the square roots of the irradiance: evenly lit skin carries no
# information
MIN_VARIATION = 0.1
# of the median brightness of all views, relative to their irradiance
BLACK_FRACTION = 0.01
# of the area that a camera sees under the light that illuminates most of it
MIN_SEEN_FRACTION = 0.1
# albedo and offsets improve each other; a third round changed offsets by less than 0.05
# mm
ALBEDO_ROUNDS = 2
MIN_AGREEMENT = 0.7  # correlation of the square roots of photograph and prediction
MAX_OFFSET_MM = 10.0  # mm on the face, a tenth of a head's radius


@dataclass(frozen=True)
class Calibration:
    """How well the photographs fit the calibration; NaN where too little is visible to decide."""

    # (camera,) correlation of the square roots of photograph and prediction
    camera_agreement: Float64
    camera_offset: Float64  # (camera,) mm on the face
    camera_scale: (
        Float64  # (camera,) relative excess size of the face in the photographs
    )
    light_agreement: Float64  # (light,) correlation under this light
    # (light,) the light with the most similar shading; -1: unknown
    light_similar: Index
    light_similar_agreement: Float64  # (light,) its correlation
    scan_translation: Float64  # (3,) mm that would bring the scan to the photographs
    scan_rotation: Float64  # (3,) degrees about x, y, z through the centre of the scan
    # (camera,) mm of the offset that the pose of the scan does not explain
    camera_residual: Float64
    brightness: Brightness  # of the photographs, relative to a matte face


@dataclass(frozen=True)
class CalibrationCheck:
    """Selects and compares views: a few lights of every camera, and one camera of every light.

    Parameters
    ----------
    dome, surfels
        As read; at most `MAX_SURFELS` surfels are compared.
    light_visible
        (n, light) visible fraction of the lights' discs.
    clear, pixels
        (n, camera) and (n, camera, 2): what each camera sees, and where.
    intensity
        (light, 3).
    """

    dome: DomeRecord
    surfels: SurfelSet
    light_visible: Half
    clear: Mask
    pixels: Float32
    intensity: Float64

    @cached_property
    def pairs(self) -> frozenset[Pair]:
        """The views to compare; empty for a patch of skin."""
        if np.linalg.norm(np.ptp(self.surfels.position, axis=0)) < MIN_DIAGONAL_MM:
            return frozenset()
        seen = self.seen_area
        pairs = {
            (int(j), c)
            for c in range(seen.shape[1])
            for j in np.argsort(-seen[:, c])[:LIGHTS_PER_CAMERA]
        }
        pairs |= {(j, int(seen[j].argmax())) for j in range(seen.shape[0])}
        minimum = MIN_SEEN_FRACTION * seen.max()
        return frozenset(pair for pair in pairs if seen[pair] > minimum)

    @cached_property
    def seen_area(self) -> Float64:
        """Area (light, camera) [mm2] that is lit and visible, projected to the camera."""
        surfels = self.surfels.area[self.compared]
        area = [
            np.maximum(self.cosine(camera), 0) * surfels for camera in self.dome.cameras
        ]
        return (self.irradiance > 0) @ (np.stack(area, axis=1) * self._clear)

    @cached_property
    def irradiance(self) -> Float64:
        """Irradiance (light, n) by each light at the compared surfels, 0 in shadow."""
        rows = []
        for j, light in enumerate(self.dome.lights):
            square, falloff = light_falloff(light, self._position)
            way = light.position - self._position
            cosine = dots(way, self.surfels.normal[self.compared]) / np.sqrt(square)
            visible = float64(self.light_visible[self.compared, j])
            lit = np.maximum(cosine, 0) * visible
            rows.append(lit * falloff / square * self.intensity[j].mean())
        return np.array(rows)

    def reduce(self, camera: int, radiance: Float32) -> Float32:
        """Downsampled picture (h, w, 3) of a view."""
        return reduced(radiance, self.factor(camera))

    def evaluate(self, pictures: Mapping[Pair, Float32]) -> Calibration:
        """Compare the downsampled pictures of `pairs` with the predictions."""
        views = self.views(pictures)
        offsets, albedo = self._offsets(views)
        agreement, length, scale = np.full((3, len(self.dome.cameras)), np.nan)
        for c, offset in offsets.items():
            agreement[c] = offset.agreement
            length[c] = offset.length * self._mm(c)
            scale[c] = offset.scale
        wrong = self._wrong(offsets)
        good = {c: x for c, x in offsets.items() if c not in wrong} or offsets
        good_views = [view for view in views if view.camera in good]
        table = self._light_table(good_views, offsets, albedo)
        light_agreement = np.diagonal(table).copy()
        np.fill_diagonal(table, -1.0)
        similar = np.nan_to_num(table, nan=-1.0).argmax(axis=1)
        translation, rotation, residual = self._scan_pose(good)
        return Calibration(
            camera_agreement=agreement,
            camera_offset=length,
            camera_scale=scale,
            light_agreement=light_agreement,
            light_similar=np.where(np.isfinite(light_agreement), similar, -1),
            light_similar_agreement=np.nanmax(table, axis=1, initial=-1.0),
            scan_translation=translation,
            scan_rotation=rotation,
            camera_residual=residual,
            brightness=self._brightness(good_views, pictures, offsets, albedo),
        )

    def good_offsets(
        self,
        views: Sequence[ReducedView],
        start: Mapping[int, Offset] | None = None,
    ) -> dict[int, Offset]:
        """Offset of each camera whose photographs show the face near the scan; with
        `start` the search begins at these.
        """
        offsets, _ = self._offsets(views, start)
        wrong = self._wrong(offsets)
        return {c: offset for c, offset in offsets.items() if c not in wrong}

    def _brightness(
        self,
        views: Sequence[ReducedView],
        pictures: Mapping[Pair, Float32],
        offsets: Mapping[int, Offset],
        albedo: Float64,
    ) -> Brightness:
        """Relative brightness of the photographs by camera and light."""
        factors = []
        for view in views:
            pixels = moved_pixels(view, offsets[view.camera])
            colour = self.intensity[view.light] / self.intensity[view.light].mean()
            irradiance = self.irradiance[view.light][:, None] * colour
            picture = pictures[view.light, view.camera]
            factors.append(view_factors(view, picture, pixels, irradiance, albedo))
        lights = [view.light for view in views]
        cameras = [view.camera for view in views]
        shape = (len(self.dome.lights), len(self.dome.cameras))
        return relative_brightness(np.array(factors), lights, cameras, shape=shape)

    @property
    def compared(self) -> slice:
        """Slice that selects the compared surfels."""
        return slice(None, None, -(-len(self.surfels.position) // MAX_SURFELS))

    @cached_property
    def _position(self) -> Float64:
        return self.surfels.position[self.compared]

    @cached_property
    def _clear(self) -> Mask:
        return self.clear[self.compared]

    @cached_property
    def _middle(self) -> Float64:
        return self.surfels.position.mean(axis=0)

    def cosine(self, camera: CameraRecord) -> Float64:
        """Cosine (n,) between the normals of the surfels and the direction to the camera."""
        return self.surfels.cosine(camera, self.compared)

    def factor(self, camera: int) -> int:
        """Downsampling factor of a camera."""
        return reduction(self.dome.cameras[camera].pixel_width(self._middle))

    def _mm(self, camera: int) -> float:
        """Width [mm] of a downsampled pixel on the face."""
        width = self.dome.cameras[camera].pixel_width(self._middle)
        return self.factor(camera) * width

    def _reduced_pixels(self, camera: int) -> Float64:
        """Pixels (n, 2) of the compared surfels in the downsampled pictures of a camera."""
        pixels = float64(self.pixels[self.compared, camera])
        return pixels / self.factor(camera)

    def views(self, pictures: Mapping[Pair, Float32]) -> list[ReducedView]:
        """Views with enough surfels of varying irradiance that are not black, as they
        are when a lamp fails.
        """
        views = []
        brightness = []
        for (j, c), picture in sorted(pictures.items()):
            clear = self._clear[:, c]
            light = self.irradiance[j, clear]
            root = np.sqrt(light)
            if clear.sum() < MIN_SURFELS or np.std(root) < MIN_VARIATION * np.mean(
                root
            ):
                continue
            image = square_root_image(np.einsum("hwc->hw", picture) / 3)
            view = ReducedView(j, c, image, self._reduced_pixels(c), clear)
            seen = bilinear(view.image, view.pixels[clear])
            views.append(view)
            ratio = float(np.mean(seen**2)) / max(float(np.mean(light)), 1e-300)
            brightness.append(ratio)
        minimum = BLACK_FRACTION * float(np.median(brightness)) if brightness else 0.0
        return [
            v for v, ratio in zip(views, brightness, strict=True) if ratio > minimum
        ]

    def projected(self, views: Sequence[ReducedView]) -> list[ReducedView]:
        """The views with the pixels of this check."""
        return [
            replace(view, pixels=self._reduced_pixels(view.camera)) for view in views
        ]

    def _offsets(
        self,
        views: Sequence[ReducedView],
        start: Mapping[int, Offset] | None = None,
    ) -> tuple[dict[int, Offset], Float64]:
        """Offset of every camera, and albedo of the surfels."""
        albedo = np.ones(len(self._position))
        offsets = dict[int, Offset]()
        earlier = dict(start or {})
        if not views:
            return offsets, albedo
        by_camera = dict[int, list[ReducedView]]()
        for view in sorted(views, key=lambda view: view.camera):
            by_camera.setdefault(view.camera, []).append(view)
        for turn in range(ALBEDO_ROUNDS + 1):
            for c, camera_views in by_camera.items():
                offsets[c] = camera_offset(
                    camera_views, self.irradiance, albedo, start=earlier.get(c)
                )
            earlier = offsets
            # wrong photographs would produce an albedo that agrees with them
            if turn < ALBEDO_ROUNDS:
                wrong = self._wrong(offsets)
                good = [view for view in views if view.camera not in wrong]
                albedo = surfel_albedo(good or views, self.irradiance, offsets)
        return offsets, albedo

    def _wrong(self, offsets: Mapping[int, Offset]) -> list[int]:
        """Cameras whose photographs do not show the face where the scan is."""
        return [
            c
            for c, x in offsets.items()
            if x.agreement < MIN_AGREEMENT or x.length * self._mm(c) > MAX_OFFSET_MM
        ]

    def _light_table(
        self,
        views: Sequence[ReducedView],
        offsets: Mapping[int, Offset],
        albedo: Float64,
    ) -> Float64:
        """Correlation (light, light) of the best view under each light with the
        prediction for every light.
        """
        table = np.full((len(self.dome.lights),) * 2, np.nan)
        for view in views:
            clear = view.clear
            seen = bilinear(view.image, moved_pixels(view, offsets[view.camera])[clear])
            predictions = np.sqrt(self.irradiance[:, clear] * albedo[clear])
            row = np.array([correlation(seen, shade) for shade in predictions])
            if not row[view.light] <= table[view.light, view.light]:
                table[view.light] = row
        return table

    def _scan_pose(
        self, offsets: Mapping[int, Offset]
    ) -> tuple[Float64, Float64, Float64]:
        """Translation [mm] and rotation [degrees] of the scan about its centre that fit
        best, and the residuals.

        They are a least-squares fit to the displacements of 200 surfels in each picture.
        """
        residuals = np.full(len(self.dome.cameras), np.nan)
        if not offsets:
            return np.full(3, np.nan), np.full(3, np.nan), residuals
        rows = {c: self._pose_rows(c, offset) for c, offset in offsets.items()}
        matrix = np.concatenate([slopes for slopes, _ in rows.values()])
        right = np.concatenate([moves for _, moves in rows.values()])
        x = np.linalg.lstsq(matrix, right)[0]
        for c, (slopes, moves) in rows.items():
            residual = (moves - slopes @ x).reshape(-1, 2)
            length = float(np.sqrt((residual**2).sum(axis=1).mean()))
            residuals[c] = length * self._mm(c)
        return x[:3], np.degrees(x[3:]), residuals

    def _pose_rows(self, c: int, offset: Offset) -> tuple[Float64, Float64]:
        """Derivatives (2 m, 6) of m pixels by translation [mm] and rotation [rad], and
        displacements (2 m,).
        """
        camera = self.dome.cameras[c]
        factor = self.factor(c)
        surfels = np.flatnonzero(self._clear[:, c])
        surfels = surfels[:: max(len(surfels) // 200, 1)]
        points = self._position[surfels]
        axes = np.eye(3)
        steps = [np.broadcast_to(axis, points.shape) for axis in axes]
        steps += [np.cross(axis, points - self._middle) for axis in axes]
        small = 1e-3
        pixels = camera.project(points) / factor
        slopes = [
            (camera.project(points + small * step) / factor - pixels) / small
            for step in steps
        ]
        moves = offset.moves(self.pixels[self.compared, c][surfels] / factor)
        return np.stack(slopes, axis=-1).reshape(-1, 6), moves.ravel()
