"""Stress cases of fits with all BRDFs and with a reduced basis, which must return the
planted weights or a status.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from skindb.bench.case import SCALES, Case, close, each, expect
from skindb.bench.stress.surfels import (
    WEIGHT,
    filled,
    first,
    rows,
    six,
    spoiled,
    surfels,
    weights,
)
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.reduction import reduce_dictionary
from skindb.schema import FitStatus
from skindb.schema.status import LARGEST_R_D, SMALLEST_R_D

Array = NDArray[Any]
# error for samples in single precision: positions in a table to 1e-6, times the slope
# of its lobes
SINGLE = 1e-4
TOTAL = 1e-6  # relative: rounding of samples in single precision
MODES = ("linear", "perceptual")

# surface


def _recovers(mode: str) -> None:
    skin = surfels(150, 16)
    found = weights(skin, mode)
    expect(
        (found.status == FitStatus.FITTED).all() and (found.samples == 2400).all(),
        (found.status, found.samples),
    )
    expect(found.residual.max() < SINGLE, found.residual)
    for s in range(3):
        M, _ = rows(skin, s)
        close(
            M @ found.parameters[s], M @ WEIGHT, atol=SINGLE * np.abs(M @ WEIGHT).max()
        )


def _few(lights: int, cameras: int) -> None:
    skin = surfels(lights, cameras)
    # channels disagree
    skin = replace(
        skin, sample=skin.sample * np.linspace(0.9, 1.1, 3, dtype=np.float32)
    )
    refused = weights(skin)
    expect(
        (refused.status == FitStatus.TOO_FEW_SAMPLES).all()
        and np.isnan(refused.parameters).all(),
        refused.status,
    )
    found = weights(skin, min_samples=1)
    for s in range(3):
        M, target = rows(skin, s)
        theirs = nnls(np.repeat(M, 3, 0), target.ravel())[1]
        ours = np.linalg.norm((M @ found.parameters[s])[:, None] - target)
        expect(ours <= theirs + SINGLE * np.linalg.norm(target), (ours, theirs))


def _unseen_surfel(mode: str) -> None:
    skin = surfels()
    found = weights(spoiled(skin, filled(np.nan)), mode)
    whole = weights(skin, mode)
    expect(
        found.status.tolist() == [FitStatus.UNSEEN, 0, 0]
        and np.isnan(found.parameters[0]).all(),
        found.status,
    )
    np.testing.assert_array_equal(found.parameters[1:], whole.parameters[1:])


def _infinite(bad: float) -> None:
    found = weights(first(surfels(), bad))
    whole = weights(surfels())
    expect(
        found.status.tolist() == [FitStatus.NOT_FINITE, 0, 0]
        and np.isnan(found.parameters[0]).all(),
        found.status,
    )
    np.testing.assert_array_equal(found.parameters[1:], whole.parameters[1:])


def _one_nan() -> None:
    """A sample that lacks one channel is excluded, and the weights are still recovered."""
    found = weights(first(surfels(), np.nan))
    expect(found.samples.tolist() == [239, 240, 240], found.samples)
    expect(found.residual.max() < SINGLE, found.residual)


def _geometry_nan(field: str, status: FitStatus) -> None:
    skin = surfels()
    spoiled = getattr(skin, field).copy()
    spoiled[0] = np.nan
    found = weights(replace(skin, **{field: spoiled}))
    whole = weights(skin)
    expect(
        found.status.tolist() == [status, 0, 0] and np.isnan(found.parameters[0]).all(),
        found.status,
    )
    np.testing.assert_array_equal(found.parameters[1:], whole.parameters[1:])


def _black_surfel(mode: str) -> None:
    found = weights(spoiled(surfels(), filled(0.0)), mode)
    expect(
        found.status[0] == FitStatus.FITTED and (found.parameters[0] == 0).all(),
        (found.status[0], found.parameters[0]),
    )


def _matte(eta: float) -> None:
    skin = surfels(eta=eta, weight=0 * WEIGHT)
    found = weights(skin, eta=eta)
    expect(
        found.residual.max() < TOTAL and np.abs(found.parameters).max() < SINGLE,
        (found.residual, found.parameters),
    )


def _albedo_bound(value: float) -> None:
    skin = surfels()
    diffuse = skin.diffuse.astype(np.float32)  # as it is stored
    diffuse[0] = value
    found = weights(replace(skin, diffuse=diffuse))
    expect(found.status.tolist() == [FitStatus.DIFFUSE_CLAMPED, 0, 0], found.status)
    expect(
        np.isfinite(found.parameters).all() and (found.parameters >= 0).all(),
        found.parameters,
    )


def _grazing_lights() -> None:
    """Lights 3 degrees above the horizon are ignored, whatever their samples."""
    skin = surfels()
    low = 900 * np.array([[np.cos(a), np.sin(a), 0.05] for a in (0.1, 2.0, 4.0)])
    wild = np.full((3, 3, *skin.sample.shape[2:]), 50.0, np.float32)
    flat = replace(skin, normal=np.tile([0.0, 0, 1], (3, 1)), position=np.zeros((3, 3)))
    more = replace(
        flat,
        light=np.concatenate([skin.light, low]),
        sample=np.concatenate([skin.sample, wild], axis=1),
    )
    close(weights(more).parameters, weights(flat).parameters, rtol=1e-9, atol=1e-12)


def _behind() -> None:
    """Lights and cameras behind the surfel are ignored, whatever their samples."""
    skin = surfels()
    wild = np.full((3, 2, *skin.sample.shape[2:]), 50.0, np.float32)
    behind = np.concatenate([skin.light, [[0.0, 0, -900], [100, 0, -900]]])
    more = replace(
        skin, light=behind, sample=np.concatenate([skin.sample, wild], axis=1)
    )
    close(weights(more).parameters, weights(skin).parameters, rtol=1e-9, atol=1e-12)


def _precision(dtype: str) -> None:
    skin = surfels()
    half = skin.sample.astype(np.float16)  # values that are exact in every precision
    found, want = (
        weights(replace(skin, sample=half.astype(t))) for t in (dtype, np.float16)
    )
    # only the mixed reflectance is determined, not the weights of similar materials
    for s in range(3):
        M, _ = rows(skin, s)
        close(
            M @ found.parameters[s],
            M @ want.parameters[s],
            atol=1e-5 * np.abs(M @ WEIGHT).max(),
        )


def _extra_tables(change: str) -> None:
    extra = {"zero": 0 * six()[..., :1], "duplicate": six()[..., :1]}
    extra["collinear"] = six()[..., :1] + six()[..., 1:2]
    both = np.concatenate([extra[change], six(), extra[change]], axis=-1)
    found = weights(surfels(), model=Mixture(both))
    expect(
        (found.status == FitStatus.FITTED).all() and found.kkt.max() < 1e-9,
        (found.status, found.kkt),
    )
    expect(found.residual.max() < SINGLE, found.residual)
    if change == "zero":
        expect((found.parameters[:, [0, 7]] == 0).all(), found.parameters)


def _rank_above() -> None:
    reduced, lift = reduce_dictionary(six(), 99)
    found = weights(surfels(), model=Mixture(reduced, lift))
    close(found.parameters, weights(surfels()).parameters, rtol=1e-12)


def _rank_of_one_material() -> None:
    """Six tables that are multiples of one lie in a space of four dimensions, and fits
    are finite and correct.
    """
    one = six()[..., :1] * np.geomspace(0.5, 4, 6, dtype=np.float32)
    reduced, lift = reduce_dictionary(np.ascontiguousarray(one), 4)
    skin = surfels(weight=np.array([0.4, 0, 0, 0, 0, 0]))
    found = weights(skin, model=Mixture(reduced, lift))
    expect(
        (found.status == FitStatus.FITTED).all() and found.residual.max() < SINGLE,
        (found.status, found.residual),
    )


def _no_surfels() -> None:
    skin = surfels()
    empty = replace(
        skin,
        **{
            f: getattr(skin, f)[:0] for f in ("sample", "position", "normal", "diffuse")
        },
    )
    expect(weights(empty).parameters.shape == (0, 6), weights(empty).parameters.shape)


# refit


def _basis(*columns: Array) -> Mixture:
    table = np.stack([six() @ c.astype(np.float32) for c in columns], axis=-1)
    return Mixture(table)


def _true_mixture(mode: str) -> None:
    found = weights(surfels(), mode, _basis(WEIGHT))
    close(found.parameters, 1.0, rtol=SINGLE)
    expect(found.residual.max() < SINGLE, found.residual)


def _twins(mode: str) -> None:
    found = weights(surfels(), mode, _basis(WEIGHT, WEIGHT, 0 * WEIGHT))
    close(found.parameters[:, :2].sum(axis=1), 1.0, rtol=SINGLE)
    expect(
        (found.parameters[:, 2] == 0).all() and (found.status == 0).all(),
        (found.parameters, found.status),
    )


def _scaled_basis(scale: float) -> None:
    found = weights(surfels(), model=_basis(WEIGHT * scale))
    close(found.parameters * scale, 1.0, rtol=SINGLE)


def _refit_nothing() -> None:
    found = weights(spoiled(surfels(), filled(np.nan)), model=_basis(WEIGHT))
    expect(
        found.status.tolist() == [FitStatus.UNSEEN, 0, 0]
        and np.isnan(found.residual[0]),
        found.status,
    )


SURFACE = (
    *each(
        "surface",
        "2400 samples, {}",
        "The planted weights are recovered.",
        _recovers,
        *MODES,
    ),
    *each(
        "surface",
        "{} light(s), {} camera",
        "Too few samples are refused; with a lower limit, no worse than SciPy.",
        _few,
        (1, 1),
        (3, 1),
    ),
    *each(
        "surface",
        "all saturated, {}",
        "Weights are NaN with a status; neighbours are identical.",
        _unseen_surfel,
        *MODES,
    ),
    *each(
        "surface",
        "a sample is {}",
        "Weights are NaN with a status; neighbours are identical.",
        _infinite,
        np.inf,
        -np.inf,
    ),
    Case(
        "surface",
        "a sample is NaN",
        "The sample is excluded, and nothing else changes.",
        _one_nan,
    ),
    *each(
        "surface",
        "{} is NaN: {!r}",
        "The status gives the reason; neighbours are identical.",
        _geometry_nan,
        ("position", FitStatus.NOT_FINITE),
        ("normal", FitStatus.TOO_FEW_SAMPLES),
        ("diffuse", FitStatus.NO_DIFFUSE_ESTIMATE),
    ),
    *each(
        "surface", "all black, {}", "Weights are exactly zero.", _black_surfel, *MODES
    ),
    *each(
        "surface",
        "matte skin, eta {}",
        "Weights of the surface are zero.",
        _matte,
        1.0,
        1.3,
        1.5,
    ),
    *each(
        "surface",
        "R_d {:g}",
        "Weights are flagged as clamped, finite and not negative.",
        _albedo_bound,
        SMALLEST_R_D,
        LARGEST_R_D,
    ),
    Case("surface", "grazing lights", "Their samples are ignored.", _grazing_lights),
    Case("surface", "lights behind", "Their samples are ignored.", _behind),
    *each(
        "surface",
        "{} samples",
        "Reflectance is the same as from half floats.",
        _precision,
        "float32",
        "float64",
    ),
    *each(
        "surface",
        "{} tables",
        "The fit is certified and exact, and zero tables have zero weight.",
        _extra_tables,
        "zero",
        "duplicate",
        "collinear",
    ),
    Case(
        "surface",
        "rank above the bases",
        "The weights are those of the exact tables.",
        _rank_above,
    ),
    Case(
        "surface",
        "rank above that of the tables",
        "The fit is finite and correct.",
        _rank_of_one_material,
    ),
    Case(
        "surface",
        "no surfels",
        "Arrays are empty and have the right shapes.",
        _no_surfels,
    ),
    *each(
        "refit",
        "one component, {}",
        "A surfel made from the component has weight one.",
        _true_mixture,
        *MODES,
    ),
    *each(
        "refit",
        "k above the rank, {}",
        "Duplicates divide the weight, a black component has none.",
        _twins,
        *MODES,
    ),
    *each(
        "refit",
        "component times {:g}",
        "Weights are divided by it.",
        _scaled_basis,
        *SCALES,
    ),
    Case("refit", "all saturated", "Weights are NaN with a status.", _refit_nothing),
)
