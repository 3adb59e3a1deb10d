"""Subsurface light with the octree, tables averaged over a disc light, and radiance
from exposures.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.bench.curve import Curve, Point, cpu_time
from skindb.calibration.pixel_flags import OK
from skindb.calibration.radiance import merge_exposures
from skindb.format.frames import FrameKind
from skindb.format.sensor import SensorRecord
from skindb.optics.angles import directions, half_difference
from skindb.optics.diffusion import (
    diffuse_reflectance,
    dipole_profile,
    dipole_s,
    scattering_coefficients,
)
from skindb.optics.dipole_tree import subsurface_exitance
from skindb.reflectance.dictionary import (
    FAR_RULE,
    NEAR_RULE,
    Dictionary,
    convolve_disc,
    embedded_dictionary,
)
from skindb.reflectance.tables import lookup
from skindb.types import Array
from skindb.virtual.sensor import Sensor

# refractive index, radius of a ball [mm], points of comparison
ETA = 1.3
RADIUS = 30.0
RECEIVERS = 150
SIGMA_TR = np.array([0.55, 0.98, 1.55])  # mm-1
SKIN = (0.5, 0.3, 0.2)  # R_d
PROFILE_REACH_MM = 25.0  # mm: beyond it the profile is below 1e-6 of its integral
LIGHTS = 4


def subsurface_curves(quick: bool) -> list[Curve]:
    """The octree by opening tolerance and point spacing, for hard shadows 4 mm wide."""
    spacings = (1.6,) if quick else (0.5, 0.8, 1.6)
    fine = 0.4 if quick else 0.15
    fine_points, fine_areas = _ball(fine)
    fine_light = _irradiance(fine_points)
    tree = []
    spaced = []
    _exitance(*_ball(20.0), 0.1)  # compiles
    for spacing in spacings:
        points, areas = _ball(spacing)
        chosen = np.random.default_rng(4).integers(0, len(points), RECEIVERS)
        light = _irradiance(points)
        took, want = cpu_time(
            lambda c=chosen, p=points, a=areas, x=light: _plain(p[c], p, a, x)  # type: ignore[misc]
        )
        brute = took * len(points) / RECEIVERS
        best = _plain(points[chosen], fine_points, fine_areas, fine_light)
        tree.append(Point("every pair by NumPy", f"{spacing} mm", brute, np.nan))
        spaced.append(
            Point("every pair by NumPy", f"{spacing} mm", brute, _rms(want, best))
        )
        for tolerance in (0.05, 0.2) if quick else (0.02, 0.05, 0.1, 0.2, 0.4):
            took, got = cpu_time(
                lambda p=points, a=areas, t=tolerance: _exitance(p, a, t)  # type: ignore[misc]
            )
            name = f"skindb octree, {spacing} mm"
            at = f"tolerance {tolerance}"
            tree.append(Point(name, at, took, _rms(got[:, chosen], want)))
            spaced.append(Point(name, at, took, _rms(got[:, chosen], best)))
    base = f"every pair by NumPy, {spacings[0]} mm"
    of = f"{LIGHTS} lights on a ball of {RADIUS:g} mm"
    error = "RMS error of the exitance over its RMS"
    brute_of = f"every pair of the same points ({RECEIVERS} receivers)"
    fine_of = f"every pair of points {fine} mm apart, so that the error of the spacing is included"
    return [
        Curve("subsurface", error, brute_of, of, base, tuple(tree)),
        Curve("subsurface", error, fine_of, of, base, tuple(spaced)),
    ]


def _ball(spacing: float) -> tuple[Array, Array]:
    """Points (n, 3) of a spiral on the ball, and their areas."""
    n = round(4 * np.pi * RADIUS**2 / spacing**2)
    z = 1 - (2 * np.arange(n) + 1) / n
    phi = np.pi * (1 + 5**0.5) * (np.arange(n) + 0.5)
    r = np.sqrt(1 - z * z)
    return RADIUS * np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1), np.full(
        n, spacing**2
    )


def _irradiance(points: Array) -> Array:
    towards = np.random.default_rng(3).normal(size=(3, LIGHTS))
    towards /= np.linalg.norm(towards, axis=0)
    stripes = np.sin(points[:, 1:2] * np.pi / 4 + np.arange(LIGHTS)) > 0
    return np.asarray(np.maximum(points @ towards / RADIUS, 0) * stripes)


def _exitance(points: Array, areas: Array, tolerance: float) -> NDArray[np.float32]:
    s, tr = (
        np.tile(x, (len(points), 1))
        for x in (dipole_s(np.array(SKIN), eta=ETA)[0], SIGMA_TR)
    )
    return subsurface_exitance(
        points, areas, _irradiance(points), s, tr, eta=ETA, tolerance=tolerance
    )


def _plain(at: Array, points: Array, areas: Array, light: Array) -> Array:
    """Exitance (lights, receivers, 3) with the kernel normalised by its sum, as in
    `subsurface_exitance`.
    """
    s = dipole_s(np.array(SKIN), eta=ETA)[0]
    absorbed, scattered = scattering_coefficients(s, SIGMA_TR)
    out = np.empty((light.shape[1], len(at), 3))
    for i, place in enumerate(at):
        near = np.flatnonzero(((points - place) ** 2).sum(axis=1) < PROFILE_REACH_MM**2)
        r = np.linalg.norm(points[near] - place, axis=1)[:, None]
        kernel = dipole_profile(r, absorbed, scattered, eta=ETA) * areas[near, None]
        out[:, i] = (
            (light[near].T @ kernel)
            / kernel.sum(axis=0)
            * diffuse_reflectance(s, eta=ETA)
        )
    return out


def _rms(got: Array, want: Array) -> float:
    return float(np.sqrt(((got - want) ** 2).mean() / (want**2).mean()))


def disc_curves(quick: bool) -> list[Curve]:
    """Averages of tables over the disc of the light, by number of quadrature points."""
    whole = embedded_dictionary()
    angle = float(np.radians(0.8))
    table = np.ascontiguousarray(whole.table[..., 18:50:8])
    few = Dictionary(whole.names[18:50:8], table, whole.grid, whole.source)
    nodes = _nodes(whole.table.shape[:3], 150 if quick else 600)
    want = _dense_disc(few, nodes, angle, 100 if quick else 400)
    convolve_disc(few, angle, far=(1, 1), near=(1, 1))  # compiles
    points = []
    one = ((1, 4), (1, 4))
    four = ((4, 12), (4, 12))
    more = (
        () if quick else (((2, 6), (2, 6)), ((3, 8), (3, 8)), four, ((6, 18), (6, 18)))
    )
    rules = (one, *more, (FAR_RULE, NEAR_RULE))
    for far, near in rules:
        took, found = cpu_time(
            lambda f=far, n=near: convolve_disc(few, angle, far=f, near=n).table  # type: ignore[misc]
        )
        got = found[nodes]
        error = np.linalg.norm(got - want, axis=0) / np.linalg.norm(want, axis=0)
        per = {f"{name}": float(e) for name, e in zip(few.names, error, strict=True)}
        rule = " and ".join(
            f"{rings} x {spokes}" for rings, spokes in dict.fromkeys((far, near))
        )
        points.append(
            Point("skindb convolve_disc", rule, took, float(error.max()), "", per)
        )
    error = np.linalg.norm(table[nodes] - want, axis=0) / np.linalg.norm(want, axis=0)
    why = "a lamp is not a point, so sharp lobes become too high and too narrow"
    points.append(Point("no convolution", "", np.nan, float(error.max()), why))
    label = f"relative RMS error at {len(nodes[0])} nodes, worst of {len(few.names)} materials"
    reference = (
        "averages of interpolated values over a dense disc around either direction"
    )
    return [
        Curve(
            "disc",
            label,
            reference,
            f"{len(few.names)} tables",
            f"skindb convolve_disc, {rule}",
            tuple(points),
        )
    ]


def _nodes(shape: tuple[int, ...], count: int) -> tuple[NDArray[np.int64], ...]:
    """Indices of random nodes in the lobes, both directions 12 degrees above the horizon."""
    grid = embedded_dictionary().grid
    rng = np.random.default_rng(5)
    i, j, k = (
        rng.integers(0, n, 20 * count)
        for n in (shape[0] // 2, shape[1] * 2 // 3, shape[2])
    )
    wi, wo = directions(grid.theta_h[i], grid.theta_d[j], grid.phi_d[k])
    up = np.flatnonzero(np.minimum(wi[:, 2], wo[:, 2]) > 0.2)[:count]
    return i[up], j[up], k[up]


def _dense_disc(
    dictionary: Dictionary,
    nodes: tuple[NDArray[np.int64], ...],
    angle: float,
    count: int,
) -> Array:
    """Means (nodes, materials) over `count` spiral points on the disc around either direction."""
    grid, (i, j, k), q = dictionary.grid, nodes, np.arange(count)
    wi, wo = directions(grid.theta_h[i], grid.theta_d[j], grid.phi_d[k])
    radius = np.sqrt((q + 0.5) / count) * np.tan(angle)
    turn = q * np.pi * (3 - np.sqrt(5))
    total = np.zeros((len(i), len(dictionary.names)))
    for a, b in ((wi, wo), (wo, wi)):
        first = np.cross(a, [0.3, 0.9, 0.1])
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(a, first)
        for u, v in zip(radius * np.cos(turn), radius * np.sin(turn), strict=True):
            moved = a + u * first + v * second
            moved /= np.linalg.norm(moved, axis=1, keepdims=True)
            total += lookup(dictionary.table, *half_difference(moved, b)) / (2 * count)
    return total


def exposures_curves(quick: bool) -> list[Curve]:
    """Radiance over four decades from one to five exposures in steps of a factor of four."""
    side = 100 if quick else 300
    rng = np.random.default_rng(6)
    sensor = Sensor()
    record = SensorRecord(
        FrameKind(side, side, 16),
        sensor.black,
        sensor.white,
        sensor.read_noise,
        sensor.electrons_per_dn,
        sensor.step,
    )
    # 1 is white after a second
    truth = np.asarray(10 ** rng.uniform(-3, 1, (side, side, 3)), np.float32)
    still = np.zeros_like(truth)
    points = []
    for count in (1, 2, 3) if quick else (1, 2, 3, 4, 5):
        seconds = tuple(float(s) for s in 0.09 * 4.0 ** np.arange(count))
        frames = [sensor.expose(truth * np.float32(s), still, rng=rng) for s in seconds]
        took, (got, claimed, flag) = cpu_time(
            lambda f=frames, s=seconds: merge_exposures(f, s, record),  # type: ignore[misc]
            side**2,
        )
        points.append(
            _merged("skindb merge_exposures", count, took, got, truth, flag == OK)
        )
        known = flag == OK
        z = (got - truth)[known] / claimed[known]
        points[-1].more["scatter_over_claimed_error"] = float(np.sqrt((z**2).mean()))
        took, got = cpu_time(
            lambda f=frames, s=seconds: _longest(f, s, sensor),  # type: ignore[misc]
            side**2,
        )
        name = "longest exposure that is not saturated"
        points.append(_merged(name, count, took, got, truth, np.isfinite(got).all(-1)))
    longest = 0.09 * 4.0**2
    frame = sensor.expose(truth * np.float32(longest), still, rng=rng)
    one, _, flag = merge_exposures([frame], (longest,), record)
    why = (
        f"{(flag != OK).mean():.0%} of the pixels are white or black: one exposure "
        "does not cover four decades"
    )
    points.append(
        _merged("one medium exposure", 1, np.nan, one, truth, flag == OK, why)
    )
    label = "median relative error of radiance from 1e-3 to 10 (white after 1 s at 1)"
    base = "skindb merge_exposures, 1 exposure"
    return [
        Curve(
            "exposures",
            label,
            "radiance given to a virtual sensor",
            "a pixel",
            base,
            tuple(points),
        )
    ]


def _longest(frames: list[Any], seconds: tuple[float, ...], sensor: Sensor) -> Array:
    found = np.full(frames[0].shape, np.nan)
    for frame, s in zip(frames, seconds, strict=True):  # from short to long
        level = (
            (frame.astype(np.float64) - sensor.black)
            / (sensor.white - sensor.black)
            / s
        )
        found = np.where(frame < sensor.white, level, found)
    return found


def _merged(
    name: str,
    count: int,
    took: float,
    got: Array,
    truth: Array,
    known: Any,
    why: str = "",
) -> Point:
    relative = np.abs(got[known] / truth[known] - 1)
    more = {
        "p95": float(np.quantile(relative, 0.95)),
        "without_value": float(1 - known.mean()),
    }
    return Point(
        name,
        f"{count} exposure{'s' * (count > 1)}",
        took,
        float(np.median(relative)),
        why,
        more,
    )
