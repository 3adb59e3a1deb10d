"""From the scan to surfels: subdivision, Morton order, normals, areas, texture
coordinates, regions; their visibility from lights and cameras, and the distance from
edges in the photographs.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from skindb.errors import require
from skindb.format.dome import CameraRecord, LightRecord
from skindb.format.folder import Capture
from skindb.format.scan_checks import LANDMARK_REACH, SITE_LANDMARK
from skindb.geometry._mesh_kernels import grown, mixed
from skindb.geometry._ray_kernels import matches_tangent_plane
from skindb.geometry.atlas import disc_atlas
from skindb.geometry.clean import CleanMesh
from skindb.geometry.mesh import (
    closest_on_mesh,
    edge_table,
    lattice_spacing,
    morton_order,
    split_longest,
    subdivide,
    vertex_areas,
    vertex_normals,
)
from skindb.geometry.rays import RayScene
from skindb.schema.label import FACE
from skindb.types import Float32, Float64, Half, Index, Mask, dots, float64, lengths

MAX_SURFELS = 2_500_000  # the samples of this many surfels in a full dome take 36 GB
# mm; a landmark that is farther from the cropped than from the complete scan by this
# distance was cropped away
CROPPED_LANDMARK_MM = 0.5
NECK_STRIP_HALF_WIDTH_MM = 15.0  # mm; half width of the strip at the front of the neck
# nodes, 4 mm apart on a face, and those whose lobes are blended, within about 8 mm
BLEND_NODES = 4000
BLENDED = 13
VisibilityTest = Callable[[Index], Mask]  # surfels (m,) that face an eye -> (m,)
# points of a light's disc besides its centre; each stands for a fifth of its area
RING_POINTS = 4
# one surfel in this many is tested for all points of a disc, to find isolated penumbrae
SURFELS_PER_PROBE = 16
EDGE_PX = 1.5  # pixels within this distance may contribute to a sample
STRIP_ROWS = 32  # rows of a depth map at a time
SURFELS_PER_BLOCK = 1 << 14  # surfels at a time
DEPTH_SLACK = 2.0  # mm, allowance for the error of the scan between neighbouring pixels
# depth per width, as at a cosine of 0.1; a steeper step is another surface
MAX_DEPTH_SLOPE = 10.0


@dataclass(frozen=True)
class SurfelSet:
    """Surfels of one take, and the mesh whose vertices they are."""

    position: Float64  # (n, 3) mm
    normal: Float64  # (n, 3)
    area: Float64  # (n,) mm2
    uv: Float32  # (n, 2)
    faces: Index  # (f, 3)
    region_names: tuple[str, ...]
    region: Mask  # (n, region)

    def cosine(self, camera: CameraRecord, part: slice = slice(None)) -> Float64:
        """Cosine (n,) between normals and the direction to the camera."""
        way = camera.centre - self.position[part]
        return dots(way, self.normal[part]) / lengths(way)

    def spacing(self) -> float:
        """Distance [mm] of neighbours in an even lattice of the same density."""
        return float(lattice_spacing(self.area.mean()))


def build_surfels(
    capture: Capture, *, spacing_mm: float, planar: bool = False
) -> SurfelSet:
    """Surfels `spacing_mm` apart, in the mean over the surface.

    As each level of subdivision halves the spacing, the longest edges of the scan are
    split before, as many as are needed. A scan that is finer than the spacing is not
    thinned.

    `planar` surfels are the vertices of the mesh, and their texture coordinates those of
    the picture.
    """
    mesh = capture.surface
    levels, splits = (0, 0) if planar else subdivision(mesh, spacing_mm)
    split, halves = split_longest(mesh.vertices, mesh.faces, splits)
    vertices, faces, matrix = subdivide(halves @ mesh.vertices, split, levels)
    matrix = matrix @ halves
    if planar:
        uv = _planar_uv(vertices)
    else:
        uv = disc_atlas(mesh.vertices, mesh.faces, finer=(matrix, faces))[0]
    order = morton_order(vertices)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    names, member = _regions(mesh, capture.regions)
    return SurfelSet(
        position=vertices[order],
        normal=vertex_normals(vertices, faces)[order],
        area=vertex_areas(vertices, faces)[order],
        uv=uv[order],
        faces=rank[faces],
        region_names=names,
        region=np.asarray(matrix @ member)[order] > 0.5,
    )


def _planar_uv(vertices: Float64) -> Float32:
    """Texture coordinates (n, 2) by x and y, v = 0 at the top; equal scales in both."""
    low = vertices[:, :2].min(axis=0)
    size = float(np.ptp(vertices[:, :2], axis=0).max()) or 1.0
    u, v = ((vertices[:, :2] - low) / size).T
    return np.stack([u, 1 - v], axis=1).astype(np.float32)


def subdivision(mesh: CleanMesh, spacing_mm: float) -> tuple[int, int]:
    """Number of levels of subdivision, and of edges to split before them, after which
    the spacing is that of an even triangular lattice.

    Raises
    ------
    InputError
        If this requires more surfels than a capture may have.
    """
    if not spacing_mm > 0:
        raise ValueError(f"spacing_mm must be positive, not {spacing_mm}")
    count = len(mesh.vertices)
    area = float(vertex_areas(mesh.vertices, mesh.faces).sum())
    rule = f"a capture must have at most {MAX_SURFELS:,} surfels"
    require(
        count <= MAX_SURFELS,
        "scan",
        rule,
        f"{count:,} vertices of the scan, each of which becomes a surfel",
        "decimate the scan, or crop it",
    )
    surfels = area * float(lattice_spacing(1.0) / spacing_mm) ** 2
    finest = 1.05 * float(lattice_spacing(area / MAX_SURFELS))  # allows for rounding
    require(
        surfels <= MAX_SURFELS,
        "spacing",
        rule,
        f"{spacing_mm:g} mm, which requires {surfels:,.0f}",
        f"choose {finest:.2g} mm or more",
    )
    edges = len(edge_table(mesh.faces).edges)
    faces = len(mesh.faces)
    levels = 0
    while count + edges <= surfels:
        count, edges, faces = count + edges, 2 * edges + 3 * faces, 4 * faces
        levels += 1
    return levels, max(round((surfels - count) / 4**levels), 0)


def transferred_landmarks(
    capture: Capture, surfels: SurfelSet
) -> tuple[Float64, Float64]:
    """The points (k, 3) of the surface of the surfels that are nearest to the
    landmarks, and the distance (k,) of these in mm.

    The distance is that of the given landmark from the cleaned scan. The position is
    NaN if the landmark was cropped away, so that the complete scan is nearer to it than
    the surface.
    """
    landmarks = np.array([*capture.landmarks.values()]).reshape(-1, 3)
    base = capture.surface
    scan = capture.scan
    _, _, distance = closest_on_mesh(base.vertices, base.faces, landmarks)
    near = distance <= LANDMARK_REACH
    if capture.crop is not None:
        near &= (
            distance
            <= closest_on_mesh(scan.vertices, scan.faces, landmarks)[2]
            + CROPPED_LANDMARK_MM
        )
    face, weight, _ = closest_on_mesh(surfels.position, surfels.faces, landmarks)
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
            return float64(landmarks[name])
    region = [name == site for name in surfels.region_names]
    member = surfels.region[:, region].any(axis=1)
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
    return points[lengths(points - middle).argmin()]


def _regions(
    mesh: CleanMesh, regions: Mapping[str, Index]
) -> tuple[tuple[str, ...], Float64]:
    """Membership (v', region) of the cleaned vertices in the regions of the scan."""
    member = np.zeros((len(mesh.vertices), len(regions)))
    for i, ids in enumerate(regions.values()):
        vertices = mesh.clean_vertex[ids]
        member[vertices[vertices >= 0], i] = 1.0
    return tuple(regions), member


def blended_lobes(
    position: Float64, regions: Mapping[str, Mask], lobes: Mapping[str, Sequence[float]]
) -> Float64:
    """Strengths (n, lobe) of the smallest region of a surfel, or else of the face; means over
    the nearest of even nodes, so that no border of regions is seen in maps.
    """
    strength = np.tile(lobes[FACE], (len(position), 1))
    for name in sorted(regions.keys() & lobes, key=lambda name: -regions[name].sum()):
        strength[regions[name]] = lobes[name]
    nodes = np.linspace(0, len(position) - 1, BLEND_NODES).astype(np.int64)
    near = cKDTree(position[nodes]).query(position, BLENDED)[1]
    return strength[nodes[near]].mean(axis=1)


def light_visibility(
    surfels: SurfelSet,
    lights: Sequence[LightRecord],
    scene: RayScene,
    pool: Executor,
) -> Half:
    """Visible fraction (n, light) of the lights' discs; 0 where the surfel faces away
    from the centre.

    All points of a disc are tested only where their visibility may differ: at the edge
    of the shadow of the centre, and from there on as long as a penumbra is found.
    """

    def visible_fraction(light: LightRecord) -> Half:
        fraction = np.zeros(len(surfels.position), np.float16)
        way = light.position - surfels.position
        facing = dots(way, surfels.normal) > 0
        indices = np.flatnonzero(facing)
        centre, *ring = disc_points(light)
        fraction[indices] = _visible(surfels, scene, centre, indices)
        if ring:
            start = mixed(surfels.faces, fraction > 0)
            start[::SURFELS_PER_PROBE] = True
            tests = [partial(_visible, surfels, scene, point) for point in ring]
            _add_penumbrae(fraction, start & facing, surfels.faces, facing, tests)
        return fraction

    # used column by column
    out = np.empty((len(surfels.position), len(lights)), np.float16, order="F")
    for j, fraction in enumerate(pool.map(visible_fraction, lights)):
        out[:, j] = fraction
    return out


def _add_penumbrae(
    fraction: Half,
    start: Mask,
    faces: Index,
    facing: Mask,
    ring: Sequence[VisibilityTest],
) -> None:
    """Refine `fraction` (n,), the visibility of a disc's centre, to that of the disc,
    beginning at `start` (n,).

    The neighbours of every surfel in a penumbra are also tested, until no further
    surfel is in a penumbra.
    """
    untested = facing & ~start
    front = np.flatnonzero(start)
    while len(front):
        total = fraction[front] + np.sum([sees(front) for sees in ring], axis=0)
        fraction[front] = total / (RING_POINTS + 1)
        soft = np.zeros(len(fraction), bool)
        soft[front[(total > 0) & (total < RING_POINTS + 1)]] = True
        ring_surfels = grown(faces, soft) & untested
        untested &= ~ring_surfels
        front = np.flatnonzero(ring_surfels)


def _visible(surfels: SurfelSet, scene: RayScene, eye: Float64, chosen: Index) -> Mask:
    """Whether chosen surfels (m,) are visible from a point (3,) in mm."""
    return ~scene.occluded(
        surfels.position, eye[None], normal=surfels.normal, chosen=chosen
    )


def disc_points(light: LightRecord) -> Float64:
    """Five points (5, 3) that represent equal parts of a light's disc; one for a point light."""
    if light.disc_radius == 0:
        return light.position[None]
    helper = np.eye(3)[np.abs(light.axis).argmin()]
    u = np.cross(light.axis, helper)
    u /= np.linalg.norm(u)
    v = np.cross(light.axis, u)
    # the centre represents a fifth of the area; the ring is where it halves the area of the rest
    radius = light.disc_radius * np.sqrt(0.6)
    angle = 2 * np.pi * np.arange(RING_POINTS) / RING_POINTS
    ring = light.position + radius * (
        np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v
    )
    return np.concatenate([light.position[None], ring])


def camera_visibility(
    surfels: SurfelSet,
    cameras: Sequence[CameraRecord],
    scene: RayScene,
    pool: Executor,
) -> tuple[Half, Mask, Float32]:
    """Visibility of the surfels in each camera.

    Returns
    -------
    visible : ndarray
        (n, camera) 1 where the camera sees the surfel inside its picture, else 0.
    clear : ndarray
        (n, camera) visible, and no silhouette or step in depth within EDGE_PX.
    pixels : ndarray
        (n, camera, 2) distorted projections.
    """
    count = len(surfels.position)
    # the columns of cameras are used one by one
    visible = np.zeros((len(cameras), count), np.float16).T
    clear = np.zeros((len(cameras), count), bool).T
    pixels = np.empty((len(cameras), count, 2), np.float32).transpose(1, 0, 2)

    def see(c: int) -> None:
        camera = cameras[c]
        projected, candidate = _in_picture(surfels, camera)
        indices = np.flatnonzero(candidate)
        indices = indices[_visible(surfels, scene, camera.centre, indices)]
        visible[indices, c] = 1
        pixels[:, c] = projected
        clear[indices, c] = _clear(camera, scene, surfels, projected, indices)

    list(pool.map(see, range(len(cameras))))
    return visible, clear, pixels


def _in_picture(surfels: SurfelSet, camera: CameraRecord) -> tuple[Float64, Mask]:
    """Projections (n, 2) of the surfels, and which of them face the camera and fall
    inside its picture (n,).
    """
    centre = camera.centre
    limit = np.array([camera.width, camera.height]) - 0.5
    pixels = np.empty((len(surfels.position), 2))
    inside = np.empty(len(surfels.position), bool)
    for i in range(0, len(pixels), SURFELS_PER_BLOCK):
        part = slice(i, i + SURFELS_PER_BLOCK)
        position = surfels.position[part]
        projected = camera.project(position)
        facing = dots(centre - position, surfels.normal[part]) > 0
        pixels[part] = projected
        inside[part] = facing & ((projected >= 0.5) & (projected <= limit)).all(axis=1)
    return pixels, inside


def depth_map(
    camera: CameraRecord, scene: RayScene, near: Float64
) -> tuple[Float32, Float32]:
    """Distance (h, w) mm of the surface along the rays (h, w, 3) through the centres of
    the pixels within EDGE_PX of positions (n, 2); infinity outside the surface.
    """
    rays = np.empty((camera.height, camera.width, 3), np.float32)
    distance = np.full((camera.height, camera.width), np.inf, np.float32)
    reach = EDGE_PX + 1  # of a pixel's corner
    centre = camera.centre
    # in strips, whose arrays stay in the cache: allocating large arrays takes longer
    # than filling them
    for top in range(0, camera.height, STRIP_ROWS):
        bottom = min(top + STRIP_ROWS, camera.height)
        row = near[:, 1]
        column = near[(row > top - reach) & (row < bottom + reach), 0]
        if not len(column):
            continue
        left = max(int(column.min() - reach), 0)
        right = min(int(column.max() + reach) + 1, camera.width)
        pixels = np.mgrid[left:right, top:bottom].T + 0.5
        part = np.s_[top:bottom, left:right]
        rays[part] = camera.rays(pixels)
        way = rays[part].reshape(-1, 3)
        distance[part] = scene.distances(centre, way).reshape(bottom - top, -1)
    return distance, rays


def _clear(
    camera: CameraRecord,
    scene: RayScene,
    surfels: SurfelSet,
    pixels: Float64,
    indices: Index,
) -> Mask:
    """Whether the pixels around surfels show the surface that their tangent planes predict."""
    distance, rays = depth_map(camera, scene, pixels[indices])
    focal_px = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    return matches_tangent_plane(
        surfels.position,
        surfels.normal,
        pixels,
        indices,
        camera.centre,
        rays,
        distance,
        EDGE_PX,
        DEPTH_SLACK,
        EDGE_PX * MAX_DEPTH_SLOPE / focal_px,
    )
