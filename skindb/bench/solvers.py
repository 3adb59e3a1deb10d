"""Factorisations and non-negative least squares: curves compared with scikit-learn, and
stress cases.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from scipy.optimize import nnls
from sklearn.decomposition import NMF
from sklearn.exceptions import ConvergenceWarning

from skindb.bench.case import SCALES, close, expect, stress_cases
from skindb.bench.curve import Curve, Point, cpu_time
from skindb.numerics.factorise import nmf, relative_error
from skindb.numerics.nnls import solve_nnls
from skindb.reflectance.dictionary import embedded_dictionary
from skindb.reflectance.rows import ReflectanceFit, fit_reflectance
from skindb.reflectance.tables import brdf_metric
from skindb.types import Array

K = 6
# normal equations square the condition: residuals agree to the root of the rounding
# error
ROUNDING = 1e-7
# of weights up to 0.5: rows and sums of a surfel are in single precision, and scales no
# powers of two
SINGLE = 2e-5
KKT = 1e-9  # largest KKT residual of a solution; the tolerance of the solver is 1e-10
MODES = ("linear", "perceptual")
SPACES = ("weights", "metric")
BOTH = [(mode, s) for mode in MODES for s in SCALES]


def nmf_curves(quick: bool) -> list[Curve]:
    """Skindb by number of starts, scikit-learn by iterations; each H is rated in both
    metrics with the best W.
    """
    X, H = _weights(300 if quick else 2000)
    gram = brdf_metric(embedded_dictionary().table)
    gram /= np.trace(gram)
    metrics = {"weights": np.eye(len(gram)), "BRDFs": gram}
    results = [("planted", "", np.nan, H)]
    nmf(X[:20], 2, metric=gram, seeds=0, rng=_rng())  # compiles
    for name, metric in (("weights", None), ("BRDFs", gram)):
        for seeds in (0,) if quick else (0, 3, 8):
            took, factors = cpu_time(
                lambda m=metric, s=seeds: nmf(X, K, metric=m, seeds=s, rng=_rng())  # type: ignore[misc]
            )
            results.append(
                (f"skindb between {name}", f"{1 + seeds} starts", took, factors.H)
            )
    for solver in ("cd", "mu"):
        for steps in (10, 200) if quick else (10, 50, 200, 1000):
            took, rows = cpu_time(lambda s=solver, n=steps: _scikit(X, s, n))  # type: ignore[misc]
            results.append(
                (f"scikit-learn {solver}", f"{steps} iterations", took, rows)
            )
    reference = (
        f"{len(X)} planted mixtures of {K} with 20 % scatter, so that the error cannot "
        "be zero"
    )
    return [
        Curve(
            "nmf",
            f"|X - W H| / |X| between {name}",
            reference,
            "a factorisation",
            "scikit-learn cd, 200 iterations",
            tuple(
                Point(method, setting, took, relative_error(X, rows, metric))
                for method, setting, took, rows in results
            ),
        )
        for name, metric in metrics.items()
    ]


def _rng() -> np.random.Generator:
    return np.random.default_rng(1)


def _weights(n: int) -> tuple[Array, Array]:
    """Weights (n, 59), mixtures of K sparse rows H with scatter like that of similar
    BRDFs, and H.
    """
    rng = np.random.default_rng(0)
    H = np.where(rng.random((K, 59)) < 0.2, rng.uniform(0.2, 1, (K, 59)), 0)
    H[:, :K] += np.eye(K)
    X = rng.gamma(0.7, 1.0, (n, K)) @ H
    return X * rng.lognormal(0, 0.2, X.shape), H


def _scikit(X: Array, solver: str, steps: int) -> Any:
    model = NMF(
        K, init="nndsvda", solver=solver, max_iter=steps, tol=1e-6, random_state=0
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model.fit(X)
    return model.components_


def _rows(n: int, m: int = 6, seed: int = 0) -> tuple[Array, Array]:
    """Rows (n, m) float32 and noisy samples (n, 3) of a sparse mixture."""
    rng = np.random.default_rng(seed)
    rows = rng.uniform(0.05, 1.0, (n, m)).astype(np.float32)
    clean = rows.astype(np.float64) @ np.where(np.arange(m) % 2, 0.0, 0.5)
    return rows, clean[:, None] * (1 + 0.05 * rng.normal(size=(n, 3)))


def _fit(
    rows: Array,
    target: Array,
    mode: Any = "linear",
    floor: float = 1e-3,
    least: int = 1,
) -> ReflectanceFit:
    eye = np.eye(rows.shape[1])
    return fit_reflectance(
        rows,
        np.array([0, len(rows)]),
        target,
        None,
        eye,
        mode=mode,
        noise_floor=floor,
        min_samples=least,
    )


def _as_scipy(rows: Array, target: Array) -> None:
    """Check that the fit is certified and that its residual is not above SciPy's on the
    same rows.
    """
    fit = _fit(rows, target)
    M = np.repeat(rows.astype(np.float64), 3, axis=0)
    expect(fit.status[0] == 0 and fit.kkt[0] < KKT, (fit.status, fit.kkt))
    ours = np.linalg.norm(M @ fit.weight[0] - target.ravel())
    theirs = nnls(M, target.ravel())[1]
    expect(
        ours <= theirs * (1 + ROUNDING) + 1e-14 * np.linalg.norm(target), (ours, theirs)
    )


def _no_rows() -> None:
    fit = _fit(np.zeros((0, 6), np.float32), np.zeros((0, 3)))
    expect(fit.status[0] == 2 and np.isnan(fit.weight).all(), (fit.status, fit.weight))


def _few_are_refused() -> None:
    fit = _fit(*_rows(9), least=10)
    expect(fit.status[0] == 2 and np.isnan(fit.weight).all(), (fit.status, fit.weight))


def _columns(change: str) -> None:
    rows, target = _rows(60)
    extra = {
        "zero": 0 * rows[:, :1],
        "duplicate": rows[:, :1],
        "collinear": rows[:, :1] + rows[:, 1:2],
    }[change]
    _as_scipy(np.concatenate([rows, extra, extra], axis=1), target)
    extended = _fit(np.concatenate([extra, rows], axis=1), target)
    less = _fit(rows, target)
    # a redundant column does not change the residual (a collinear one may, as it is a new mixture)
    if change != "collinear":
        close(extended.residual, less.residual, rtol=1e-6)
    if change == "zero":
        expect(extended.weight[0, 0] == 0, extended.weight)


def _scaled_rows(mode: str, scale: float) -> None:
    rows, target = _rows(60)
    want = _fit(rows, target, mode).weight
    close(
        _fit((rows * np.float32(scale)), target, mode).weight * scale, want, atol=SINGLE
    )


def _scaled_samples(mode: str, scale: float) -> None:
    rows, target = _rows(60)
    want = _fit(rows, target, mode).weight
    close(
        _fit(rows, target * scale, mode, 1e-3 * scale).weight / scale, want, atol=SINGLE
    )


def _scaled_columns(scale: float) -> None:
    rows, target = _rows(60)
    factor = np.geomspace(1, scale, rows.shape[1])
    M = np.repeat(rows.astype(np.float64), 3, axis=0) * factor
    r = target.ravel()
    x, kkt, _, met = solve_nnls((M.T @ M)[None], (M.T @ r)[None])
    expect(met[0] and kkt[0] < KKT, kkt)
    ours = np.linalg.norm(M @ x[0] - r)
    theirs = nnls(M / factor, r)[1]
    expect(ours <= theirs * (1 + ROUNDING), (ours, theirs))


def _not_finite(mode: str, bad: float) -> None:
    rows, target = _rows(40)
    both = np.concatenate([rows, rows])
    offsets = np.array([0, 40, 80])
    spoiled = np.concatenate([target, target])
    spoiled[3, 1] = bad
    fit = fit_reflectance(
        both,
        offsets,
        spoiled,
        None,
        np.eye(6),
        mode=mode,  # type: ignore[arg-type]
        noise_floor=1e-3,
    )
    expect(fit.status.tolist() == [6, 0] and np.isnan(fit.weight[0]).all(), fit.status)
    close(fit.weight[1], _fit(rows, target, mode).weight[0], rtol=1e-12)


def _black(mode: str, level: float) -> None:
    rows, _ = _rows(40)
    fit = _fit(rows, np.full((40, 3), level), mode)
    expect(fit.status[0] == 0 and (fit.weight == 0).all(), (fit.status, fit.weight))


def _single_precision() -> None:
    rows, target = _rows(60)
    close(
        _fit(rows, target.astype(np.float32)).weight,
        _fit(rows, target).weight,
        rtol=1e-5,
        atol=1e-6,
    )


def _more_bases_than_samples() -> None:
    _as_scipy(*_rows(12, m=59))


def _empty_batch() -> None:
    x, kkt, count, met = solve_nnls(np.zeros((0, 4, 4)), np.zeros((0, 4)))
    expect(x.shape == (0, 4) and kkt.shape == count.shape == met.shape == (0,), x.shape)


def _planted(n: int = 200, m: int = 12, k: int = 3) -> Array:
    rng = np.random.default_rng(4)
    H = np.where(rng.random((k, m)) < 0.4, rng.uniform(0.2, 1, (k, m)), 0)
    H[:, :k] += np.eye(k)
    return rng.gamma(0.7, 1.0, (n, k)) @ H


def _factors(X: Array, k: int, metric: Array | None = None) -> Any:
    factors = nmf(X, k, metric=metric, seeds=1, rng=np.random.default_rng(0))
    expect(np.isfinite(factors.H).all() and (factors.H >= 0).all(), factors.H)
    close(factors.H.sum(axis=1), 1.0, rtol=1e-9)
    return factors


def _above_the_rank(space: str) -> None:
    A = np.eye(12) if space == "metric" else None
    expect(
        _factors(_planted(k=2), 4, A).error < 0.02, _factors(_planted(k=2), 4, A).error
    )


def _above_the_size() -> None:
    for shape in ((2, 12), (12, 2)):
        try:
            nmf(np.ones(shape), 3, rng=np.random.default_rng(0))
        except ValueError as error:
            expect("k = 3" in str(error), error)
        else:
            raise AssertionError("found a basis of 3 in a space of 2")


def _scaled_weights(scale: float) -> None:
    X = _planted()
    # starts are in single precision
    close(_factors(X * scale, 3).H, _factors(X, 3).H, atol=1e-3)
    close(_factors(X * scale, 3).error, _factors(X, 3).error, rtol=0.05, atol=1e-4)


def _scaled_in_metric(scale: float) -> None:
    X = _planted()
    A = np.eye(12) + 0.5
    close(_factors(X * scale, 3, A).H, _factors(X, 3, A).H, atol=1e-3)
    close(_factors(X, 3, A * scale).H, _factors(X, 3, A).H, atol=1e-3)


def _one_surfel(space: str) -> None:
    X = _planted(1)
    close(
        _factors(X, 1, np.eye(12) if space == "metric" else None).H,
        X / X.sum(),
        atol=1e-6,
    )


def _constant(space: str) -> None:
    factors = _factors(
        np.full((30, 12), 0.7), 1, np.eye(12) if space == "metric" else None
    )
    close(factors.H, 1 / 12, rtol=1e-5)
    expect(factors.error < 1e-5, factors.error)


def _nothing() -> None:
    factors = _factors(np.zeros((5, 4)), 2)
    close(factors.H, 0.25)
    expect(factors.error == 0, factors.error)


def _idle_rows_and_columns(space: str) -> None:
    X = np.zeros((210, 14))
    X[:200, :12] = _planted()
    A = np.eye(14) if space == "metric" else None
    factors = _factors(X, 3, A)
    expect(factors.H[:, 12:].max() < 1e-9, factors.H[:, 12:].max())
    expect(factors.error < 0.02, factors.error)


def _zero_basis_in_metric() -> None:
    A = np.diag([1.0] * 11 + [0.0])
    X = _planted()
    expect(_factors(X, 3, A).error < 0.02, _factors(X, 3, A).error)


def _bad_weights(bad: float) -> None:
    X = _planted()
    X[3, 3] = bad
    try:
        nmf(X, 2, rng=np.random.default_rng(0))
    except ValueError as error:
        expect("finite and non-negative" in str(error), error)
    else:
        raise AssertionError("found a factorisation")


def _duplicates() -> None:
    """Duplicated surfels or columns give the same components, divided between the duplicates."""
    X = _planted()
    twice = _factors(np.concatenate([X, X]), 3)
    close(twice.error, _factors(X, 3).error, atol=5e-3)
    both = _factors(np.concatenate([X, X], axis=1) / 2, 3)
    close(both.H[:, :12], both.H[:, 12:], atol=5e-3)


def _samples(n: int) -> None:
    _as_scipy(*_rows(n))


SOLVERS = (
    *stress_cases(
        "surface",
        ("solver: 0 samples", "Nothing is fitted, and the status says so.", _no_rows),
        (
            "solver: fewer than required",
            "Too few samples give a status, not a fit.",
            _few_are_refused,
        ),
        (
            "solver: {} samples",
            "Certified, and no worse than SciPy.",
            _samples,
            (
                1,
                3,
                2400,
            ),
        ),
        (
            "solver: {} bases",
            "No worse than SciPy; redundant bases change nothing.",
            _columns,
            (
                "zero",
                "duplicate",
                "collinear",
            ),
        ),
        (
            "solver: {}, bases times {:g}",
            "Weights are divided by it.",
            _scaled_rows,
            BOTH,
        ),
        (
            "solver: {}, samples times {:g}",
            "Weights are multiplied by it.",
            _scaled_samples,
            BOTH,
        ),
        (
            "solver: bases from 1 to {:g}",
            "No worse than SciPy on equal scales.",
            _scaled_columns,
            SCALES,
        ),
        (
            "solver: {}, a sample is {}",
            "Its surfel is NaN with a status; its neighbour is unchanged.",
            _not_finite,
            ((mode, bad) for mode in MODES for bad in (np.nan, np.inf, -np.inf)),
        ),
        (
            "solver: {}, all samples {:g}",
            "Black and negative samples give weights of exactly zero.",
            _black,
            ((mode, level) for mode in MODES for level in (0.0, -1.0)),
        ),
        (
            "solver: single precision",
            "Weights are the same to rounding.",
            _single_precision,
        ),
        (
            "solver: 59 bases, 12 samples",
            "Certified, and no worse than SciPy.",
            _more_bases_than_samples,
        ),
        (
            "solver: no surfels",
            "Arrays are empty and have the right shapes.",
            _empty_batch,
        ),
    ),
    *stress_cases(
        "nmf",
        (
            "k above the rank, {}",
            "The error is small; spare components are valid.",
            _above_the_rank,
            SPACES,
        ),
        ("k above a side", "Refused with the rule.", _above_the_size),
        (
            "weights times {:g}",
            "Basis and relative error are unchanged.",
            _scaled_weights,
            SCALES,
        ),
        (
            "in the metric, times {:g}",
            "The basis is unchanged.",
            _scaled_in_metric,
            SCALES,
        ),
        ("one surfel, {}", "The basis is its own reflectance.", _one_surfel, SPACES),
        (
            "constant, {}",
            "The component is the constant, without error.",
            _constant,
            SPACES,
        ),
        ("weights of zero", "The basis is uniform, without error.", _nothing),
        (
            "unused rows, {}",
            "Unused BRDFs have no weight in the basis.",
            _idle_rows_and_columns,
            SPACES,
        ),
        (
            "a BRDF of zero",
            "A singular metric still gives a basis.",
            _zero_basis_in_metric,
        ),
        (
            "a weight is {}",
            "Refused with the rule.",
            _bad_weights,
            (
                np.nan,
                np.inf,
                -1.0,
            ),
        ),
        (
            "duplicates",
            "Components are the same, divided equally between duplicates.",
            _duplicates,
        ),
    ),
)
