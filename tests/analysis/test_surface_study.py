"""The space of BRDFs on planted coefficients: groups, distances, the map, plots and the
study through the store.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
import xarray as xr
from planted_population import NAMES, TABLES, H, model_of
from scipy.spatial.distance import pdist, squareform

from skindb import workflow
from skindb.analysis import (
    brdf_space,
    describe_brdf_space,
    describe_study,
    plot_brdf_space,
    plot_group_lobes,
    plot_group_spheres,
    plot_study,
    tabulate_study,
)
from skindb.analysis.brdf import component_vectors
from skindb.analysis.brdf_plots import lobe, sphere_radiance
from skindb.errors import InputError
from skindb.optics.angles import half_difference
from skindb.reflectance.tables import brdf_metric, lookup
from skindb.schema import check, dataset
from skindb.store import Database
from skindb.workflow import studies
from skindb.workflow.upkeep import repeat_study

GLOSS = np.array([0.05, 0.0, 0.0])


def _planted(
    subjects, *, shift=0.0, seed=0, spread=0.004, conditions=None, noise=0.002, **coords
):
    """A cohort and its basis, with coefficients by subject and by take; `shift` (take,)
    is added to the gloss.
    """
    rng = np.random.default_rng([31, seed])
    n = len(subjects)
    who = {name: spread * rng.normal(size=3) for name in dict.fromkeys(subjects)}
    own = np.array([who[name] for name in subjects]) + noise * rng.normal(size=(n, 3))
    coefficient = 0.1 + own + np.broadcast_to(shift, n)[:, None] * GLOSS
    takes = [f"{name}.{i}" for i, name in enumerate(subjects)]
    along = {name: ("take", np.array(values)) for name, values in coords.items()}
    along |= {
        "subject": ("take", list(subjects)),
        "condition": ("take", conditions or ["normal"] * n),
    }
    basis = dataset(
        {
            "population_mixture": H,
            "take_coefficient": coefficient,
            "component_vector": component_vectors(H, brdf_metric(TABLES)),
        },
        coords={"take": takes, "dictionary": NAMES},
    )
    return xr.Dataset(coords={"take": takes, **along}), basis


def _space(planted, group_by, **options):
    cohort, basis = planted
    options = {"permutations": 999, "rng": np.random.default_rng(0)} | options
    return brdf_space(cohort, basis=basis, tables=TABLES, group_by=group_by, **options)


def _names(n):
    return [f"S{i:02d}" for i in range(n)]


def test_brdf_space__a_planted_difference_is_found_and_nothing_else():
    group = np.array(["a", "b", "c"])[np.arange(36) % 3]
    space = _space(
        _planted(_names(36), shift=(group == "c") * 0.3, group=group), "group"
    )
    assert space["pair"].values.tolist() == ["a to b", "a to c", "b to c"]
    p = space["group_distance_p_adjusted"].values
    assert p[0] > 0.05
    assert (p[1:] < 0.01).all()
    assert (p >= space["group_distance_p"].values).all()
    assert space.attrs["adjusted_by"] == "largest statistic"
    assert space["group_distance"][1] > 3 * space["group_distance_noise"][1]
    assert describe_brdf_space(space)[0].startswith("2 of 3 pairs of groups differ")
    check(
        space,
        ["group_coefficient", "group_brdf", "take_distance", "take_place", "map_error"],
    )


def test_brdf_space__pairs_of_interest_alone_are_counted():
    group = np.array(["a", "b", "c"])[np.arange(36) % 3]
    planted = _planted(_names(36), shift=(group == "c") * 0.1, group=group)
    chosen = _space(planted, "group", pairs=["a to c", "b to c"])
    assert chosen["pair"].values.tolist() == ["a to c", "b to c"]
    assert chosen.attrs["adjusted_by"] == "Bonferroni"
    p = chosen["group_distance_p"]
    np.testing.assert_allclose(
        chosen["group_distance_p_adjusted"], np.minimum(2 * p, 1)
    )
    with pytest.raises(InputError, match="choose from: a to b, a to c, b to c"):
        _space(planted, "group", pairs=["c to a"])


def test_brdf_space__distances_are_those_of_the_tables():
    """SciPy's distances of the BRDFs at every node, weighted as the metric does."""
    planted = _planted(_names(12), group=["a", "b"] * 6)
    space = _space(planted, "group")
    coefficient = planted[1]["take_coefficient"].values.astype(float)
    metric = brdf_metric(TABLES)
    root = np.linalg.cholesky(metric + 1e-12 * np.trace(metric) * np.eye(8))
    place = coefficient @ H @ root
    length = np.linalg.norm(place.mean(axis=0))
    np.testing.assert_allclose(
        space["take_distance"], squareform(pdist(place)) / length, rtol=1e-5, atol=1e-9
    )
    step = np.linalg.norm(place[::2].mean(axis=0) - place[1::2].mean(axis=0)) / length
    np.testing.assert_allclose(space["group_distance"], [step], rtol=1e-5)
    want = TABLES @ (coefficient[::2].mean(axis=0) @ H)
    found = space["group_brdf"].isel(group=0).values
    np.testing.assert_allclose(found[..., :-1], want, rtol=1e-5)
    # the first node again, at the end of the period
    np.testing.assert_array_equal(found[..., -1], found[..., 0])


@pytest.mark.parametrize("error", [0.0001, 0.002])
def test_brdf_space__changes_within_the_errors_of_the_surface_are_flagged(error):
    """The surface reflectance of the face changes by 0.001."""
    names = _names(12)
    conditions = ["normal"] * 12 + ["lotion"] * 12
    cohort, basis = _planted(names * 2, conditions=conditions)
    values = 0.03 + np.repeat([0.0, 0.001], 12)[:, None]
    dims = ("take", "region")
    cohort = cohort.assign(
        region_surface_reflectance=(dims, values),
        region_surface_reflectance_error=(dims, np.full((24, 1), error)),
    ).assign_coords(region=["face"])
    flags = _space((cohort, basis), "condition").attrs["flags"]
    expected = "the reliability of the surface reflectance of the face is 0.00"
    assert any(flag.endswith(expected) for flag in flags) == (error == 0.002)


def test_brdf_space__the_unit_is_the_subject():
    """Ten takes of one subject count as one; otherwise, two groups would differ."""
    subjects = ["S00"] * 10 + _names(12)[1:]
    group = ["a" if name < "S06" else "b" for name in subjects]
    planted = _planted(subjects, spread=0.01, noise=1e-5, group=group)
    space = _space(planted, "group")
    assert space["group_subject_count"].values.tolist() == [6, 6]
    first = planted[1].isel(take=[9, *range(10, 15)])["take_coefficient"].mean("take")
    np.testing.assert_allclose(
        space["group_coefficient"].isel(group=0), first, atol=3e-5
    )
    assert space.sizes["take"] == 21


def test_brdf_space__conditions_are_compared_within_subjects():
    """A shift below the spread between subjects is found; a subject with one condition
    only does not count.
    """
    subjects = [*_names(12), *_names(12), "T"]
    conditions = ["normal"] * 12 + ["lotion"] * 12 + ["lotion"]
    lotion = np.array(conditions) == "lotion"
    planted = _planted(
        subjects, spread=0.02, noise=0.001, shift=0.1 * lotion, conditions=conditions
    )
    space = _space(planted, "condition", permutations=5000)
    assert space["group"].values.tolist() == ["normal", "lotion"]
    assert space["pair_subject_count"].values.tolist() == [[12, 12]]
    assert int(space["pair_permutations"][0]) == 2**12 - 1  # all subjects
    assert float(space["group_distance_p"][0]) == 2 / 2**12
    trait = _space(planted, "lotion", permutations=5000)
    np.testing.assert_array_equal(trait["group_distance_p"], space["group_distance_p"])
    np.testing.assert_allclose(
        trait["group_distance"], space["group_distance"], rtol=1e-6
    )


def test_brdf_space__three_conditions_and_pairs_of_two_kinds():
    subjects = _names(8) * 3
    conditions = ["normal"] * 8 + ["lotion"] * 8 + ["powder"] * 8
    shift = 0.3 * (np.array(conditions) == "powder")
    space = _space(
        _planted(subjects, noise=0.001, shift=shift, conditions=conditions), "condition"
    )
    assert space["group"].values.tolist() == ["normal", "lotion", "powder"]
    assert space.attrs["adjusted_by"] == "largest statistic"
    assert (space["group_distance_p_adjusted"].values < 0.05).tolist() == [
        False,
        True,
        True,
    ]
    subjects = [*_names(8), *_names(8), *(f"T{i}" for i in range(8))]
    mixed = _space(
        _planted(subjects, noise=0.001, shift=shift, conditions=conditions), "condition"
    )
    assert mixed.attrs["adjusted_by"] == "Bonferroni"
    assert mixed["pair_subject_count"].values.tolist() == [[8, 8]] * 3


def test_brdf_space__a_group_of_one_has_a_distance_and_no_p_value():
    group = ["a"] * 5 + ["b"] * 5 + ["c", ""]
    space = _space(_planted(_names(12), group=group), "group")
    assert np.isnan(space["group_distance_p"].values).tolist() == [False, True, True]
    assert np.isfinite(space["group_distance"]).all()
    assert (
        "1 of 12 takes are excluded because they belong to none of the groups"
        in space.attrs["flags"]
    )
    assert (
        "a to c: no p value with fewer than two subjects per group"
        in space.attrs["flags"]
    )
    # choices of 5 of 10, without the observed one
    assert space["pair_permutations"].values.tolist() == [251, 0, 0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"group": ["a"] * 6}, "subjects of two groups; found only a"),
        ({"group": [""] * 6}, "found no take with this attribute"),
        (
            {"age": [20, 30, 40, 50, 60, 70]},
            "must not be numeric; found a numeric attribute",
        ),
        ({"subjects": ["S"] * 6}, "at least two subjects; found one"),
        ({"coefficient": 0.1}, "must differ; found the same BRDF in all takes"),
        ({"coefficient": 0.0}, "must differ; found the same BRDF in all takes"),
        ({"lost": 2}, "take S02.2: a take must have fitted surfels"),
        ({"left": 2}, "take S02.2: a take must have fitted surfels"),
        (
            {"mixture": H[[0, 1, 1]]},
            "linearly independent; found 3 components of rank 2; choose a smaller k",
        ),
    ],
)
def test_brdf_space__refuses(change, message):
    change = {"group": list("aabbab")} | change
    known = {name: change[name] for name in ("group", "age") if name in change}
    cohort, basis = _planted(change.get("subjects", _names(6)), **known)
    if "coefficient" in change:
        basis["take_coefficient"][:] = change["coefficient"]
    if "lost" in change:
        basis["take_coefficient"][change["lost"]] = np.nan
    if "left" in change:
        basis = basis.isel(take=np.delete(np.arange(6), change["left"]))
    if "mixture" in change:
        basis["population_mixture"][:] = change["mixture"]
    with pytest.raises(InputError, match=re.escape(message)):
        _space((cohort, basis), "age" if "age" in change else "group")


def test_sphere_radiance__of_a_constant_brdf_is_the_cosine():
    """A Lambertian sphere, and a sphere of the dictionary compared with a lookup in
    another frame.
    """
    radiance, inside = sphere_radiance(np.ones((*TABLES.shape[:3], 1)))
    y, x = np.nonzero(inside)
    half = len(inside) / 2
    n = np.stack([(x + 0.5) / half - 1, 1 - (y + 0.5) / half], axis=-1)
    n = np.column_stack([n, np.sqrt(1 - (n**2).sum(axis=1))])
    lights = [np.radians(15), np.radians(100)]
    lights = np.array(
        [
            [0, np.sin(lights[0]), np.cos(lights[0])],
            [np.sin(lights[1]), 0, np.cos(lights[1])],
        ]
    )
    np.testing.assert_allclose(
        radiance[inside][:, 0], np.maximum(n @ lights.T, 0).sum(axis=1), atol=1e-12
    )
    pixel = 5000
    frame = np.linalg.qr(np.column_stack([n[pixel], [0.3, 0.8, 0.1], [1, 0, 0]]))[0] * [
        1,
        1,
        1,
    ]
    frame = frame * np.sign(frame[:, 0] @ n[pixel])
    wo = frame[:, [1, 2, 0]].T @ [0, 0, 1]
    want = 0.0
    for light in lights:
        wi = frame[:, [1, 2, 0]].T @ light
        want = want + (
            lookup(TABLES, *half_difference(wi, wo)) * wi[2] if wi[2] > 0 else 0.0
        )
    np.testing.assert_allclose(
        sphere_radiance(TABLES)[0][inside][pixel], want, rtol=1e-6
    )


def test_lobe__is_highest_near_the_mirror_direction():
    angle = np.radians(np.linspace(-80, 80, 161))
    values = lobe(TABLES, np.radians(30), angle)
    narrow = values[:, np.argmax(values.max(axis=0))]
    assert abs(np.degrees(angle[narrow.argmax()]) - 30) <= 3
    mirror = lookup(TABLES, 0.0, np.radians(30), 0.0)
    np.testing.assert_allclose(
        lobe(TABLES, np.radians(30), np.radians([30.0]))[0],
        mirror * np.cos(np.radians(30)),
    )


def test_plots__say_what_they_show(tmp_path):
    group = np.array(["male", "female"])[np.arange(20) % 2]
    space = _space(
        _planted(_names(20), shift=0.3 * (group == "male"), group=group), "group"
    )
    ax = plot_brdf_space(space)
    assert [text.get_text() for text in ax.get_legend().get_texts()] == [
        "female (n = 10)",
        "male (n = 10)",
    ]
    assert f"error of the map {float(space['map_error']):.1%}" in ax.get_ylabel()
    spheres = plot_group_spheres(space)
    assert [text.get_text() for text in spheres.texts] == [
        "female\n(n = 10)",
        "male\n(n = 10)",
    ]
    assert len(spheres.get_images()) == 2
    lobes = plot_group_lobes(space)
    labels = [line.get_label() for line in lobes.get_lines()]
    assert labels == [
        f"{g} (n = 10), {i}°" for i in (30, 60) for g in ("female", "male")
    ]
    plot_study(xr.DataTree.from_dict({"brdf_space": space}), tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000


def _stored(root, models):
    db = Database(root)
    for take, model in models.items():
        with db.stage("model", take) as stage:
            stage.write(
                {str(name): node.to_dataset() for name, node in model.children.items()}
            )
            stage.commit(model.attrs)
    return db


def _people():
    genders = ["female", "male"] * 4
    return {
        f"P{i}": model_of(
            i, gloss=1 + (g == "male"), subject=f"P{i}", traits={"gender": g}
        )
        for i, g in enumerate(genders)
    }


@pytest.mark.slow
def test_surface__is_stored_and_repeated(tmp_path, monkeypatch):
    """The study is stored; the same seed gives the same numbers, and other parameters
    give another study.
    """
    asked = []
    monkeypatch.setattr(
        studies,
        "dictionary_tables",
        lambda *given: asked.append(given[2]) or TABLES,
    )  # 8 of the 59 materials
    db = _stored(tmp_path / "db", _people())
    tree = workflow.surface(db, group_by="gender", k=3)
    assert tree.attrs["study"] == "surface.group_by-gender_k-3"
    header, rows = tabulate_study(tree)
    assert header[:3] == ["pair", "subjects_first", "subjects_second"]
    assert rows[0][:3] == ["female to male", 4, 4]
    # the smallest: 2 of 70 splits
    assert 0.02 < rows[0][header.index("group_distance_p_adjusted")] < 0.05
    assert describe_study(tree)[0].startswith("1 of 1 pairs of groups differ")
    assert (
        describe_study(tree)[-1]
        == "female to male: 4 and 4 subjects; p values are approximate with fewer than 10"
    )
    plot_study(tree, tmp_path / "a.svg")
    assert "sr" in (tmp_path / "a.svg").read_text()
    stored = db.record("population", tree.attrs["study"])
    # as in `refresh`
    record = repeat_study(
        db, stored.take, stored.provenance["parameters"], dictionary=tmp_path
    )
    again = db.read("population", record.take)
    assert (record.generation, asked[-1]) == (2, tmp_path)
    xr.testing.assert_identical(
        again["brdf_space"].to_dataset().load(), tree["brdf_space"].to_dataset().load()
    )
    other = workflow.surface(db, group_by="male", k=2, permutations=500)
    assert other.attrs["study"] not in (again.attrs["study"], "surface")
    with pytest.raises(
        InputError,
        match="k: must not be above the number of BRDFs of the dictionary or of surfels",
    ):
        workflow.surface(db, group_by="gender", k=9)
    with pytest.raises(InputError, match="must be an attribute or a trait"):
        workflow.surface(db, group_by="gendre", k=3)


@pytest.mark.slow
def test_surface__refuses_a_take_without_fitted_surfels(tmp_path, monkeypatch):
    monkeypatch.setattr(studies, "dictionary_tables", lambda *_: TABLES)
    models = dict(list(_people().items())[:4])
    fitted = models["P3"]["fitted"].to_dataset()
    fitted["dictionary_weight"][:] = np.nan
    fitted["diffuse_reflectance"][:] = np.nan
    fitted["fit_status"][:] = 1
    models["P3"]["fitted"] = xr.DataTree(fitted)
    with pytest.raises(
        InputError, match="take P3: a take must have fitted surfels; found none"
    ):
        workflow.surface(_stored(tmp_path, models), group_by="gender", k=3)
