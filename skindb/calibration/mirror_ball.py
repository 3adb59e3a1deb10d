"""Directions and positions of lights from their highlights on a mirror ball, and
reprojection of known points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from skindb.errors import Fault, InputError
from skindb.geometry.camera import camera_centre, pixel_rays, project

Array = NDArray[np.float64]
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

    centre: Array
    radius: float


@dataclass(frozen=True)
class Pinhole:
    """A camera `x_cam = R x + t`: K (3, 3) px, R (3, 3), t (3,) mm, distortion (5,)."""

    K: Array
    R: Array
    t: Array
    distortion: Array


@dataclass(frozen=True)
class BallCentre:
    """Centre (3,) mm of a ball, and largest relative mismatch of its size in the
    pictures; NaN for one camera.
    """

    centre: Array
    mismatch: float


@dataclass(frozen=True)
class LightPosition:
    """Position (3,) mm, its covariance (3, 3) mm2, and the angle (ray,) in degrees by
    which each ray misses it.
    """

    position: Array
    covariance: Array
    miss: Array


@dataclass(frozen=True)
class Reprojection:
    """Residual (point, 2) px, observed minus predicted; its root mean square and
    maximum in px; number of points.
    """

    residual: Array
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
    inside = np.asarray(mask, bool)
    row, column = np.nonzero(inside)
    area = len(row)
    if area:
        radius = float(np.sqrt(area / np.pi))
        centre = np.array([column.mean(), row.mean()]) + 0.5
        far = float(np.hypot(column + 0.5 - centre[0], row + 0.5 - centre[1]).max())
        if far < 1.1 * radius + 1:
            return Outline(centre, radius)
    rule = "the mask of the mirror ball must be one disc"
    cure = "draw it again, without the stand of the ball"
    raise InputError(
        Fault(
            "mirror ball",
            rule,
            f"{area} pixels that do not fill a disc" if area else "nothing",
            cure,
        )
    )


def highlight_centre(picture: ArrayLike, outline: Outline) -> Array:
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
    ball = (
        np.hypot(column - outline.centre[0], row - outline.centre[1]) < outline.radius
    )
    known = bool(ball.any()) and bool(np.isfinite(grey[ball]).all())
    low, high = (
        (float(np.median(grey[ball])), float(grey[ball].max())) if known else (0.0, 0.0)
    )
    if not high > low:
        rule = "the mirror ball must show a highlight"
        cure = "check its position in the picture, or expose it longer"
        raise InputError(
            Fault(
                "mirror ball",
                rule,
                "a uniform picture" if known else "no finite values",
                cure,
            )
        )
    level = low + HIGHLIGHT_FRACTION * (high - low)
    labels, _ = ndimage.label(ball & (grey >= level))
    sizes = np.bincount(labels.ravel())[1:]
    spot = labels == 1 + int(sizes.argmax())
    if sizes.max() > MAX_HIGHLIGHT_FRACTION * ball.sum():
        rule = (
            f"the highlight must cover at most {MAX_HIGHLIGHT_FRACTION:.0%} of the ball"
        )
        found = f"{sizes.max() / ball.sum():.0%}"
        cure = "expose the frame shorter, and darken the room"
        raise InputError(Fault("mirror ball", rule, found, cure))
    near = ball & ndimage.binary_dilation(spot, iterations=HIGHLIGHT_MARGIN)
    row = row[near]
    column = column[near]
    weight = np.maximum(grey[near] - low, 0)
    return np.array(
        [np.average(column, weights=weight), np.average(row, weights=weight)]
    )


def distant_light(outline: Outline, highlight: ArrayLike) -> Array:
    """Unit direction (3,) to a distant light seen by a distant camera: x right, y up, z
    to the viewer.

    The view along -z is reflected at the normal of the ball under the highlight (2,)
    px: l = 2 (n . v) n - v.
    """
    offset = (
        (np.asarray(highlight, np.float64) - outline.centre) / outline.radius * [1, -1]
    )
    square = float(offset @ offset)
    if not square < 1:
        rule = "the highlight must lie on the ball"
        cure = "check the centre and radius of the ball"
        raise InputError(
            Fault(
                "mirror ball",
                rule,
                f"{np.sqrt(square):.2f} radii from its centre",
                cure,
            )
        )
    normal = np.array([*offset, np.sqrt(1 - square)])
    return np.asarray(2 * normal[2] * normal - [0, 0, 1])


def reflected_ray(
    camera: Pinhole, ball: ArrayLike, radius: float, highlight: ArrayLike
) -> tuple[Array, Array]:
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
    origin = camera_centre(camera.R, camera.t)
    view = pixel_rays(
        np.asarray(highlight, np.float64), camera.K, camera.R, camera.distortion
    )
    way = np.asarray(np.asarray(ball, np.float64) - origin, np.float64)
    along = float(way @ view)
    under = radius**2 - float(way @ way) + along**2
    if not (under > 0 and along > 0):
        found = (
            f"{np.sqrt(max(float(way @ way) - along**2, 0.0)):.1f} mm from its centre"
        )
        cure = "check the position of the ball"
        raise InputError(
            Fault(
                "mirror ball",
                f"the line of sight must meet the ball of {radius:g} mm",
                found,
                cure,
            )
        )
    point = origin + (along - np.sqrt(under)) * view
    normal = (point - np.asarray(ball, np.float64)) / radius
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
    circles = np.asarray(outlines, np.float64)
    turn = np.linspace(0, 2 * np.pi, OUTLINE_POINTS, endpoint=False)
    around = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    origins = list[Array]()
    axes = list[Array]()
    distances = list[float]()
    for camera, circle in zip(cameras, circles, strict=True):
        sight = pixel_rays(
            circle[:2] + circle[2] * around, camera.K, camera.R, camera.distortion
        )
        # all lines make the same angle with the axis: sight . axis = cos(angle)
        axis = np.linalg.lstsq(sight, np.ones(OUTLINE_POINTS))[0]
        length = float(np.linalg.norm(axis))
        origins.append(np.asarray(camera_centre(camera.R, camera.t), np.float64))
        axes.append(np.asarray(axis / length, np.float64))
        distances.append(radius / np.sqrt(1 - min(1 / length**2, 1 - 1e-12)))
    start = np.array(origins)
    way = np.array(axes)
    distance = np.array(distances)
    if len(start) == 1:
        return BallCentre(start[0] + distance[0] * way[0], np.nan)
    centre = light_position(start, way).position
    mismatch = float(
        np.abs(np.linalg.norm(centre - start, axis=1) / distance - 1).max()
    )
    if mismatch > MAX_SIZE_MISMATCH:
        rule = (
            f"its outlines must be of the size of a ball of radius {radius:g} mm, "
            f"within {MAX_SIZE_MISMATCH:.0%}"
        )
        cure = "give the radius of the ball in mm, and column, row and radius of its outlines in px"
        raise InputError(Fault("mirror ball", rule, f"{mismatch:.0%} off", cure))
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
    if (
        start.ndim != 2
        or start.shape != way.shape
        or len(start) < 2
        or not np.isfinite([start, way]).all()
    ):
        rule = "its position needs two or more rays of finite numbers"
        cure = "photograph the ball at another position"
        raise InputError(Fault("light", rule, f"{start.shape} and {way.shape}", cure))
    across = np.eye(3) - way[:, :, None] * way[:, None, :]
    weight = np.ones(len(start))
    for _ in range(ROUNDS):
        normal = np.einsum("r,rij->ij", weight, across)
        if np.linalg.eigvalsh(normal)[0] < MIN_BASELINE**2 * weight.sum() / 4:
            rule = "its rays must not be parallel"
            cure = "move the ball farther between the photographs"
            raise InputError(
                Fault("light", rule, f"{len(start)} rays within about a degree", cure)
            )
        position = np.linalg.solve(
            normal, np.einsum("r,rij,rj->i", weight, across, start)
        )
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
    predicted, _ = project(points, camera.K, camera.R, camera.t, camera.distortion)
    residual = np.asarray(pixels, np.float64) - predicted
    length = np.linalg.norm(residual, axis=-1)
    seen = np.isfinite(length)
    if not seen.any():
        rule = "at least one known point must be seen"
        cure = "check the pose of the camera"
        raise InputError(Fault("reprojection", rule, f"none of {len(length)}", cure))
    return Reprojection(
        residual,
        float(np.sqrt(np.mean(length[seen] ** 2))),
        float(length[seen].max()),
        int(seen.sum()),
    )
