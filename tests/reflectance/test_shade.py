"""Oracle: a slow numpy twin that interpolates with SciPy and evaluates Fresnel by Snell's law."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from skindb.reflectance.mixture import Mixture
from skindb.reflectance.model import Lamp, Points

ETA = 1.3
FLOAT32 = 2e-6  # relative: tables and results are float32, eight corners are summed


def fresnel_by_snell(cosine: np.ndarray, eta: float) -> np.ndarray:
    inside = np.sqrt(1 - (1 - cosine**2) / eta**2)
    s = (cosine - eta * inside) / (cosine + eta * inside)
    p = (eta * cosine - inside) / (eta * cosine + inside)
    return 1 - (s**2 + p**2) / 2


def unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def table_value(
    table: np.ndarray, n: np.ndarray, wi: np.ndarray, wo: np.ndarray
) -> np.ndarray:
    """Rotates into the half-vector frame by explicit matrices, as Rusinkiewicz 1998 writes it."""
    h = unit(wi + wo)
    theta_h = np.arccos(np.clip(n @ h, -1, 1))
    z = n
    x = unit(h - (n @ h) * n)
    local = np.array([x, np.cross(z, x), z]) @ wi
    c = np.cos(-theta_h)
    s = np.sin(-theta_h)
    difference = np.array(
        [c * local[0] + s * local[2], local[1], -s * local[0] + c * local[2]]
    )
    theta_d = np.arccos(np.clip(difference[2], -1, 1))
    phi_d = np.mod(np.arctan2(difference[1], difference[0]), np.pi)
    wrapped = np.concatenate([table, table[:, :, :1]], axis=2)
    nodes = [
        np.linspace(0, 1, table.shape[0]),
        np.linspace(0, np.pi / 2, table.shape[1]),
    ]
    phi = np.linspace(0, np.pi, table.shape[2] + 1)
    look = RegularGridInterpolator((*nodes, phi), wrapped.astype(np.float64))
    return look([np.sqrt(theta_h / (np.pi / 2)), theta_d, phi_d])[0]


@pytest.fixture
def points() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    n = 60
    k = 3
    lamps = 2
    normal = unit(rng.normal(size=(n, 3)))
    return {
        "position": rng.normal(size=(n, 3)) * 50,
        "normal": normal,
        "view": unit(normal + 0.8 * rng.normal(size=(n, 3))),
        "diffuse": rng.uniform(0.1, 0.9, (n, 3)),
        "weight": rng.uniform(0, 1, (n, k)) * (rng.random((n, k)) > 0.2),
        "table": rng.uniform(0.1, 1, (7, 6, 5, k)).astype(np.float32),
        "lamp": normal[:, None] * 800 + rng.normal(size=(n, lamps, 3)) * 500,
        "lit": rng.uniform(0, 1, (n, lamps)).astype(np.float32)
        * (rng.random((n, lamps)) > 0.2),
    }


def shaded(
    position, normal, view, diffuse, weight, table, *, lamp, lit, axis, falloff, eta
):
    points = Points(position, normal, view, diffuse, weight)
    return Mixture(table).shade(points, Lamp(lamp, lit, axis, falloff), eta=eta)


def test_shade__equals_slow_twin(points: dict[str, np.ndarray]) -> None:
    axis = unit(np.array([0.3, -0.2, -1.0]))
    falloff = 1.5
    values = shaded(**points, axis=axis, falloff=falloff, eta=ETA)
    for i, (x, n, wo) in enumerate(
        zip(points["position"], points["normal"], points["view"], strict=True)
    ):
        expected = np.zeros(3)
        for lamp, share in zip(points["lamp"][i], points["lit"][i], strict=True):
            d = np.linalg.norm(lamp - x)
            wi = (lamp - x) / d
            if share == 0 or wi @ n <= 0 or wo @ n <= 0:
                continue
            through = (
                fresnel_by_snell(wi @ n, ETA) * fresnel_by_snell(wo @ n, ETA) / np.pi
            )
            gloss = points["weight"][i] @ table_value(points["table"], n, wi, wo)
            received = share * (wi @ n) / d**2 * max(-axis @ wi, 0) ** falloff
            expected += received * (through * points["diffuse"][i] + gloss)
        np.testing.assert_allclose(values[i], expected / 2, rtol=FLOAT32, atol=1e-12)


def test_shade__mirror_at_normal_incidence_reads_the_first_node() -> None:
    table = np.zeros((5, 4, 3, 1), np.float32)
    table[0, 0] = 2.0
    up = np.array([[0.0, 0.0, 1.0]])
    values = shaded(
        np.zeros((1, 3)),
        up,
        up,
        np.zeros((1, 3)),
        np.ones((1, 1)),
        table,
        lamp=up[:, None] * 10,
        lit=np.ones((1, 1), np.float32),
        axis=-up[0],
        falloff=0,
        eta=ETA,
    )
    np.testing.assert_allclose(values, 2.0 / 100, rtol=FLOAT32)


def test_shade__is_reciprocal(points: dict[str, np.ndarray]) -> None:
    # swapping light and camera directions changes the radiance only by the ratio of the cosines
    one = points | {
        "lamp": points["position"][:, None]
        + points["normal"][:, None]
        + points["view"][:, None]
    }
    one["lit"] = np.ones((60, 1), np.float32)
    there = one["lamp"][:, 0] - one["position"]
    back = one | {
        "view": unit(there),
        "lamp": one["position"][:, None] + 5 * points["view"][:, None],
    }
    axis = np.array([0.0, 0.0, -1.0])
    cos_i = np.einsum("nc,nc->n", unit(there), points["normal"])
    cos_o = np.einsum("nc,nc->n", points["view"], points["normal"])
    use = (cos_i > 0.01) & (cos_o > 0.01)
    forward = (
        shaded(**one, axis=axis, falloff=0, eta=ETA)
        * np.sum(there**2, axis=1)[:, None]
        / cos_i[:, None]
    )
    backward = shaded(**back, axis=axis, falloff=0, eta=ETA) * 25 / cos_o[:, None]
    np.testing.assert_allclose(forward[use], backward[use], rtol=5e-6)
