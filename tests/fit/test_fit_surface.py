"""Surface fits: planted mixtures, certificates, statuses, prediction of unseen lights,
reduced bases.
"""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from skindb.errors import InputError
from skindb.fit import fit_surface, held_out_error, reduce_basis, refit
from skindb.fit.surface import NOISE_FLOOR_SURFACE
from skindb.optics.angles import half_difference
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance._lumitexel_kernels import MIN_COSINE_SURFACE
from skindb.reflectance.dictionary import Dictionary
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.reduction import (
    reduce_dictionary,
)
from skindb.reflectance.separation import surface_lobes
from skindb.reflectance.tables import (
    NARROW_ANGLE,
    brdf_metric,
    directional_albedo,
    half_widths,
    lookup,
    stored_brdf,
)
from skindb.schema import FitStatus, dataset, label

HALF = 2e-3  # samples are half floats: 5e-4 each, relative to the surface term more


@pytest.fixture(scope="module")
def planted(skin, small_dictionary, plant):
    return plant(skin, small_dictionary, np.random.default_rng(5))


@pytest.mark.parametrize("mode", ["linear", "perceptual"])
@pytest.mark.parametrize("rank", [6, 5])
def test_fit_surface__reproduces_planted_reflectance(
    planted, small_dictionary, mode, rank
):
    lumitexels, weight = planted
    found = fit_surface(
        lumitexels,
        min_width=0.0,
        surface=Mixture.of_dictionary(small_dictionary, rank=rank),
        mode=mode,
    )
    assert (found["fit_status"] == FitStatus.FITTED).all()
    # five dimensions do not hold six materials, whose peaks then count as outliers
    assert found["dictionary_residual"].max() < (HALF if rank == 6 else 0.1)
    assert found["kkt_residual"].max() < 1e-9
    assert (found["dictionary_weight"] >= 0).all()
    # compared as BRDFs: weights are not unique
    cells = (
        small_dictionary.table[5:60, 5:60, ::6]
        .reshape(-1, weight.shape[1])
        .astype(float)
    )
    true = weight @ cells.T
    fitted = found["dictionary_weight"].values @ cells.T
    assert np.median(np.abs(fitted - true)) < 0.02 * np.median(true)


@pytest.mark.parametrize("rank", [5, 4])
@pytest.mark.parametrize("mode", ["linear", "perceptual"])
def test_fit_surface__reduced_rank_agrees_within_the_bound(
    skin, small_dictionary, plant, mode, rank
):
    """|M x' - R| <= |M x - R| + |E x| + |E x'| with x found by M and x' by M + E, and
    |E x| <= worst |M x|.

    Perceptual fits measure all three in cube-root space.
    """
    lumitexels, _ = plant(skin, small_dictionary, np.random.default_rng(6), noise=0.02)
    reduced, lift = reduce_dictionary(small_dictionary.table, rank)
    worst = np.abs(reduced @ lift / small_dictionary.table - 1).max()
    found = [
        fit_surface(
            lumitexels,
            min_width=0.0,
            surface=Mixture.of_dictionary(small_dictionary, rank=r),
            mode=mode,
        )
        for r in (6, rank)
    ]
    place = lumitexels["surfel_position"].values.astype(float)
    gaps = []
    for s, n in enumerate(lumitexels["shading_normal"].values.astype(float)):
        ways = [
            lumitexels[name].values - place[s]
            for name in ("light_position", "camera_position")
        ]
        wi, wo = (way / np.linalg.norm(way, axis=1)[:, None] for way in ways)
        i, o = np.nonzero(
            (wi @ n > MIN_COSINE_SURFACE)[:, None] & (wo @ n > MIN_COSINE_SURFACE)
        )
        cosine = wi[i] @ n
        angles = half_difference(wi[i], wo[o], np.broadcast_to(n, (len(i), 3)))
        body = (
            cosine
            * fresnel_transmittance(cosine, 1.3)
            * fresnel_transmittance(wo[o] @ n, 1.3)
            / np.pi
        )
        given = lumitexels["reflectance_sample"].values[s, i, o].astype(float)
        given -= body[:, None] * lumitexels["diffuse_reflectance"].values[s].astype(
            float
        )
        whole, low = (
            lookup(t, *angles) * cosine[:, None]
            for t in (small_dictionary.table, reduced)
        )
        x = [f["dictionary_weight"].values[s] for f in found]

        def root(y):
            return (
                y
                if mode == "linear"
                else y / (y * y + NOISE_FLOOR_SURFACE**2) ** (1 / 3)
            )

        far = [np.linalg.norm(root(whole @ one)[:, None] - root(given)) for one in x]
        off = [
            np.sqrt(3) * np.linalg.norm(root(low @ lift @ one) - root(whole @ one))
            for one in x
        ]
        gaps.append((far[1] - far[0]) / sum(off))
        if mode == "linear":
            assert all(
                off[k] <= worst * np.sqrt(3) * np.linalg.norm(whole @ x[k])
                for k in (0, 1)
            )
    assert np.max(gaps) <= 1
    assert np.max(gaps) > 0.01  # something was omitted
    assert np.min(gaps) > -1e-3  # and all dimensions fit best, within single precision


def test_fit_surface__statuses(planted, small_dictionary):
    lumitexels = planted[0].copy(deep=True)
    sample = lumitexels["reflectance_sample"].values
    position = lumitexels["surfel_position"].values
    diffuse = lumitexels["diffuse_reflectance"].values
    normal = lumitexels["shading_normal"].values
    sample[0] = np.nan
    sample[1].reshape(-1, 3)[40:] = np.nan
    sample[1].reshape(-1, 3)[:38] = np.nan
    diffuse[2] = np.nan
    diffuse[3] = 1e-4
    sample[4, 0, 0] = np.inf
    position[5] = np.nan
    normal[6] = np.nan
    found = fit_surface(
        lumitexels, min_width=0.0, surface=Mixture.of_dictionary(small_dictionary)
    )
    expected = [
        FitStatus.UNSEEN,
        FitStatus.TOO_FEW_SAMPLES,
        FitStatus.NO_DIFFUSE_ESTIMATE,
        FitStatus.DIFFUSE_CLAMPED,
        FitStatus.NOT_FINITE,
        FitStatus.NOT_FINITE,
        FitStatus.UNDETERMINED,
        FitStatus.FITTED,
    ]
    assert found["fit_status"].values[:8].tolist() == expected
    nothing = [0, 1, 2, 5, 6]
    assert np.isnan(found["dictionary_weight"].values[nothing]).all()
    assert np.isfinite(found["dictionary_weight"].values[[3, 7]]).all()


def test_fit_surface__any_chunking(planted, small_dictionary):
    lumitexels, _ = planted
    eager = fit_surface(
        lumitexels, min_width=0.0, surface=Mixture.of_dictionary(small_dictionary)
    )
    lazy = fit_surface(
        lumitexels.chunk(surfel=9),
        min_width=0.0,
        surface=Mixture.of_dictionary(small_dictionary),
    ).compute()
    for name in ("dictionary_weight", "dictionary_residual"):
        np.testing.assert_allclose(
            lazy[name].values, eager[name].values, rtol=1e-4, atol=1e-6
        )


def test_fit_surface__asks_for_normals_and_diffuse(skin, small_dictionary):
    with pytest.raises(InputError, match="shading_normal") as caught:
        fit_surface(
            skin.lumitexels,
            min_width=0.0,
            surface=Mixture.of_dictionary(small_dictionary),
        )
    assert len(caught.value.faults) == 2


def _identity_basis(dictionary):
    k = len(dictionary.names)
    return dataset(
        {"basis_mixture": np.eye(k), "basis_brdf": stored_brdf(dictionary.table)}
    )


def test_refit__every_bases_as_components_is_the_full_fit(planted, small_dictionary):
    lumitexels, _ = planted
    full = fit_surface(
        lumitexels,
        min_width=0.0,
        surface=Mixture.of_dictionary(small_dictionary, rank=6),
    )
    reduced = refit(lumitexels, min_width=0.0, basis=_identity_basis(small_dictionary))
    np.testing.assert_allclose(
        reduced["basis_weight"], full["dictionary_weight"], rtol=1e-6, atol=1e-9
    )
    np.testing.assert_allclose(
        reduced["fit_residual"], full["dictionary_residual"], rtol=1e-6
    )


@pytest.fixture(scope="module")
def two_lobes(new_skin, plant):
    """300 surfels with two distinguishable lobes, their weights, and the fractions each
    reflects along the normal: all, and near the mirror direction.
    """
    table, grid = surface_lobes()
    dictionary = Dictionary(
        ("broad", "narrow"), np.ascontiguousarray(table[..., [2, 4]]), grid, "two lobes"
    )
    skin = new_skin(surfels=300)
    lumitexels, weight = plant(
        skin, dictionary, np.random.default_rng(2), noise=0.01, scale=0.2
    )
    assert (weight > 0).all()
    albedo = [
        directional_albedo(dictionary.table, 1.0, angle)[0]
        for angle in (np.pi / 2, NARROW_ANGLE)
    ]
    return lumitexels, _identity_basis(dictionary), weight, np.array(albedo)


def _share_inside(found, truth, error):
    known = np.isfinite(error)
    return (np.abs(found - truth) < 1.96 * error)[known].mean()


@pytest.mark.parametrize("mode", ["linear", "perceptual"])
def test_refit__errors_cover_weights_and_gloss(two_lobes, mode):
    """Rationale: R_d and normals are the true ones, only noise is at work. Expected: 95
    % within 1.96 errors.

    300 trials give the fraction to 1.3 %, three times that is allowed.
    """
    lumitexels, basis, weight, strength = two_lobes
    found = refit(lumitexels, min_width=0.0, basis=basis, mode=mode)
    error = found["basis_weight_error"].values
    np.testing.assert_array_equal(np.isfinite(error), found["basis_weight"].values > 0)
    assert np.isfinite(error).mean() > 0.95
    shares = [
        _share_inside(found["basis_weight"].values[:, k], weight[:, k], error[:, k])
        for k in range(2)
    ]
    whole, narrow = strength @ found["basis_weight"].values.T
    true_whole, true_narrow = strength @ weight.T
    for name, values, truth in (
        ("surface_reflectance", whole, true_whole),
        ("glossiness", narrow / whole, true_narrow / true_whole),
    ):
        np.testing.assert_allclose(found[name], values, rtol=1e-5)
        spread = found[f"{name}_error"].values
        shares.append(_share_inside(values, truth, spread))
        assert np.nanmedian(spread / values) < 0.1  # small enough to be informative
    assert min(shares) > 0.95 - 0.039
    assert max(shares) < 0.95 + 0.039


def test_refit__error_of_diffuse_light_reaches_the_weights(two_lobes):
    """An R_d that is wrong by a known step changes the weights by the stated error."""
    lumitexels, basis, _, _ = two_lobes
    step = 1e-3
    higher = lumitexels.assign(
        diffuse_reflectance=label(
            "diffuse_reflectance", lumitexels["diffuse_reflectance"].values + step
        )
    )
    known = lumitexels.assign(
        diffuse_reflectance_error=label(
            "diffuse_reflectance_error",
            np.full(lumitexels["diffuse_reflectance"].shape, step),
        )
    )
    plain, moved, stated = (
        refit(ds, min_width=0.0, basis=basis, mode="linear")
        for ds in (lumitexels, higher, known)
    )
    share = np.sqrt(
        stated["basis_weight_error"] ** 2 - plain["basis_weight_error"] ** 2
    ).values
    both = ((plain["basis_weight"] > 0) & (moved["basis_weight"] > 0)).values.all(
        axis=1
    )
    gone = np.abs(moved["basis_weight"] - plain["basis_weight"]).values
    # linear: exact except for the single precision of the difference of squares
    np.testing.assert_allclose(share[both], gone[both], rtol=0.02, atol=1e-5)


@pytest.mark.parametrize("mode", ["linear", "perceptual"])
def test_refit__error_of_the_normal_reaches_the_weights(two_lobes, mode):
    """For normals that are wrong by their error, errors of the weights cover the truth
    only if they include it.
    """
    lumitexels, basis, weight, _ = two_lobes
    # degrees; the narrow lobe has a half width of some three
    rng = np.random.default_rng(17)
    turn = 0.7
    normal = lumitexels["shading_normal"].values.astype(float)
    off = rng.normal(size=normal.shape) * np.radians(turn) / np.sqrt(2)
    off -= (off * normal).sum(1, keepdims=True) * normal
    turned = (normal + off) / np.linalg.norm(normal + off, axis=1, keepdims=True)
    blind = lumitexels.assign(shading_normal=label("shading_normal", turned))
    known = blind.assign(normal_error=label("normal_error", np.full(len(normal), turn)))
    shares = []
    for given in (known, blind):
        found = refit(given, min_width=0.0, basis=basis, mode=mode)
        error = found["basis_weight_error"].values
        shares.append(
            [
                _share_inside(
                    found["basis_weight"].values[:, k], weight[:, k], error[:, k]
                )
                for k in range(2)
            ]
        )
    # weights spread unlike a Gaussian where the normal is the larger part
    assert min(shares[0]) > 0.9
    assert shares[1][1] < 0.8


def test_held_out_error__is_the_noise_for_the_true_model(skin, small_dictionary, plant):
    noise = 0.04
    lumitexels, weight = plant(
        skin, small_dictionary, np.random.default_rng(6), noise=noise
    )
    lumitexels = lumitexels.assign(basis_weight=label("basis_weight", weight))
    found = held_out_error(
        lumitexels.isel(light=slice(0, 20)), basis=_identity_basis(small_dictionary)
    )
    assert abs(float(found["held_out_error"].median()) - noise) < 0.25 * noise
    # d cbrt(y) / cbrt(y) = dy / (3 y)
    assert (
        abs(float(found["held_out_error_perceptual"].median()) - noise / 3)
        < 0.25 * noise / 3
    )


def test_held_out_error__wrong_weights_show(planted, small_dictionary):
    lumitexels, weight = planted
    basis = _identity_basis(small_dictionary)
    right, wrong = (
        held_out_error(
            lumitexels.assign(basis_weight=label("basis_weight", f * weight)),
            basis=basis,
        )
        for f in (1.0, 2.0)
    )
    assert right["held_out_error"].max() < HALF
    assert wrong["held_out_error"].min() > 0.05


def _fitted(weight, *, status=FitStatus.FITTED):
    n = len(weight)
    return dataset(
        {
            "dictionary_weight": weight,
            "fit_status": np.full(n, status),
            "surfel_area": np.linspace(1, 2, n),
        },
    )


def test_reduce_basis__finds_the_planted_space(small_dictionary):
    rng = np.random.default_rng(7)
    rows = np.array([[1.0, 0, 0.5, 0, 0, 0], [0, 1.0, 0, 0, 0.2, 0]])
    weight = rng.uniform(0, 1, (300, 2)) @ rows
    found = reduce_basis(_fitted(weight), dictionary=small_dictionary, k=2, rng=rng)
    H = found["basis_mixture"].values
    left = weight - weight @ np.linalg.pinv(H) @ H
    assert np.linalg.norm(left) < 0.02 * np.linalg.norm(weight)
    tables = np.einsum("kj,hdpj->khdp", H, small_dictionary.table)
    np.testing.assert_allclose(found["basis_brdf"].values[..., :-1], tables, rtol=1e-4)
    area = np.linspace(1, 2, 300)
    np.testing.assert_allclose(
        found["mean_dictionary_weight"], area @ weight / area.sum(), rtol=1e-5
    )
    assert found["dictionary"].values.tolist() == list(small_dictionary.names)


def test_reduce_basis__same_seed_same_basis(small_dictionary):
    weight = np.random.default_rng(8).uniform(0, 1, (200, 6))
    twice = [
        reduce_basis(
            _fitted(weight),
            dictionary=small_dictionary,
            k=3,
            rng=np.random.default_rng(1),
        )
        for _ in range(2)
    ]
    # rounding of BLAS depends on the alignment of arrays
    xr.testing.assert_allclose(twice[0], twice[1], rtol=1e-6)


def test_reduce_basis__refuses_what_it_cannot_do(small_dictionary):
    weight = np.ones((20, 6))
    for k in (0, 7):
        with pytest.raises(InputError, match="a reduced basis has 1 to 6 components"):
            reduce_basis(
                _fitted(weight),
                dictionary=small_dictionary,
                k=k,
                rng=np.random.default_rng(0),
            )
    with pytest.raises(InputError, match="a basis needs fitted surfels"):
        reduce_basis(
            _fitted(weight, status=FitStatus.UNSEEN),
            dictionary=small_dictionary,
            rng=np.random.default_rng(0),
        )


def test_brdf_metric__is_the_sum_over_cells(small_dictionary):
    grid = small_dictionary.grid
    table = small_dictionary.table.astype(float)
    total = 0.0
    for i, th in enumerate(grid.theta_h):
        for j, td in enumerate(grid.theta_d):
            for p, pd in enumerate(grid.phi_d):
                # elevations of the two
                both = np.cos(th) * np.cos(td)
                side = np.sin(th) * np.sin(td) * np.cos(pd)
                seen = max(both - side, 0) * max(both + side, 0)
                step = np.sin(th) * np.sqrt(th) * np.sin(td) * np.cos(td) * seen
                cell = table[i, j, p]
                total += step * cell[1] * cell[4] / max(cell.mean(), 1e-6) ** (4 / 3)
    # sums of float32 tables in another order
    np.testing.assert_allclose(
        brdf_metric(small_dictionary.table)[1, 4], total, rtol=1e-5
    )


def test_fit_surface__counts_and_condition(planted, small_dictionary):
    lumitexels, _ = planted
    found = fit_surface(
        lumitexels,
        min_width=0.0,
        surface=Mixture.of_dictionary(small_dictionary, rank=6),
    )
    usable = np.isfinite(lumitexels["reflectance_sample"].values).all(-1).sum((1, 2))
    assert (found["fit_samples"] <= usable).all()
    # the other samples are at grazing angles
    assert (found["fit_samples"] > 0.5 * usable).all()
    assert (
        found["fit_iterations"] >= (found["dictionary_weight"] > 0).sum("dictionary")
    ).all()
    assert (found["fit_condition"] >= 1).all()


def test_fit_surface__mixes_no_brdf_whose_peak_no_sample_shows(
    planted, small_dictionary
):
    lumitexels, _ = planted
    hidden = np.radians(15)
    normal = lumitexels["shading_normal"].values.astype(float)
    position = lumitexels["surfel_position"].values.astype(float)
    wi, wo = (
        lumitexels[name].values - position[:, None]
        for name in ("light_position", "camera_position")
    )
    wi = wi / np.linalg.norm(wi, axis=-1, keepdims=True)
    wo = wo / np.linalg.norm(wo, axis=-1, keepdims=True)
    half = wi[:, :, None] + wo[:, None]
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    angle = np.arccos(np.clip(np.einsum("nk,nlck->nlc", normal, half), -1, 1))
    sample = lumitexels["reflectance_sample"]
    lumitexels = lumitexels.assign(
        reflectance_sample=sample.where(angle[..., None] > hidden)
    )
    nearest = np.where(
        np.isfinite(lumitexels["reflectance_sample"].values[..., 0]), angle, np.inf
    ).min(axis=(1, 2))
    width = half_widths(small_dictionary.table)
    unseen = width < 2 / 3 * nearest[:, None]
    assert unseen.any()
    assert (~unseen).any(axis=1).all()
    surface = Mixture.of_dictionary(small_dictionary, rank=6)
    weight = fit_surface(lumitexels, surface=surface)["dictionary_weight"].values
    assert (weight[unseen] == 0).all()
    assert (weight[~unseen] > 0).any()
