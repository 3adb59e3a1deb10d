"""Subsurface light with the octree, tables averaged over a disc light, and radiance
from exposures: curves and stress cases.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.bench.case import SCALES, close, expect, stress_cases
from skindb.bench.curve import Curve, Point, cpu_time
from skindb.calibration._merge_kernels import DARK, OK, SATURATED
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
from skindb.reflectance.rows import basis_rows
from skindb.reflectance.tables import TableGrid, lookup, tabulate
from skindb.types import Array
from skindb.virtual.dome import Sensor

# refractive index, radius of a ball [mm], points of comparison
ETA = 1.3
RADIUS = 30.0
RECEIVERS = 150
SIGMA_TR = np.array([0.55, 0.98, 1.55])  # mm-1
SKIN = (0.5, 0.3, 0.2)  # R_d
PROFILE_REACH_MM = 25.0  # mm: beyond it the profile is below 1e-6 of its integral
LIGHTS = 4
SECONDS = (0.04, 0.005)
GRID = TableGrid(24, 20, 8)


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
            setting = f"tolerance {tolerance}"
            tree.append(Point(name, setting, took, _rms(got[:, chosen], want)))
            spaced.append(Point(name, setting, took, _rms(got[:, chosen], best)))
    base = f"every pair by NumPy, {spacings[0]} mm"
    scene = f"{LIGHTS} lights on a ball of {RADIUS:g} mm"
    error = "RMS error of the exitance over its RMS"
    brute_of = f"every pair of the same points ({RECEIVERS} receivers)"
    fine_of = f"every pair of points {fine} mm apart, so that the error of the spacing is included"
    return [
        Curve("subsurface", error, brute_of, scene, base, tuple(tree)),
        Curve("subsurface", error, fine_of, scene, base, tuple(spaced)),
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


def _plain(receivers: Array, points: Array, areas: Array, light: Array) -> Array:
    """Exitance (lights, receivers, 3) with the kernel normalised by its sum, as in
    `subsurface_exitance`.
    """
    s = dipole_s(np.array(SKIN), eta=ETA)[0]
    absorbed, scattered = scattering_coefficients(s, SIGMA_TR)
    out = np.empty((light.shape[1], len(receivers), 3))
    for i, place in enumerate(receivers):
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
    dictionary = embedded_dictionary()
    angle = float(np.radians(0.8))
    table = np.ascontiguousarray(dictionary.table[..., 18:50:8])
    few = Dictionary(
        dictionary.names[18:50:8], table, dictionary.grid, dictionary.source
    )
    nodes = _nodes(dictionary.table.shape[:3], 150 if quick else 600)
    want = _dense_disc(few, nodes, angle, 100 if quick else 400)
    convolve_disc(few, angle, far=(1, 1), near=(1, 1))  # compiles
    points = []
    coarse = ((1, 4), (1, 4))
    four = ((4, 12), (4, 12))
    rules_between = (
        () if quick else (((2, 6), (2, 6)), ((3, 8), (3, 8)), four, ((6, 18), (6, 18)))
    )
    rules = (coarse, *rules_between, (FAR_RULE, NEAR_RULE))
    for far, near in rules:
        took, tables = cpu_time(
            lambda f=far, n=near: convolve_disc(few, angle, far=f, near=n).table  # type: ignore[misc]
        )
        got = tables[nodes]
        error = np.linalg.norm(got - want, axis=0) / np.linalg.norm(want, axis=0)
        per = {f"{name}": float(e) for name, e in zip(few.names, error, strict=True)}
        rule = " and ".join(
            f"{rings} x {spokes}" for rings, spokes in dict.fromkeys((far, near))
        )
        points.append(
            Point("skindb convolve_disc", rule, took, float(error.max()), "", per)
        )
    error = np.linalg.norm(table[nodes] - want, axis=0) / np.linalg.norm(want, axis=0)
    failure = "a lamp is not a point, so sharp lobes become too high and too narrow"
    points.append(Point("no convolution", "", np.nan, float(error.max()), failure))
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
        across = np.cross(a, [0.3, 0.9, 0.1])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        second = np.cross(a, across)
        for u, v in zip(radius * np.cos(turn), radius * np.sin(turn), strict=True):
            moved = a + u * across + v * second
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
        usable = flag == OK
        z = (got - truth)[usable] / claimed[usable]
        points[-1].more["scatter_over_claimed_error"] = float(np.sqrt((z**2).mean()))
        took, got = cpu_time(
            lambda f=frames, s=seconds: _longest(f, s, sensor),  # type: ignore[misc]
            side**2,
        )
        name = "longest exposure that is not saturated"
        points.append(_merged(name, count, took, got, truth, np.isfinite(got).all(-1)))
    longest = 0.09 * 4.0**2
    frame = sensor.expose(truth * np.float32(longest), still, rng=rng)
    merged, _, flag = merge_exposures([frame], (longest,), record)
    failure = (
        f"{(flag != OK).mean():.0%} of the pixels are white or black: one exposure "
        "does not cover four decades"
    )
    points.append(
        _merged("one medium exposure", 1, np.nan, merged, truth, flag == OK, failure)
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
    radiance = np.full(frames[0].shape, np.nan)
    for frame, s in zip(frames, seconds, strict=True):  # from short to long
        level = (
            (frame.astype(np.float64) - sensor.black)
            / (sensor.white - sensor.black)
            / s
        )
        radiance = np.where(frame < sensor.white, level, radiance)
    return radiance


def _merged(
    name: str,
    count: int,
    took: float,
    got: Array,
    truth: Array,
    usable: Any,
    failure: str = "",
) -> Point:
    relative = np.abs(got[usable] / truth[usable] - 1)
    details = {
        "p95": float(np.quantile(relative, 0.95)),
        "without_value": float(1 - usable.mean()),
    }
    return Point(
        name,
        f"{count} exposure{'s' * (count > 1)}",
        took,
        float(np.median(relative)),
        failure,
        details,
    )


def _sensor(**changes: Any) -> SensorRecord:
    levels: dict[str, Any] = {
        "black": 256.0,
        "white": 65535.0,
        "read_noise": 6.0,
        "electrons_per_dn": 0.3,
    }
    return SensorRecord(FrameKind(4, 3, 16), **(levels | changes))


def _frames(value: int, shape: tuple[int, ...] = (3, 4, 3)) -> list[Array]:
    return [np.full(shape, value, np.uint16) for _ in SECONDS]


def _white() -> None:
    radiance, _, flag = merge_exposures(_frames(65535), SECONDS, _sensor())
    expect((flag == SATURATED).all() and np.isnan(radiance).all(), (flag, radiance))


def _one_white() -> None:
    frames = _frames(65535)
    frames[1][:] = 30000
    radiance, _, flag = merge_exposures(frames, SECONDS, _sensor())
    expect((flag == OK).all(), flag)
    close(radiance, (30000 - 256) / (65535 - 256) / 0.005, rtol=1e-6)


def _no_exposure_black(value: int) -> None:
    radiance, error, flag = merge_exposures(_frames(value), SECONDS, _sensor())
    expect((flag == DARK).all(), flag)
    expect(
        (np.abs(radiance) <= 3 * error).all() and np.isfinite(error).all(),
        (radiance, error),
    )


def _dead_noise() -> None:
    """A sensor without noise gives the value over the time, without a division by zero."""
    radiance, error, flag = merge_exposures(
        _frames(256 + 6528)[:1], SECONDS[:1], _sensor(read_noise=0.0, step=0.0)
    )
    close(radiance, 6528 / (65535 - 256) / 0.04, rtol=1e-6)
    expect(np.isfinite(error).all() and (flag == OK).all(), (error, flag))


def _shot_noise_unknown() -> None:
    frames = [
        np.full((3, 4, 3), 256 + round(6528 * s / 0.04), np.uint16) for s in SECONDS
    ]
    radiance, error, flag = merge_exposures(
        frames, SECONDS, _sensor(electrons_per_dn=np.inf, read_noise=0.0)
    )
    close(radiance, 6528 / (65535 - 256) / 0.04, rtol=1e-3)
    expect(np.isfinite(error).all() and (flag == OK).all(), (error, flag))


def _scaled_times(scale: float) -> None:
    frames = [
        np.full((3, 4, 3), 256 + round(6528 * s / 0.04), np.uint16) for s in SECONDS
    ]
    want, want_error, _ = merge_exposures(frames, SECONDS, _sensor())
    times = tuple(s * scale for s in SECONDS)
    radiance, error, flag = merge_exposures(frames, times, _sensor())
    expect((flag == OK).all(), flag)
    close(radiance.astype(np.float64) * scale, want, rtol=1e-5)
    close(error.astype(np.float64) * scale, want_error, rtol=1e-5)


def _odd_sizes(rows: int, columns: int) -> None:
    radiance, error, flag = merge_exposures(
        _frames(6784, (rows, columns, 3))[:1], SECONDS[:1], _sensor()
    )
    expect(
        radiance.shape == error.shape == (rows, columns, 3)
        and flag.shape == (rows, columns),
        radiance.shape,
    )
    close(radiance, 6528 / (65535 - 256) / 0.04, rtol=1e-6)


def _duplicates() -> None:
    """The same exposure twice gives the same radiance, with an error smaller by sqrt 2."""
    single, once, _ = merge_exposures(_frames(6784)[:1], SECONDS[:1], _sensor())
    two, twice, _ = merge_exposures(_frames(6784), (SECONDS[0], SECONDS[0]), _sensor())
    close(two, single, rtol=1e-6)
    close(twice, once / np.sqrt(2), rtol=1e-6)


def _linear(bad: float) -> None:
    frame = np.full((2, 2, 3), 0.25, np.float32)
    frame[0, 1, 2] = bad
    radiance, _, flag = merge_exposures([frame], (1.0,), _linear_sensor())
    expect(
        flag.tolist() == [[OK, SATURATED], [OK, OK]] and np.isnan(radiance[0, 1]).all(),
        (flag, radiance),
    )
    close(radiance[1], 0.25)


def _linear_sensor() -> SensorRecord:
    return SensorRecord(FrameKind(2, 2, 0), 0.0, 1.0, 0.0, np.inf)


EXPOSURES = stress_cases(
    "exposures",
    ("all saturated", "The result is NaN and flagged.", _white),
    ("one of two saturated", "The other exposure is used.", _one_white),
    (
        "all black, value {}",
        "The result is flagged dark, and zero within its error.",
        _no_exposure_black,
        (
            256,
            250,
        ),
    ),
    ("no noise", "The result is the value over the time.", _dead_noise),
    (
        "shot noise unknown",
        "The result is the value over the time, with the error of quantisation.",
        _shot_noise_unknown,
    ),
    (
        "times multiplied by {:g}",
        "Radiance and error are divided by it.",
        _scaled_times,
        SCALES,
    ),
    (
        "{} x {} pixels",
        "Shapes and values are right.",
        _odd_sizes,
        (
            (0, 4),
            (1, 1),
            (3, 7),
        ),
    ),
    (
        "the same exposure twice",
        "The radiance is the same, and the error smaller by sqrt 2.",
        _duplicates,
    ),
    (
        "a linear pixel is {}",
        "Only that pixel is NaN and flagged.",
        _linear,
        (
            np.nan,
            np.inf,
        ),
    ),
)


def _dictionary(table: Array) -> Dictionary:
    table = np.ascontiguousarray(table, np.float32)
    return Dictionary(
        tuple(str(i) for i in range(table.shape[-1])), table, GRID, "stress"
    )


def _lobe(sharp: float = 40.0) -> Array:
    return tabulate(
        lambda wi, wo: np.exp(-sharp * half_difference(wi, wo)[0][..., None] ** 2), GRID
    )


def _even_table(radius: float, value: float) -> None:
    close(
        convolve_disc(_dictionary(np.full((24, 20, 8, 2), value)), radius).table,
        np.float32(value),
        rtol=1e-5,
    )


def _no_disc() -> None:
    lobe = _dictionary(_lobe())
    expect(convolve_disc(lobe, 0.0) is lobe, "a copy")
    close(convolve_disc(lobe, 1e-9).table, lobe.table, atol=1e-5)


def _scaled_table(scale: float) -> None:
    lobe = _lobe()
    averaged = convolve_disc(_dictionary(lobe * np.float32(scale)), 0.05).table
    close(
        averaged / np.float32(scale),
        convolve_disc(_dictionary(lobe), 0.05).table,
        rtol=1e-5,
        atol=1e-12,
    )


def _between_extremes(radius: float) -> None:
    lobe = _dictionary(_lobe(400.0))
    averaged = convolve_disc(lobe, radius).table
    expect(
        averaged.min() >= -1e-6 and averaged.max() <= lobe.table.max() * (1 + 1e-5),
        (averaged.min(), averaged.max()),
    )
    expect(
        averaged[0, 0, 0, 0] < lobe.table[0, 0, 0, 0],
        "a lobe not lowered by a wide lamp",
    )


# rows, for the fits


def _row_of(wi: Any, wo: Any) -> Array:
    table = np.concatenate([_lobe(), np.ones_like(_lobe())], axis=-1)
    mask = np.ones((1, 1, 1), np.bool_)
    return basis_rows(
        table, GRID, np.array([[0.0, 0, 1]]), np.array([[wi]]), np.array([[wo]]), mask
    )[0]


def _grazing_rows(height: float) -> None:
    """Towards the horizon a row decreases only with the cosine, times the value of the table."""
    wi = np.array([np.sqrt(1 - height**2), 0, height])
    wo = np.array([0.6, 0.0, 0.8])
    want = (
        lookup(
            np.concatenate([_lobe(), np.ones_like(_lobe())], axis=-1),
            *half_difference(wi, wo),
        )
        * height
    )
    close(_row_of(wi, wo)[0], want, rtol=1e-4, atol=1e-12)


def _special_rows() -> None:
    up = [0.0, 0.0, 1.0]
    down = [0.0, 0.0, -1.0]
    # light, camera and normal coincide, so phi_d is undefined
    close(_row_of(up, up), [[1.0, 1.0]], rtol=1e-6)
    expect(len(_row_of(down, up)) == len(_row_of(up, down)) == 0, "a row from below")
    expect(
        len(_row_of([np.nan, 0, 1], up)) == len(_row_of(up, [np.inf, 0, 1])) == 0,
        "a row of no finite direction",
    )
    # the mirror direction
    close(_row_of([0.6, 0, 0.8], [-0.6, 0, 0.8]), [[0.8, 0.8]], rtol=1e-5)


TABLES = (
    *stress_cases(
        "disc",
        (
            "a table of {1:g}, disc of {0} rad",
            "A constant is unchanged.",
            _even_table,
            (
                (0.014, 0.0),
                (0.014, 0.25),
                (0.3, 0.25),
                (0.014, 1e-30),
                (0.014, 1e30),
            ),
        ),
        ("no disc", "The tables are unchanged, also in the limit.", _no_disc),
        ("tables times {:g}", "Averages are multiplied by it.", _scaled_table, SCALES),
        (
            "a disc of {} rad",
            "Averages lie between the extremes; sharp lobes are lowered.",
            _between_extremes,
            (
                0.05,
                0.5,
            ),
        ),
    ),
    *stress_cases(
        "surface",
        (
            "rows: light {:g} above the horizon",
            "A row is the table's value times the cosine.",
            _grazing_rows,
            (
                1e-08,
                0.0001,
                0.02,
            ),
        ),
        (
            "rows: overhead, mirror, below, not finite",
            "Rows are one, the cosine, none and none.",
            _special_rows,
        ),
    ),
)
