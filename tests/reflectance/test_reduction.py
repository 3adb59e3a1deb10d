"""Linear reduction of a dictionary with its bounds, and bases from reflectance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from skindb.reflectance.dictionary import (
    abc_parameters,
    embedded_dictionary,
    evaluate_abc,
)
from skindb.reflectance.mixture import basis_rows
from skindb.reflectance.reduction import (
    Systems,
    factor_reflectance,
    reduce_dictionary,
    residuals,
    truncation_bound,
)
from skindb.reflectance.tables import (
    TableGrid,
    brdf_metric,
    directional_albedo,
    tabulate,
)
from skindb.types import dots, unit

GRID = TableGrid(24, 20, 8)
# of a mixture: tables are single floats, mixed ones sums of terms up to a thousand
# times their size
SINGLE = 1e-4
NARROW = (
    "ggx 0.04",
    "ggx 0.15",
    "ggx 0.9",
    "black-phenolic",
    "ggx 0.37",
    "ggx 0.062",
    "special-walnut-224",
    "ggx 0.097",
)


@pytest.fixture(scope="module")
def tables():
    rows = np.array(list(abc_parameters().values()))
    return tabulate(lambda wi, wo: evaluate_abc(rows, wi, wo), GRID)


def _mixtures(rng, m):
    """Dense and sparse mixtures, and single materials."""
    dense = rng.exponential(size=(100, m)) ** 3
    sparse = np.where(rng.random((200, m)) < 3 / m, rng.exponential(size=(200, m)), 0.0)
    return np.concatenate([dense, sparse[sparse.any(axis=1)], np.eye(m)])


@pytest.mark.parametrize("rank", [3, 8, 16, 24])
def test_truncation_bound__holds_for_mixtures(tables, rank):
    rng = np.random.default_rng(rank)
    reduced, lift = reduce_dictionary(tables, rank)
    bound = truncation_bound(tables, reduced, lift)
    x = _mixtures(rng, tables.shape[-1])
    metric = brdf_metric(
        np.concatenate([tables, tables - reduced @ lift], axis=-1), weighted_like=tables
    )
    signs = np.concatenate([0 * x, x], axis=1), np.concatenate([x, 0 * x], axis=1)
    off, whole = (np.sqrt(np.einsum("ij,jk,ik->i", s, metric, s)) for s in signs)
    assert (off <= bound * whole * (1 + SINGLE)).all()
    # a single table is a mixture: the bound is not far from the actual error
    assert (off / whole).max() > 0.8 * bound


def test_truncation_bound__is_zero_at_full_rank(tables):
    bound = truncation_bound(tables, *reduce_dictionary(tables, tables.shape[-1]))
    assert bound == 0.0


def _problem(rng, *, n=60, m=20, k=3, noise=0.0):
    """Surfels of unequal sample counts; columns in a space of 12, of very different
    size: matt and glossy.
    """
    counts = rng.integers(30, 60, n)
    counts[0] = 0
    offsets = np.concatenate([[0], np.cumsum(counts)])
    space = rng.gamma(0.5, 1.0, (offsets[-1], 12)) @ rng.gamma(0.3, 1.0, (12, m))
    rows = (space * np.geomspace(1, 30, m)).astype(np.float32)
    H = np.zeros((k, m))
    for j in range(k):
        H[j, [j, m - 1 - j]] = 0.5
    H /= (H @ rows.mean(axis=0))[:, None]
    weight = rng.gamma(0.7, 1.0, (n, k))
    surfel = np.repeat(np.arange(n), counts)
    value = np.einsum("nm,nm->n", rows, (weight @ H)[surfel])[:, None] * np.ones(3)
    return rows, offsets, value * (1 + noise * rng.normal(size=value.shape)), H


def test_systems__residuals_are_those_of_the_rows():
    """SciPy on the rows of every surfel, one column per channel stacked."""
    rows, offsets, target, H = _problem(np.random.default_rng(0), n=10, noise=0.2)
    systems = Systems.of(rows, offsets, target)
    for basis in (None, H):
        x, squares = residuals(systems, basis)
        for s in range(1, 10):
            own = rows[offsets[s] : offsets[s + 1]].astype(float)
            own = own if basis is None else own @ basis.T
            want, norm = nnls(
                np.tile(own, (3, 1)), target[offsets[s] : offsets[s + 1]].T.ravel()
            )
            np.testing.assert_allclose(squares[s], norm**2, rtol=1e-7)
            np.testing.assert_allclose(x[s], want, atol=1e-6 * want.max())
        assert squares[0] == 0  # no samples
    np.testing.assert_array_equal(systems.samples, 3 * np.diff(offsets))
    parts = [Systems(*(x[half] for x in systems)) for half in np.s_[:4, 4:]]
    whole = Systems.joined(parts)
    np.testing.assert_array_equal(whole.gram, systems.gram)


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_factor_reflectance__finds_the_planted_basis(noise):
    rows, offsets, target, H = _problem(np.random.default_rng(1), noise=noise)
    systems = Systems.of(rows, offsets, target)
    bases = factor_reflectance(systems, 5)
    assert [len(basis) for basis in bases] == [1, 2, 3, 4, 5]
    assert all((basis >= 0).all() for basis in bases)
    np.testing.assert_allclose([basis.sum(axis=1) for basis in bases[2:3]], 1.0)
    error = np.sqrt(
        [residuals(systems, basis)[1].sum() / systems.square.sum() for basis in bases]
    )
    truth = np.sqrt(residuals(systems, H)[1].sum() / systems.square.sum())
    assert error[1] > 0.05  # two are not enough
    # the alternation stops 0.2 % short of the truth
    assert error[2] < 1.02 * truth + 2e-3
    assert error[4] <= error[2] + 1e-4


def test_factor_reflectance__finds_narrow_lobes():
    """Each surfel has one of eight BRDFs beside diffuse light, with noise of 1 %. In a
    space of 16 dimensions, the error was 0.5 % above that of the planted ones.
    """
    rng = np.random.default_rng(4)
    dictionary = embedded_dictionary()
    index = np.array([dictionary.names.index(name) for name in NARROW])
    n, lights, cameras = 240, 40, 4
    normal = unit(rng.normal(size=(n, 3)) * [0.6, 0.6, 0.3] + [0, 0, 1])
    to_light, to_camera = (
        unit(
            unit(rng.normal(size=(count, 3)) * [1, 1, 0.5] + [0, 0, 0.7]) * 900
            - 80 * normal[:, None]
        )
        for count in (lights, cameras)
    )
    rows, offsets, pair = basis_rows(
        dictionary.table,
        dictionary.grid,
        normal,
        to_light,
        to_camera,
        np.ones((n, lights, cameras), bool),
    )
    surfel = np.repeat(np.arange(n), np.diff(offsets))
    own = index[surfel % len(index)]
    albedo = directional_albedo(dictionary.table, 1.0)[0]
    gloss = 0.04 * rows[np.arange(len(rows)), own] / albedo[own]
    matte = 0.08 * dots(normal[surfel], to_light[surfel, pair[:, 0]])
    samples = np.repeat((gloss + matte)[:, None], 3, axis=1)
    samples *= 1 + 0.01 * rng.normal(size=samples.shape)
    noise = np.hypot(0.001, 0.02 * samples.mean(axis=1))[:, None]
    systems = Systems.of(rows / noise, offsets, samples / noise, matte[:, None] / noise)
    planted = np.eye(len(dictionary.names))[index]
    found = factor_reflectance(systems, len(index))[-1]
    error, truth = (np.sqrt(residuals(systems, H)[1].sum()) for H in (found, planted))
    assert error < 1.002 * truth  # 1.0000 measured
