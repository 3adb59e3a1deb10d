"""The surface of a capture without a scan: normals by photometric stereo of the pictures
of one camera, integrated to a mesh.
"""

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_propagation, uniform_filter
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import splu

from skindb.calibration._merge_kernels import SATURATED
from skindb.calibration.irradiance import light_falloff
from skindb.calibration.radiance import FrameMerger, read_view
from skindb.errors import attempt_all, require
from skindb.format.dome import CameraRecord, DomeRecord, LightRecord
from skindb.geometry.clean import CleanMesh, clean_mesh
from skindb.geometry.scan import Scan
from skindb.limits import MAX_RELIEF_POINTS
from skindb.types import (
    Float32,
    Float64,
    Half,
    Index,
    Mask,
    dots,
    finite_rows,
    float64,
    lengths,
)

# error of the normals for which their prior has no effect [degree]
NO_SCAN_DEGREES = 60.0
POINTS_PER_BLOCK = 1 << 14  # whose directions to all lights are in memory: 60 MB
MIN_LIGHTS = 3
# of the brightest lights of a pixel; darker ones are in a shadow or graze the surface
SHADOW_FRACTION = 0.08
BRIGHT_QUANTILE = 0.9
# of the brightest pixels; pixels that no light brightens further are background
BACKGROUND_FRACTION = 0.02
# so are dark ones that all lights show alike, as black levels and ambient light do
DIM_FRACTION = 0.15
MIN_CHANGE = 0.1
# variance between pictures of the mean of a square over that of its points: 1 for a matt
# surface, 0.04 for noise; 0.17 to 0.4 for the least hundredth of dark parts of 15 subjects
MIN_SHARED = 0.2
NOISE_WINDOW = 5  # points
MIN_BACKGROUND = 0.01  # of the picture, from which it is noted
# smallest over largest eigenvalue of the lights' directions, below which they are in a plane
MIN_SPREAD = 2e-3
ROUNDS = 5  # of reweighting; the weights of a sixth differ by less than a percent
# of the scale of residuals, from which samples count less (Holland and Welsch 1977)
CAUCHY = 2.385
# to the camera, and number of the points whose slopes are compared across
MIN_COSINE_MIXED = 0.5
MIN_MIXED = 100
# Misfit of the slopes over that with other axes, and convexity, from which the lights have
# wrong axes. With true ones, 15 faces and objects under 3 to 12 of their lights have at most
# 1.07 and at least 0.23; with wrong ones 0.98 have more, with mirrored ones 0.92.
WRONG_AXES_RATIO = 1.15
MIN_CONVEXITY = -0.1
MIN_TILT = 0.2  # RMS sine of the normals to their mean; those subjects have 0.55 to 0.7
# what the misfits are of
WRONG_AXES = ("", "mirrored", "exchanged in x and y", "turned by 90 degrees")
MIN_COSINE = 0.1  # to the camera; slopes beyond it are not measurable
# of neighbouring points: depth over width, from which the surface is torn apart
MAX_SLOPE = 8.0
# distance of the nearest light over the size of the surface, below which directions
# differ between points
NEAR = 50.0


@dataclass(frozen=True)
class Relief:
    """A surface that was estimated from photographs, and where they show light."""

    scan: Scan
    surface: CleanMesh
    lit: Mask  # (light, rows, columns) of the grid
    step: int  # pixels between the points of the grid
    notes: list[str]  # on the background and on the lights

    def light_fraction(self, camera: CameraRecord, position: Float64) -> Half:
        """Whether each surfel (n, light) at `position` (n, 3) is lit: 1 or 0."""
        column, row = np.floor(camera.project(position) / self.step).astype(int).T
        _, rows, columns = self.lit.shape
        at = np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)
        return np.asarray(self.lit[:, at[0], at[1]].T, np.float16)


def estimate_relief(
    dome: DomeRecord,
    mergers: Mapping[str, FrameMerger],
    pool: Executor,
    *,
    spacing_mm: float,
) -> Relief:
    """Estimate the surface that the only camera of a dome shows.

    Normals are those of a matt surface, fitted robustly to the lights that reach a
    pixel (Woodham 1980), and are integrated with weights that tear the surface at steps
    of depth. Where lights are near, both are repeated with the directions of the lights
    from the points of the first surface.

    Parameters
    ----------
    dome
        One camera; lights without an intensity are taken as equal.
    mergers, pool
        Frame merger of the camera; threads that decode.
    spacing_mm
        Wanted distance of the points, at the origin.

    Raises
    ------
    InputError
        If a frame cannot be decoded, or fewer than three lights reach every pixel.
    """
    camera = dome.cameras[0]
    values, step = _grey_pictures(dome, mergers[camera.id], pool, spacing_mm)
    lit, background = _lit(values)
    rows, columns = lit.shape[1:]
    pixels = (np.mgrid[:columns, :rows].T + 0.5) * step
    rays = camera.rays(pixels)
    # the plane through the origin, parallel to the picture
    forward = camera.R[2]
    depth = np.full((rows, columns), float(-camera.centre @ forward))
    rays /= (rays @ forward)[..., None]
    rounds = 2 if _near(dome, depth[0, 0], rays) else 1
    for _ in range(rounds):
        points = camera.centre + depth[..., None] * rays
        normal = photometric_normals(values, lit, dome.lights, points, -rays)
        known = finite_rows(normal)
        require(
            known.any(),
            f"{dome.file}[frames]",
            f"at least {MIN_LIGHTS} lights that are not in a plane must reach a pixel",
            f"none of {rows * columns:,} pixels is lit by so many",
            "add lights, or a scan",
        )
        depth = depth[0, 0] * np.exp(_integrated(normal, known, rays))
    vertices = (camera.centre + depth[..., None] * rays).reshape(-1, 3)
    width = step * camera.pixel_width(np.zeros(3))
    faces = _faces(known, depth, width)
    require(
        len(faces),
        f"{dome.file}[frames]",
        "neighbouring pixels must be lit by three lights to form a surface",
        "only pixels without such neighbours",
        "photograph the subject larger, or with more lights",
    )
    surface = clean_mesh(vertices, faces)
    if surface.report["turned_mesh"]:  # a hollow surface faces the camera, too
        report = surface.report | {"turned_mesh": 0}
        surface = replace(surface, faces=surface.faces[:, ::-1], report=report)
    notes = []
    if background > MIN_BACKGROUND:
        notes.append(
            f"{background:.0%} of the picture is a dark background with noise and is "
            "excluded; a mask states the subject"
        )
    if wrong := _wrong_axes(normal @ camera.R.T):
        notes.append(
            f"the lights seem to be {wrong}: check that x of their directions is to the "
            "right, y up and z to the camera"
        )
    return Relief(Scan(vertices, faces), surface, lit, step, notes)


def _grey_pictures(
    dome: DomeRecord, merger: FrameMerger, pool: Executor, spacing_mm: float
) -> tuple[Float32, int]:
    """Mean radiance (light, rows, columns) of the squares of a grid, over the intensity
    of the light; NaN where pixels are saturated. The width of the squares in pixels.
    """
    camera = merger.camera
    area = camera.width * camera.height
    wanted = spacing_mm / camera.pixel_width(np.zeros(3))
    step = max(round(wanted), int(np.ceil(np.sqrt(area / MAX_RELIEF_POINTS))), 1)
    step = min(step, camera.width // 2 or 1, camera.height // 2 or 1)
    rows, columns = camera.height // step, camera.width // step

    def picture(light: LightRecord) -> Float32:
        radiance, flag = merger.merge(read_view(dome, light.id, camera))
        radiance[flag == SATURATED] = np.nan
        grey = radiance.mean(axis=-1)[: rows * step, : columns * step]
        grey = grey.reshape(rows, step, columns, step).mean(axis=(1, 3))
        intensity = 1.0 if light.intensity is None else light.intensity.mean()
        return np.asarray(grey / (intensity * light.gain), np.float32)

    return np.stack(attempt_all([], picture, dome.lights, pool=pool)), step


def _lit(values: Float32) -> tuple[Mask, float]:
    """Where (light, rows, columns) a picture shows light, neither shadow nor saturation;
    and the fraction of the picture that shows noise of a dark background.
    """
    low, bright = np.quantile(
        np.nan_to_num(values), (1 - BRIGHT_QUANTILE, BRIGHT_QUANTILE), axis=0
    )
    top = np.quantile(bright, 0.99)
    dim = bright <= DIM_FRACTION * top
    changes = bright - low > MIN_CHANGE * bright
    shown = (bright > BACKGROUND_FRACTION * top) & (changes | ~dim)
    # dark hair inside the subject may be noise, and dark skin inside a mask, beyond which all is 0
    noise = dim & (bright > 0) & _is_noise(values)
    border = np.ones(noise.shape, bool)
    border[1:-1, 1:-1] = False
    subject = ~binary_propagation(noise & border, mask=noise)
    lit = np.isfinite(values) & (values > SHADOW_FRACTION * bright) & (values > 0)
    return lit & shown & subject, float((shown & ~subject).mean())


def _is_noise(values: Float32) -> Mask:
    """Where (rows, columns) differences between pictures do not extend to neighbours."""
    mean = np.nan_to_num(values).mean(axis=0)
    shared, total = np.zeros(mean.shape), np.zeros(mean.shape)
    for picture in values:
        change = np.nan_to_num(picture) - mean
        shared += uniform_filter(change, NOISE_WINDOW) ** 2
        total += change**2
    return shared <= MIN_SHARED * uniform_filter(total, NOISE_WINDOW)


def _near(dome: DomeRecord, distance: float, rays: Float64) -> bool:
    """Whether directions of lights differ over the surface."""
    size = distance * float(np.linalg.norm(rays[-1, -1] - rays[0, 0]))
    nearest = min(float(np.linalg.norm(light.position)) for light in dome.lights)
    return nearest < NEAR * size


def photometric_normals(
    values: Float32,
    lit: Mask,
    lights: tuple[LightRecord, ...],
    points: Float64,
    towards: Float64,
) -> Float64:
    """Unit normals (rows, columns, 3) of a matt surface by robust least squares.

    Parameters
    ----------
    values
        (light, rows, columns) radiance over intensity.
    lit
        Where they are used.
    lights
        Positions and fall-off.
    points, towards
        (rows, columns, 3) points in mm, and directions towards the camera.

    Returns
    -------
    ndarray
        NaN where fewer than three lights are used, where these are in a plane, or where
        the normal faces away from the camera.
    """
    shown = lit.reshape(len(lights), -1)
    measured = values.reshape(shown.shape)
    place, view = points.reshape(-1, 3), towards.reshape(-1, 3)
    normal = np.full(place.shape, np.nan)
    enough = np.flatnonzero(shown.sum(axis=0) >= MIN_LIGHTS)
    for i in range(0, len(enough), POINTS_PER_BLOCK):
        at = enough[i : i + POINTS_PER_BLOCK]
        value, weight = (float64(part[:, at]) for part in (measured, shown))
        normal[at] = _normals_of(value, weight, lights, place[at], view[at])
    return normal.reshape(points.shape)


def _normals_of(
    value: Float64,
    weight: Float64,
    lights: tuple[LightRecord, ...],
    place: Float64,
    view: Float64,
) -> Float64:
    """Normals (p, 3) from values (light, p) where the weights are 1."""
    direction = np.empty((*value.shape, 3))
    for j, light in enumerate(lights):
        square, falloff = light_falloff(light, place)
        way = light.position - place
        direction[j] = way / np.sqrt(square)[:, None]
        # so that value = direction . solution for a matt surface
        value[j] *= square / np.maximum(falloff, 1e-6)
    value = np.where(weight > 0, value, 0.0)
    solution = np.zeros(place.shape)
    used = weight
    for _ in range(ROUNDS):
        # einsum of three factors is slow
        weighted = used[..., None] * direction
        system = np.einsum("jpa,jpb->pab", weighted, direction)
        right = np.einsum("jpa,jp->pa", weighted, value)
        ridge = 1e-12 * np.trace(system, axis1=1, axis2=2)
        system += ridge[:, None, None] * np.eye(3)
        solution = np.linalg.solve(system, right[..., None])[..., 0]
        residual = np.abs(np.einsum("jpa,pa->jp", direction, solution) - value)
        scale = np.nanmedian(np.where(weight > 0, residual, np.nan), axis=0) / 0.6745
        ratio = residual / (
            CAUCHY * np.maximum(scale, 1e-9 * np.abs(value).max(initial=0))
        )
        used = weight / (1 + ratio**2)
    spread = np.linalg.eigvalsh(
        np.einsum("jpa,jpb->pab", weight[..., None] * direction, direction)
    )
    good = (spread[:, 0] > MIN_SPREAD * spread[:, 2]) & (dots(solution, view) > 0)
    length = np.maximum(lengths(solution), 1e-300)
    return np.where(good[:, None], solution / length[:, None], np.nan)


def _wrong_axes(normal: Float64) -> str:
    """How and why the lights seem to be mirrored or turned, by normals (rows, columns, 3)
    in the frame of the camera; empty if they do not.

    The mixed derivatives of heights are equal. With wrong axes of the lights, other
    derivatives of their slopes are; turned by 180 degrees, a convex surface is hollow.
    """
    facing = np.where(normal[..., 2] < -MIN_COSINE_MIXED, normal[..., 2], np.nan)
    across, down = (-normal[..., i] / facing for i in (0, 1))
    ax, dx = (np.diff(slope, axis=1)[:-1] for slope in (across, down))
    ay, dy = (np.diff(slope, axis=0)[:, :-1] for slope in (across, down))
    known = np.isfinite(ax + ay + dx + dy)
    if known.sum() < MIN_MIXED:
        return ""
    pairs = (ay - dx, ay + dx, ax - dy, ax + dy)
    misfit = [np.median(np.abs(pair[known])) for pair in pairs]
    if misfit[0] > WRONG_AXES_RATIO * min(misfit):
        return f"{WRONG_AXES[np.argmin(misfit)]}, as no surface has these normals"
    known_normal = np.isfinite(normal[..., 2])
    place = np.argwhere(known_normal)[:, ::-1]
    place = place - place.mean(axis=0)
    tilt = normal[known_normal, :2]
    tilt -= tilt.mean(axis=0)
    if np.sqrt(2 * np.mean(tilt**2)) < MIN_TILT:
        return ""  # flat things, such as coins, are hollow by noise
    outwards = np.vdot(place, tilt) / (np.linalg.norm(place) * np.linalg.norm(tilt))
    convexity = outwards + np.sign(ax + dy)[known].mean()
    if convexity < MIN_CONVEXITY:
        return "turned by 180 degrees, as the surface is hollow"
    return ""


def _integrated(normal: Float64, known: Mask, rays: Float64) -> Float64:
    """Logarithm of the relative depth (rows, columns); 0 where no normal is known.

    The gradient of the logarithm of the depth Z along the picture follows from
    P = C + Z r and n . dP = 0: it is -(n . dr) / (n . r).
    """
    number = np.full(known.shape, -1)
    number[known] = np.arange(known.sum())
    down, across = (number[:-1], number[1:]), (number[:, :-1], number[:, 1:])
    pairs = np.hstack([np.reshape(side, (2, -1)) for side in (down, across)])
    first, second = pairs[:, (pairs >= 0).all(axis=0)]
    way, facing = rays[known], normal[known]
    length = lengths(way)
    cosine = np.minimum(dots(facing, way), -MIN_COSINE * length)
    change = way[second] - way[first]
    along = [-dots(facing[i], change) / cosine[i] for i in (first, second)]
    steepness = cosine / length
    weight = np.maximum(steepness[first], steepness[second]) ** 2
    depth = np.zeros(known.shape)
    depth[known] = _robust_heights(
        first, second, (along[0] + along[1]) / 2, weight, len(way)
    )
    return depth


def _robust_heights(
    first: Index, second: Index, slope: Float64, weight: Float64, count: int
) -> Float64:
    """Heights (count,) whose differences are closest to `slope`, with weights that
    decrease with the residuals, so that steps of depth stay local.
    """
    height = np.zeros(count)
    if not len(slope):
        return height
    edges = np.arange(len(slope))
    signs = np.repeat([-1.0, 1.0], len(slope))
    ends = (np.tile(edges, 2), np.concatenate([first, second]))
    difference = coo_array((signs, ends), shape=(len(slope), count)).tocsr()
    used = weight
    for _ in range(3):
        scaled = diags_array(used) @ difference
        # every part of the surface stays at the mean depth
        system = (difference.T @ scaled + 1e-7 * diags_array(np.ones(count))).tocsc()
        height = splu(system, permc_spec="MMD_AT_PLUS_A").solve(
            difference.T @ (used * slope)
        )
        residual = np.abs(difference @ height - slope)
        scale = np.median(residual) / 0.6745
        used = weight / (1 + (residual / max(CAUCHY * scale, 1e-12)) ** 2)
    return height


def _faces(known: Mask, depth: Float64, width: float) -> Index:
    """Triangles (f, 3) of the points of the grid, which face the camera and do not cross
    steps of depth.
    """
    number = np.arange(known.size).reshape(known.shape)
    upper, lower = number[:-1], number[1:]
    sides = (upper[:, :-1], lower[:, :-1], lower[:, 1:], upper[:, 1:])
    corners = np.stack(sides, axis=-1).reshape(-1, 4)
    near = depth.ravel()[corners]
    whole = known.ravel()[corners].all(axis=1)
    whole &= np.ptp(near, axis=1) < MAX_SLOPE * width
    corners = corners[whole]
    return np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
