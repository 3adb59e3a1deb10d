"""Stress cases of diffusion and the octree."""

from __future__ import annotations

import numpy as np
from scipy.integrate import quad

from skindb.bench.case import SCALES, close, combinations, expect, stress_cases
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
from skindb.optics.fresnel import fresnel_reflectance, internal_diffuse_reflectance
from skindb.optics.transport import transport_profile
from skindb.types import Array

ETA = 1.3
PROFILES = {"dipole": dipole_profile, "transport": transport_profile}
SINGLE = 2e-6  # results in single precision

# eq. 5, its inverse, Fresnel
NAMES = tuple(PROFILES)


def _round_trip(eta: float) -> None:
    s = np.concatenate(
        [np.geomspace(1e-8, 0.1, 30), np.linspace(0.1, S_MAX - 1e-5, 30)]
    )
    diffuse = diffuse_reflectance(s, eta=eta)
    # nearer to 1, the rounding of R_d dominates s
    inside = (diffuse > 1e-6) & (diffuse < 1 - 1e-6)
    close(dipole_s(diffuse[inside], eta=eta)[0], s[inside], rtol=1e-9)


def _bright(eta: float) -> None:
    """As alpha' -> 1, 1 - R_d -> (1 + 2 A / 3) s, the first term of its series."""
    inside = internal_diffuse_reflectance(eta)
    slope = 1 + 2 / 3 * (1 + inside) / (1 - inside)
    lost = np.array([1e-7, 1e-8, 1e-9])
    s, clamped = dipole_s(1 - lost, eta=eta)
    expect(not clamped.any(), clamped)
    # the next term, s^2, and the rounding of 1 - 1e-9 (1e-7)
    close(s, lost / slope, rtol=1e-6)


def _dark(eta: float) -> None:
    """As alpha' -> 0, R_d -> alpha'/2 (1 + exp(-4 A / sqrt 3)) exp(-sqrt 3)."""
    inside = internal_diffuse_reflectance(eta)
    a = (1 + inside) / (1 - inside)
    value = np.array([1e-6, 1e-5])
    s, clamped = dipole_s(value, eta=eta)
    expect(not clamped.any(), clamped)
    level = (1 + np.exp(-4 / 3 * a * np.sqrt(3))) * np.exp(-np.sqrt(3)) / 2
    close(reduced_albedo(s), value / level, rtol=1e-3)  # the next term is alpha' itself


def _outside() -> None:
    s, clamped = dipole_s(
        [-np.inf, -1.0, 0.0, 1e-30, 0.5, 1.0, 2.0, 1e30, np.inf, np.nan], eta=ETA
    )
    expect(clamped.tolist() == [True] * 4 + [False] + [True] * 4 + [False], clamped)
    expect(
        np.isnan(s[-1])
        and ((s[:-1] > 0) & (s[:-1] < S_MAX)).all()
        and (np.diff(s[:-1]) <= 0).all(),
        s,
    )


def _single_precision() -> None:
    value = np.linspace(0.01, 0.99, 25).astype(np.float32)
    close(
        dipole_s(value, eta=ETA)[0],
        dipole_s(value.astype(np.float64), eta=ETA)[0],
        rtol=0,
    )


def _no_values() -> None:
    expect(
        dipole_s(np.zeros((0, 3)), eta=ETA)[0].shape == (0, 3),
        dipole_s(np.zeros((0, 3)), eta=ETA)[0].shape,
    )


def _coefficients(tr: float) -> None:
    s = np.array([0.0, 1e-30, 1e-4, 0.5, S_MAX])
    a, scattered = scattering_coefficients(s, tr)
    expect(
        np.isfinite([a, scattered]).all() and (np.array([a, scattered]) >= 0).all(),
        (a, scattered),
    )
    close(sigma_tr(a, scattered), tr, rtol=1e-12)


def _no_boundary() -> None:
    cosine = np.array([0.0, 1e-30, 1e-6, 0.5, 1.0])
    close(fresnel_reflectance(cosine, 1.0), 0.0)
    close(internal_diffuse_reflectance(1.0), 0.0, atol=1e-15)


def _grazing_light(eta: float) -> None:
    """F_r -> 1 - 4 cos F(eta) towards the horizon: continuous, and one at the horizon."""
    close(fresnel_reflectance([0.0, 1e-30, 1e-12], eta), 1.0, atol=1e-10)
    expect(
        (np.diff(fresnel_reflectance(np.linspace(0, 0.2, 50), eta)) < 0).all(), "a rise"
    )
    close(fresnel_reflectance([0.0, 0.1], 1 / eta), 1.0)  # total internal reflection


# profiles


def _near(name: str) -> None:
    """R decreases with distance, and grows towards 0 at most like exp(-sigma_t' r) / r,
    as single scattering does.
    """
    r = np.geomspace(1e-12, 0.015, 60)  # mean free paths are 0.6
    value = PROFILES[name](r, 0.1, 1.5, eta=ETA)
    expect(
        np.isfinite(value).all() and (value > 0).all() and (np.diff(value) <= 0).all(),
        value,
    )
    alone = value * r * np.exp(1.6 * r)
    expect(
        (np.diff(alone) >= -1e-12 * alone[1:]).all(), "steeper than exp(-sigma_t' r)/r"
    )


def _far(name: str) -> None:
    """Far away R decays at the rate sigma_tr (the dipole) or at the exact rate, which
    absorption makes lower.
    """
    r = np.array([40.0, 50.0, 60.0])
    value = PROFILES[name](r, 0.3, 1.0, eta=ETA)
    rate = -np.diff(np.log(value * r**2)) / np.diff(r)
    tr = sigma_tr(0.3, 1.0)
    expect((rate < tr * 1.02).all() and (rate > 0.75 * tr).all(), rate / tr)
    expect(
        np.isfinite(PROFILES[name](np.array([1e6, 1e30]), 0.3, 1.0, eta=ETA)).all(),
        "not finite",
    )


def _no_absorption(name: str) -> None:
    """With sigma_a = 0 the mean free path is the only length, so R ~ r^-3 far away, the
    limit of small sigma_a.
    """
    r = np.array([30.0, 100.0])
    value = PROFILES[name](r, 0.0, 1.0, eta=ETA)
    rate = np.log(value[0] / value[1]) / np.log(r[1] / r[0])
    expect(abs(rate - 3) < 0.1, rate)
    close(PROFILES[name](r[:1], 1e-12, 1.0, eta=ETA), value[:1], rtol=1e-3)


def _no_scattering(name: str) -> None:
    """As sigma_s' -> 0, R vanishes, for the dipole in proportion to sigma_s'."""
    r = np.array([0.5, 1.0, 3.0])
    small, less = (PROFILES[name](r, 0.5, s, eta=ETA) for s in (1e-4, 1e-6))
    expect(
        np.isfinite([small, less]).all() and (less >= 0).all() and (less < small).all(),
        (small, less),
    )
    if name == "dipole":
        close(less / small, 0.01, rtol=1e-3)
        close(PROFILES[name](r, 0.5, 0.0, eta=ETA), 0.0)


def _similar(name: str, scale: float) -> None:
    """If lengths are multiplied by f, coefficients are divided by f and R by f squared."""
    r = np.geomspace(0.1, 10, 9)
    value = PROFILES[name](r * scale, 0.1 / scale, 1.5 / scale, eta=ETA)
    close(value * scale * scale, PROFILES[name](r, 0.1, 1.5, eta=ETA), rtol=1e-9)


def _profile_precision(name: str) -> None:
    r = np.array([0.5, 2.0, 8.0], np.float32)
    close(
        PROFILES[name](r, np.float32(0.25), np.float32(1.5), eta=ETA),
        PROFILES[name](r.astype(float), 0.25, 1.5, eta=ETA),
    )


def _profile_nan(name: str) -> None:
    """NaN stays NaN and infinity gives zero or NaN, never a number that looks measured."""
    value = PROFILES[name](np.array([np.nan, 1.0, np.inf]), 0.1, 1.5, eta=ETA)
    expect(np.isnan(value[0]) and value[1] > 0 and not value[2] > 0, value)
    expect(np.isnan(PROFILES[name](1.0, np.nan, 1.5, eta=ETA)), "a number from NaN")


def _integral(eta: float, albedo: float) -> None:
    """The integral of the dipole over the plane is eq. 5, with and without a boundary."""
    a = 1 - albedo
    s = albedo
    far = 60 / float(sigma_tr(a, s))
    total = sum(
        quad(
            lambda r: 2 * np.pi * r * float(dipole_profile(r, a, s, eta=eta)),
            low,
            high,
            epsrel=1e-10,
            limit=400,
        )[0]
        for low, high in ((0, 1), (1, 30), (30, max(far, 31)))
    )
    close(total, diffuse_reflectance(np.sqrt(3 * a), eta=eta), rtol=1e-6)


def _medium(name: str, sigma_a: float, sigma_s: float) -> None:
    """R is finite and decreases with distance; it may vanish only where absorption is
    far above scattering.
    """
    r = np.geomspace(1e-6, 2000, 200)
    value = PROFILES[name](r, sigma_a, sigma_s, eta=ETA)
    expect(np.isfinite(value).all() and (np.diff(value) <= 0).all(), value)
    expect((value[:100] > 0).all() or sigma_a / sigma_s > 10, value[:100])


def _more_absorption(name: str) -> None:
    r = np.geomspace(1e-6, 350, 120)
    bright, dark = (PROFILES[name](r, a, 1.0, eta=ETA) for a in (0.01, 0.02))
    expect((bright > dark).all(), bright - dark)


def _no_distances(name: str) -> None:
    expect(
        PROFILES[name](np.zeros(0), 0.1, 1.5, eta=ETA).shape == (0,), "another shape"
    )


# subsurface


def _exitance(
    points: Array, light: Array, s: float = 0.7, tr: float = 1.0, *, eta: float = ETA
) -> Array:
    n = len(points)
    skin = np.full((n, 3), s), np.full((n, 3), tr)
    return subsurface_exitance(points, np.full(n, 0.04), light, *skin, eta=eta)


def _patch(n: int = 900) -> Array:
    side = round(n**0.5)
    x, y = np.meshgrid(np.arange(side) * 0.2, np.arange(side) * 0.2)
    return np.stack([x.ravel(), y.ravel(), 0.01 * x.ravel() * y.ravel()], axis=1)


def _uniform(s: float, tr: float, eta: float = ETA) -> None:
    out = _exitance(_patch(), np.ones((900, 2)), s, tr, eta=eta)
    # s has a lower bound in the code
    close(out, diffuse_reflectance(np.maximum(s, 1e-4), eta=eta), rtol=SINGLE)


def _few_points(n: int) -> None:
    out = _exitance(_patch(2500)[:n], np.ones((n, 1)))
    close(out, np.full((1, n, 3), diffuse_reflectance(0.7, eta=ETA)), rtol=SINGLE)


def _no_lights() -> None:
    expect(
        _exitance(np.zeros((1, 3)), np.ones((1, 0))).shape == (0, 1, 3), "another shape"
    )


def _same_place() -> None:
    out = _exitance(np.zeros((50, 3)), np.linspace(0, 2, 50)[:, None])
    # all points receive the mean of the light, which is one
    close(out, diffuse_reflectance(0.7, eta=ETA), rtol=SINGLE)


def _in_a_line() -> None:
    points = np.stack([0.2 * np.arange(300), np.zeros(300), np.zeros(300)], axis=1)
    close(
        _exitance(points, np.ones((300, 1))),
        diffuse_reflectance(0.7, eta=ETA),
        rtol=SINGLE,
    )


def _far_apart() -> None:
    """The light of a patch does not reach another patch a kilometre away."""
    both = np.concatenate([_patch(), _patch() + np.array([1e6, 0, 0])])
    light = np.concatenate([np.ones(900), np.zeros(900)])[:, None]
    out = _exitance(both, light)[0]
    close(out[:900], diffuse_reflectance(0.7, eta=ETA), rtol=SINGLE)
    close(out[900:], 0.0)


def _scaled_light(scale: float) -> None:
    light = np.linspace(0, 1, 900)[:, None]
    close(
        _exitance(_patch(), light * scale) / scale,
        _exitance(_patch(), light),
        rtol=SINGLE,
        atol=1e-12,
    )


def _scaled_lengths(scale: float) -> None:
    light = np.linspace(0, 1, 900)[:, None]
    n = 900
    skin = np.full((n, 3), 0.7), np.full((n, 3), 1.0 / scale)
    grown = subsurface_exitance(
        _patch() * scale, np.full(n, 0.04 * scale * scale), light, *skin, eta=ETA
    )
    close(grown, _exitance(_patch(), light), rtol=1e-5)


def _no_light() -> None:
    close(_exitance(_patch(), np.zeros((900, 1))), 0.0)


def _broken_light() -> None:
    """A NaN in one light affects the points that this light reaches, but no other light."""
    light = np.ones((900, 2))
    light[450, 0] = np.nan
    out = _exitance(_patch(), light)
    expect(np.isnan(out[0, 450]).all(), out[0, 450])
    close(out[1], diffuse_reflectance(0.7, eta=ETA), rtol=SINGLE)


OPTICS = (
    *stress_cases(
        "inverse",
        (
            "eta {}",
            "s is recovered from R_d(s).",
            _round_trip,
            (
                1.0,
                1.3,
                1.5,
            ),
        ),
        (
            "alpha' to 1, eta {}",
            "s follows the first term of the series.",
            _bright,
            (
                1.0,
                1.3,
            ),
        ),
        (
            "alpha' to 0, eta {}",
            "s follows the first term of the series.",
            _dark,
            (
                1.0,
                1.3,
            ),
        ),
        (
            "black, white, out of range, NaN and inf",
            "Clamped and flagged, monotone; NaN stays NaN.",
            _outside,
        ),
        (
            "single precision",
            "Computed in double precision: the same bits.",
            _single_precision,
        ),
        ("no values", "Arrays are empty and have the right shapes.", _no_values),
        (
            "coefficients at sigma_tr {:g}",
            "Limited where s approaches 0; sigma_tr is recovered.",
            _coefficients,
            (
                1e-30,
                1.0,
                1e30,
            ),
        ),
        ("Fresnel at eta 1", "Nothing is reflected at any angle.", _no_boundary),
        (
            "Fresnel towards the horizon, eta {}",
            "All light is reflected at the horizon, less above it.",
            _grazing_light,
            (
                1.05,
                1.3,
                2.0,
            ),
        ),
    ),
    *stress_cases(
        "transport",
        (
            "{}: r to 0",
            "Positive, finite, and not steeper than single scattering.",
            _near,
            NAMES,
        ),
        ("{}: r far", "Decays to zero at the rate of its medium.", _far, NAMES),
        (
            "{}: sigma_a = 0",
            "Decays with the third power; it is the limit of little absorption.",
            _no_absorption,
            NAMES,
        ),
        ("{}: sigma_s' to 0", "No light is scattered back.", _no_scattering, NAMES),
        (
            "{}: lengths times {:g}",
            "The same in units of the mean free path.",
            _similar,
            ((name, s) for name in NAMES for s in SCALES),
        ),
        (
            "{}: single precision",
            "Computed in double precision: the same bits.",
            _profile_precision,
            NAMES,
        ),
        (
            "{}: NaN and inf",
            "NaN gives NaN, and infinity no positive number.",
            _profile_nan,
            NAMES,
        ),
        (
            "{}: sigma_a {:g}, sigma_s' {:g}",
            "Finite, and decreasing with distance.",
            _medium,
            combinations(
                NAMES,
                (0.0, 1.0),
                (1e-12, 1.0),
                (0.1, 0.0001),
                (30.0, 1.0),
                (0.1, 100.0),
            ),
        ),
        (
            "{}: more absorption",
            "There is less light at every distance.",
            _more_absorption,
            NAMES,
        ),
        ("{}: no distances", "The array is empty.", _no_distances, NAMES),
        (
            "dipole: eta {}, albedo {:g}",
            "Its integral over the plane is eq. 5.",
            _integral,
            (
                (1.0, 0.5),
                (1.3, 0.01),
                (1.3, 0.5),
                (1.3, 0.999),
            ),
        ),
    ),
    *stress_cases(
        "subsurface",
        (
            "uniform light, s {:g}, sigma_tr {:g}",
            "Exitance is R_d.",
            _uniform,
            (
                (0.0, 1.0),
                (0.7, 0.01),
                (0.7, 100.0),
                (S_MAX - 1e-06, 1.0),
            ),
        ),
        ("uniform light, eta {2}", "Exitance is R_d.", _uniform, ((0.7, 1.0, 1.0),)),
        (
            "{} point(s)",
            "Exitance is R_d in uniform light; empty for no points.",
            _few_points,
            (
                0,
                1,
                3,
                2400,
            ),
        ),
        ("no lights", "Arrays are empty and have the right shapes.", _no_lights),
        ("50 points in one place", "All receive the mean of their light.", _same_place),
        ("points in a line", "Exitance is R_d in uniform light.", _in_a_line),
        ("a kilometre apart", "No light is exchanged.", _far_apart),
        ("light times {:g}", "Exitance is multiplied by it.", _scaled_light, SCALES),
        (
            "lengths times {:g}",
            "Exitance is unchanged.",
            _scaled_lengths,
            (
                1e-06,
                1000000.0,
            ),
        ),
        ("no light", "Exitance is zero.", _no_light),
        ("NaN in one light", "Only this light has NaN.", _broken_light),
    ),
)
