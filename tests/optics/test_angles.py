"""Half and difference angles compared with their definitions."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest

from skindb.optics.angles import directions, half_difference


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _upper(rng, shape):
    return _unit(rng.normal(size=(*shape, 3)) * [1, 1, 0.3] + [0, 0, 0.9])


def test_half_difference__by_definition():
    rng = np.random.default_rng(0)
    wi = _upper(rng, (500,))
    wo = _upper(rng, (500,))
    th, td, pd = half_difference(wi, wo)
    h = _unit(wi + wo)
    np.testing.assert_allclose(np.cos(th), h[:, 2], atol=1e-12)
    np.testing.assert_allclose(np.cos(td), (wi * h).sum(1), atol=1e-12)
    # Rusinkiewicz 1998: turn by -phi_h about the normal, then by -theta_h about y;
    # phi_d is what is left
    phi_h = np.arctan2(h[:, 1], h[:, 0])
    x = wi[:, 0] * np.cos(phi_h) + wi[:, 1] * np.sin(phi_h)
    y = -wi[:, 0] * np.sin(phi_h) + wi[:, 1] * np.cos(phi_h)
    left = np.arctan2(y, x * np.cos(th) - wi[:, 2] * np.sin(th))
    # equal or half a turn apart
    np.testing.assert_allclose(np.sin(pd - left), 0, atol=1e-9)
    assert ((pd >= 0) & (pd < np.pi)).all()


def test_half_difference__reciprocal_and_turned_with_the_normal():
    rng = np.random.default_rng(1)
    wi = _upper(rng, (200,))
    wo = _upper(rng, (200,))
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    here = half_difference(wi, wo)
    there = half_difference(
        wo @ turn.T, wi @ turn.T, np.broadcast_to(turn[:, 2], wi.shape)
    )
    for a, b in zip(here, there, strict=True):
        # phi_d = 0 is phi_d = pi
        np.testing.assert_allclose(np.exp(2j * a), np.exp(2j * b), atol=1e-9)


@pytest.mark.parametrize("tilt", [1e-7, 1e-5, 1e-3])
def test_half_difference__narrow_lobes_keep_their_angle(tilt):
    """The half vector is `tilt` away from the normal; an arc cosine would lose angles
    below 1e-8.
    """
    wi = np.array([mpmath.sin(0.4 + 2 * tilt), 0, mpmath.cos(0.4 + 2 * tilt)], float)
    wo = np.array([-mpmath.sin(0.4), 0, mpmath.cos(0.4)], float)
    theta_h, theta_d, _ = half_difference(wi, wo)
    assert theta_h == pytest.approx(tilt, rel=1e-8)
    assert theta_d == pytest.approx(0.4 + tilt, rel=1e-12)


def test_half_difference__one_direction_and_the_normal():
    up = np.array([0.0, 0.0, 1.0])
    assert [float(a) for a in half_difference(up, up)] == [0, 0, 0]
    mirror = half_difference(
        [np.sin(0.5), 0, np.cos(0.5)], [-np.sin(0.5), 0, np.cos(0.5)]
    )
    np.testing.assert_allclose(mirror, [0, 0.5, 0], atol=1e-15)


def test_directions__invert_the_angles():
    rng = np.random.default_rng(2)
    th = rng.uniform(0.01, 0.7, 100)
    td = rng.uniform(0.01, 0.7, 100)
    pd = rng.uniform(0.01, 3.1, 100)
    wi, wo = directions(th, td, pd)
    np.testing.assert_allclose(np.linalg.norm([wi, wo], axis=-1), 1, rtol=1e-14)
    for got, want in zip(half_difference(wi, wo), (th, td, pd), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-9)
