"""Calibration of the lights of a dome: intensities from its white target, positions from
highlights on a mirror ball, and their application to a capture.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy import ndimage
from scipy.optimize import least_squares

from skindb.calibration._merge_kernels import OK, SATURATED
from skindb.calibration.frame_checks import checked_white_view
from skindb.calibration.irradiance import (
    TARGET_INTERIOR_FRACTION,
    LightFit,
    Target,
    TargetPixels,
    fit_light,
    position_sensitivity,
    target_pixels,
)
from skindb.calibration.radiance import FrameMerger, frame_mergers
from skindb.calibration.setup import PLACE, BallFrames, of_devices
from skindb.errors import (
    Fault,
    InputError,
    attempt,
    attempt_all,
    few_names,
    input_error,
    require,
)
from skindb.format.dome import (
    CameraRecord,
    DomeRecord,
    LightRecord,
    WhiteRecord,
)
from skindb.format.frames import CAMERA, LIGHT, Frame, filled, read_frame
from skindb.geometry.camera import Pinhole
from skindb.parameters import POSITION_ERROR_MM
from skindb.schema import dataset
from skindb.types import Float64, Mask, float64, lengths, unit

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
MAX_PLACE_LIGHTS = (
    24  # from which the places of a ball are found; each has six unknowns
)
BEHIND = (
    0.0,
    0.2,
    0.4,
    0.6,
    0.8,
    1.0,
)  # radii: highlights on the front to those of its edge
OUTLIERS = (
    0.3,
    0.01,
)  # rad, misses from which a ray counts less: at first, and at the end
# median of the highlights: a pixel on a ball with a radius of 100 px turns a ray by 1.1 degrees
MAX_MISS_DEGREES = 2.0
# half diagonals of the target: light farther from its centre is not that of its blurred
# corners
BESIDE_TARGET = 1.05
THREADS = 2
# between lights of one rig: more than the rounding of files, less than a lamp that was moved
SAME_POSITION_MM = 1.0
SAME_ANGLE = float(np.radians(0.1))
SAME_FRACTION = 0.8  # a few lamps may have failed
MIN_SHARED = 3  # lights; one or two of two rigs may have the same places


Highlights = dict[tuple[str, str], Float64]  # place, camera -> column and row, px


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


def ball_places(
    cameras: Mapping[str, Pinhole], highlights: Sequence[Highlights], radius: float
) -> dict[str, Float64]:
    """Centres (3,) mm of a ball of known radius at several places, from the highlights of
    many lights: those for which the mirrored lines of sight of each light meet best.

    Raises
    ------
    InputError
        If fewer than two cameras see the highlights at a place, or the lines do not meet.
    """
    seen = [one for one in highlights if len(one) > 2]
    seen = seen[:: -(-len(seen) // MAX_PLACE_LIGHTS) or 1]
    start = dict[str, Float64]()
    for place in sorted({place for one in seen for place, _ in one}):
        views = defaultdict[str, list[Float64]](list)
        for one in seen:
            for (at, camera), pixel in one.items():
                if at == place:
                    views[camera].append(pixel)
        require(
            len(views) > 1,
            f"mirror ball, place {place}",
            "two cameras must see its highlights",
            few_names(list(views)),
            "move the ball to the middle of the dome, or give its outlines",
        )
        start[place] = light_position(
            [cameras[camera].centre for camera in views],
            [cameras[c].rays(np.median(p, axis=0)) for c, p in views.items()],
        ).position
    index = {place: i for i, place in enumerate(start)}
    # eyes, lines of sight, and indices of the place
    rays = [
        (
            np.array([cameras[camera].centre for _, camera in one]),
            np.array([cameras[camera].rays(one[p, camera]) for p, camera in one]),
            [index[place] for place, _ in one],
        )
        for one in seen
    ]

    def misses(x: Float64) -> Float64:
        centres = x.reshape(-1, 3)
        apart = []
        for eye, view, places in rays:
            point, out, _ = _mirrored(eye, view, centres[places], radius)
            try:
                light = light_position(point, out).position
            except InputError:  # they are parallel far from the solution
                light = point - out
            apart.append(unit(light - point) - out)
        return np.concatenate(apart).ravel()

    if not start:
        return {}
    # the lines to the highlights meet before the centre
    eyes = np.array([camera.centre for camera in cameras.values()])
    front = np.array([*start.values()])
    back = np.array([unit(centre - eyes).mean(axis=0) for centre in front])
    starts = [(front + part * radius * back).ravel() for part in BEHIND]
    best = min(starts, key=lambda x: float(np.abs(misses(x)).sum()))
    for outlier in OUTLIERS:
        fit = least_squares(misses, best, loss="soft_l1", f_scale=outlier)
        best = fit.x
    miss = np.degrees(np.median(lengths(fit.fun.reshape(-1, 3))))
    # balls of a wrong size fit best far away, where all lines are parallel
    away = lengths(fit.x.reshape(-1, 3) - front).max()
    require(
        miss <= MAX_MISS_DEGREES and away <= 2 * radius,
        "mirror ball",
        f"its highlights must agree with a ball of radius {radius:g} mm within "
        f"{MAX_MISS_DEGREES:g} degrees",
        f"{miss:.1f} degrees, {away:.0f} mm from where the lines to them meet",
        "give the radius of the ball in mm, and remove other bright things from the pictures",
    )
    return dict(zip(start, fit.x.reshape(-1, 3), strict=True))


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
    directions = list[Float64]()
    distances = list[float]()
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


def calibrate_lights(
    dome: DomeRecord, *, position_error: float = POSITION_ERROR_MM
) -> xr.Dataset:
    """Radiant intensity of every light, with standard errors.

    The systematic error of an intensity is that of the position of the light relative
    to the target, and glare: the light that the pictures show beside the target. If the
    surroundings of the target are black, the lens has scattered it there, and the
    intensity is too low by this fraction. It is not corrected, because pictures of a
    face lose about as much.

    Parameters
    ----------
    dome
        From `read_setup_dome`.
    position_error
        Standard error of the position of a light relative to the target along each axis, in mm.

    Returns
    -------
    Dataset
        Group "light_calibration".

    Raises
    ------
    InputError
        With every light that does not illuminate the target, and every frame that
        cannot be decoded.
    """
    white = dome.white
    if white is None:
        raise input_error(
            "white target", "a calibration needs one", "none", "photograph it"
        )
    faults = list[Fault]()
    mergers = frame_mergers(dome, faults)
    views = [
        _view(camera, mergers[camera.id], white)
        for camera in dome.cameras
        if camera.id in white.cameras
    ]

    def calibrated(light: LightRecord) -> tuple[LightFit, float, float]:
        """Fit of a light, the relative error by positions, and the light beside the
        target over that on the target.
        """
        pixels, beside = _pixels(dome, white, light, views)
        fit = fit_light(pixels, falloff=light.falloff)
        sensitivity = position_sensitivity(pixels, falloff=light.falloff)
        return fit, position_error * sensitivity, beside

    with ThreadPoolExecutor(THREADS) as pool:
        results = attempt_all(
            faults,
            calibrated,
            dome.lights,
            pool=pool,
            where=lambda light: f"{dome.file}[lights], light {light.id}: {{}}",
        )
    fits, position_errors, glare = zip(*results, strict=True)
    return dataset(
        {
            "calibrated_intensity": [fit.intensity for fit in fits],
            "calibrated_intensity_error": [fit.intensity_error for fit in fits],
            "calibrated_intensity_position_error": list(position_errors),
            "glare_fraction": list(glare),
            "calibrated_falloff": [light.falloff for light in dome.lights],
            "target_used_fraction": [fit.used for fit in fits],
        },
        coords={
            "light": dome.light_ids,
            "channel": ["R", "G", "B"],
        },
    )


@dataclass(frozen=True)
class _View:
    """A camera that sees the target: its pixels on the target, those beside it (h, w),
    and the target's area in px.
    """

    merger: FrameMerger
    target: Target
    beside: Mask
    area: float


def _view(camera: CameraRecord, merger: FrameMerger, white: WhiteRecord) -> _View:
    target = target_pixels(camera, white)
    corner = BESIDE_TARGET * np.sqrt(2) * white.half_size
    near = replace(white, half_size=corner / TARGET_INTERIOR_FRACTION)
    beside = np.ones(camera.height * camera.width, bool)
    beside[target_pixels(camera, near).at] = False
    square_over_disc = 4 / (np.pi * TARGET_INTERIOR_FRACTION**2)
    return _View(
        merger,
        target,
        beside.reshape(camera.height, camera.width),
        len(target.at) * square_over_disc,
    )


def _pixels(
    dome: DomeRecord, white: WhiteRecord, light: LightRecord, views: list[_View]
) -> tuple[TargetPixels, float]:
    """Pixels of the target under one light, of all cameras together, and the fraction
    of light beside the target.
    """
    radiance = [np.zeros((0, 3))]
    points = [np.zeros((0, 3))]
    beside = [0.0]
    for view in views:
        frames = checked_white_view(dome, light.id, view.merger)
        merged, flag = view.merger.merge(frames)
        usable = flag.ravel()[view.target.at] == OK
        values = merged.reshape(-1, 3)[view.target.at].astype(float)
        values[~usable] = np.nan
        radiance.append(values)
        points.append(view.target.points)
        if usable.any():
            scattered = merged[view.beside & (flag != SATURATED)]
            total = np.nansum(scattered, dtype=float) / 3
            beside.append(total / (float(np.nanmean(values)) * view.area))
    pixels = TargetPixels(
        np.concatenate(radiance),
        np.concatenate(points),
        light.position,
        light.axis,
        white.normal,
        white.reflectance,
    )
    return pixels, max(beside)


def calibrated_dome(
    dome: DomeRecord, calibration: xr.Dataset, *, where: str
) -> DomeRecord:
    """The dome with intensities and fall-offs of a calibration.

    Raises
    ------
    InputError
        If the calibration lacks a light.
    """
    ids = dome.light_ids
    lights = of_devices(calibration, "light", ids, where=where)
    intensities = lights["calibrated_intensity"].values
    exponents = lights["calibrated_falloff"].values
    calibrated = (
        replace(light, intensity=intensity, falloff=float(exponent))
        for light, intensity, exponent in zip(
            dome.lights, intensities, exponents, strict=True
        )
    )
    return replace(dome, lights=tuple(calibrated), relative=False)


def is_same_rig(
    positions: Mapping[str, Float64], others: Mapping[str, Float64]
) -> bool:
    """Whether two sets of lights are of one rig, see `moved_lights`: at least three,
    and 80 % of the smaller set, are in both, and none of these is elsewhere.
    """
    shared = positions.keys() & others.keys()
    smaller = min(len(positions), len(others))
    enough = len(shared) >= max(MIN_SHARED, SAME_FRACTION * smaller)
    return enough and not moved_lights(positions, others)


def moved_lights(
    positions: Mapping[str, Float64], others: Mapping[str, Float64]
) -> list[str]:
    """Ids that are in both sets of lights, with positions (3,) mm that differ by more
    than 1 mm, and 0.1 degrees as seen from the origin.
    """
    return [
        name
        for name, position in positions.items()
        if name in others
        and np.linalg.norm(position - others[name])
        > max(SAME_POSITION_MM, SAME_ANGLE * float(np.linalg.norm(position)))
    ]


def rig_positions(rig: xr.Dataset) -> dict[str, Float64]:
    """Position (3,) mm of each light of the group "rig_calibration"."""
    positions = rig["rig_light_position"].values
    return dict(zip(map(str, rig["light"].values), positions, strict=True))


def rig_dome(dome: DomeRecord, calibration: xr.Dataset, *, where: str) -> DomeRecord:
    """The dome with the gains and offsets of the lights, gains of the cameras, and lobes
    of the skin, by a calibration from takes; lights and cameras that it does not have
    keep their own.

    Raises
    ------
    InputError
        If the lights are not those of the calibration.
    """
    require(
        is_same_rig(
            {light.id: light.position for light in dome.lights},
            rig_positions(calibration),
        ),
        where,
        "a calibration from takes applies to captures with its lights, at least "
        f"{SAME_FRACTION:.0%} of them, within {SAME_POSITION_MM:g} mm or "
        f"{np.degrees(SAME_ANGLE):.1f} degrees",
        "other ids or positions of the lights",
        "remove the key calibration of capture.json, or calibrate from takes of this dome",
    )
    own = calibration.reindex(light=dome.light_ids)
    gains = own["rig_light_gain"].fillna(1.0).values
    offsets = own["rig_light_offset"].fillna(0.0).values
    lights = (
        replace(
            light,
            gain=float(gain),
            position=light.position + offset,
            offset=tuple(offset.tolist()),
        )
        for light, gain, offset in zip(dome.lights, gains, offsets, strict=True)
    )
    names = dome.camera_ids
    sensitivity = calibration["rig_camera_gain"].reindex(camera=names, fill_value=1.0)
    cameras = (
        replace(camera, gain=tuple(gain.tolist()))
        for camera, gain in zip(dome.cameras, sensitivity.values, strict=True)
    )
    return replace(
        dome,
        lights=tuple(lights),
        cameras=tuple(cameras),
        lobes=rig_lobes(calibration),
    )


def rig_lobes(rig: xr.Dataset) -> dict[str, tuple[float, ...]]:
    """Strengths (lobe,) of the face and of the regions that have them."""
    strength = rig["rig_lobe_strength"].dropna("region")
    rows = map(tuple, strength.values.tolist())
    return dict(zip(map(str, strength["region"].values), rows, strict=True))


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
    centres = dict[str, Float64]()
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
    found: Highlights = {}
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


def positioned_dome(
    dome: DomeRecord, calibration: xr.Dataset, *, where: str
) -> DomeRecord:
    """The dome with the light positions of a calibration; the axes of the lights are unchanged.

    Raises
    ------
    InputError
        If the calibration lacks a light.
    """
    ids = dome.light_ids
    positions = of_devices(calibration, "light", ids, where=where)[
        "calibrated_position"
    ]
    lights = (
        replace(light, position=position)
        for light, position in zip(dome.lights, positions.values, strict=True)
    )
    return replace(dome, lights=tuple(lights))
