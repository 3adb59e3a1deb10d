"""evaluate against the formula of the paper with SciPy's interpolation of the stored tables."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy.interpolate import RegularGridInterpolator

from skindb.errors import InputError
from skindb.optics.angles import half_difference
from skindb.reflectance.tables import TableGrid, brdf_coords, stored_brdf
from skindb.render import evaluate, evaluate_error
from skindb.schema import FitStatus, dataset

ETA = 1.35
GRID = TableGrid(12, 10, 6)
# values, weights and tables are in single precision, and cells are interpolated twice
SINGLE = 2e-5


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def model() -> xr.DataTree:
    """Six surfels with random normals, colours and weights of two random tables; the
    fourth was not fitted.
    """
    rng = np.random.default_rng(3)
    n = 6
    status = np.zeros(n)
    status[3] = FitStatus.UNSEEN
    fitted = {
        "shading_normal": _unit(rng.normal(size=(n, 3))),
        "diffuse_reflectance": rng.uniform(0.1, 0.7, (n, 3)),
        "basis_weight": rng.uniform(0, 0.3, (n, 2)),
        "fit_status": status,
        "refractive_index": ETA,
    }
    tables = rng.uniform(0, 1, (GRID.n_theta_h, GRID.n_theta_d, GRID.n_phi_d, 2))
    basis = {"basis_brdf": stored_brdf(tables), "disc_angular_radius": 0.0}
    groups = {
        "/fitted": dataset(fitted),
        "/basis": dataset(basis, coords=brdf_coords(GRID)),
    }
    return xr.DataTree.from_dict(groups)


def _pairs(model, surfel, count=400, seed=1):
    """Unit directions above the horizon of a surfel's normal."""
    rng = np.random.default_rng(seed)
    normal = model["fitted/shading_normal"].values[surfel].astype(float)
    wi, wo = _unit(rng.normal(size=(2, count, 3)))
    return tuple(np.where((w @ normal)[:, None] < 0, -w, w) for w in (wi, wo))


def _transmittance(cosine):
    """Fresnel by Snell's law and the two polarisations."""
    t = np.sqrt(1 - (1 - cosine**2) / ETA**2)
    s = (cosine - ETA * t) / (cosine + ETA * t)
    p = (t - ETA * cosine) / (t + ETA * cosine)
    return 1 - (s**2 + p**2) / 2


def _oracle(model, surfel, wi, wo):
    fitted = model["fitted"]
    basis = model["basis"]
    normal = _unit(fitted["shading_normal"].values[surfel].astype(float))
    nodes = tuple(basis[name].values for name in ("theta_h", "theta_d", "phi_d"))
    angles = half_difference(wi, wo, np.broadcast_to(normal, wi.shape))
    surface = 0.0
    for k, weight in enumerate(fitted["basis_weight"].values[surfel]):
        # nodes are uniform in the root of theta_h, and values linear in it
        table = RegularGridInterpolator(
            (np.sqrt(nodes[0]), *nodes[1:]), basis["basis_brdf"].values[k].astype(float)
        )
        surface = surface + weight * table(
            np.stack([np.sqrt(angles[0]), *angles[1:]], axis=-1)
        )
    through = _transmittance(wi @ normal) * _transmittance(wo @ normal) / np.pi
    return (
        through[:, None] * fitted["diffuse_reflectance"].values[surfel]
        + surface[:, None]
    )


@pytest.mark.parametrize("surfel", [0, 1, 5])
def test_evaluate__is_the_formula(model, surfel):
    wi, wo = _pairs(model, surfel)
    found = evaluate(model, surfel, wi, wo)
    assert found.shape == (400, 3)
    assert found.min() > 0
    np.testing.assert_allclose(found, _oracle(model, surfel, wi, wo), rtol=SINGLE)


def test_evaluate__is_reciprocal(model):
    wi, wo = _pairs(model, 2)
    np.testing.assert_allclose(
        evaluate(model, 2, wi, wo), evaluate(model, 2, wo, wi), rtol=SINGLE
    )


def test_evaluate__is_zero_below_the_horizon(model):
    wi, wo = _pairs(model, 0, 50)
    assert (evaluate(model, 0, -wi, wo) == 0).all()
    assert (evaluate(model, 0, wi, -wo) == 0).all()
    assert (evaluate(model, 0, -wi, -wo) == 0).all()


@pytest.mark.slow
def test_evaluate__broadcasts_and_takes_one_pair(model):
    wi, wo = _pairs(model, 1, 12)
    every = evaluate(model, 1, wi[:, None], wo[:5])
    assert every.shape == (12, 5, 3)
    np.testing.assert_array_equal(every[7, 4], evaluate(model, 1, wi[7], wo[4]))
    assert evaluate(model, 1, wi[:0], wo[0]).shape == (0, 3)


def test_evaluate__is_the_same_for_a_lazy_model(model):
    lazy = model.chunk({"surfel": 2})
    wi, wo = _pairs(model, 1, 12)
    np.testing.assert_array_equal(evaluate(lazy, 1, wi, wo), evaluate(model, 1, wi, wo))


SEEN = 20.0  # degrees, of the surfels of `with_errors`


@pytest.fixture(scope="module")
def with_errors(model) -> xr.DataTree:
    """The model with errors and a smallest measured half angle."""
    rng = np.random.default_rng(4)
    n = model["fitted"].sizes["surfel"]
    errors = {
        "diffuse_reflectance_total_error": rng.uniform(0.01, 0.05, (n, 3)),
        "surface_reflectance": np.full(n, 0.04),
        "surface_reflectance_error": rng.uniform(0.001, 0.01, n),
        "fit_residual": rng.uniform(0.01, 0.1, n),
        "smallest_half_angle": np.full(n, SEEN),
    }
    fitted = model["fitted"].to_dataset().merge(dataset(errors))
    return xr.DataTree.from_dict(
        {"fitted": fitted, "basis": model["basis"].to_dataset()}
    )


def _at_half_angle(normal, theta_h, count=300, seed=5):
    """Pairs with a half angle, whose directions stay above the horizon when it becomes SEEN."""
    rng = np.random.default_rng(seed)
    frame = np.linalg.svd(normal[None])[2]
    frame[0] = normal
    frame[1] = np.cross(frame[2], normal)
    theta_d, phi_h, phi_d = rng.uniform(
        [[0.1], [0], [0]], [[1.0], [6], [6]], (3, count)
    )
    spin = np.exp(1j * phi_h)
    pair = []
    for sign in (1, -1):
        x, y, z = (
            sign * np.sin(theta_d) * np.cos(phi_d),
            sign * np.sin(theta_d) * np.sin(phi_d),
            np.cos(theta_d),
        )
        turned = np.cos(theta_h) * x + np.sin(theta_h) * z
        z = np.cos(theta_h) * z - np.sin(theta_h) * x
        plane = (turned + 1j * y) * spin
        pair.append(np.stack([z, plane.real, plane.imag], axis=-1) @ frame)
    return pair


@pytest.mark.parametrize("theta_h", [5.0, 25.0])
def test_evaluate_error__is_the_sum_of_its_parts(with_errors, theta_h):
    """The same pairs at the measured half angle are made independently by spherical
    coordinates; above it nothing is extrapolated.
    """
    surfel = 1
    fitted = with_errors["fitted"].isel(surfel=surfel)
    normal = _unit(fitted["shading_normal"].values.astype(float))
    wi, wo = _at_half_angle(normal, np.radians(theta_h))
    through = _transmittance(wi @ normal) * _transmittance(wo @ normal) / np.pi
    total = _oracle(with_errors, surfel, wi, wo)
    diffuse = through[:, None] * fitted["diffuse_reflectance"].values
    measured = _at_half_angle(normal, np.radians(max(theta_h, SEEN)))
    seen_diffuse = np.prod([_transmittance(w @ normal) for w in measured], axis=0)
    seen = _oracle(with_errors, surfel, *measured) - (
        seen_diffuse[:, None] / np.pi * fitted["diffuse_reflectance"].values
    )
    gloss = total - diffuse
    want = (
        (through[:, None] * fitted["diffuse_reflectance_total_error"].values) ** 2
        + (float(fitted["surface_reflectance_error"]) / 0.04 * gloss) ** 2
        + (float(fitted["fit_residual"]) * total) ** 2
        + (gloss - seen) ** 2
    )
    found = evaluate_error(with_errors, surfel, wi, wo)
    np.testing.assert_allclose(found, np.sqrt(want), rtol=1e-3)
    extrapolated = np.abs(gloss - seen) > 1e-3
    assert extrapolated.any() == (theta_h < SEEN)


def test_evaluate_error__is_zero_below_the_horizon(with_errors):
    normal = _unit(with_errors["fitted/shading_normal"].values[1].astype(float))
    wi, wo = _at_half_angle(normal, np.radians(5.0))
    grazing = _unit(wo - (wo @ normal)[:, None] * normal - 0.02 * normal)
    assert (evaluate_error(with_errors, 1, wi, wo) > 0).all()
    assert (evaluate_error(with_errors, 1, wi, grazing) == 0).all()


def test_evaluate_error__refuses_a_model_without_errors(model):
    with pytest.raises(InputError, match="diffuse_reflectance_total_error"):
        evaluate_error(model, 1, [0, 0, 1], [0, 0, 1])


@pytest.mark.parametrize("surfel", [-1, 6, 1000])
def test_evaluate__refuses_a_surfel_out_of_range(model, surfel):
    with pytest.raises(
        InputError,
        match=rf"surfel must be an index from 0 to 5; found {surfel}; choose",
    ):
        evaluate(model, surfel, [0, 0, 1], [0, 0, 1])


def test_evaluate__refuses_a_surfel_that_was_not_fitted(model):
    with pytest.raises(
        InputError,
        match=r"surfel 3: the surfel must be fitted; found the status UNSEEN \(",
    ):
        evaluate(model, 3, [0, 0, 1], [0, 0, 1])


def test_evaluate__refuses_what_are_no_directions(model):
    with pytest.raises(
        InputError,
        match=r"wi: directions must be unit vectors; found a length of 2; normalise",
    ):
        evaluate(model, 0, [0, 0, 2], [0, 0, 1])
    with pytest.raises(
        InputError, match="wo: directions must be unit vectors; found a length of nan"
    ):
        evaluate(model, 0, [0, 0, 1], [[0, 0, 1], [np.nan, 0, 1]])
    with pytest.raises(
        InputError,
        match=r"wo: directions must have the shape \(\.\.\., 3\); found the shape \(2,\)",
    ):
        evaluate(model, 0, [0, 0, 1], [0, 1])


def test_evaluate__a_model_without_weights_is_refused(model):
    other = xr.DataTree.from_dict(
        {
            "/fitted": model["fitted"].to_dataset().drop_vars("basis_weight"),
            "/basis": model["basis"].to_dataset(),
        }
    )
    with pytest.raises(
        InputError, match=r"fitted\[basis_weight\]: variable is required"
    ):
        evaluate(other, 0, [0, 0, 1], [0, 0, 1])
