"""Tables of BRDFs compared with SciPy's interpolation and integrals."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from skindb.optics.angles import half_difference
from skindb.reflectance.tables import (
    DEFAULT_GRID,
    TableGrid,
    directional_albedo,
    half_widths,
    lookup,
    tabulate,
)

GRID = TableGrid(12, 10, 8)
TABLE = np.random.default_rng(0).uniform(size=(12, 10, 8, 3))


def test_lookup__exact_at_nodes_and_periodic():
    mesh = np.meshgrid(GRID.theta_h, GRID.theta_d, GRID.phi_d, indexing="ij")
    np.testing.assert_allclose(lookup(TABLE, *mesh), TABLE, atol=1e-12)
    np.testing.assert_allclose(
        lookup(TABLE, mesh[0], mesh[1], mesh[2] + np.pi), TABLE, atol=1e-12
    )


def test_lookup__as_scipy_interpolates():
    nodes = (np.linspace(0, 1, 12), GRID.theta_d, np.append(GRID.phi_d, np.pi))
    twin = RegularGridInterpolator(
        nodes, np.concatenate([TABLE, TABLE[:, :, :1]], axis=2)
    )
    th, td, pd = np.random.default_rng(1).uniform(0, 1, (3, 400)) * [
        [np.pi / 2],
        [np.pi / 2],
        [np.pi],
    ]
    want = twin(np.stack([np.sqrt(th / (np.pi / 2)), td, pd], axis=-1))
    np.testing.assert_allclose(lookup(TABLE, th, td, pd), want, atol=1e-12)


def test_tabulate__opposite_directions_take_the_limit():
    """At theta_d = 90 degrees the half vector is 0/0; by rounding, a table contained
    700 times the value there.
    """
    table = tabulate(
        lambda wi, wo: np.exp(-5 * half_difference(wi, wo)[0])[..., None], GRID
    )
    np.testing.assert_allclose(
        table[:, -1, :, 0], np.exp(-5 * GRID.theta_h)[:, None] + np.zeros(8), rtol=1e-5
    )


def test_directional_albedo__lambertian():
    table = np.full((90, 120, 16, 1), 0.5 / np.pi)
    # the horizon cuts cells
    np.testing.assert_allclose(directional_albedo(table, [1.0, 0.5]), 0.5, rtol=5e-3)


def test_directional_albedo__equals_a_plain_integral_over_directions():
    table = tabulate(
        lambda wi, wo: np.exp(-3 * half_difference(wi, wo)[0])[..., None], DEFAULT_GRID
    )
    wo = np.array([0.6, 0.0, 0.8])
    z, phi = np.meshgrid(
        (np.arange(400) + 0.5) / 400, (np.arange(400) + 0.5) * np.pi / 200
    )
    wi = np.stack(
        [np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z], axis=-1
    )
    want = (
        2
        * np.pi
        * np.mean(
            z * np.exp(-3 * half_difference(wi, np.broadcast_to(wo, wi.shape))[0])
        )
    )
    # the horizon cuts cells
    np.testing.assert_allclose(directional_albedo(table, 0.8), want, rtol=5e-3)


def test_half_widths__of_ggx_are_those_of_the_formula():
    """The distribution falls to a half where cos^2 = (1 - sqrt 2 a^2) / (1 - a^2)."""
    roughness = np.array([0.1, 0.2, 0.4])
    square = roughness**2

    def evaluate(wi, wo):
        half = wi + wo
        cosine = half[..., 2] / np.maximum(np.linalg.norm(half, axis=-1), 1e-9)
        q = cosine[..., None] ** 2 * (square - 1) + 1
        even = np.ones_like(q[..., :1])
        return np.concatenate([square / q**2, even, 0 * even], axis=-1)

    width = half_widths(tabulate(evaluate))
    expected = np.arccos(np.sqrt((1 - np.sqrt(2) * square) / (1 - square)))
    # linear between nodes that are 1 to 2 degrees apart
    np.testing.assert_allclose(width[:3], expected, atol=np.radians(0.15))
    assert width[3:].tolist() == [np.pi / 2, 0.0]
