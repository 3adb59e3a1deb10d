"""Importance sampling of tabulated BRDFs: directions have the stated density
(chi-squared tests).
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from skindb.reflectance.sampling import TableSampler, tangents
from skindb.reflectance.tables import TableGrid, tabulate

GRID = TableGrid(60, 40, 8)
LEVEL = 1e-4  # probability with which a correct sampler fails one of the tests


def _tables():
    def lobes(wi, wo):
        h = wi + wo
        h /= np.maximum(np.linalg.norm(h, axis=-1, keepdims=True), 1e-9)
        cosine = np.clip(h[..., 2], 0, 1)
        return np.stack(
            [np.ones_like(cosine), 5 * cosine**30, 100 * cosine**1000], axis=-1
        )

    return tabulate(lobes, GRID)


@pytest.mark.parametrize(
    "weights", [[1.0, 0, 0], [0.2, 1.0, 0], [0, 0.1, 0.05], [0, 0, 0], [0, 0, 1.0]]
)
@pytest.mark.parametrize("tilt", [0.0, 50.0, 80.0])
def test_sample__has_the_stated_density(weights, tilt):
    sampler = TableSampler.of_tables(_tables())
    rng = np.random.default_rng(3)
    count = 200_000
    normal = np.broadcast_to([0.0, 0.0, 1.0], (count, 3))
    view = np.broadcast_to(
        [np.sin(np.radians(tilt)), 0.0, np.cos(np.radians(tilt))], (count, 3)
    )
    mix = sampler.mix(np.broadcast_to(weights, (count, 3)))
    drawn = sampler.sample(mix, normal, view, rng.random((count, 3)))
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 1, atol=1e-12)

    # cells of equal solid angle over the upper hemisphere; the density is integrated on
    # a grid that is fine in theta, so that narrow lobes about the normal are resolved
    n_z = 24
    n_phi = 32
    steps = 100
    fine = 12
    edge = np.arccos(np.linspace(0, 1, n_z + 1))[:, None]
    theta = edge[:-1] + (edge[1:] - edge[:-1]) * (np.arange(steps) + 0.5) / steps
    width = np.sin(theta) * (edge[:-1] - edge[1:]) / steps
    phi = (np.arange(n_phi * fine) + 0.5) / (n_phi * fine) * 2 * np.pi - np.pi
    angle, turn = np.meshgrid(theta.ravel(), phi, indexing="ij")
    towards = np.stack(
        [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)],
        axis=-1,
    )
    density = sampler.pdf(
        mix[:1], normal[:1], view[:1], towards.reshape(-1, 3)
    ).reshape(angle.shape)
    cells = (
        (density * width.ravel()[:, None])
        .reshape(n_z, steps, n_phi, fine)
        .sum(axis=(1, 3))
    )
    expected = count * cells * 2 * np.pi / (n_phi * fine)
    up = drawn[:, 2] > 0
    found, _, _ = np.histogram2d(
        drawn[up, 2],
        np.arctan2(drawn[up, 1], drawn[up, 0]),
        bins=[n_z, n_phi],
        range=[[0, 1], [-np.pi, np.pi]],
    )
    enough = expected > 20
    square = ((found - expected)[enough] ** 2 / expected[enough]).sum()
    # the midpoint rule is off by up to 2 % of a cell in narrow lobes: its square adds
    # to the variance of the counts
    slack = ((0.02 * expected[enough]) ** 2 / expected[enough]).sum()
    assert square < stats.chi2.ppf(1 - LEVEL, enough.sum() - 1) + slack
    # directions below the horizon are neither drawn nor part of the density
    assert up.sum() == pytest.approx(expected.sum(), rel=0.01)


def test_sample__weights_integrate_the_brdf():
    """The estimator f cos / pdf has the mean of a plain quadrature over the hemisphere,
    and finite variance.
    """
    tables = _tables()
    sampler = TableSampler.of_tables(tables)
    rng = np.random.default_rng(5)
    count = 100_000
    normal = np.broadcast_to([0.0, 0.0, 1.0], (count, 3))
    view = np.broadcast_to([0.6, 0.0, 0.8], (count, 3))

    def lobe(towards):
        h = towards + view[0]
        h /= np.linalg.norm(h, axis=1, keepdims=True)
        return 100 * np.clip(h[:, 2], 0, 1) ** 1000 * np.maximum(towards[:, 2], 0)

    mix = sampler.mix(np.broadcast_to([0.0, 0.0, 1.0], (count, 3)))
    drawn = sampler.sample(mix, normal, view, rng.random((count, 3)))
    up = drawn[:, 2] > 0
    value = np.zeros(count)
    value[up] = lobe(drawn[up]) / sampler.pdf(mix[up], normal[up], view[up], drawn[up])
    z = (np.arange(2000) + 0.5) / 2000
    phi = (np.arange(2000) + 0.5) / 2000 * 2 * np.pi
    cosine, turn = np.meshgrid(z, phi)
    sine = np.sqrt(1 - cosine**2)
    grid = np.stack(
        [sine * np.cos(turn), sine * np.sin(turn), cosine], axis=-1
    ).reshape(-1, 3)
    expected = lobe(grid).mean() * 2 * np.pi
    error = value.std() / np.sqrt(count)
    assert abs(value.mean() - expected) < 4 * error
    # with cosine sampling, the relative standard deviation of one direction is 11
    assert value.std() / expected < 1.5


def test_tangents__are_a_frame_of_any_normal():
    rng = np.random.default_rng(1)
    normal = rng.standard_normal((1000, 3))
    normal = np.concatenate(
        [
            normal / np.linalg.norm(normal, axis=1, keepdims=True),
            [[0, 0, 1.0], [0, 0, -1.0]],
        ]
    )
    frame = np.stack([*tangents(normal), normal], axis=1)
    np.testing.assert_allclose(
        frame @ frame.transpose(0, 2, 1),
        np.broadcast_to(np.eye(3), frame.shape),
        atol=1e-12,
    )
