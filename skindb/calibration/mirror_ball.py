"""Positions of lights from their highlights on a mirror ball."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy import ndimage
from scipy.optimize import least_squares

from skindb.calibration.setup import PLACE, BallFrames
from skindb.errors import (
    Fault,
    InputError,
    attempt,
    attempt_all,
    require,
)
from skindb.format.dome import (
    CameraRecord,
    DomeRecord,
    LightRecord,
)
from skindb.format.frames import CAMERA, LIGHT, Frame, filled, read_frame
from skindb.geometry.camera import Pinhole
from skindb.schema import dataset
from skindb.types import Float64, float64, lengths, unit

# of the contrast over the ball; pixels above it belong to the highlight
HIGHLIGHT_FRACTION = 0.5
# of the ball's area; a larger spot is a window or an overexposed frame
MAX_HIGHLIGHT_FRACTION = 0.1
# px around a highlight whose light counts: a highlight may be smaller than a pixel
HIGHLIGHT_MARGIN = 2
# rad between rays, at which the error along them is 50 times the error across
MIN_BASELINE = 0.02
OUTLINE_POINTS = 32  # lines of sight to the outline of a ball
# one pixel of a ball with a radius of 20 px; a diameter instead of a radius is 50 % off
MAX_SIZE_MISMATCH = 0.05
# of reweighting by distance; five change the position by less than a micrometre
ROUNDS = 20
# from which the places of a ball are found; each adds three unknowns
MAX_PLACE_LIGHTS = 24
MAX_PLACE_STEPS = 60  # of a fit; random domes with the right radius needed at most 48
# radii: from highlights on the front to those of its edge
BEHIND = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
# losses, and misses [rad] of lines of sight from which they count less; a pixel is 0.3 to 3 mrad
OUTLIERS = (("soft_l1", 2e-3), ("soft_l1", 3e-4), ("cauchy", 3e-4))
MAX_MISS = 0.2  # of the radius
# each reduces the error by the radius over the distance of eye and light
SIGHT_STEPS = 6
FAR_MM = 1000.0
THREADS = 2

# place, camera -> column and row, px
Highlights = dict[tuple[str, str], Float64]


@dataclass(frozen=True)
class Outline:
    """Circle of a ball in a picture: centre (2,) column and row, and radius, in px."""

    centre: Float64
    radius: float


@dataclass(frozen=True)
class LightPosition:
    """Position (3,) mm, its covariance (3, 3) mm2, and the angle (ray,) in degrees by
    which each ray misses it.
    """

    position: Float64
    covariance: Float64
    miss: Float64


def ball_outline(mask: ArrayLike) -> Outline:
    """Circle with the centroid and the area of the pixels of a mask (height, width).

    Raises
    ------
    InputError
        The mask is empty, or not round.
    """
    row, column = np.nonzero(np.asarray(mask, bool))
    area = len(row)
    radius = float(np.sqrt(area / np.pi))
    centre = np.array([column.sum(), row.sum()]) / max(area, 1) + 0.5
    away = np.hypot(column + 0.5 - centre[0], row + 0.5 - centre[1])
    require(
        area and away.max() < 1.1 * radius + 1,
        "mirror ball",
        "the mask of the mirror ball must be one disc",
        f"{area} pixels that do not fill a disc" if area else "nothing",
        "draw it again, without the stand of the ball",
    )
    return Outline(centre, radius)


def highlight_centre(picture: ArrayLike, outline: Outline) -> Float64:
    """Column and row (2,) in px of the highlight on a ball: centroid of the largest bright spot.

    Parameters
    ----------
    picture
        (height, width) or (height, width, 3) values; a saturated highlight is allowed.
    outline
        Circle of the ball.

    Raises
    ------
    InputError
        The picture is not finite or even, or the bright spot is too large for a highlight.
    """
    grey = float64(picture)
    grey = grey.mean(axis=-1) if grey.ndim == 3 else grey
    row, column = np.mgrid[: grey.shape[0], : grey.shape[1]] + 0.5
    x, y = outline.centre
    ball = np.hypot(column - x, row - y) < outline.radius
    values = grey[ball]
    finite = len(values) > 0 and bool(np.isfinite(values).all())
    low = float(np.median(values)) if finite else 0.0
    high = float(values.max()) if finite else 0.0
    require(
        high > low,
        "mirror ball",
        "the mirror ball must show a highlight",
        "a uniform picture" if finite else "no finite values",
        "check its position in the picture, or expose it longer",
    )
    level = low + HIGHLIGHT_FRACTION * (high - low)
    labels, _ = ndimage.label(ball & (grey >= level))
    sizes = np.bincount(labels.ravel())[1:]
    fraction = sizes.max() / ball.sum()
    require(
        fraction <= MAX_HIGHLIGHT_FRACTION,
        "mirror ball",
        f"the highlight must cover at most {MAX_HIGHLIGHT_FRACTION:.0%} of the ball",
        f"{fraction:.0%}",
        "expose the frame shorter, and darken the room",
    )
    spot = labels == 1 + int(sizes.argmax())
    near = ball & ndimage.binary_dilation(spot, iterations=HIGHLIGHT_MARGIN)
    weight = np.maximum(grey[near] - low, 0)
    return np.array([np.average(axis[near], weights=weight) for axis in (column, row)])


def distant_light(outline: Outline, highlight: ArrayLike) -> Float64:
    """Unit direction (3,) to a distant light seen by a distant camera: x right, y up, z
    to the viewer.

    The view along -z is reflected at the normal of the ball under the highlight (2,)
    px: l = 2 (n . v) n - v.
    """
    away = float64(highlight) - outline.centre
    offset = away / outline.radius * [1, -1]
    square = float(offset @ offset)
    require(
        square < 1,
        "mirror ball",
        "the highlight must lie on the ball",
        f"{np.sqrt(square):.2f} radii from its centre",
        "check the centre and radius of the ball",
    )
    normal = np.array([*offset, np.sqrt(1 - square)])
    return 2 * normal[2] * normal - [0, 0, 1]


def reflected_ray(
    camera: Pinhole, ball: ArrayLike, radius: float, highlight: ArrayLike
) -> tuple[Float64, Float64]:
    """Point (3,) mm of the ball at a highlight, and the unit direction (3,) from it to the light.

    Parameters
    ----------
    camera
        The camera that sees the highlight.
    ball
        (3,) centre of the ball in mm, subject frame.
    radius
        Radius of the ball in mm.
    highlight
        (2,) column and row in px.

    Raises
    ------
    InputError
        The line of sight misses the ball.
    """
    view = camera.rays(float64(highlight))
    centre = float64(ball)
    way = centre - camera.centre
    point, direction, under = _mirrored(camera.centre, view, centre, radius)
    require(
        under > 0 and way @ view > 0,
        "mirror ball",
        f"the line of sight must meet the ball of {radius:g} mm",
        f"{np.sqrt(max(radius**2 - float(under), 0.0)):.1f} mm from its centre",
        "check the position of the ball",
    )
    return point, direction


def _mirrored(
    eye: Float64, view: Float64, ball: Float64, radius: float
) -> tuple[Float64, Float64, Float64]:
    """Points (..., 3) where lines of sight (..., 3) meet a ball, directions (..., 3) in which
    it mirrors them, and the squares (...) of half of their lengths in it, negative for lines
    that miss it, which are mirrored where they are nearest.
    """
    way = ball - eye
    along = (view * way).sum(axis=-1)
    under = radius**2 - (way * way).sum(axis=-1) + along**2
    point = eye + (along - np.sqrt(np.maximum(under, 0)))[..., None] * view
    normal = unit(point - ball)
    out = view - 2 * (view * normal).sum(axis=-1)[..., None] * normal
    return point, out, under


def _sights(eye: Float64, ball: Float64, radius: float, light: Float64) -> Float64:
    """Unit directions (..., 3) in which eyes (..., 3) see the highlights of lights (..., 3) on
    balls (..., 3).
    """
    point = ball
    for _ in range(SIGHT_STEPS):
        # the normal halves the angle between eye and light
        point = ball + radius * unit(unit(eye - point) + unit(light - point))
    return unit(point - eye)


def ball_places(
    cameras: Mapping[str, Pinhole], highlights: Sequence[Highlights], radius: float
) -> dict[str, Float64]:
    """Centres (3,) mm of a ball of known radius at several places, from the highlights of
    many lights: bundle adjustment of the centres and the lights. The radius is estimated as
    well, and compared with the known one.

    Raises
    ------
    InputError
        If fewer than two cameras see the highlights at a place, or the highlights are not those of
        a ball of this radius.
    """
    seen = [one for one in highlights if len(one) > 2]
    seen = seen[:: -(-len(seen) // MAX_PLACE_LIGHTS) or 1]
    places = sorted({place for one in seen for place, _ in one})
    if not places:
        return {}
    rows = [
        (places.index(place), i, cameras[name].centre, cameras[name].rays(pixel))
        for i, one in enumerate(seen)
        for (place, name), pixel in one.items()
    ]
    at, of, eye, view = map(np.array, zip(*rows, strict=True))
    front = np.empty((len(places), 3))
    for k, place in enumerate(places):
        eyes, which = np.unique(eye[at == k], axis=0, return_inverse=True)
        require(
            len(eyes) > 1,
            f"mirror ball, place {place}",
            "two cameras must see its highlights",
            f"{len(eyes)}",
            "move the ball to the middle of the dome, or give its outlines",
        )
        lines = [np.median(view[at == k][which == j], axis=0) for j in range(len(eyes))]
        front[k] = light_position(eyes, unit(np.array(lines))).position
    count = front.size

    def misses(x: Float64, size: float | None = None) -> Float64:
        balls, lights = np.split(
            x[: count + 3 * len(seen)].reshape(-1, 3), [len(front)]
        )
        size = radius * np.exp(x[-1]) if size is None else size
        return (_sights(eye, balls[at], size, lights[of]) - view).ravel()

    def start(part: float) -> Float64:
        # the lines to the highlights meet before the centre
        back = [
            unit(centre - eye[at == k]).mean(axis=0) for k, centre in enumerate(front)
        ]
        balls = front + part * radius * np.array(back)
        point, out, _ = _mirrored(eye, view, balls[at], radius)
        lights = [_meeting(point[of == i], out[of == i]) for i in range(len(seen))]
        return np.concatenate([balls.ravel(), np.ravel(lights), [0]])

    best = min(map(start, BEHIND), key=lambda x: float(np.abs(misses(x)).sum()))
    scale = np.repeat([1.0, 100, 0.03], [count, 3 * len(seen), 1])
    adjust = partial(least_squares, misses, max_nfev=MAX_PLACE_STEPS)
    for loss, outlier in OUTLIERS:
        fit = adjust(best, loss=loss, f_scale=outlier, x_scale=scale)
        best = fit.x
    # in the median 1.18 standard deviations, of two angles a highlight
    angle = np.median(lengths(fit.fun.reshape(-1, 3))) / 1.18
    noise = angle**2 * 2 * len(view) / max(2 * len(view) - len(best), 1)
    spread = np.sqrt(noise * np.linalg.pinv(fit.jac.T @ fit.jac)[-1, -1])
    found = radius * np.exp(best[-1])
    miss = angle * np.median(lengths(front[at] - eye))
    agrees = abs(best[-1]) < MAX_SIZE_MISMATCH + 3 * spread and miss < MAX_MISS * radius
    require(
        fit.success and agrees,
        "mirror ball",
        f"its highlights must be those of a ball of radius {radius:g} mm",
        f"of {found:.3g} +- {found * spread:.1g} mm, missed by {miss:.1g} mm",
        "correct the radius of the ball or the squares of the board (mm), and remove other bright "
        "things from the pictures",
    )
    of_size = {"x_scale": scale[:-1], "args": (radius,)}
    fit = adjust(best[:-1], loss=loss, f_scale=outlier, **of_size)
    return dict(zip(places, fit.x[:count].reshape(-1, 3), strict=True))


def _meeting(points: Float64, directions: Float64) -> Float64:
    """Where rays meet best; far away along them if they are parallel."""
    try:
        return light_position(points, directions).position
    except InputError:
        return points.mean(axis=0) + FAR_MM * unit(directions.mean(axis=0))


def ball_centre(
    cameras: Sequence[Pinhole], outlines: ArrayLike, radius: float
) -> Float64:
    """Centre (3,) mm of a ball of known radius from its outlines in one or more calibrated cameras.

    The lines of sight to the outline form a cone, whose axis points to the centre and
    whose angle gives the distance. With several cameras, the centre is where their axes
    meet, and the distances are compared with it.

    Parameters
    ----------
    cameras
        The cameras.
    outlines
        (camera, 3) column, row and radius of the outline in px.
    radius
        Radius of the ball in mm.

    Raises
    ------
    InputError
        The distances differ from the place where the axes meet by more than 5 %.
    """
    turn = np.linspace(0, 2 * np.pi, OUTLINE_POINTS, endpoint=False)
    around = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    directions = []
    distances = []
    for camera, circle in zip(cameras, float64(outlines), strict=True):
        sight = camera.rays(circle[:2] + circle[2] * around)
        # all lines make the same angle with the axis: sight . axis = cos(angle)
        axis = np.linalg.lstsq(sight, np.ones(OUTLINE_POINTS))[0]
        length = float(np.linalg.norm(axis))
        directions.append(float64(axis / length))
        distances.append(radius / np.sqrt(1 - min(1 / length**2, 1 - 1e-12)))
    start = np.array([camera.centre for camera in cameras])
    if len(cameras) == 1:
        return start[0] + distances[0] * directions[0]
    centre = light_position(start, directions).position
    ratio = lengths(centre - start) / np.array(distances)
    mismatch = float(np.abs(ratio - 1).max())
    require(
        not mismatch > MAX_SIZE_MISMATCH,
        "mirror ball",
        f"its outlines must be of the size of a ball of radius {radius:g} mm, "
        f"within {MAX_SIZE_MISMATCH:.0%}",
        f"{mismatch:.0%} off",
        "give the radius of the ball in mm, and column, row and radius of its outlines in px",
    )
    return centre


def light_position(origins: ArrayLike, directions: ArrayLike) -> LightPosition:
    """Intersection of rays from several positions of the ball, or of several cameras.

    Least squares of the angles by which the rays miss the point: squared distances from
    the rays, weighted by the inverse squared distance from their origins, which is
    updated in rounds. The covariance follows from the scatter of the rays; for two rays
    it is a rough estimate.

    Parameters
    ----------
    origins
        (ray, 3) mm, of two or more rays.
    directions
        (ray, 3) unit vectors.

    Raises
    ------
    InputError
        Rays that are nearly parallel.
    """
    start = float64(origins)
    way = float64(directions)
    across = np.eye(3) - way[:, :, None] * way[:, None, :]
    weight = np.ones(len(start))
    for _ in range(ROUNDS):
        normal = np.einsum("r,rij->ij", weight, across)
        minimum = MIN_BASELINE**2 * weight.sum() / 4
        require(
            not np.linalg.eigvalsh(normal)[0] < minimum,
            "light",
            "its rays must not be parallel",
            f"{len(start)} rays within about a degree",
            "move the ball farther between the photographs",
        )
        moment = np.einsum("r,rij,rj->i", weight, across, start)
        position = np.linalg.solve(normal, moment)
        weight = 1 / ((position - start) ** 2).sum(axis=1)
    offset = np.einsum("rij,rj->ri", across, position - start)
    angle = lengths(offset) * np.sqrt(weight)
    variance = float((angle**2).sum()) / max(2 * len(start) - 3, 1)
    covariance = variance * np.linalg.inv(np.einsum("r,rij->ij", weight, across))
    return LightPosition(position, covariance, np.degrees(angle))


def calibrate_positions(dome: DomeRecord, ball: BallFrames) -> xr.Dataset:
    """Position of every light from its highlights on the ball, with standard errors.

    A light needs its highlight in two frames, of different cameras or places of the
    ball. Frames without a highlight are skipped: the light may be hidden, or behind the
    ball.

    Returns
    -------
    Dataset
        Group "position_calibration".

    Raises
    ------
    InputError
        With every frame that cannot be read, and every light that is seen in fewer than two frames.
    """
    cameras = {camera.id: camera for camera in dome.cameras}
    centres = {}
    faults = list[Fault]()
    with ThreadPoolExecutor(THREADS) as pool:
        highlights = attempt_all(
            faults, partial(_highlights, dome, ball), dome.lights, pool=pool
        )
    for place, circles in ball.outlines.items():
        views = [cameras[name] for name in circles]
        if not views:
            continue
        centre = attempt(
            faults,
            partial(ball_centre, views, list(circles.values()), ball.radius),
            where=f"{{}}, place {place}",
        )
        if centre is None:
            raise InputError(faults)
        centres[place] = centre
    centres = centres or ball_places(cameras, highlights, ball.radius)
    of_light = dict(zip(dome.light_ids, highlights, strict=True))

    def calibrated(light: LightRecord) -> tuple[LightPosition, int]:
        rays = [
            reflected_ray(cameras[camera], centres[place], ball.radius, pixel)
            for (place, camera), pixel in of_light[light.id].items()
            if place in centres
        ]
        require(
            len(rays) >= 2,
            "mirror ball",
            "its highlight must appear in two frames",
            f"{len(rays)}",
            "expose them longer, or add a place of the ball",
        )
        return light_position(*zip(*rays, strict=True)), len(rays)

    with ThreadPoolExecutor(THREADS) as pool:
        results = attempt_all(
            faults,
            calibrated,
            dome.lights,
            pool=pool,
            where=lambda light: f"light {light.id}, {{}}",
        )
    positions, counts = zip(*results, strict=True)
    return dataset(
        {
            "calibrated_position": [fit.position for fit in positions],
            "calibrated_position_error": [
                np.sqrt(np.diag(fit.covariance)) for fit in positions
            ],
            "position_ray_count": list(counts),
            "position_miss": [np.sqrt(np.mean(fit.miss**2)) for fit in positions],
        },
        coords={"light": dome.light_ids, "xyz": ["x", "y", "z"]},
    )


def _highlights(dome: DomeRecord, ball: BallFrames, light: LightRecord) -> Highlights:
    """Highlights of a light, in the outline of the ball or, without any, in the whole picture."""
    found = {}
    for place, circles in ball.outlines.items():
        for camera in dome.cameras:
            if circles and camera.id not in circles:
                continue
            names = {PLACE: place, LIGHT: light.id, CAMERA: camera.id}
            file = ball.folder / filled(ball.frames, **names)
            frame = read_frame(file, camera.sensor.kind)
            highlight = highlight_of(camera, frame, circles.get(camera.id))
            if highlight is not None:
                found[place, camera.id] = highlight
    return found


def highlight_of(
    camera: CameraRecord, frame: Frame, circle: Float64 | None = None
) -> Float64 | None:
    """Highlight in the outline (3,) of a ball, or in the whole picture; None without one."""
    if circle is None:
        size = np.array([camera.width, camera.height])
        circle = np.array([*size / 2, np.linalg.norm(size)])
    outline = Outline(circle[:2], circle[2])
    return attempt([], partial(highlight_centre, frame, outline))
