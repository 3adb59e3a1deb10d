"""Bases of planted populations, their size, and studies through the store."""

from __future__ import annotations

import importlib.util
import re
import tracemalloc
from pathlib import Path

import dask.array
import numpy as np
import pytest
import xarray as xr
from planted_population import GRID, NAMES, TABLES, H, N, surfels
from planted_population import population as _population
from planted_population import unit as _unit

from skindb import workflow
from skindb.analysis import (
    basis_size_curve,
    brdf,
    cohort_of,
    describe_basis_size,
    plot_basis_size,
    plot_study,
    population_basis,
    tabulate_basis_size,
    tabulate_study,
)
from skindb.analysis.brdf import (
    choose_size,
    project,
    surfel_errors,
)
from skindb.errors import InputError
from skindb.numerics.factorise import relative_error
from skindb.optics.angles import half_difference
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.mixture import basis_rows
from skindb.reflectance.tables import brdf_metric, lookup
from skindb.schema import dataset
from skindb.schema.cohort import Part, Values, combine, values_of
from skindb.store import Database, StaleWarning
from skindb.workflow import studies


def test_population_basis__spans_the_planted_one():
    models = _population()
    basis = population_basis(
        surfels(models), tables=TABLES, k=3, rng=np.random.default_rng(0)
    )
    assert basis.attrs["nmf_error"] < 0.01
    found = basis["population_mixture"].values
    left = H - project(H, found, np.eye(8)) @ found
    # NMF of a planted cone is unique up to its noise
    assert np.linalg.norm(left) / np.linalg.norm(H) < 0.15


@pytest.mark.parametrize("in_metric", [False, True])
def test_population_basis__of_every_surfel(in_metric):
    """The error equals that of all surfels at once, with equal weights of takes and any
    scheduler.
    """
    cohort = _lazy_cohort({"S0": 40_000, "S1": 5_000})
    call = {"tables": TABLES, "k": 3, "in_metric": in_metric}
    with dask.config.set(scheduler="synchronous"):
        found = population_basis(cohort, rng=np.random.default_rng(0), **call)
    other = population_basis(cohort.load(), rng=np.random.default_rng(0), **call)
    # BLAS depends on the alignment of arrays: 2e-10 measured
    xr.testing.assert_allclose(found, other, rtol=1e-6)
    assert found.attrs["nmf_surfels"] == 45_000
    A = brdf_metric(TABLES) if in_metric else np.eye(8)
    weights = [
        w[np.isfinite(w).all(axis=1)].astype(float)
        for w in cohort["dictionary_weight"].values
    ]
    X = [w / np.sqrt(len(w)) for w in weights]
    # single precision of the stored rows
    assert found.attrs["nmf_error"] == pytest.approx(
        relative_error(
            np.concatenate(X), found["population_mixture"].values.astype(float), A
        ),
        rel=1e-5,
    )
    areas = [a[np.isfinite(a)].astype(float) for a in cohort["surfel_area"].values]
    means = np.stack(
        [np.average(w, axis=0, weights=a) for w, a in zip(weights, areas, strict=True)]
    )
    want = project(
        means, found["population_mixture"].values.astype(float), brdf_metric(TABLES)
    )
    np.testing.assert_allclose(found["take_coefficient"], want, rtol=1e-4, atol=1e-7)


def test_population_basis__two_runs_agree():
    """Different samples and starts of planted mixtures give the same rows in order,
    within the freedom of NMF.
    """
    models = _population()
    a, b = (
        population_basis(
            surfels(models), tables=TABLES, k=3, rng=np.random.default_rng(s)
        )
        for s in (1, 2)
    )
    np.testing.assert_allclose(
        a["population_mixture"], b["population_mixture"], atol=0.1
    )


def test_population_basis__one_dictionary():
    models = _population()
    for take, model in models.items():
        model.attrs["dictionary"] = "mine" if take == "B" else "embedded"
    with pytest.raises(InputError, match="one dictionary; found embedded, mine"):
        population_basis(
            surfels(models).assign_attrs(mixed_fits=True),
            tables=TABLES,
            k=2,
            rng=np.random.default_rng(0),
        )


def test_brdf_metric__is_the_integral_over_directions():
    """Compared with Monte Carlo integration over uniform pairs of directions, with
    values looked up in the tables.
    """
    rng = np.random.default_rng(0)
    wi, wo = (_unit(rng.normal(size=(300_000, 3))) * [1, 1, 1] for _ in range(2))
    wi[:, 2], wo[:, 2] = abs(wi[:, 2]), abs(wo[:, 2])
    # narrow lobes need more samples
    smooth = TABLES[..., np.argsort(TABLES.max(axis=(0, 1, 2)))[:3]]
    b = lookup(smooth, *half_difference(wi, wo))
    weight = wi[:, 2] * wo[:, 2] / np.maximum(b.mean(axis=1), 1e-6) ** (4 / 3)
    want = b.T @ (b * weight[:, None])
    found = brdf_metric(smooth)
    np.testing.assert_allclose(
        found / np.trace(found), want / np.trace(want), rtol=0.03
    )
    assert np.linalg.eigvalsh(brdf_metric(TABLES)).min() > 0


def _capture(model: xr.DataTree, noise: float) -> xr.DataTree:
    """Samples that the basis weights of the model predict, with noise."""
    rng = np.random.default_rng(9)
    lights, cameras = (
        _unit(rng.normal(size=(n, 3)) * [1, 1, 0.3] + [0, 0, 1]) * 900 for n in (20, 3)
    )
    node = model["fitted"].to_dataset()
    position = node["surfel_position"].values.astype(float)
    normal = node["shading_normal"].values.astype(float)
    to_light, to_camera = (
        _unit(p[None] - position[:, None]) for p in (lights, cameras)
    )
    rows, offsets, index = basis_rows(
        TABLES, GRID, normal, to_light, to_camera, np.ones((N, 20, 3), bool)
    )
    surfel = np.repeat(np.arange(N), np.diff(offsets))
    cos = [
        np.einsum("nc,nc->n", normal[surfel], d[surfel, index[:, i]])
        for i, d in enumerate((to_light, to_camera))
    ]
    matte = (
        cos[0]
        * fresnel_transmittance(cos[0], 1.3)
        * fresnel_transmittance(cos[1], 1.3)
        / np.pi
    )
    value = (rows * node["dictionary_weight"].values[surfel]).sum(1)[:, None] + matte[
        :, None
    ] * node["diffuse_reflectance"].values[surfel]
    sample = np.full((N, 20, 3, 3), np.nan)
    sample[surfel, index[:, 0], index[:, 1]] = value * (
        1 + noise * rng.normal(size=value.shape)
    )
    return xr.DataTree.from_dict(
        {
            "samples": dataset({"reflectance_sample": sample}),
            "dome": dataset({"light_position": lights, "camera_position": cameras}),
        }
    )


@pytest.mark.slow
def test_basis_size_curve__finds_the_planted_size():
    models = {t: m for t, m in _population().items() if t in ("A", "B")}
    # the third basis lowers the error by 3 %
    captures = {t: _capture(m, 0.001) for t, m in models.items()}
    cohort = cohort_of(models, "surfels", captures=captures, surfels=40)
    curve = basis_size_curve(
        cohort, tables=TABLES, ks=(1, 2, 3, 4, 5, 6), rng=np.random.default_rng(0)
    )
    assert curve["smallest_size"] == curve["sufficient_size"] == 3
    assert float(curve["relative_error"].sel(k=1)) > 1.1
    assert (curve["relative_error_low"] <= curve["relative_error"] + 1e-9).all()
    assert curve.attrs["surfels"] == 80
    ax = plot_basis_size({"planted": curve})
    ax.figure.canvas.draw()
    assert not any("$" in label.get_text() for label in ax.get_yticklabels())


def test_basis_size_curve__even_reflection_and_outliers_are_no_bases():
    """Every surfel reflects some light evenly, and no BRDF explains three of them."""
    models = {t: m for t, m in _population().items() if t in ("A", "B")}
    captures = {t: _capture(m, 0.001) for t, m in models.items()}
    rng = np.random.default_rng(0)
    for take, capture in captures.items():
        fitted = models[take]["fitted"]
        place = fitted["surfel_position"].values[:, None].astype(float)
        to_light = _unit(capture["dome"]["light_position"].values - place)
        cosine = np.einsum("nli,ni->nl", to_light, fitted["shading_normal"].values)
        sample = capture["samples"]["reflectance_sample"]
        even = rng.uniform(0, 0.05, len(place))[:, None] * cosine
        sample.values += even[..., None, None]
        sample.values[7:10] *= rng.lognormal(0, 0.1, sample.values[7:10].shape)
    cohort = cohort_of(models, "surfels", captures=captures, surfels=60)
    curve = basis_size_curve(
        cohort, tables=TABLES, ks=(1, 2, 3, 4, 5, 6), rng=np.random.default_rng(0)
    )
    assert curve["smallest_size"] == curve["sufficient_size"] == 3


def _benchmark():
    path = Path(__file__).parents[2] / "benchmarks" / "basis_size.py"
    spec = importlib.util.spec_from_file_location("benchmark_of_basis_size", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_basis_size_curve__streams_what_it_does_not_factor(monkeypatch):
    """Bases from 40 of 80 surfels in blocks of 7 give the curve of all surfels, with
    its plateau at the same place.
    """
    models = {t: m for t, m in _population().items() if t in ("A", "B")}
    captures = {t: _capture(m, 0.001) for t, m in models.items()}
    cohort = cohort_of(models, "surfels", captures=captures, surfels=40)
    call = {"tables": TABLES, "ks": (1, 2, 3, 4, 5, 99)}
    whole = basis_size_curve(cohort, rng=np.random.default_rng(0), **call)
    monkeypatch.setattr(brdf, "MAX_FACTORED", 40)
    monkeypatch.setattr(brdf, "BLOCK", 7)
    part = basis_size_curve(cohort, rng=np.random.default_rng(0), **call)
    assert list(part["k"].values) == [1, 2, 3, 4, 5]  # there are 8 bases, not 99
    assert part.attrs["surfels"] == whole.attrs["surfels"] == 80
    assert whole["smallest_size"] == part["smallest_size"] == 3
    np.testing.assert_allclose(
        part["relative_error"], whole["relative_error"], rtol=0.1
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "noise", "seed"), [(4, 0.01, 1), (4, 0.03, 2), (6, 0.01, 1)]
)
def test_choose_size__finds_planted_sizes_and_refuses_below_them(size, noise, seed):
    """Problems in which all bases matter; the benchmark has more of them, and some that
    are ambiguous.
    """
    benchmark = _benchmark()
    systems, needed, H = benchmark.planted(size, noise, seed, surfels=150, lights=30)
    assert needed > 1.05
    sizes, error = benchmark.found_sizes(systems, largest=size + 2)
    assert benchmark.judged(size, *sizes) in ("right", "range that contains the truth")
    squares, free = surfel_errors(systems, [H]).sum(axis=0)
    truth = np.sqrt(squares / free)
    # the search has converged: the truth is not better
    assert error[size - 1] < 1.001 * truth[0] / truth[1]
    fewest, most = benchmark.found_sizes(systems, largest=size - 1)[0]
    assert most == 0  # each further basis would still lower the error
    assert benchmark.judged(size, fewest, most) == "range that contains the truth"


def test_choose_size__by_hand():
    """All surfels are equal, so that the interval is a point and the rule can be
    computed by hand.
    """

    def size(*rms, tolerance=0.01):
        errors = np.ones((20, 3, len(rms)))
        errors[:, 0] = np.square(rms)
        ks = range(1, len(rms))
        return choose_size(
            errors, ks, tolerance=tolerance, rng=np.random.default_rng(0)
        )[3]

    assert size(3.0, 1.5, 1.009, 1.008, 1.0) == (3, 3)
    assert size(3.0, 1.5, 1.03, 1.008, 1.0) == (4, 0)  # only the largest
    assert size(3.0, 1.5, 1.010, 1.008, 1.008, 1.0) == (3, 3)
    # within 2 %, but a step of 1.2 % remains
    assert size(3.0, 1.5, 1.02, 1.008, 1.008, 1.0, tolerance=0.02) == (4, 4)
    # the step comes later
    assert size(3.0, 1.5, 1.02, 1.02, 1.005, 1.005, 1.0, tolerance=0.02) == (5, 5)
    # small steps that add up to 1 %
    assert size(1.013, 1.0108, 1.0086, 1.0064, 1.0042, 1.002, 1.0) == (2, 2)
    assert size(1.013, 1.0108, 1.0086, 1.0064, 1.0042, 1.002, 1.0, tolerance=0.02) == (
        1,
        1,
    )
    # level, but far above the error of all bases
    assert size(3.0, 1.5, 1.5, 1.5, 1.0) == (2, 0)
    assert size(1.0, 1.0) == (1, 0)  # one size is no curve


def test_choose_size__is_a_range_if_the_sample_is_ambiguous():
    """One surfel in fifty needs the larger size: if it is drawn twice, the error is
    above the tolerance.
    """
    errors = np.ones((50, 3, 5))
    errors[:, 0, 0] = 4.0
    errors[0, 0, 1] += 0.9
    error, low, _, sizes = choose_size(
        errors, (1, 2, 3, 4), tolerance=0.01, rng=np.random.default_rng(0)
    )
    assert error[1] < 1 + brdf.STEP
    assert low[1] == 1.0
    assert sizes == (2, 3)


def _curve(error, *, fewest, most):
    error = np.asarray(error, float)
    return dataset(
        {
            "relative_error": error,
            "relative_error_low": 1 + 0.9 * (error - 1),
            "relative_error_high": 1 + 1.1 * (error - 1),
            "smallest_size": fewest,
            "sufficient_size": most,
            "plateau_tolerance": 0.01,
        },
        coords={"k": np.arange(1, len(error) + 1)},
    )


def test_tabulate_basis_size__errors_above_that_with_all_bases():
    header, rows = tabulate_basis_size(_curve([1.3, 1.004, 1.0031], fewest=2, most=3))
    assert header[:2] == ["k", "error above that with all bases [%]"]
    np.testing.assert_allclose(
        rows,
        [
            [1, 30.0, 27.0, 33.0, 100 * (1 - 1.004 / 1.3)],
            [2, 0.4, 0.36, 0.44, 100 * (1 - 1.0031 / 1.004)],
            [3, 0.31, 0.279, 0.341, np.nan],
        ],
        rtol=1e-9,
    )


def test_tabulate_basis_size__one_size():
    [row] = tabulate_basis_size(_curve([1.3], fewest=1, most=0))[1]
    np.testing.assert_allclose(row, [1, 30.0, 27.0, 33.0, np.nan])


@pytest.mark.parametrize(
    ("error", "fewest", "most", "said"),
    [
        (
            [1.3, 1.01, 1.004, 1.003],
            2,
            3,
            "2 to 3 bases. With 3 the error is significantly within 1 % of that "
            "with 4, the largest size tried, and no "
            "further basis reduces it by more than 1 %; this sample does not "
            "show whether fewer would suffice.",
        ),
        (
            [1.3, 1.01, 1.004, 1.003, 1.003],
            1,
            4,
            "1 to 4 bases. .* whether fewer would suffice",
        ),
        (
            [1.3, 1.004, 1.004],
            2,
            2,
            "2 bases. With 2 .*; smaller sizes are significantly worse.",
        ),
        ([1.0, 1.0, 1.0], 1, 1, "1 basis. With 1 .* by more than 1 %."),
        (
            [1.9, 1.5, 1.3],
            3,
            0,
            "At least 3 bases: with 3, .* still 30 % above that with the whole dictionary",
        ),
        (
            [1.9, 1.5, 1.0],
            3,
            0,
            "At least 3 bases: no size below 3, the largest size tried, is significantly on",
        ),
    ],
)
def test_describe_basis_size__states_the_answer_and_why(error, fewest, most, said):
    assert re.fullmatch(
        said + ".*", describe_basis_size(_curve(error, fewest=fewest, most=most))
    )


class _Made:
    """A take whose surfels are computed when they are read, and not kept."""

    def __init__(self, seed: int, count: int) -> None:
        self.seed = seed
        self.count = count

    def read(self, name: str) -> Values:
        rng = np.random.default_rng([self.seed, len(name)])
        make = {
            "dictionary_weight": lambda: rng.gamma(0.3, 0.02, (self.count, 8)),
            "diffuse_reflectance": lambda: rng.uniform(0.2, 0.6, (self.count, 3)),
            "surfel_area": lambda: rng.uniform(0.5, 1.5, self.count),
        }
        found = dataset(
            {name: make[name]().astype(np.float32)},
            coords={"dictionary": NAMES} if "dict" in name else {},
        )
        return values_of(found, name)


def _lazy_cohort(counts):
    """A cohort of takes with so many surfels each."""
    parts = [
        Part(
            take,
            {"subject": take, "condition": "normal", "age": 20 + i},
            ["dictionary_weight", "diffuse_reflectance", "surfel_area"],
            {"surfel": count, "dictionary": 8, "channel": 3},
            {"dictionary": NAMES, "channel": ["R", "G", "B"]},
            _Made(i, count),
        )
        for i, (take, count) in enumerate(counts.items())
    ]
    return combine(parts)


@pytest.mark.slow
def test_population_basis__memory_does_not_grow_with_the_population():
    """Six takes need the memory of two: one take at a time is kept, and a sample of each."""

    def peak(takes):
        cohort = _lazy_cohort({f"S{i}": 40_000 for i in range(takes)})
        tracemalloc.start()
        with dask.config.set(scheduler="synchronous"):
            population_basis(cohort, tables=TABLES, k=2, rng=np.random.default_rng(0))
        top = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return top

    peak(2)  # imports and compiled code
    assert peak(6) < 1.15 * peak(2)  # keeping a take would need 1 to 3 MB of about 8


def _stored(root) -> Database:
    """A database of the population's models, as an earlier version of skindb would have
    written it.
    """
    db = Database(root)
    for take, model in _population().items():
        with db.stage("model", take) as stage:
            stage.write(
                {str(name): node.to_dataset() for name, node in model.children.items()}
            )
            stage.commit(model.attrs)
    return db


def test_studies__commit_read_back_and_tabulate(tmp_path):
    """Studies are stored, with labels read as variable-length text; summaries are made
    where models lack them.
    """
    db = _stored(tmp_path)
    with pytest.raises(InputError, match=r"call skindb\.workflow\.summarise"):
        db.cohort("tables")
    tree = workflow.translucency(db)
    header, rows = tabulate_study(tree)
    assert tree.attrs["command"] == "analyze"
    assert [one["take"] for one in tree.attrs["inputs"]] == ["A", "A.lotion", "B", "C"]
    assert header[:3] == ["group", "site", "channel"]
    assert rows[0][:3] == ["all", "cheek", "R"]
    assert len(rows) == 6
    assert rows[0][3] == 3
    assert db.cohort("tables").sizes["take"] == 4
    header, rows = tabulate_study(workflow.albedo(db))
    assert len(rows) == 4 * 2 * 3
    plot_study(tree, tmp_path / "t.png")
    assert (tmp_path / "t.png").stat().st_size > 1000
    with pytest.raises(InputError, match="must be a study of traits in the database"):
        workflow.edit(db, "A", {"lotion": 1.0})


def test_traits__the_basis_of_one_person_in_two_conditions(tmp_path, monkeypatch):
    # 8 of the 59
    monkeypatch.setattr(studies, "dictionary_tables", lambda *_: TABLES)
    tree = workflow.traits(_stored(tmp_path), takes=["A", "A.lotion"], k=3)
    basis = tree["population_basis"]
    assert list(basis["take"].values) == ["A", "A.lotion"]
    # one surfel of each was not fitted
    assert basis.attrs["nmf_surfels"] == 2 * (N - 1)


@pytest.mark.slow
def test_edit__is_stored_with_its_report(tmp_path, monkeypatch):
    # 8 of the 59
    monkeypatch.setattr(studies, "dictionary_tables", lambda *_: TABLES)
    db = _stored(tmp_path)
    workflow.traits(db, k=3)
    tree = workflow.edit(db, "B", {"lotion": 0.5})
    record = db.record("edit", "B")
    report = tree.attrs["edit_report"]
    assert set(report) == {"brdf", "albedo", "translucency"}
    assert all(
        {"requested", "applied", "clipped", "from_nearest"} <= set(part)
        for part in report.values()
    )
    assert record.provenance["edit_report"] == report
    assert record.provenance["parameters"] == {
        "amounts": {"lotion": 0.5},
        "study": "traits.k-3",
    }
    assert [source["take"] for source in record.provenance["inputs"]] == [
        "B",
        "traits.k-3",
    ]
    assert np.isfinite(tree["fitted/basis_weight"].values[1:]).all()


@pytest.mark.slow
def test_edit__warns_of_a_study_that_is_out_of_date(tmp_path, monkeypatch):
    # 8 of the 59
    monkeypatch.setattr(studies, "dictionary_tables", lambda *_: TABLES)
    db = _stored(tmp_path)
    workflow.traits(db, k=3)
    model = _population()["C"]
    with db.stage("model", "C") as stage:
        stage.write(
            {str(name): node.to_dataset() for name, node in model.children.items()}
        )
        stage.commit(model.attrs)
    with pytest.warns(
        StaleWarning,
        match=r"population 1 of traits.k-3 is out of date: model 1 of C was superseded",
    ):
        workflow.edit(db, "B", {"lotion": 0.5})
    model = _population()["B"]
    with db.stage("model", "B") as stage:
        stage.write(
            {str(name): node.to_dataset() for name, node in model.children.items()}
        )
        stage.commit(model.attrs | {"consent_scope": []})
    with pytest.raises(InputError, match="needs the scope 'statistics'"):
        workflow.edit(db, "B", {"lotion": 0.5})
