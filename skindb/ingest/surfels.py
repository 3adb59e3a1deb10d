"""From the scan to surfels: subdivision, Morton order, normals, areas, texture
coordinates, regions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb.errors import require
from skindb.format.folder import Capture
from skindb.format.scan_checks import LANDMARK_REACH, SITE_LANDMARK
from skindb.geometry.atlas import disc_atlas
from skindb.geometry.clean import CleanMesh
from skindb.geometry.mesh import (
    carry_points,
    closest_on_mesh,
    morton_order,
    splat_radius,
    subdivide,
    vertex_areas,
    vertex_normals,
)
from skindb.types import Float64, Index, Mask

MAX_SURFELS = 2_500_000  # the samples of this many surfels in a full dome take 36 GB
# mm; a landmark that is farther from the cropped than from the complete scan by this
# distance was cropped away
CROPPED_LANDMARK_MM = 0.5
NECK_STRIP_HALF_WIDTH_MM = 15.0  # mm; half width of the strip at the front of the neck


@dataclass(frozen=True)
class SurfelSet:
    """Surfels of one take, and the mesh whose vertices they are."""

    position: Float64  # (n, 3) mm
    normal: Float64  # (n, 3)
    area: Float64  # (n,) mm2
    radius: Float64  # (n,) mm, of the splat
    uv: NDArray[np.float32]  # (n, 2)
    faces: Index  # (f, 3)
    region_names: tuple[str, ...]
    region: Mask  # (n, region)
    uv_weights: str  # weights that uv were computed with: "intrinsic" or "mean_value"

    def spacing(self) -> float:
        """Distance [mm] of neighbours in an even lattice of the same density."""
        return lattice_spacing(float(self.area.mean()))


def lattice_spacing(area: float) -> float:
    """Distance [mm] of neighbours in an even triangular lattice with `area` mm2 per point."""
    return float(np.sqrt(2 / np.sqrt(3) * area))


def build_surfels(capture: Capture, *, spacing_mm: float) -> SurfelSet:
    """Surfels about `spacing_mm` apart, within a factor of sqrt 2, as each level of
    subdivision halves the spacing.
    """
    mesh = capture.surface
    levels = subdivision_levels(mesh, spacing_mm)
    vertices, faces, matrix = subdivide(mesh.vertices, mesh.faces, levels)
    uv, atlas = disc_atlas(mesh.vertices, mesh.faces, finer=(matrix, faces))
    order = morton_order(vertices)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    names, member = _regions(mesh, capture.regions)
    return SurfelSet(
        position=vertices[order],
        normal=vertex_normals(vertices, faces)[order],
        area=vertex_areas(vertices, faces)[order],
        radius=splat_radius(vertices, faces)[order],
        uv=uv[order],
        faces=rank[faces],
        region_names=names,
        region=np.asarray(matrix @ member)[order] > 0.5,
        uv_weights="intrinsic" if atlas["intrinsic"] else "mean_value",
    )


def subdivision_levels(mesh: CleanMesh, spacing_mm: float) -> int:
    """Number of levels after which the spacing, of an even triangular lattice, is
    closest to the target.

    Raises
    ------
    InputError
        If this requires more surfels than a capture may have.
    """
    if not spacing_mm > 0:
        raise ValueError(f"spacing_mm must be positive, not {spacing_mm}")
    count = len(mesh.vertices)
    area = float(vertex_areas(mesh.vertices, mesh.faces).sum())
    spacing = lattice_spacing(area / count)
    levels = max(int(np.rint(np.log2(spacing / spacing_mm))), 0)
    rule = f"a capture must have at most {MAX_SURFELS:,} surfels"
    require(
        count <= MAX_SURFELS,
        "scan",
        rule,
        f"{count:,} vertices of the scan, each of which becomes a surfel",
        "decimate the scan, or crop it",
    )
    finest = int(np.log2(MAX_SURFELS / count) / 2)
    require(
        levels <= finest,
        "spacing",
        rule,
        f"{spacing_mm:g} mm, which requires {count * 4.0**levels:,.0f}",
        f"choose {spacing / 2**finest:.2g} mm or more",
    )
    return levels


def transferred_landmarks(
    capture: Capture, surfels: SurfelSet
) -> tuple[Float64, Float64]:
    """Landmarks (k, 3) on the surface of the surfels, transferred by subdivision, and
    their distance (k,) in mm.

    The distance is that of the given landmark from the cleaned scan. The position is
    NaN if the landmark was cropped away, so that the complete scan is nearer to it than
    the surface.
    """
    landmarks = np.array([*capture.landmarks.values()]).reshape(-1, 3)
    base = capture.surface
    scan = capture.scan
    face, weight, distance = closest_on_mesh(base.vertices, base.faces, landmarks)
    near = distance <= LANDMARK_REACH
    if capture.crop is not None:
        near &= (
            distance
            <= closest_on_mesh(scan.vertices, scan.faces, landmarks)[2]
            + CROPPED_LANDMARK_MM
        )
    levels = round(np.log2(len(surfels.faces) / len(base.faces)) / 2)
    face, weight = carry_points(face, weight, len(base.faces), levels)
    position = np.einsum("kc,kci->ki", weight, surfels.position[surfels.faces[face]])
    return np.where(near[:, None], position, np.nan), distance


def site_positions(
    capture: Capture, surfels: SurfelSet, sites: tuple[str, ...]
) -> Float64:
    """Positions of the probe (site, 3) mm: a landmark, or the surfel nearest to the
    centre of the region of that name.

    A landmark is used at its transferred position, or as given if it was cropped away.
    For a region on both sides, the subject's left side (+x) is used, and for the neck
    its front. NaN if there is no landmark or region of the name.
    """
    carried, _ = transferred_landmarks(capture, surfels)
    landmarks = {
        name: place if np.isfinite(place).all() else stated
        for (name, stated), place in zip(
            capture.landmarks.items(), carried, strict=True
        )
    }
    return np.array(
        [_site_position(surfels, site, landmarks) for site in sites]
    ).reshape(-1, 3)


def _site_position(
    surfels: SurfelSet, site: str, landmarks: Mapping[str, Float64]
) -> Float64:
    for name in (SITE_LANDMARK.get(site, site), site):
        if name in landmarks:
            return np.asarray(landmarks[name], np.float64)
    if site not in surfels.region_names:
        return np.full(3, np.nan)
    member = surfels.region[:, surfels.region_names.index(site)]
    x = surfels.position[:, 0]
    preferred = [x > 0]
    if site == "neck":
        preferred.insert(0, np.abs(x) < NECK_STRIP_HALF_WIDTH_MM)
    for part in preferred:
        if (member & part).any():
            member = member & part
            break
    if not member.any():
        return np.full(3, np.nan)
    points = surfels.position[member]
    area = surfels.area[member]
    middle = area @ points / area.sum()
    return np.asarray(points[np.linalg.norm(points - middle, axis=1).argmin()])


def _regions(
    mesh: CleanMesh, regions: Mapping[str, Index]
) -> tuple[tuple[str, ...], Float64]:
    """Membership (v', region) of the cleaned vertices in the regions of the scan."""
    member = np.zeros((len(mesh.vertices), len(regions)))
    for i, ids in enumerate(regions.values()):
        vertices = mesh.clean_vertex[ids]
        member[vertices[vertices >= 0], i] = 1.0
    return tuple(regions), member
