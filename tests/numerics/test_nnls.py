"""nnls compared with SciPy's dense solver and a general minimiser, and on extremes that
must give a status.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import minimize, nnls

from skindb.jit import LANES
from skindb.numerics import _nnls_kernels
from skindb.numerics.nnls import solve_nnls
from skindb.reflectance import _mixture_kernels

# normal equations square the condition number: residuals agree to the root of the
# rounding error
ROUNDING = 1e-7


def _problem(seed: int, n: int = 60, m: int = 9):
    rng = np.random.default_rng(seed)
    rows = rng.uniform(0.0, 1.0, (n, m)).astype(np.float32)
    x = np.where(rng.random(m) < 0.5, rng.uniform(0, 1, m), 0)
    clean = rows.astype(np.float64) @ x
    return rows, clean[:, None] * (
        1 + 0.1 * rng.normal(size=(n, 3))
    ) + 0.02 * rng.normal(size=(n, 3))


class Fit(NamedTuple):
    parameters: np.ndarray
    kkt: float
    converged: bool
    residual: float
    residual_perceptual: float


def _relative(found, true):
    size = np.linalg.norm(true)
    return np.linalg.norm(found - true) / size if size else 0.0


def _fit(rows, target, *, mode="linear", floor=1e-2, weight=None, lift=None):
    """Weights of one surfel by `fit_one`, and the RMS residual over that of the samples."""
    n, r = rows.shape
    lift = np.eye(r) if lift is None else lift
    weight = np.ones(n) if weight is None else weight
    width = -(-r // LANES) * LANES
    x = np.zeros(lift.shape[1])
    problem = _mixture_kernels.Problem(
        np.pad(rows, ((0, 0), (0, width - r))),
        np.ascontiguousarray(target.T, np.float32),
        weight.astype(np.float32),
        n,
        lift,
        mode == "perceptual",
        floor,
        1e-10,
    )
    work = _mixture_kernels.fit_memory(n, width, len(x))
    kkt, _, converged, _ = _mixture_kernels.fit_one(problem, x, work)
    predicted = (rows.astype(np.float64) @ lift @ x)[:, None]

    def root(y):
        return y / (y * y + floor * floor) ** (1 / 3)

    return Fit(
        x,
        kkt,
        converged,
        _relative(predicted, target),
        _relative(root(predicted), root(target)),
    )


def test_fit_one__linear_agrees_with_scipy():
    for seed in range(20):
        rows, target = _problem(seed)
        fit = _fit(rows, target)
        M = np.repeat(rows.astype(np.float64), 3, axis=0)
        _, reference = nnls(M, target.ravel())
        assert fit.converged
        assert fit.kkt < 1e-9
        assert np.linalg.norm(M @ fit.parameters - target.ravel()) <= reference * (
            1 + ROUNDING
        )


@pytest.mark.parametrize("apart", [1e-9, 1e-7, 1e-6, 1e-5, 1e-3])
def test_solve_nnls__the_certificate_holds_for_nearly_collinear_columns(apart):
    """Every column has a near copy; the certificate of the solver agrees with its definition."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        a = rng.uniform(size=(60, 8))
        M = np.concatenate([a, a + apart * rng.normal(size=a.shape)], axis=1)[
            :, rng.permutation(16)
        ]
        r = M @ np.where(
            rng.random(16) < 0.3, rng.uniform(size=16), 0
        ) + 0.05 * rng.normal(size=60)
        x, kkt, _, met = solve_nnls((M.T @ M)[None], (M.T @ r)[None])
        w = M.T @ (r - M @ x[0])
        length = np.linalg.norm(M, axis=0)
        true = (np.where(x[0] > 0, abs(w), np.maximum(w, 0)) / length).max() / abs(
            M.T @ r / length
        ).max()
        assert met[0]
        assert kkt[0] < 1e-9
        assert true < kkt[0] + 1e-13  # rounding of the Gram matrix
        assert np.linalg.norm(M @ x[0] - r) <= nnls(M, r)[1] * (1 + ROUNDING)


def test_solve_nnls__not_finite_is_not_a_number():
    gram = np.stack([np.eye(2), np.eye(2)])
    gram[0, 0, 0] = np.nan
    x, _, _, met = solve_nnls(gram, np.ones((2, 2)))
    assert np.isnan(x[0]).all()
    assert not met[0]
    np.testing.assert_allclose(x[1], 1.0)


def _check_minimum(seed):
    rows, target = _problem(seed)
    (n, m), floor = rows.shape, 1e-2
    M = rows.astype(np.float64)

    def root(y):
        return y / (y * y + floor * floor) ** (1 / 3)

    def objective(x):
        return ((root(M @ x)[:, None] - root(target)) ** 2).sum()

    starts = np.random.default_rng(seed).uniform(0, 1, (4, m))
    best = min(
        minimize(objective, s, method="L-BFGS-B", bounds=[(0, None)] * m).fun
        for s in starts
    )
    x = np.zeros(m)
    filled = np.pad(rows, ((0, 0), (0, 7)))
    given = np.ascontiguousarray(target.T, np.float32)
    work = _mixture_kernels.fit_memory(n, 16, m)
    problem = _mixture_kernels.Problem(
        filled, given, np.ones(n, np.float32), n, np.eye(m), True, floor, 1e-10
    )
    _mixture_kernels._fit_roots(problem, x, work)
    assert objective(x) <= best * (1 + 1e-4)  # Gauss-Newton stops at a gain of 1e-6
    # and a last linear step, which may not cost much
    fit = _fit(rows, target, mode="perceptual", floor=floor)
    assert objective(fit.parameters) <= best * 1.01
    assert fit.residual_perceptual == pytest.approx(
        np.sqrt(objective(fit.parameters) / (root(target) ** 2).sum())
    )


def test_fit_roots__reaches_the_minimum():
    """Compared with L-BFGS-B from several starts: never worse by more than its tolerance."""
    for seed in range(5):
        _check_minimum(seed)


def test_fit_one__noise_does_not_bias_the_perceptual_fit():
    """Noise as large as the samples: their mean root is lower than the root of their
    mean, by 10 % and more here.
    """
    rng = np.random.default_rng(31)
    rows = rng.uniform(0.1, 1.0, (300, 2)).astype(np.float32)
    clean = rows.astype(np.float64) @ [0.3, 0.2]
    draws = 100
    floor = 1e-2
    found = np.empty(draws)
    noise = 0.5 * clean.mean()
    for k in range(draws):
        target = clean[:, None] + noise * rng.normal(size=(300, 3))
        found[k] = _fit(
            rows, target, mode="perceptual", floor=floor
        ).parameters @ rows.mean(axis=0)
    off = found.mean() / clean.mean() - 1
    # weights depend on the noise a little
    assert abs(off) < 0.01 + 3 * found.std() / np.sqrt(draws) / clean.mean()


def test_fit_one__weights_of_zero_leave_rows_out():
    rows, target = _problem(1)
    weight = np.ones(len(rows))
    weight[:20] = 0
    kept = _fit(rows[20:], target[20:]).parameters
    np.testing.assert_allclose(
        _fit(rows, target, weight=weight).parameters, kept, rtol=1e-9, atol=1e-12
    )


def test_fit_one__lift_is_the_same_as_the_product():
    rows, target = _problem(2)
    lift = np.random.default_rng(5).uniform(size=(9, 6))
    product = (rows.astype(np.float64) @ lift).astype(np.float32)
    assert _fit(rows, target, lift=lift).residual == pytest.approx(
        _fit(product, target).residual, rel=1e-6
    )


@pytest.mark.parametrize("perceptual", [False, True])
def test_weight_covariance__is_the_sandwich_in_plain_numpy(perceptual):
    rng = np.random.default_rng(12)
    n = 300
    floor = 0.02
    drift = np.array([0.1, 0.2, 0.05])
    rows = (rng.uniform(0, 1, (n, 4)) ** [1, 2, 3, 4]).astype(np.float32)
    target = (rows @ np.array([0.3, 0.2, 0.0, 0.4]) - 0.3 * rows[:, 2])[:, None] * (
        1 + 0.1 * rng.normal(size=(n, 3))
    )
    scattered = rng.uniform(0, 0.1, (3, n))
    work = _mixture_kernels.fit_memory(n + 7, 8, 4)
    x = np.zeros(4)
    covariance = np.empty((4, 4))
    filled = np.pad(rows, ((0, 7), (0, 4)))
    given = np.ascontiguousarray(target.T, np.float32)
    weight = rng.uniform(0.2, 1, n).astype(np.float32)
    problem = _mixture_kernels.Problem(
        filled, given, weight, n, np.eye(4), perceptual, floor, 1e-10
    )
    _mixture_kernels.fit_one(problem, x, work)
    y = rows.astype(np.float64) @ x
    scattered = scattered.astype(np.float32)
    _mixture_kernels.weight_covariance(
        problem,
        y.astype(np.float32),
        scattered,
        drift,
        x,
        1.0,
        covariance,
        work,
    )
    free = x > 0
    assert free.tolist() == [True, True, False, True]

    def root(v):
        return v / np.cbrt(v**2 + floor**2) if perceptual else v

    M = rows[:, free].astype(np.float64)
    h = 1e-6
    slope = (root(y + h) - root(y - h)) / (2 * h)
    square = weight * slope**2
    inverse = np.linalg.inv(3 * (M * square[:, None]).T @ M)
    score = (square * (target - y[:, None]).sum(1))[:, None] * M
    lit = inverse @ (M.T @ (square * (drift @ scattered)))

    expected = inverse @ score.T @ score @ inverse * n / (n - 3) + np.outer(lit, lit)
    # single precision
    np.testing.assert_allclose(covariance[np.ix_(free, free)], expected, rtol=1e-4)
    assert np.isnan(covariance[~free]).all()
    assert np.isnan(covariance[:, ~free]).all()


def test_weight_covariance__collinear_columns_have_none():
    rng = np.random.default_rng(13)
    rows = np.repeat(rng.uniform(0, 1, (50, 1)), 2, axis=1).astype(np.float32)
    work = _mixture_kernels.fit_memory(50, 8, 2)
    covariance = np.empty((2, 2))
    filled = np.pad(rows, ((0, 0), (0, 6)))
    ones = np.ones(50, np.float32)
    given = np.repeat(rows[:, :1].T, 3, axis=0)
    problem = _mixture_kernels.Problem(
        filled, given, ones, 50, np.eye(2), False, 1.0, 1e-10
    )
    _mixture_kernels.fit_one(problem, np.zeros(2), work)
    nothing = np.zeros((3, 50), np.float32), np.zeros(3)
    _mixture_kernels.weight_covariance(
        problem,
        0 * ones,
        *nothing,
        np.full(2, 0.5),
        1.0,
        covariance,
        work,
    )
    assert np.isnan(covariance).all()


def test_solve_nnls__a_shared_system_compiles_nothing_more():
    """Each layout of an array needs its own kernel, 5 s of compiling; a common system
    is passed as a broadcast view.
    """
    gram = np.array([[2.0, 0.5], [0.5, 1.0]])
    rhs = np.array([[1.0, -1.0], [0.2, 0.7]])
    x, *_ = solve_nnls(np.broadcast_to(gram, (2, 2, 2)), rhs)
    np.testing.assert_allclose(x, [[0.5, 0.0], [0.0, 0.7]], atol=1e-12)
    compiled = _nnls_kernels.solve_many.entry.signatures
    # gram, rhs, x
    assert {kind.layout for one in compiled for kind in one[:3]} == {"C"}


# extreme inputs


def _check_against_scipy(rows, target):
    """The fit is certified, and its residual is not above SciPy's on the same rows."""
    fit = _fit(rows, target, floor=1e-3)
    M = np.repeat(rows.astype(np.float64), 3, axis=0)
    residual = np.linalg.norm(M @ fit.parameters - target.ravel())
    assert fit.converged
    assert fit.kkt < 1e-9  # the tolerance of the solver is 1e-10
    assert residual <= nnls(M, target.ravel())[1] * (
        1 + ROUNDING
    ) + 1e-14 * np.linalg.norm(target)


def test_fit_one__few_and_many_samples():
    for n, m in ((1, 6), (3, 6), (12, 59), (2400, 6)):
        _check_against_scipy(*_problem(0, n, m))


@pytest.mark.parametrize("kind", ["zero", "duplicate", "collinear"])
def test_fit_one__redundant_bases(kind):
    rows, target = _problem(0)
    extra = {
        "zero": 0 * rows[:, :1],
        "duplicate": rows[:, :1],
        "collinear": rows[:, :1] + rows[:, 1:2],
    }[kind]
    _check_against_scipy(np.concatenate([rows, extra, extra], axis=1), target)
    extended = _fit(np.concatenate([extra, rows], axis=1), target)
    if kind != "collinear":  # a sum of two bases is a new mixture
        np.testing.assert_allclose(
            extended.residual, _fit(rows, target).residual, rtol=1e-6
        )
    if kind == "zero":
        assert extended.parameters[0] == 0


@pytest.mark.parametrize("mode", ["linear", "perceptual"])
def test_fit_one__black_and_negative_samples_have_no_weight(mode):
    rows, _ = _problem(0, 40)
    for level in (0.0, -1.0):
        fit = _fit(rows, np.full((40, 3), level), mode=mode)
        assert fit.converged
        assert (fit.parameters == 0).all()


def test_solve_nnls__no_systems():
    x, kkt, count, met = solve_nnls(np.zeros((0, 4, 4)), np.zeros((0, 4)))
    assert x.shape == (0, 4)
    assert kkt.shape == count.shape == met.shape == (0,)
