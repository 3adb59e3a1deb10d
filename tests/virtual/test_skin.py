from dataclasses import replace

import numpy as np
import pytest

from skindb.optics.diffusion import diffuse_reflectance, reduced_albedo
from skindb.parameters import CONDITIONS
from skindb.virtual.face import FaceShape
from skindb.virtual.head import parametric_head
from skindb.virtual.person import ANCESTRIES, Person, cohort_people
from skindb.virtual.skin import (
    MATERIALS,
    skin_of,
    skin_tables,
    smooth_noise,
)

# stand-in albedos of the materials at normal incidence
TABLES = skin_tables()
ALBEDO = np.array([0.10, 0.05, 0.20, 0.30, 0.08, 0.06, 0.15, 0.25])
SHARP = [1, 3, 5, 6]
PERSON = Person("A", 35, "female", "european", 7)


@pytest.fixture(scope="module")
def head():
    return parametric_head(FaceShape(), spacing_mm=3.0)


def _skin(head, person):
    return skin_of(head, person, material_albedo=ALBEDO, eta=1.3)


def _specular(skin):
    return skin.weights @ ALBEDO


@pytest.mark.parametrize("ancestry", ANCESTRIES)
@pytest.mark.parametrize("gender", ["female", "male"])
def test_skin_of__cheek_colour_is_near_the_measured_mean(head, ancestry, gender):
    colours = [
        _skin(head, Person("A", 30, gender, ancestry, seed))
        .diffuse[head.membership["cheek"] > 0.9]
        .mean(axis=0)
        for seed in range(3)
    ]
    # 25 %: the flush of the cheeks, ageing and low-frequency mottling are real shifts of one person
    np.testing.assert_allclose(
        np.mean(colours, axis=0),
        TABLES.mean[ancestry, gender][TABLES.sites.index("cheek")],
        rtol=0.25,
    )


def test_skin_of__is_within_physical_limits(head):
    for condition in CONDITIONS:
        skin = _skin(
            head, replace(PERSON, condition=condition, beard_density=1.0, freckles=1.0)
        )
        assert skin.diffuse.min() > 0
        assert skin.diffuse.max() < 1
        assert skin.weights.min() >= 0
        assert skin.weights.shape == (len(head.vertices), len(MATERIALS))
        assert (skin.diffuse.max(axis=1) + _specular(skin) < 1).all()


def test_skin_of__normal_condition_has_the_specular_albedo_of_skin(head):
    skin = _skin(head, PERSON)
    albedo = _specular(skin) / skin.gloss["age"]
    assert albedo.min() >= 0.03 - 1e-12
    assert albedo.max() <= 0.06 + 1e-12
    nose, neck = (albedo[head.membership[r] > 0.9].mean() for r in ("nose", "neck"))
    assert nose > neck


def test_skin_of__lotion_is_glossier_and_narrower_powder_the_opposite(head):
    normal, lotion, powder = (
        _skin(head, replace(PERSON, condition=c))
        for c in ("normal", "lotion", "powder")
    )
    assert (_specular(lotion) > 1.2 * _specular(normal)).all()
    assert (_specular(powder) < 0.9 * _specular(normal)).all()
    sharp = [
        (s.weights[:, SHARP] @ ALBEDO[SHARP]).sum() / _specular(s).sum()
        for s in (powder, normal, lotion)
    ]
    assert sharp == sorted(sharp)
    np.testing.assert_array_equal(lotion.diffuse, normal.diffuse)


def test_skin_of__one_person_has_four_bases_all_conditions_six_a_population_eight(head):
    people = cohort_people(20, paper=True)
    weights = [_skin(head, person).weights[::50] for person in people]
    assert np.linalg.matrix_rank(weights[0]) == np.linalg.matrix_rank(weights[-1]) == 4
    of_one = [w for w, p in zip(weights, people, strict=True) if p.subject == "A001"]
    assert np.linalg.matrix_rank(np.vstack(of_one)) == 6
    assert np.linalg.matrix_rank(np.vstack(weights)) == 8


def test_skin_of__each_vertex_has_one_planted_brdf(head):
    """Four of the planted BRDFs in a take, six in conditions of a person, all in a population,
    each on a fair fraction of the surface.
    """
    of_one = [replace(PERSON, bases=8, condition=c) for c in ("normal", "lotion")]
    fractions = []
    for person in of_one:
        skin = skin_of(head, person, material_albedo=ALBEDO, eta=1.3)
        assert ((skin.weights > 0).sum(axis=1) == 1).all()
        fractions.append((skin.weights > 0).mean(axis=0))
    fractions = np.array(fractions)
    assert ((fractions > 0.15).sum(axis=1) == 4).all()
    assert fractions[fractions > 0].max() < 0.35
    assert (fractions > 0).any(axis=0).sum() == 6


def test_skin_of__gloss_has_the_stated_factors(head):
    base = _skin(head, replace(PERSON, age=40))
    changed = replace(PERSON, age=65, ancestry="african", condition="lotion")
    skin = _skin(head, changed)
    effects = TABLES.gloss_effects
    assert skin.gloss == {
        "ancestry": effects.albedo["african"],
        "age": pytest.approx(np.exp(25 * effects.albedo_per_year)),
        "condition": TABLES.effects["lotion"].gloss,
    }
    assert [*base.gloss.values()] == [1, 1, 1]
    factor = np.prod([*skin.gloss.values()])
    np.testing.assert_allclose(_specular(skin), factor * _specular(base))


def test_skin_of__tan_is_darker_and_hot_is_redder(head):
    normal, tan, hot = (
        _skin(head, replace(PERSON, condition=c)).diffuse
        for c in ("normal", "tan", "hot")
    )
    np.testing.assert_allclose(
        np.log(normal / tan).mean(axis=0), 0.22 * TABLES.melanin, rtol=1e-6
    )
    np.testing.assert_allclose(
        np.log(normal / hot).mean(axis=0), 0.12 * TABLES.haemoglobin, rtol=1e-6
    )


def test_skin_of__beard_darkens_the_beard_region_only(head):
    bare, shadow = (
        _skin(head, replace(PERSON, gender="male", beard_density=d)).diffuse
        for d in (0.0, 0.8)
    )
    outside = head.membership["beard"] == 0
    np.testing.assert_array_equal(bare[outside], shadow[outside])
    assert (
        shadow[head.membership["beard"] > 0.9]
        < 0.95 * bare[head.membership["beard"] > 0.9]
    ).all()


def test_skin_of__sites_lie_on_the_face_and_their_optics_are_consistent(head):
    skin = _skin(head, PERSON)
    assert [site.name for site in skin.sites] == list(TABLES.sigma_tr)
    for site in skin.sites:
        sigma_t = site.sigma_a + site.sigma_s_prime
        np.testing.assert_allclose(
            np.sqrt(3 * site.sigma_a * sigma_t), site.sigma_tr, rtol=1e-9
        )
        s = np.sqrt(3 * site.sigma_a / sigma_t)
        np.testing.assert_allclose(
            diffuse_reflectance(s, eta=1.3), site.diffuse_reflectance, rtol=1e-9
        )
        np.testing.assert_allclose(
            reduced_albedo(s), site.sigma_s_prime / sigma_t, rtol=1e-9
        )
        assert (np.diff(site.sigma_tr) > 0).all()  # red travels farthest
        at = ((head.vertices - site.position) ** 2).sum(axis=1).argmin()
        assert head.membership[site.name][at] > 0.5
        # Shepard mixes in the other sites
        np.testing.assert_allclose(skin.sigma_tr[at], site.sigma_tr, rtol=0.1)


def test_smooth_noise__has_zero_mean_and_unit_variance():
    rng = np.random.default_rng(0)
    points = rng.uniform(-100, 100, (20000, 3))
    field = np.stack([smooth_noise(points, 10.0, rng=rng) for _ in range(4)])
    assert abs(field.mean()) < 0.05
    assert field.var() == pytest.approx(1, abs=0.1)
