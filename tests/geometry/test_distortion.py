"""Distortion of maps compared with closed forms, and folds with rational arithmetic."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from scipy.spatial import Delaunay

from skindb.geometry.distortion import (
    area_log2_sd,
    distortion,
    flipped,
    stretches,
    symmetric_dirichlet,
)


def square(n: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """A grid on the unit square, seen from outside with v downwards."""
    uv = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, n)]), axis=-1).reshape(-1, 2)
    return uv, Delaunay(uv).simplices[:, ::-1]


def on_paper(uv: np.ndarray, x: float, y: float) -> np.ndarray:
    return np.column_stack([x * uv[:, 0], -y * uv[:, 1], np.zeros(len(uv))])


def no_regions(v: np.ndarray) -> np.ndarray:
    return np.zeros((len(v), 0), bool)


def test_distortion__of_an_affine_map():
    uv, f = square()
    v = on_paper(uv, 30.0, 10.0)
    found = distortion(v, f, uv, no_regions(v))
    np.testing.assert_allclose(found["anisotropy_median"], 3, rtol=1e-12)
    np.testing.assert_allclose(found["anisotropy_p99"], 3, rtol=1e-12)
    np.testing.assert_allclose(found["area_log2_sd"], 0, atol=1e-12)
    assert found["flips"].tolist() == [0]
    largest, smallest, area = stretches(v, f, uv)
    np.testing.assert_allclose(
        [largest, smallest], np.tile([[30.0], [10.0]], len(f)), rtol=1e-12
    )
    np.testing.assert_allclose(area.sum(), 300, rtol=1e-12)
    # stretches sqrt 3 and 1/sqrt 3 of the isometry of the same area, by hand
    np.testing.assert_allclose(
        symmetric_dirichlet(largest, smallest, area), (3 + 1 / 3) / 2, rtol=1e-12
    )


def test_distortion__by_region_and_of_half_the_area_at_twice_the_size():
    """The left half of the surface has twice the right one's texels: log2 is 1 apart,
    its sd 1/2.
    """
    uv, f = square(13)
    v = on_paper(uv, 10.0, 10.0)
    left = uv[:, 0] <= 0.5
    stretched = uv + np.where(left[:, None], uv * [1, 0], [[0.5, 0]])
    member = np.column_stack([left, uv[:, 0] >= 0.5, np.zeros(len(uv), bool)])
    found = distortion(v, f, stretched, member)
    np.testing.assert_allclose(found["area_log2_sd"], [0.5, 0, 0, np.nan], atol=1e-7)
    np.testing.assert_allclose(
        found["anisotropy_median"][1:], [2, 1, np.nan], rtol=1e-12
    )
    np.testing.assert_allclose(found["anisotropy_p99"], [2, 2, 1, np.nan], rtol=1e-12)
    stretched[np.flatnonzero(left & (uv[:, 0] > 0.3))[3]] += [0.4, 0.0]
    flips = distortion(v, f, stretched, member)["flips"]
    assert flips[0] == flips[1:].sum() > 0
    assert flips[3] == 0


def test_distortion__of_lamberts_projection(hemisphere):
    """Areas are kept; the stretch 1 / cos^2(theta / 2) exceeds 1 / (1 - q / 2) on a
    fraction q of the hemisphere.
    """
    v, f, lambert = hemisphere
    found = distortion(v, f, 0.5 + lambert * [0.5, -0.5], no_regions(v))
    # rings of 2 degrees: a quantile is off by one at most; both halves of a quad at the
    # rim are equal on the sphere and differ by 2 % in the map
    np.testing.assert_allclose(found["anisotropy_median"], 4 / 3, rtol=2e-2)
    np.testing.assert_allclose(found["anisotropy_p99"], 1 / (1 - 0.495), rtol=2e-2)
    np.testing.assert_allclose(found["area_log2_sd"], 0, atol=1e-2)


def test_distortion__triangles_without_area_do_not_count():
    uv, f = square(4)
    v = on_paper(uv, 10.0, 10.0)
    flat = np.concatenate([f, [[0, 1, 2], [3, 3, 3]]])
    plain, with_flat = (distortion(v, x, uv, no_regions(v)) for x in (f, flat))
    assert with_flat["flips"].tolist() == [2]
    for name in ("area_log2_sd", "anisotropy_median", "anisotropy_p99"):
        np.testing.assert_allclose(with_flat[name], plain[name], atol=1e-12)
    assert np.isfinite(area_log2_sd(*stretches(v, flat, uv)))


def test_flipped__is_exact_where_rounding_decides():
    """Points within 64 roundings of a line (Kettner et al. 2008): double precision has
    the wrong sign at many.
    """
    step = 2.0**-53
    near = np.stack(np.meshgrid(*2 * [0.5 + step * np.arange(64)]), axis=-1).reshape(
        -1, 2
    )
    uv = np.concatenate([near, [[12.0, 12.0], [24.0, 24.0]]])
    n = len(near)
    f = np.column_stack([np.arange(n), np.full(n, n), np.full(n, n + 1)])

    def side(p: np.ndarray) -> Fraction:
        x, y = map(Fraction, p.tolist())
        return (12 - y) * (24 - x) - (12 - x) * (24 - y)

    expected = np.array([side(p) <= 0 for p in near])
    assert 0 < expected.sum() < n
    np.testing.assert_array_equal(flipped(uv, f), expected)
    a, b, c = (uv[f[:, k]] for k in range(3))
    rounded = (b - a)[:, 1] * (c - a)[:, 0] <= (b - a)[:, 0] * (c - a)[:, 1]
    assert (rounded != expected).sum() > 100
