"""Monte Carlo pictures: furnaces, unbiased means, calibrated variances, and a second renderer."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy import stats

from skindb.errors import InputError
from skindb.geometry.mesh import vertex_areas
from skindb.optics.diffusion import dipole_s
from skindb.optics.dipole_tree import subsurface_exitance
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.tables import TableGrid, directional_albedo, tabulate
from skindb.render import monte_carlo
from skindb.render.image import write_exr
from skindb.render.monte_carlo import (
    LIGHTS_PER_RAY,
    MIN_BATCHES,
    LightChoice,
    Quality,
    render_monte_carlo,
    stratified,
)
from skindb.render.scene import Camera, Environment, Lighting, Lights, Surface
from skindb.render.shading import trace_view, tree_opening
from tests.pictures import render_view

LEVEL = 1e-5  # probability with which a right renderer fails a z-test of a picture


def camera(size: int = 24) -> Camera:
    K = np.array([[2.0 * size, 0, size / 2], [0, 2.0 * size, size / 2], [0, 0, 1]])
    R = np.diag([1.0, -1.0, -1.0])
    return Camera(K, R, -R @ np.array([0, 0, 300.0]), np.zeros(5), size, size)


def ball(eta: float = 1.0, diffuse: float = 0.6, weight: float = 0.0) -> Surface:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=60.0)
    n = len(mesh.vertices)

    def lobe(wi, wo):
        h = wi + wo
        h /= np.maximum(np.linalg.norm(h, axis=-1, keepdims=True), 1e-9)
        return 2 * np.clip(h[..., 2:], 0, 1) ** 40

    return Surface(
        mesh.vertices,
        mesh.faces,
        mesh.vertices / 60.0,
        np.full((n, 3), diffuse),
        np.full((n, 1), weight),
        Mixture(tabulate(lobe, TableGrid(40, 30, 8))),
        eta=eta,
    )


def lights(count: int, radius: float = 30.0) -> Lights:
    rng = np.random.default_rng(1)
    position = rng.standard_normal((count, 3)) + np.array([0, 0, 1.5])
    position *= 500 / np.linalg.norm(position, axis=1, keepdims=True)
    intensity = rng.uniform(1e5, 5e5, (count, 3))
    return Lights(
        position,
        intensity,
        np.full(count, radius),
        -position / 500,
        np.full(count, 1.0),
    )


EVEN = Lighting(None, Environment(np.ones((8, 16, 3))))
SKY = Lighting(
    None, Environment(np.random.default_rng(0).random((8, 16, 3)) ** 3 + 0.05)
)


def rendered(
    surface: Surface, lighting: Lighting, seed: int = 1, size: int = 24, **quality
):
    return render_monte_carlo(
        surface,
        camera(size),
        lighting,
        Quality(**quality),
        rng=np.random.default_rng(seed),
    )


def z_scores(found, expected):
    seen = (found.coverage == 1)[..., None] & (found.variance > 0)  # it is 0 in shadow
    return (found.radiance - expected)[seen] / np.sqrt(found.variance[seen])


def require_no_bias(found, expected):
    """The mean of the picture is within the noise that its variances say, pixels being
    independent.
    """
    seen = found.coverage == 1
    gap = (found.radiance - expected)[seen].sum(axis=0)
    error = np.sqrt(found.variance[seen].sum(axis=0))
    assert (np.abs(gap / error) < stats.norm.isf(LEVEL / 2)).all(), gap / error


def test_furnace__a_white_ball_vanishes() -> None:
    """A surface that absorbs nothing, in even light of radiance 1, has radiance 1
    wherever one looks.
    """
    found = rendered(ball(diffuse=1.0), EVEN, samples=64)
    require_no_bias(found, 1.0)
    # 64 pairs of directions, of which the cosine draws one without noise
    assert found.relative_error < 0.05


def test_furnace__a_lobe_has_its_directional_albedo() -> None:
    surface = ball(diffuse=0.0, weight=1.0)
    found = rendered(surface, EVEN, samples=256)
    view = trace_view(surface, camera(), samples=8)
    cosine = np.einsum("nc,nc->n", view.normal, view.towards)
    at = np.linspace(0.05, 1, 60)
    albedo = np.interp(cosine, at, directional_albedo(surface.model.table, at)[:, 0])
    expected = view.image(np.repeat(albedo[:, None], 3, axis=1))
    middle = (expected > 0) & (found.coverage == 1)[..., None]
    gap = (found.radiance - expected)[middle].mean() / expected[middle].mean()
    # noise of the mean 0.35 %; the expected picture by 64 rays
    assert abs(gap) < 0.01


def test_subsurface__even_light_gives_r_d() -> None:
    surface = ball(eta=1.3)
    n = len(surface.vertices)
    surface = replace(
        surface,
        s=np.full((n, 3), dipole_s(0.6, eta=1.3)[0]),
        sigma_tr=np.full((n, 3), 1.0),
    )
    found = rendered(surface, EVEN, samples=64, subsurface=True, terms=("diffuse",))
    t, w = np.polynomial.legendre.leggauss(64)
    cosine = (t + 1) / 2
    entered = np.pi * (w * cosine * fresnel_transmittance(cosine, 1.3)).sum()
    view = trace_view(surface, camera(), samples=8)
    leaves = (
        fresnel_transmittance(np.einsum("nc,nc->n", view.normal, view.towards), 1.3)
        / np.pi
    )
    expected = view.image(np.repeat((leaves * 0.6 * entered)[:, None], 3, axis=1))
    seen = found.coverage == 1
    # the noise of the irradiance is shared by neighbours; 16 batches of 32 directions
    # at each vertex leave 0.2 %
    assert abs(found.radiance[seen].mean() / expected[seen].mean() - 1) < 0.005


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3, 12])
@pytest.mark.parametrize("disc_included", [False, True])
def test_lights__as_the_renderer_of_the_fit(count, disc_included) -> None:
    """Against `render_view`, which goes through all lights and regular points of their discs."""
    surface = ball(eta=1.3, weight=0.5)
    radius = 0.01 if disc_included else 0.0
    surface = replace(surface, model=replace(surface.model, disc_angular_radius=radius))
    expected = render_view(
        surface, camera(), lights(count), samples=6, disc_samples=4
    ).sum(axis=0)
    found = rendered(surface, Lighting(lights(count)), samples=128)
    require_no_bias(found, expected)
    # 32 batches: variances of Student's t with 31 degrees of freedom, and 36 rays of
    # the reference have noise too
    spread = 1.4826 * np.median(np.abs(z_scores(found, expected)))
    assert 0.85 < spread < 1.3


@pytest.mark.slow
def test_environment__as_many_small_lights() -> None:
    """An environment against one distant point light for each of its texels."""
    surface = ball(eta=1.3, weight=0.5)
    sky = SKY.environment
    height, width, _ = sky.radiance.shape
    fine = 4  # points in a texel along each side
    theta = (np.arange(height * fine) + 0.5) / (height * fine) * np.pi
    phi = ((np.arange(width * fine) + 0.5) / (width * fine) - 0.5) * 2 * np.pi
    a, b = np.meshgrid(theta, phi, indexing="ij")
    direction = np.stack(
        [np.sin(a) * np.sin(b), np.cos(a), np.sin(a) * np.cos(b)], axis=-1
    ).reshape(-1, 3)
    solid = (np.sin(a) * np.pi / (height * fine) * 2 * np.pi / (width * fine)).ravel()
    far = 1e5
    intensity = (
        np.kron(sky.radiance, np.ones((fine, fine, 1))).reshape(-1, 3)
        * solid[:, None]
        * far**2
    )
    many = Lights(
        far * direction,
        intensity,
        np.zeros(len(solid)),
        -direction,
        np.zeros(len(solid)),
    )
    expected = render_view(surface, camera(12), many, samples=3).sum(axis=0)
    found = rendered(surface, SKY, samples=1024, size=12)
    seen = found.coverage == 1
    # four standard errors of the mean, which has a noise of 0.37 %
    assert (
        np.abs(
            found.radiance[seen].mean(axis=0) / expected[seen].mean(axis=0) - 1
        ).max()
        < 0.015
    )
    assert (
        np.sqrt(np.mean((found.radiance - expected)[seen] ** 2 / found.variance[seen]))
        < 1.4
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "lighting", [SKY, Lighting(lights(12)), Lighting(lights(2), SKY.environment)]
)
@pytest.mark.parametrize("subsurface", [False, True])
def test_variance__is_that_of_repeated_pictures(lighting, subsurface) -> None:
    surface = ball(eta=1.3, weight=0.5)
    n = len(surface.vertices)
    surface = replace(
        surface,
        s=np.full((n, 3), dipole_s(0.6, eta=1.3)[0]),
        sigma_tr=np.full((n, 3), 1.0),
    )
    options = {"samples": 64, "subsurface": subsurface, "size": 10}
    several = [rendered(surface, lighting, seed, **options) for seed in range(8)]
    pictures = np.stack([one.radiance for one in several])
    stated = np.mean([one.variance for one in several], axis=0)
    seen = (several[0].coverage == 1)[..., None] & (stated > 0)
    # variance of eight pictures in 60 pixels of three channels that go together: 25 %
    assert pictures.var(axis=0, ddof=1)[seen].sum() == pytest.approx(
        stated[seen].sum(), rel=0.5
    )


def test_render__ends_at_the_wanted_error_and_says_so() -> None:
    calls = []
    found = render_monte_carlo(
        ball(),
        camera(),
        SKY,
        Quality(samples=1024, error=0.05),
        rng=np.random.default_rng(1),
        progress=lambda *a: calls.append(a),
    )
    assert found.relative_error <= 0.05
    assert found.samples == 16 * len(calls) >= 16 * MIN_BATCHES
    best = rendered(ball(), SKY, seed=9, samples=1024)
    seen = best.coverage == 1
    gap = np.sqrt(
        np.mean((found.radiance - best.radiance)[seen] ** 2)
        / np.mean(best.radiance[seen] ** 2)
    )
    # and 0.02 of the other picture
    assert gap == pytest.approx(found.relative_error, rel=0.3)


def test_render__the_same_seed_gives_the_same_picture() -> None:
    one, two = (rendered(ball(), SKY, samples=32) for _ in range(2))
    np.testing.assert_array_equal(one.radiance, two.radiance)
    assert not np.array_equal(
        one.radiance, rendered(ball(), SKY, seed=2, samples=32).radiance
    )


@pytest.mark.parametrize("subsurface", [False, True])
def test_render__in_parts_that_fit_into_memory(monkeypatch, subsurface) -> None:
    n = len(ball().vertices)
    translucent = {"s": np.full((n, 3), 0.5), "sigma_tr": np.full((n, 3), 1.0)}
    surface = replace(ball(), **translucent)
    options = {"samples": 64, "subsurface": subsurface}
    whole = rendered(surface, SKY, seed=3, **options)
    sizes = []

    def counted(surface, camera, **others):
        view = trace_view(surface, camera, **others)
        sizes.append(camera.height * camera.width * view.samples**2)
        return view

    monkeypatch.setattr(monte_carlo, "trace_view", counted)
    monkeypatch.setattr(monte_carlo, "MAX_RAYS", 5 * 24 * 16)
    parts = rendered(surface, SKY, **options)
    assert max(sizes) <= 5 * 24 * 16
    assert parts.radiance.shape == whole.radiance.shape
    # rays at random points of the pixels at the edge
    np.testing.assert_allclose(parts.coverage, whole.coverage, atol=0.3)
    np.testing.assert_array_equal(parts.coverage == 0, whole.coverage == 0)
    seen = (whole.coverage == 1)[..., None] & (whole.variance > 0)
    spread = np.sqrt(parts.variance + whole.variance)[seen]
    z = (parts.radiance - whole.radiance)[seen] / spread
    # 1 with many batches; these have four each, so that variances are rough
    assert np.sqrt(np.mean(z**2)) < 1.7
    assert np.median(np.abs(z)) < 1


def test_environment__draws_by_its_density() -> None:
    sky = SKY.environment
    count = 200_000
    drawn = sky.sample(np.random.default_rng(2).random((count, 2)))
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 1, atol=1e-12)
    found = np.bincount(sky._texel(drawn), minlength=8 * 16)
    edge = np.cos(np.pi * np.arange(9) / 8)
    solid = np.repeat((edge[:-1] - edge[1:]) * 2 * np.pi / 16, 16)
    expected = (
        count
        * np.array([sky.pdf(drawn[sky._texel(drawn) == i][:1])[0] for i in range(128)])
        * solid
    )
    assert expected.sum() == pytest.approx(count, rel=1e-9)
    assert ((found - expected) ** 2 / expected).sum() < stats.chi2.ppf(1 - LEVEL, 127)


def test_environment__directions_of_the_image() -> None:
    """Top row above the head, middle column in front of the face, right of it the
    subject's left.
    """
    image = np.zeros((2, 4, 3))
    image[0, 2] = 1  # above, from the front to the subject's left
    sky = Environment(image)
    assert sky.along(np.array([[0.5, 0.5, 0.7]]))[0, 0] == 1
    assert (
        sky.along(
            np.array([[-0.5, 0.5, 0.7], [0.5, -0.5, 0.7], [0.5, 0.5, -0.7]])
        ).max()
        == 0
    )


@pytest.mark.parametrize(
    ("channels", "said"),
    [
        (np.ones((4, 8)), "must have the channels R, G and B; found Y"),
        (-np.ones((4, 8, 3)), "must be finite, not negative"),
        (np.zeros((4, 8, 3)), "not zero everywhere; found zero everywhere"),
        (np.ones((4, 4, 3)), "twice as wide as it is high; found 4 x 4 pixels"),
        (np.full((4, 8, 3), np.nan), "found 96 values that are not finite, 0 negative"),
    ],
)
def test_environment__faults_are_named(tmp_path, channels, said) -> None:
    write_exr(tmp_path / "sky.exr", channels.astype(np.float32))
    with pytest.raises(InputError, match=said):
        Environment.read(tmp_path / "sky.exr")


@pytest.mark.parametrize("error", [0.002, 0.01, 0.05, 0.5])
def test_tree_opening__costs_less_than_it_says(error) -> None:
    """Against a tree that opens nearly every node, on a ball that is lit from one side."""
    opening, bound = tree_opening(error)
    assert bound <= max(error / 10, 0.015 * 0.02)
    surface = ball(eta=1.3)
    s, _ = dipole_s(surface.diffuse, eta=1.3)
    skin = replace(surface, s=s, sigma_tr=np.full(s.shape, [0.3, 0.7, 1.2]))
    received = np.maximum(surface.normals @ [[1.0], [0.2], [0]], 0) * np.ones((1, 3))
    areas = vertex_areas(skin.vertices, skin.faces)
    parts = (skin.vertices, areas, received, skin.s, skin.sigma_tr)
    true, found = (
        subsurface_exitance(*parts, eta=skin.eta, tolerance=tolerance)
        for tolerance in (1e-4, opening)
    )
    assert np.linalg.norm(found - true) / np.linalg.norm(true) < bound


COUNT = 32


def around(count: int = COUNT) -> Lights:
    """Lights all around, of different powers."""
    rng = np.random.default_rng(3)
    position = rng.standard_normal((count, 3))
    position *= 500 / np.linalg.norm(position, axis=1, keepdims=True)
    intensity = rng.uniform(1e5, 5e5, (count, 1)) * np.ones(3)
    return Lights(
        position, intensity, np.zeros(count), -position / 500, np.zeros(count)
    )


def test_light_choice__draws_by_its_probabilities() -> None:
    view = trace_view(ball(), camera(), samples=4)
    choice = LightChoice.of_lights(around(), np.zeros(3))
    rng = np.random.default_rng(1)
    drawn = [pair for _ in range(50) for pair in choice.draw(view, rng)]
    found = sum(np.bincount(at, minlength=COUNT) for at, _ in drawn)
    # the sum of the inverse probabilities of a light, over the hits, estimates the number of hits
    weights = (
        sum(np.bincount(at, weights=weight, minlength=COUNT) for at, weight in drawn)
        / 50
    )
    assert found.sum() == 50 * LIGHTS_PER_RAY * len(view.pixel)
    # of the rarest light, which is behind the ball
    np.testing.assert_allclose(weights, len(view.pixel), rtol=0.06)


def test_light_choice__light_from_below_the_horizon_is_rare() -> None:
    view = trace_view(ball(), camera(), samples=4)
    lights = around()
    rng = np.random.default_rng(1)
    above = [
        np.einsum("nc,nc->n", lights.position[at] - view.position, view.normal) > 0
        for at, _ in LightChoice.of_lights(lights, np.zeros(3)).draw(view, rng)
    ]
    assert np.mean(above) > 0.9  # half of the lights are below the horizon of a place


def test_light_choice__few_lights_are_all_used() -> None:
    view = trace_view(ball(), camera(), samples=2)
    pairs = LightChoice.of_lights(around(3), np.zeros(3)).draw(
        view, np.random.default_rng(1)
    )
    assert [set(at) for at, _ in pairs] == [{0}, {1}, {2}]
    assert all((weight == 1).all() for _, weight in pairs)


def test_light_choice__lights_that_are_off_give_a_black_picture() -> None:
    dark = replace(around(), intensity=np.zeros((COUNT, 3)))
    assert rendered(ball(), Lighting(dark), samples=16).radiance.max() == 0


def test_stratified__one_ray_in_every_cell_row_and_column() -> None:
    side = 4
    count = side**2
    pixel = np.repeat([7, 3, 11], count)
    view: Any = SimpleNamespace(
        samples=side, pixel=pixel, ray=np.tile(np.arange(count), 3)
    )
    drawn = stratified(view, np.random.default_rng(0))
    whole = np.tile(np.arange(count), 3)
    for k in range(2):
        np.testing.assert_array_equal(
            np.sort((drawn[:, k] * count).astype(int).reshape(3, count)).ravel(), whole
        )
    column, row = (drawn * side).astype(int).T
    cell = (column * side + row).reshape(3, count)
    np.testing.assert_array_equal(np.sort(cell).ravel(), whole)
    # pixels do not share their numbers
    assert len(np.unique(np.round(drawn[:, 0], 9))) == 3 * count


def test_environment__shares_out_stratified_draws_between_a_sun_and_the_sky() -> None:
    """Of 16 rays, those towards a sun of four texels differ by less than one from pixel
    to pixel; in the order of the rows they would differ by more.
    """
    image = np.ones((32, 64, 3))
    for row, column in ((4, 5), (9, 40), (16, 20), (20, 60)):
        image[row, column] = 500
    sky = Environment(image)
    rng = np.random.default_rng(1)
    first = (np.arange(16) + rng.random((1000, 16))) / 16
    draw = np.stack([first.ravel(), rng.random(16_000)], axis=1)
    bright = sky.along(sky.sample(draw))[:, 0] > 1
    assert np.ptp(bright.reshape(1000, 16).sum(axis=1)) <= 1
