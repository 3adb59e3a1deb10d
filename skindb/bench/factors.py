"""Factorisations of BRDF weights compared with scikit-learn, in the metrics of weights
and of BRDFs.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from sklearn.decomposition import NMF
from sklearn.exceptions import ConvergenceWarning

from skindb.bench.curve import Curve, Point, cpu_time
from skindb.numerics.factorise import nmf, relative_error
from skindb.reflectance.dictionary import embedded_dictionary
from skindb.reflectance.tables import brdf_metric
from skindb.types import Array

K = 6


def nmf_curves(quick: bool) -> list[Curve]:
    """Skindb by number of starts, scikit-learn by iterations; each H is rated in both
    metrics with the best W.
    """
    X, H = _weights(300 if quick else 2000)
    gram = brdf_metric(embedded_dictionary().table)
    gram /= np.trace(gram)
    metrics = {"weights": np.eye(len(gram)), "BRDFs": gram}
    found = [("planted", "", np.nan, H)]
    nmf(X[:20], 2, metric=gram, seeds=0, rng=_rng())  # compiles
    for name, metric in (("weights", None), ("BRDFs", gram)):
        for seeds in (0,) if quick else (0, 3, 8):
            took, factors = cpu_time(
                lambda m=metric, s=seeds: nmf(X, K, metric=m, seeds=s, rng=_rng())  # type: ignore[misc]
            )
            found.append(
                (f"skindb between {name}", f"{1 + seeds} starts", took, factors.H)
            )
    for solver in ("cd", "mu"):
        for steps in (10, 200) if quick else (10, 50, 200, 1000):
            took, rows = cpu_time(lambda s=solver, n=steps: _scikit(X, s, n))  # type: ignore[misc]
            found.append((f"scikit-learn {solver}", f"{steps} iterations", took, rows))
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
                Point(method, at, took, relative_error(X, rows, metric))
                for method, at, took, rows in found
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
