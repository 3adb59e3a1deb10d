"""Curves of methods that a user does not choose: profiles R(r) by moments, averages of tables
over the disc of a light, principal axes, and permutation tests.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy import stats
from sklearn.decomposition import PCA

from benchmarks.curve import Curve, Point, cpu_time
from benchmarks.curves_surface import DISC
from skindb.numerics.factorise import principal_axes
from skindb.numerics.inference import permutation_p
from skindb.optics.angles import directions, half_difference
from skindb.optics.diffusion import dipole_profile
from skindb.optics.transport import (
    ANISOTROPY,
    half_space_profile,
    moment_basis,
    radial_profile,
    random_walk,
    transport_profile,
)
from skindb.reflectance.dictionary import (
    FAR_RULE,
    NEAR_RULE,
    Dictionary,
    convolve_disc,
    embedded_dictionary,
)
from skindb.reflectance.tables import lookup
from skindb.types import unit

ETA = 1.3
DISTANCE = (0.5, 1.0, 2.0, 5.0, 10.0)  # transport mean free paths
WIDTH = 1.05  # rings extend from r / WIDTH to r WIDTH
NOISY = 0.1  # relative standard error of the random walk above which a ring is ignored
DIFFUSION = (
    "the diffusion approximation is invalid within some mean free paths and for "
    "strong absorption"
)
TAKES = 87
AXES = 5
MODELS = {"transport": transport_profile, "dipole": dipole_profile}


def transport_curves(quick: bool) -> list[Curve]:
    """R(r) of a medium by model, and by moments of several degrees, from which the
    table is made.
    """
    packets = 40_000 if quick else 200_000
    max_path = 60.0 if quick else 240.0
    rng = np.random.default_rng(0)
    walk = random_walk(packets, eta=ETA, max_path=max_path, rng=rng)
    points = []
    r = np.linspace(0.5, 20, 1000)
    for albedo in (0.7, 0.9) if quick else (0.3, 0.7, 0.9, 0.99):
        ratio = (1 - albedo) / albedo
        # in units of 1 / sigma_s', of which a mean free path is `albedo`
        middle = np.array(DISTANCE) * albedo
        walked = rings(walk, ratio, middle)
        ring = across(middle)
        setting = f"albedo {albedo:g}"
        for name, model in MODELS.items():
            model(1.0, ratio, 1.0, eta=ETA)  # makes the table
            work = partial(model, r, ratio, 1.0, eta=ETA)
            seconds, _ = cpu_time(work, len(r))
            profile = model(ring, ratio, 1.0, eta=ETA)
            mean = ring_mean(profile, middle)
            points.append(_profile(f"skindb {name}", setting, seconds, mean, walked))
        for degree in (3, 7, 11) if quick else (3, 5, 7, 9, 11, 13):
            basis = moment_basis(degree, eta=ETA, anisotropy=ANISOTROPY)
            seconds, _ = cpu_time(partial(half_space_profile, r, ratio, basis), len(r))
            with np.errstate(invalid="ignore"):
                level, kappa = half_space_profile(ring.ravel(), ratio, basis)
            profile = np.exp(level - kappa * ring.ravel()).reshape(ring.shape)
            mean = ring_mean(profile, middle)
            name = f"moments of degree {degree}"
            points.append(_profile(name, setting, seconds, mean, walked))
    distances = ", ".join(f"{d:g}" for d in DISTANCE)
    return [
        Curve(
            kernel="transport",
            error_of=f"RMS over {distances} mean free paths of the relative error of R(r)",
            reference=f"random walk of {walk.packets:,} photons",
            seconds_of="a distance",
            base="skindb dipole, albedo 0.9",
            points=points,
        )
    ]


def across(middle, width: float = WIDTH):
    """Distances (21, d) from r / width to r width of a ring around each distance r (d,)."""
    return np.linspace(middle / width, middle * width, 21)


def ring_mean(values, middle, width: float = WIDTH):
    """Mean (d,) over each ring of values at `across`, weighted by area."""
    r = across(middle, width)
    return np.asarray((values * r).sum(axis=0) / r.sum(axis=0))


def rings(walk, ratio: float, middle, width: float = WIDTH):
    """R in a ring around each distance, and its relative standard error; sigma_s' = 1,
    sigma_a = `ratio`.
    """
    edges = [np.array([r / width, r * width]) for r in middle]
    profiles = [radial_profile(walk, ratio, 1.0, edge) for edge in edges]
    value = np.concatenate([v for v, _ in profiles])
    error = np.concatenate([e for _, e in profiles])
    with np.errstate(invalid="ignore", divide="ignore"):
        return value, np.asarray(np.where(value > 0, error / value, np.inf))


def _profile(name: str, setting: str, seconds: float, mean, walked) -> Point:
    """The point of ring means, compared with values and noise of the random walk."""
    value, noise = walked
    clear = (noise < NOISY) & np.isfinite(mean)
    off = mean[clear] / value[clear] - 1
    error = float(np.sqrt((off**2).mean()))
    negative = ", ".join(f"{d:g}" for d in np.array(DISTANCE)[np.isnan(mean)])
    failure = ""
    if name.endswith("dipole"):
        failure = DIFFUSION
    elif negative:
        failure = f"negative at {negative} mean free paths (not in the error): too few moments"
    elif name.startswith("moments") and error > 0.1:
        failure = f"{error:.0%} off: too few moments"
    return Point(name, setting, seconds, error, failure)


def disc_curves(quick: bool) -> list[Curve]:
    """Averages of tables over the disc of the light, by number of quadrature points."""
    dictionary = embedded_dictionary()
    chosen = slice(18, 50, 8)
    table = np.ascontiguousarray(dictionary.table[..., chosen])
    names = dictionary.names[chosen]
    few = Dictionary(names, table, dictionary.grid, dictionary.source)
    nodes = _random_nodes(150 if quick else 600)
    exact = _dense_disc(few, nodes, DISC, 100 if quick else 400)
    convolve_disc(few, DISC, far=(1, 1), near=(1, 1))  # compiles
    rules = [((1, 4), (1, 4))]
    if not quick:
        rules += [(rule, rule) for rule in ((2, 6), (3, 8), (4, 12), (6, 18))]
    rules.append((FAR_RULE, NEAR_RULE))
    points = []
    for far, near in rules:
        work = partial(convolve_disc, few, DISC, far=far, near=near)
        seconds, averaged = cpu_time(work)
        errors = _relative_errors(averaged.table[nodes], exact)
        setting = " and ".join(f"{n} x {m}" for n, m in dict.fromkeys((far, near)))
        error = float(errors.max())
        points.append(Point("skindb convolve_disc", setting, seconds, error))
    base = points[-1].name
    error = float(_relative_errors(table[nodes], exact).max())
    failure = "a lamp is not a point, so sharp lobes become too high and too narrow"
    points.append(Point("no convolution", "", np.nan, error, failure))
    count = len(nodes[0])
    return [
        Curve(
            kernel="disc",
            error_of=f"relative RMS error at {count} nodes, worst of {len(names)} materials",
            reference=(
                "averages of interpolated values over a dense disc around either direction"
            ),
            seconds_of=f"{len(names)} tables",
            base=base,
            points=points,
        )
    ]


def _relative_errors(values, exact):
    """RMS errors (materials,) over nodes, over the RMS."""
    off = np.linalg.norm(values - exact, axis=0)
    return np.asarray(off / np.linalg.norm(exact, axis=0))


def _random_nodes(count: int):
    """Indices of random nodes in the lobes, both directions 12 degrees above the horizon."""
    grid = embedded_dictionary().grid
    theta_h, theta_d, phi_d = embedded_dictionary().table.shape[:3]
    rng = np.random.default_rng(5)
    sizes = (theta_h // 2, theta_d * 2 // 3, phi_d)
    i, j, k = (rng.integers(0, size, 20 * count) for size in sizes)
    wi, wo = directions(grid.theta_h[i], grid.theta_d[j], grid.phi_d[k])
    up = np.flatnonzero(np.minimum(wi[:, 2], wo[:, 2]) > 0.2)[:count]
    return i[up], j[up], k[up]


def _dense_disc(dictionary: Dictionary, nodes, angle: float, count: int):
    """Means (nodes, materials) over `count` spiral points on the disc around either direction."""
    grid = dictionary.grid
    i, j, k = nodes
    wi, wo = directions(grid.theta_h[i], grid.theta_d[j], grid.phi_d[k])
    spiral = np.arange(count)
    radius = np.sqrt((spiral + 0.5) / count) * np.tan(angle)
    turn = spiral * np.pi * (3 - np.sqrt(5))
    total = np.zeros((len(i), len(dictionary.names)))
    for centre, opposite in ((wi, wo), (wo, wi)):
        x = unit(np.cross(centre, [0.3, 0.9, 0.1]))
        y = np.cross(centre, x)
        for u, v in zip(radius * np.cos(turn), radius * np.sin(turn), strict=True):
            moved = unit(centre + u * x + v * y)
            angles = half_difference(moved, opposite)
            total += lookup(dictionary.table, *angles) / (2 * count)
    return total


def components_curves(quick: bool) -> list[Curve]:
    """Principal axes of a few long vectors, compared with scikit-learn."""
    length = 10_000 if quick else 300_000
    rng = np.random.default_rng(0)
    vectors = rng.standard_normal((TAKES, AXES)) @ rng.standard_normal((AXES, length))
    vectors += 0.1 * rng.standard_normal((TAKES, length))
    exact = PCA(AXES, svd_solver="full").fit(vectors).components_
    points = []
    for solver in ("full", "randomized"):
        fit = partial(PCA(AXES, svd_solver=solver, random_state=0).fit, vectors)
        seconds, axes = cpu_time(fit)
        error = _axes_off(axes.components_, exact)
        points.append(Point("scikit-learn", solver, seconds, error))
    for setting, dtype in (
        ("", np.float64),
        ("vectors in single precision", np.float32),
    ):
        work = partial(principal_axes, vectors.astype(dtype), AXES)
        seconds, principal = cpu_time(work)
        error = _axes_off(principal.axes, exact)
        points.append(Point("skindb", setting, seconds, error))
    base = "scikit-learn, full"
    return [
        Curve(
            kernel="components",
            error_of=f"largest difference of {AXES} axes of {TAKES} vectors of {length:,}",
            reference=base,
            seconds_of="an analysis",
            base=base,
            points=points,
        )
    ]


def _axes_off(axes, exact) -> float:
    sign = np.sign((axes * exact).sum(axis=1, keepdims=True))
    return float(np.abs(axes * sign - exact).max())


def permutations_curves(quick: bool) -> list[Curve]:
    """P values of 30 quantities of 87 subjects by number of permutations, and of
    scipy.stats.permutation_test.
    """
    rng = np.random.default_rng(0)
    group = (np.arange(TAKES) % 4 == 0).astype(float)
    values = rng.standard_normal((TAKES, 30))
    values += 0.4 * group[:, None] * np.linspace(0, 1, 30)

    def p_values(draws: int, seed: int = 1):
        rng = np.random.default_rng(seed)
        return permutation_p(values, group, max_draws=draws, rng=rng)[0]

    exact_draws = 20_000 if quick else 200_000
    exact = p_values(exact_draws, 7)
    points = []
    for draws in (100, 1000) if quick else (100, 1000, 10_000):
        seconds, p = cpu_time(partial(p_values, draws))
        setting = f"{draws} permutations"
        points.append(Point("skindb", setting, seconds, float(np.abs(p - exact).max())))
    draws = 100 if quick else 1000
    seconds, p = cpu_time(partial(p_values_of_scipy, values, group, draws))
    name = "SciPy permutation_test of Welch's statistic, which differs from HC3's"
    setting = f"{draws} permutations"
    points.append(Point(name, setting, seconds, float(np.abs(p - exact).max())))
    return [
        Curve(
            kernel="permutations",
            error_of="largest error of a p value",
            reference=f"{exact_draws:,} permutations",
            seconds_of="a test",
            base="skindb, 1000 permutations",
            points=points,
        )
    ]


def p_values_of_scipy(values, group, draws: int):
    def welch(x, y, axis: int = 0):
        return np.asarray(stats.ttest_ind(x, y, equal_var=False, axis=axis).statistic)

    test = stats.permutation_test(
        (values[group == 1], values[group == 0]),
        welch,
        n_resamples=draws,
        vectorized=True,
        axis=0,
        rng=np.random.default_rng(1),
    )
    return np.asarray(test.pvalue)
