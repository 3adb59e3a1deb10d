"""Curves of subsurface light: the inverse of eq. 5, profiles R(r) and their fits against
mpmath and Monte Carlo, and the octree against the sum over every pair.
"""

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any

import mpmath
import numpy as np
from scipy.optimize import brentq

from benchmarks.curve import Curve, Point, cpu_time
from benchmarks.curves_surface import spiral
from skindb.fit.translucency import ProbeFit, fit_profile
from skindb.optics.diffusion import (
    S_MAX,
    diffuse_reflectance,
    dipole_profile,
    dipole_s,
    reduced_albedo,
    scattering_coefficients,
    sigma_tr,
)
from skindb.optics.dipole_tree import subsurface_exitance
from skindb.optics.fresnel import boundary_factor
from skindb.optics.transport import (
    Walk,
    radial_profile,
    random_walk,
    transport_profile,
)
from skindb.types import Array, Float32, lengths

ETA = 1.3
FAR_OFF = 0.25  # relative error above which a fit counts as failed
FAILS_WITH_FREE_GAIN = "a free gain has two minima; measure the gain"
FAILS_WHERE_NEAR = "the profile is wrong where the albedo is low or the fibres are near"
FIBRES = 1 + 0.5 * np.arange(28)  # mm, of the probe
# sigma_a, sigma_s' [mm-1] of kinds of skin; albedo 0.98 to 0.59
SKIN = ((0.05, 2.4), (0.17, 2.3), (0.36, 2.9), (0.3, 1.0), (0.54, 0.79))
RADIUS = 30.0  # of a ball [mm]
RECEIVERS = 150  # points of comparison on the ball
LIGHTS = 4
BALL_SIGMA_TR = np.array([0.55, 0.98, 1.55])  # mm-1
BALL_R_D = np.array([0.5, 0.3, 0.2])
PROFILE_REACH_MM = 25.0  # beyond it the profile is below 1e-6 of its integral


@lru_cache(maxsize=1)
def _walk(quick: bool) -> Walk:
    packets = 40_000 if quick else 200_000
    max_path = 60.0 if quick else 240.0
    rng = np.random.default_rng(0)
    return random_walk(packets, eta=ETA, max_path=max_path, rng=rng)


def inverse_curves(quick: bool) -> list[Curve]:
    """The dipole's s from R_d, from nearly black to nearly white."""
    n = 20 if quick else 60
    dark = np.geomspace(1e-6, 0.5, n)
    bright = 1 - np.geomspace(0.5, 1e-9, n)[1:]
    diffuse = np.concatenate([dark, bright])
    exact = np.array([_exact(float(value)) for value in diffuse])
    count = len(diffuse)
    dipole_s(diffuse, eta=ETA)  # caches F_dr
    seconds, (s, _) = cpu_time(partial(dipole_s, diffuse, eta=ETA), count)
    seconds_of_brentq, of_brentq = cpu_time(partial(_by_brentq, diffuse), count)
    albedo = reduced_albedo(exact)
    from_single = np.sqrt(3 * (1 - albedo.astype(np.float32).astype(float)))
    s_bright = _exact(0.999)
    lost = (1 - np.float32(reduced_albedo(s_bright))) / (s_bright**2 / 3) - 1
    brentq_fails = "1 - R_d(s) is lost to cancellation where R_d is near 1"
    single_fails = (
        "1 - alpha' is lost to cancellation: "
        f"{abs(lost):.0%} off at R_d = 0.999, all of it at 1 - 1e-9"
    )
    stored = s.astype(np.float32)
    brentq_name = "SciPy brentq on eq. 5"
    points = [
        Point(name, "", cost, float(np.abs(estimate / exact - 1).max()), failure)
        for name, cost, estimate, failure in (
            ("skindb dipole_s", seconds, s, ""),
            ("skindb dipole_s, stored in single precision", seconds, stored, ""),
            (brentq_name, seconds_of_brentq, of_brentq, brentq_fails),
            ("alpha' in single precision", seconds, from_single, single_fails),
        )
    ]
    return [
        Curve(
            kernel="inverse",
            error_of=f"largest relative error of s over {count} R_d from 1e-6 to 1 - 1e-9",
            reference="mpmath, 40 digits",
            seconds_of="a value",
            base=brentq_name,
            points=points,
        )
    ]


def _by_brentq(diffuse: Array) -> Array:
    def off(s: float, value: float) -> float:
        return float(diffuse_reflectance(s, eta=ETA)) - value

    tolerance = {"xtol": 1e-300, "rtol": 1e-15}
    roots = [brentq(off, 0, S_MAX, args=(value,), **tolerance) for value in diffuse]
    return np.array(roots)


def _exact(value: float) -> float:
    with mpmath.workdps(40):
        b = mpmath.mpf(4) / 3 * mpmath.mpf(boundary_factor(ETA))
        bracket = (mpmath.mpf("1e-12"), mpmath.sqrt(3))
        target = mpmath.mpf(value)

        def off(s: Any) -> Any:
            boundary = 1 + mpmath.exp(-b * s)
            return (1 - s * s / 3) / 2 * boundary * mpmath.exp(-s) - target

        return float(mpmath.findroot(off, bracket, solver="anderson", tol=1e-60))


def probe_curves(quick: bool) -> list[Curve]:
    """sigma_tr from the fibres of the probe, by number of fibres, and known or
    fitted gain.
    """
    walk = _walk(quick)
    skin = SKIN[1:4:2] if quick else SKIN
    edges = np.append(FIBRES - 0.25, FIBRES[-1] + 0.25)
    photons = [radial_profile(walk, a, s, edges) for a, s in skin]
    true = np.array([sigma_tr(a, s) for a, s in skin])
    points = []
    transport_profile(1.0, *SKIN[0], eta=ETA)  # makes the table
    for free in (False, True):
        for fibres in (28,) if quick else (4, 6, 8, 12, 28):
            work = partial(_fits, free, fibres, photons)
            seconds, fits = cpu_time(work, len(skin))
            off = np.array([fit.sigma_tr for fit in fits]) / true - 1
            failure = _failure_of_fits(off, free)
            name = f"skindb transport, gain {'fitted' if free else 'known'}"
            setting = f"{fibres} fibres"
            error = float(np.sqrt(np.nanmean(off**2)))
            points.append(Point(name, setting, seconds, error, failure))
    return [
        Curve(
            kernel="probe",
            error_of=f"RMS over {len(skin)} kinds of skin of the relative error of sigma_tr",
            reference=(
                f"random walk of {walk.packets:,} photons through media of known coefficients"
            ),
            seconds_of="a profile",
            base=f"skindb transport, gain known, {len(FIBRES)} fibres",
            points=points,
        )
    ]


def _fits(
    free: bool, fibres: int, photons: Sequence[tuple[Array, Array]]
) -> list[ProbeFit]:
    return [
        fit_profile(
            FIBRES[:fibres],
            value[:fibres],
            error[:fibres],
            radius=0.0,
            eta=ETA,
            free_gain=free,
        )
        for value, error in photons
    ]


def _failure_of_fits(off: Array, free: bool) -> str:
    largest = np.nanmax(np.abs(off))
    if largest > FAR_OFF:
        reason = FAILS_WITH_FREE_GAIN if free else FAILS_WHERE_NEAR
        return f"{largest:.0%} off in one medium: {reason}"
    if not np.isfinite(off).all():
        return "some profiles were not fitted"
    return ""


def subsurface_curves(quick: bool) -> list[Curve]:
    """The octree by opening tolerance and point spacing, for hard shadows 4 mm wide."""
    spacings = (1.6,) if quick else (0.5, 0.8, 1.6)
    fine = 0.4 if quick else 0.15
    fine_ball = _ball(fine)
    tree = []
    spaced = []
    _octree(*_ball(20.0), 0.1)  # compiles
    for spacing in spacings:
        ball = _ball(spacing)
        points = ball[0]
        chosen = np.random.default_rng(4).integers(0, len(points), RECEIVERS)
        receivers = points[chosen]
        seconds, every_pair = cpu_time(partial(_every_pair, receivers, *ball))
        seconds *= len(points) / RECEIVERS
        exact = _every_pair(receivers, *fine_ball)
        name = "every pair by NumPy"
        setting = f"{spacing} mm"
        tree.append(Point(name, setting, seconds, np.nan))
        spaced.append(Point(name, setting, seconds, _rms(every_pair, exact)))
        for tolerance in (0.05, 0.2) if quick else (0.02, 0.05, 0.1, 0.2, 0.4):
            seconds, exitance = cpu_time(partial(_octree, *ball, tolerance))
            at_receivers = exitance[:, chosen]
            name = f"skindb octree, {spacing} mm"
            setting = f"tolerance {tolerance}"
            tree.append(Point(name, setting, seconds, _rms(at_receivers, every_pair)))
            spaced.append(Point(name, setting, seconds, _rms(at_receivers, exact)))
    base = f"every pair by NumPy, {spacings[0]} mm"
    scene = f"{LIGHTS} lights on a ball of {RADIUS:g} mm"
    error = "RMS error of the exitance over its RMS"
    return [
        Curve(
            kernel="subsurface",
            error_of=error,
            reference=f"every pair of the same points ({RECEIVERS} receivers)",
            seconds_of=scene,
            base=base,
            points=tree,
        ),
        Curve(
            kernel="subsurface",
            error_of=error,
            reference=(
                f"every pair of points {fine} mm apart, so that the error of the spacing is "
                "included"
            ),
            seconds_of=scene,
            base=base,
            points=spaced,
        ),
    ]


def _ball(spacing: float) -> tuple[Array, Array, Array]:
    """Points (n, 3) of a spiral on the ball, their areas and their irradiance (n, lights)."""
    n = round(4 * np.pi * RADIUS**2 / spacing**2)
    points = spiral(n, RADIUS, 2.0)
    light = np.random.default_rng(3).normal(size=(3, LIGHTS))
    light /= np.linalg.norm(light, axis=0)
    stripes = np.sin(points[:, 1:2] * np.pi / 4 + np.arange(LIGHTS)) > 0
    irradiance = np.maximum(points @ light / RADIUS, 0) * stripes
    return points, np.full(n, spacing**2), irradiance


def _octree(
    points: Array, areas: Array, irradiance: Array, tolerance: float
) -> Float32:
    s = np.tile(dipole_s(BALL_R_D, eta=ETA)[0], (len(points), 1))
    transport = np.tile(BALL_SIGMA_TR, (len(points), 1))
    return subsurface_exitance(
        points, areas, irradiance, s, transport, eta=ETA, tolerance=tolerance
    )


def _every_pair(
    receivers: Array, points: Array, areas: Array, irradiance: Array
) -> Array:
    """Exitance (lights, receivers, 3) with the kernel normalised by its sum, as in
    `subsurface_exitance`.
    """
    s = dipole_s(BALL_R_D, eta=ETA)[0]
    absorbed, scattered = scattering_coefficients(s, BALL_SIGMA_TR)
    diffuse = diffuse_reflectance(s, eta=ETA)
    exitance = np.empty((LIGHTS, len(receivers), 3))
    for i, place in enumerate(receivers):
        near = np.flatnonzero(((points - place) ** 2).sum(axis=1) < PROFILE_REACH_MM**2)
        r = lengths(points[near] - place)[:, None]
        kernel = dipole_profile(r, absorbed, scattered, eta=ETA) * areas[near, None]
        exitance[:, i] = irradiance[near].T @ kernel / kernel.sum(axis=0) * diffuse
    return exitance


def _rms(values: Array, exact: Array) -> float:
    return float(np.sqrt(((values - exact) ** 2).mean() / (exact**2).mean()))
