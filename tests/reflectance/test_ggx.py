"""The GGX lobe against plain NumPy, numerical integrals and SciPy, and planted captures."""

from __future__ import annotations

from typing import get_args, get_type_hints

import numpy as np
import pytest
from scipy.optimize import least_squares
from three_surfels import polariser_factors

from skindb.errors import InputError
from skindb.parameters import FitParameters
from skindb.reflectance.block import empty_fit
from skindb.reflectance.ggx import GGX
from skindb.reflectance.kinds import SURFACES, surface_model
from skindb.reflectance.lobes import evaluate_lobe
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.model import (
    Block,
    Comparison,
    FitRequest,
    Judgement,
    Lamp,
    Points,
)
from skindb.reflectance.sampling import TableSampler
from skindb.reflectance.tables import NARROW_ANGLE
from skindb.schema import FitStatus, dataset

INDEX = 1.4


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def fresnel(cosine, index):
    """Snell's law and the two polarisations, written out."""
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    across = ((cosine - index * inside) / (cosine + index * inside)) ** 2
    along = ((inside - index * cosine) / (inside + index * cosine)) ** 2
    return (across + along) / 2


def slow_lobe(n, wi, wo, alpha, index):
    """f_s of strength 1, by the tangents of Heitz 2014 instead of the cosines."""
    h = unit(wi + wo)
    tangent = {}
    for name, w in (("h", h), ("i", wi), ("o", wo)):
        c = (w * n).sum(-1)
        tangent[name] = np.sqrt(np.maximum(1 - c**2, 0)) / c
    c = (h * n).sum(-1)
    spread = 1 / (np.pi * alpha**2 * c**4 * (1 + (tangent["h"] / alpha) ** 2) ** 2)
    lam = sum((np.sqrt(1 + (alpha * tangent[k]) ** 2) - 1) / 2 for k in "io")
    cosines = (wi * n).sum(-1) * (wo * n).sum(-1)
    return fresnel((wi * h).sum(-1), index) * spread / (1 + lam) / (4 * cosines)


def dome(rng, count, spread):
    return unit(rng.normal(size=(count, 3)) * spread + [0, 0, 1.0]) * 900


def planted(strength, roughness, *, noise=0.0, diffuse=0.4, seed=0, index=INDEX):
    """A block of surfels with lobes of known strength and roughness."""
    rng = np.random.default_rng(seed)
    n = len(strength)
    position = rng.normal(size=(n, 3)) * 20
    normal = unit(rng.normal(size=(n, 3)) * 0.2 + [0, 0, 1.0])
    light = dome(rng, 60, 0.7)
    camera = dome(rng, 9, 0.5)
    wi = unit(light[None] - position[:, None])[:, :, None]
    wo = unit(camera[None] - position[:, None])[:, None]
    up = normal[:, None, None]
    cosine = (wi * up).sum(-1)
    seen = (wo * up).sum(-1)
    above = (cosine > 0.05) & (seen > 0.05)
    with np.errstate(invalid="ignore", divide="ignore"):
        lobe = slow_lobe(up, wi, wo, np.asarray(roughness)[:, None, None], index)
        passed = (1 - fresnel(cosine, index)) * (1 - fresnel(seen, index)) / np.pi
        body = passed * diffuse
        value = cosine * (body + np.asarray(strength)[:, None, None] * lobe)
    sample = np.where(above, value, np.nan)[..., None] * np.ones(3)
    sample = sample * (1 + noise * rng.standard_normal(sample.shape))
    return Block(
        sample.astype(np.float32),
        position,
        light,
        camera,
        normal,
        np.full((n, 3), diffuse),
    )


STRENGTH = np.array([1.0, 0.6, 2.0, 0.3])
ROUGHNESS = np.array([0.3, 0.2, 0.5, 0.12])
EXACT = Comparison("linear", INDEX, 2e-3, 10)


@pytest.mark.parametrize("mode", ["linear", "perceptual"])
def test_fit__recovers_planted_lobes(mode):
    fit = GGX(INDEX).fit(planted(STRENGTH, ROUGHNESS), EXACT._replace(mode=mode))
    assert (fit.status == FitStatus.FITTED).all()
    np.testing.assert_allclose(fit.parameters[:, 0], STRENGTH, rtol=2e-4)
    np.testing.assert_allclose(fit.parameters[:, 1], ROUGHNESS, rtol=2e-4)
    assert fit.residual.max() < 1e-4
    assert fit.kkt.max() < 1e-3


def test_fit__recovers_lobes_behind_polarisers():
    block = planted(STRENGTH, ROUGHNESS)
    matte = planted(0 * STRENGTH, ROUGHNESS).sample
    polarisation = np.outer(np.ones(60), np.linspace(-1, 0.99, 9))
    factor = polariser_factors(
        block.position, block.light, block.camera, polarisation, eta=INDEX
    )
    sample = np.float32(matte + factor[..., None] * (block.sample - matte))
    polarised = block._replace(sample=sample, polarisation=polarisation)
    fit = GGX(INDEX).fit(polarised, EXACT)
    np.testing.assert_allclose(fit.parameters[:, 0], STRENGTH, rtol=1e-3)
    np.testing.assert_allclose(fit.parameters[:, 1], ROUGHNESS, rtol=1e-3)
    judged = GGX(INDEX).fit(polarised, EXACT, Judgement(), fit.parameters)
    assert max(fit.residual.max(), judged.residual.max()) < 1e-3


def test_fit__noisy_samples_as_least_squares_of_scipy():
    block = planted(STRENGTH, ROUGHNESS, noise=0.05, seed=2)
    found = GGX(INDEX).fit(block, EXACT).parameters
    for s in range(len(STRENGTH)):
        n = block.normal[s]
        wi = unit(block.light - block.position[s])[:, None]
        wo = unit(block.camera - block.position[s])[None]
        lit = (wi * n).sum(-1)
        seen = (wo * n).sum(-1)
        use = (lit > 0.1) & (seen > 0.1)
        passed = (1 - fresnel(lit, INDEX)) * (1 - fresnel(seen, INDEX)) / np.pi
        body = lit * passed * 0.4
        target = (block.sample[s].mean(-1, dtype=float) - body)[use]

        def misfit(p, s=s, n=n, wi=wi, wo=wo, lit=lit, use=use, target=target):
            lobe = slow_lobe(n, wi, wo, np.exp(p[1]), INDEX)
            return (lit * p[0] * lobe)[use] - target

        best = min(
            (
                least_squares(misfit, [1.0, np.log(a)], xtol=1e-12, ftol=1e-12)
                for a in (0.1, 0.3, 0.8)
            ),
            key=lambda fit: fit.cost,
        )
        np.testing.assert_allclose(found[s, 0], best.x[0], rtol=1e-3)
        np.testing.assert_allclose(found[s, 1], np.exp(best.x[1]), rtol=1e-3)


def test_fit__matte_hidden_and_empty_surfels():
    block = planted([0.0, 1.0, 1.0], [0.3, 0.3, 0.3])
    block.sample[1] = np.nan
    block.sample[2, 1:] = np.nan
    fit = GGX(INDEX).fit(block, EXACT)
    assert fit.status.tolist() == [
        FitStatus.FITTED,
        FitStatus.UNSEEN,
        FitStatus.LAMBERT,
    ]
    assert fit.parameters[0, 0] < 1e-3
    assert np.isnan(fit.parameters[1:]).all()
    empty = block._replace(
        sample=block.sample[:0],
        position=block.position[:0],
        normal=block.normal[:0],
        diffuse=block.diffuse[:0],
    )
    assert GGX(INDEX).fit(empty, EXACT).parameters.shape == (0, 2)


def test_fit__fits_like_fit_and_predicts_what_is_held_out():
    block = planted(STRENGTH, ROUGHNESS)
    held = np.zeros((60, 9), np.int64)
    held[::7] = 1
    held[:, 4] += 2
    errors = Judgement(np.full((4, 3), 1e-3), np.full(4, 0.2), held, outliers=True)
    judged = GGX(INDEX).fit(block, EXACT, errors)
    np.testing.assert_allclose(judged.parameters[:, 1], ROUGHNESS, rtol=1e-3)
    assert judged.held_error.max() < 1e-3
    assert judged.outlier.max() == 0
    again = GGX(INDEX).fit(block, EXACT, errors, judged.parameters)
    np.testing.assert_allclose(again.held_error, judged.held_error, rtol=1e-6)
    np.testing.assert_array_equal(again.counts, judged.counts)


def test_fit__evaluated_parameters_have_the_errors_of_their_fit():
    block = planted(STRENGTH, ROUGHNESS, noise=0.05, seed=3)
    errors = Judgement(np.full((4, 3), 1e-3), np.full(4, 0.2))
    judged = GGX(INDEX).fit(block, EXACT, errors)
    again = GGX(INDEX).fit(block, EXACT, errors, judged.parameters)
    np.testing.assert_allclose(again.covariance, judged.covariance, rtol=1e-9)


def test_fit__errors_are_the_scatter_of_repeated_fits():
    repeats = 60
    model = GGX(INDEX)
    judgement = Judgement(np.zeros((repeats, 3)))
    block = planted([0.8] * repeats, [0.3] * repeats, noise=0.05, seed=4)
    block.position[:] = block.position[0]
    block.normal[:] = block.normal[0]
    one = planted([0.8], [0.3], seed=4)
    rng = np.random.default_rng(1)
    block.sample[:] = one.sample[0] * (
        1 + 0.05 * rng.standard_normal(block.sample.shape)
    )
    block = block._replace(
        position=np.repeat(one.position, repeats, 0),
        normal=np.repeat(one.normal, repeats, 0),
        light=one.light,
        camera=one.camera,
    )
    judged = model.fit(block, EXACT, judgement)
    columns = model.judged_columns(judged)
    for name in (
        "lobe_strength",
        "lobe_roughness",
        "surface_reflectance",
        "glossiness",
    ):
        scatter = columns[name].std(ddof=1)
        stated = np.sqrt(np.mean(columns[f"{name}_error"] ** 2))
        # 60 repeats: a standard deviation is known to 9 %
        assert 0.7 < stated / scatter < 1.4, name


def test_shade__equals_plain_numpy():
    rng = np.random.default_rng(5)
    n = 40
    normal = unit(rng.normal(size=(n, 3)))
    view = unit(normal + 0.7 * rng.normal(size=(n, 3)))
    position = rng.normal(size=(n, 3)) * 30
    place = position[:, None] + 500 * unit(
        normal[:, None] + 0.7 * rng.normal(size=(n, 2, 3))
    )
    lit = rng.uniform(0, 1, (n, 2)).astype(np.float32)
    parameters = np.column_stack([rng.uniform(0, 2, n), rng.uniform(0.08, 1, n)])
    axis = unit(np.array([0.2, 0.1, -1.0]))
    points = Points(position, normal, view, np.full((n, 3), 0.5), parameters)
    found = GGX(INDEX).shade(points, Lamp(place, lit, axis, 1.5), eta=INDEX)
    for i in range(n):
        total = 0.0
        for p in range(2):
            d = np.linalg.norm(place[i, p] - position[i])
            wi = (place[i, p] - position[i]) / d
            ci = wi @ normal[i]
            co = view[i] @ normal[i]
            if ci <= 0 or co <= 0:
                continue
            body = (1 - fresnel(ci, INDEX)) * (1 - fresnel(co, INDEX)) * 0.5 / np.pi
            lobe = slow_lobe(normal[i], wi, view[i], parameters[i, 1], INDEX)
            received = lit[i, p] * ci / d**2 * max(-axis @ wi, 0) ** 1.5
            total += received * (body + parameters[i, 0] * lobe)
        np.testing.assert_allclose(found[i], total / 2, rtol=1e-5, atol=1e-14)


def hemisphere(count=400):
    z, w = np.polynomial.legendre.leggauss(count)
    z = (z + 1) / 2
    phi = (np.arange(2 * count) + 0.5) * np.pi / count
    s = np.sqrt(1 - z**2)[:, None]
    wi = np.stack([s * np.cos(phi), s * np.sin(phi), z[:, None] + 0 * phi], axis=-1)
    return wi, (w / 2)[:, None] * (np.pi / count) + 0 * phi


@pytest.mark.parametrize("alpha", [0.15, 0.4, 1.0])
@pytest.mark.parametrize("cosine", [0.3, 0.9])
def test_lobe__reflects_no_more_light_than_the_fresnel_term_lets_it(alpha, cosine):
    """Without Fresnel's term (a large index) at most 1, and all of it for a smooth surface;
    reciprocal.
    """
    wi, solid = hemisphere()
    wo = np.broadcast_to([np.sqrt(1 - cosine**2), 0, cosine], wi.shape)
    white = (evaluate_lobe(wi, wo, alpha, 1e6) * wi[..., 2] * solid).sum()
    assert white < 1 + 1e-3
    if alpha < 0.2 and cosine > 0.5:
        assert white > 0.95
    np.testing.assert_allclose(
        evaluate_lobe(wi, wo, alpha, INDEX), evaluate_lobe(wo, wi, alpha, INDEX)
    )
    exact = slow_lobe(np.array([0, 0, 1.0]), wi, wo, alpha, INDEX)
    clear = wi[..., 2] > 0.01
    np.testing.assert_allclose(
        evaluate_lobe(wi, wo, alpha, INDEX)[clear], exact[clear], rtol=1e-9
    )


def test_normal_reflectance__is_the_integral():
    wi, solid = hemisphere()
    up = np.broadcast_to([0.0, 0.0, 1.0], wi.shape)
    for alpha in (0.1, 0.35, 0.9):
        whole = (evaluate_lobe(wi, up, alpha, INDEX) * wi[..., 2] * solid).sum()
        found = GGX(INDEX).normal_reflectance(np.array([[0.7, alpha]]))[0]
        np.testing.assert_allclose(found, 0.7 * whole, rtol=5e-3)


def test_judged_columns__glossiness_is_the_integral():
    """Half vectors within an angle are directions of light within twice of it. One per cent
    is the error of interpolation between 24 roughnesses and of the cells that the angle
    cuts. Beside an exact roughness glossiness has no error.
    """
    wi, solid = hemisphere()
    up = np.broadcast_to([0.0, 0.0, 1.0], wi.shape)
    is_narrow = wi[..., 2] > np.cos(2 * NARROW_ANGLE)
    alpha = np.array([0.1, 0.28, 0.6])
    parameters = np.column_stack([[0.5, 1.0, 2.0], alpha])
    block = planted([0.8] * 3, [0.3] * 3)
    judged = empty_fit(block, Judgement(np.zeros((3, 3))), 2, parameters)
    judged.covariance[:] = np.diag([0.01, 0.0])
    columns = GGX(INDEX).judged_columns(judged)
    for width, found in zip(alpha, columns["glossiness"], strict=True):
        light = evaluate_lobe(wi, up, width, INDEX) * wi[..., 2] * solid
        want = light[is_narrow].sum() / light.sum()
        np.testing.assert_allclose(found, want, rtol=0.01)
    assert np.isnan(columns["glossiness_error"]).all()


def test_resample__tables_reproduce_the_lobes():
    rng = np.random.default_rng(3)
    parameters = np.column_stack([rng.uniform(0.2, 2, 50), rng.uniform(0.2, 0.6, 50)])
    tables, weights = GGX(INDEX).resample(parameters)
    normal = np.tile([0.0, 0.0, 1.0], (50, 1))
    view = unit(normal + 0.5 * rng.normal(size=(50, 3)) * [1, 1, 0])
    place = unit(normal + 0.5 * rng.normal(size=(50, 1, 3)) * [1, 1, 0]) * 1000
    lamp = Lamp(place[0], np.ones((50, 1), np.float32), np.array([0, 0, -1.0]), 0.0)
    lamp = lamp._replace(place=place[np.arange(50), 0][:, None])
    zero = np.zeros((50, 3))
    exact = GGX(INDEX).shade(
        Points(zero, normal, view, zero, parameters), lamp, eta=INDEX
    )
    near = Mixture(tables).shade(
        Points(zero, normal, view, zero, weights), lamp, eta=INDEX
    )
    assert np.sqrt(np.mean((near - exact) ** 2) / np.mean(exact**2)) < 0.03


def test_resample__directions_by_its_tables_have_the_albedo_as_mean():
    rng = np.random.default_rng(0)
    n = 200_000
    tables, weights = GGX(INDEX).resample(np.tile([1.0, 0.3], (n, 1)))
    sampler = TableSampler.of_tables(tables)
    view = np.tile(unit(np.array([0.5, 0.1, 0.8])), (n, 1))
    normal = np.tile([0.0, 0.0, 1.0], (n, 1))
    mix = sampler.mix(weights)
    towards = sampler.sample(mix, normal, view, rng.random((n, 3)))
    density = sampler.pdf(mix, normal, view, towards)
    up = towards[:, 2] > 0
    values = np.zeros(n)
    values[up] = evaluate_lobe(towards[up], view[up], 0.3, INDEX) * towards[up, 2]
    estimate = values[up] / density[up]
    mean = estimate.sum() / n
    wi, solid = hemisphere(300)
    wo = np.broadcast_to(view[0], wi.shape)
    whole = (evaluate_lobe(wi, wo, 0.3, INDEX) * wi[..., 2] * solid).sum()
    error = np.sqrt(((estimate**2).sum() / n - mean**2) / n)
    assert abs(mean - whole) < 5 * error
    flat = sampler.pdf(
        np.tile(mix[:1], (wi[..., 0].size, 1)),
        np.tile([0.0, 0, 1], (wi[..., 0].size, 1)),
        np.tile(view[0], (wi[..., 0].size, 1)),
        wi.reshape(-1, 3),
    )
    # what is missing was drawn below the surface
    np.testing.assert_allclose((flat * solid.ravel()).sum(), up.mean(), atol=3e-3)


def test_kinds__are_the_choices_of_fits():
    hints = get_type_hints(FitParameters)
    assert set(get_args(hints["surface"])) == set(SURFACES)


def test_kinds__stored_and_unfitted_models():
    model = SURFACES["ggx"].unfitted(FitRequest(1.4, 0.01, 16, 4))
    assert model == GGX(1.4, 0.01)
    stored = dataset({"lobe_index": 1.4, "disc_angular_radius": 0.01})
    assert surface_model(stored) == model
    with pytest.raises(InputError, match="mixtures alone are of a dictionary"):
        SURFACES["ggx"].unfitted(FitRequest(1.4, 0.01, 16, 4, object()))
