"""Directions and positions of lights from their highlights on a mirror ball, and
reprojection of known points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from skindb.errors import require
from skindb.format.dome import Pinhole
from skindb.types import Float64

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


@dataclass(frozen=True)
class Outline:
    """Circle of a ball in a picture: centre (2,) column and row, and radius, in px."""

    centre: Float64
    radius: float


@dataclass(frozen=True)
class BallCentre:
    """Centre (3,) mm of a ball, and largest relative mismatch of its size in the
    pictures; NaN for one camera.
    """

    centre: Float64
    mismatch: float


@dataclass(frozen=True)
class LightPosition:
    """Position (3,) mm, its covariance (3, 3) mm2, and the angle (ray,) in degrees by
    which each ray misses it.
    """

    position: Float64
    covariance: Float64
    miss: Float64


@dataclass(frozen=True)
class Reprojection:
    """Residual (point, 2) px, observed minus predicted; its root mean square and
    maximum in px; number of points.
    """

    residual: Float64
    rms: float
    largest: float
    count: int


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
    grey = np.asarray(picture, np.float64)
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
    away = np.asarray(highlight, np.float64) - outline.centre
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
    return np.asarray(2 * normal[2] * normal - [0, 0, 1])


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
    view = camera.rays(np.asarray(highlight, np.float64))
    centre = np.asarray(ball, np.float64)
    way = centre - camera.centre
    along = float(way @ view)
    square = float(way @ way)
    under = radius**2 - square + along**2
    require(
        under > 0 and along > 0,
        "mirror ball",
        f"the line of sight must meet the ball of {radius:g} mm",
        f"{np.sqrt(max(square - along**2, 0.0)):.1f} mm from its centre",
        "check the position of the ball",
    )
    point = camera.centre + (along - np.sqrt(under)) * view
    normal = (point - centre) / radius
    return point, np.asarray(view - 2 * (view @ normal) * normal)


def ball_centre(
    cameras: Sequence[Pinhole], outlines: ArrayLike, radius: float
) -> BallCentre:
    """Centre of a ball of known radius from its outlines in one or more calibrated cameras.

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
    directions = list[Float64]()
    distances = list[float]()
    for camera, circle in zip(cameras, np.asarray(outlines, np.float64), strict=True):
        sight = camera.rays(circle[:2] + circle[2] * around)
        # all lines make the same angle with the axis: sight . axis = cos(angle)
        axis = np.linalg.lstsq(sight, np.ones(OUTLINE_POINTS))[0]
        length = float(np.linalg.norm(axis))
        directions.append(np.asarray(axis / length, np.float64))
        distances.append(radius / np.sqrt(1 - min(1 / length**2, 1 - 1e-12)))
    start = np.array([camera.centre for camera in cameras])
    if len(cameras) == 1:
        return BallCentre(start[0] + distances[0] * directions[0], np.nan)
    centre = light_position(start, directions).position
    ratio = np.linalg.norm(centre - start, axis=1) / np.array(distances)
    mismatch = float(np.abs(ratio - 1).max())
    require(
        not mismatch > MAX_SIZE_MISMATCH,
        "mirror ball",
        f"its outlines must be of the size of a ball of radius {radius:g} mm, "
        f"within {MAX_SIZE_MISMATCH:.0%}",
        f"{mismatch:.0%} off",
        "give the radius of the ball in mm, and column, row and radius of its outlines in px",
    )
    return BallCentre(centre, mismatch)


def light_position(origins: ArrayLike, directions: ArrayLike) -> LightPosition:
    """Intersection of rays from several positions of the ball, or of several cameras.

    Least squares of the angles by which the rays miss the point: squared distances from
    the rays, weighted by the inverse squared distance from their origins, which is
    updated in rounds. The covariance follows from the scatter of the rays; for two rays
    it is a rough estimate.

    Parameters
    ----------
    origins
        (ray, 3) mm.
    directions
        (ray, 3) unit vectors.

    Raises
    ------
    InputError
        Fewer than two rays, values that are not finite, or rays that are nearly parallel.
    """
    start = np.asarray(origins, np.float64)
    way = np.asarray(directions, np.float64)
    shaped = start.ndim == 2 and start.shape == way.shape and len(start) >= 2
    require(
        shaped and np.isfinite([start, way]).all(),
        "light",
        "its position needs two or more rays of finite numbers",
        f"{start.shape} and {way.shape}",
        "photograph the ball at another position",
    )
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
    angle = np.linalg.norm(offset, axis=1) * np.sqrt(weight)
    variance = float((angle**2).sum()) / max(2 * len(start) - 3, 1)
    covariance = variance * np.linalg.inv(np.einsum("r,rij->ij", weight, across))
    return LightPosition(position, covariance, np.degrees(angle))


def reprojection_error(
    points: ArrayLike, pixels: ArrayLike, camera: Pinhole
) -> Reprojection:
    """Distance of observed pixels (point, 2) from the projections of known points (point, 3) in mm.

    Points that are behind the camera, or that were not observed (NaN), are excluded.

    Raises
    ------
    InputError
        No point remains.
    """
    residual = np.asarray(pixels, np.float64) - camera.project(points)
    length = np.linalg.norm(residual, axis=-1)
    observed = length[np.isfinite(length)]
    require(
        len(observed),
        "reprojection",
        "at least one known point must be seen",
        f"none of {len(length)}",
        "check the pose of the camera",
    )
    rms = float(np.sqrt(np.mean(observed**2)))
    return Reprojection(residual, rms, float(observed.max()), len(observed))
