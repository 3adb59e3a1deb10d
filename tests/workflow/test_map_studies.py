"""Maps of differences, components and correlations, from a database to tables and plots."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from planted_sheet import face_take
from xarray import DataTree

from skindb import workflow
from skindb.analysis import describe_study, tabulate_study
from skindb.analysis.studies import STUDIES
from skindb.cli import cli
from skindb.errors import InputError, SkindbWarning
from skindb.store import Database
from skindb.workflow import pictures
from skindb.workflow.edits import stored_study
from skindb.workflow.pictures import _along_modes
from skindb.workflow.studies import open_population
from skindb.workflow.upkeep import repeat_study

pytestmark = pytest.mark.slow

STEP = 0.1  # of R_d between the two groups


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    """Eight subjects; men are darker by a constant everywhere."""
    db = Database(tmp_path_factory.mktemp("maps") / "db")
    rng = np.random.default_rng(0)
    for i in range(8):
        model = face_take(seed=i + 1)
        fitted = model["fitted"].to_dataset()
        level = 0.5 - STEP * (i % 2) + 0.005 * rng.standard_normal()
        colour = np.full(fitted["diffuse_reflectance"].shape, level) * [1.0, 0.7, 0.5]
        colour = colour + 0.01 * rng.standard_normal(colour.shape)
        model["fitted"] = fitted.assign(
            diffuse_reflectance=fitted["diffuse_reflectance"].copy(data=colour)
        )
        model.attrs |= {
            "subject": f"S{i}",
            "consent_scope": ["statistics", "export"],
            "traits": {"gender": "male" if i % 2 else "female", "age": 20 + 5 * i},
        }
        with db.stage("model", f"S{i}") as stage:
            stage.write(
                {str(name): node.to_dataset() for name, node in model.children.items()}
            )
            stage.commit(model.attrs)
    return db


def test_open_population__maps_have_the_options_of_the_study(database):
    study = replace(STUDIES["maps"], cohort_options={"size": 256})
    population, _ = open_population(database, study)
    assert population.cohort.sizes["v"] == population.cohort.sizes["u"] == 256
    assert population.cohort.sizes["take"] == len(population.registered) == 8


def test_maps__find_the_step(database):
    study = workflow.maps(database, group_by="gender", permutations=100)
    assert study.attrs["study"] == "maps.group_by-gender_permutations-100"
    header, rows = tabulate_study(study)
    red = dict(zip(header, rows[0], strict=True))
    assert (red["contrast"], red["quantity"], red["subjects"]) == (
        "male less female",
        "R_d R",
        8,
    )
    # 0.005 of the level differs between subjects
    assert red["mean_effect"] == pytest.approx(-STEP, abs=0.01)
    assert "permutations" in describe_study(study)[0]
    assert study.attrs["registration"][0]["reason"].startswith("8 takes")


def test_components__first_mode_is_the_step(database, tmp_path):
    study = workflow.components(database, k=2)
    assert study.attrs["study"] == "components.k-2"
    model = study["face_model"].to_dataset()
    scores = model["mode_score"].sel(mode=1).values
    assert abs(np.corrcoef(scores, np.arange(8) % 2)[0, 1]) > 0.95
    assert describe_study(study)[0].startswith("8 subjects, each with the mean")
    out = str(tmp_path / "faces.npz")
    options = ["components", "--k", "2", "--out", out]
    done = CliRunner().invoke(cli, ["analyze", database.url, *options])
    assert done.exit_code == 0, done.output
    with np.load(out) as file:
        assert file["shape/model/pcaVariance"].shape == (2,)


def test_along_modes__are_edits_of_the_take(database, monkeypatch):
    workflow.components(database)
    model = database.read("model", "S0")
    fitted = model["fitted"].to_dataset().load().assign(refractive_index=1.3)
    model["fitted"] = DataTree(fitted)
    # every subject has a part of each mode
    monkeypatch.setattr("skindb.analysis.components.MAX_FRACTION", 0.0)
    note = "privacy: a mode or the samples show one subject"
    with pytest.warns(SkindbWarning, match=f"study of components: {note}"):
        modes = _along_modes(database, "S0", model, 2)
    # of a model with a basis, which these do not have
    monkeypatch.setattr(pictures, "page_omissions", lambda *_, **__: [])
    explained = workflow.explain_view(database, "S0", modes=2)
    assert explained[-1].startswith(note)
    assert "0 and 2 standard deviations" in explained[-2]
    assert [mode.name for mode in modes] == ["mode 1", "mode 2"]
    whole, half = (
        np.log(tree["fitted/diffuse_reflectance"] / fitted["diffuse_reflectance"])
        for tree in (modes[0].whole, modes[0].half)
    )
    # two standard deviations of two groups of four, with the noise of the takes
    expected = np.sqrt(8 / 7) * np.log(0.5 / (0.5 - STEP))
    assert float(np.abs(whole.median())) == pytest.approx(expected, rel=0.05)
    np.testing.assert_allclose(half, whole / 2, atol=1e-5)


def test_stored_study__is_the_only_one_of_its_method():
    stored = ["components.k-3", "traits", "traits.k-4"]
    db = SimpleNamespace(takes=lambda _: stored)
    assert stored_study(db, "components") == "components.k-3"
    assert stored_study(db, "traits") == "traits"
    assert stored_study(db, "traits", "traits.k-4") == "traits.k-4"
    stored += ["components.k-5"]
    with pytest.raises(InputError, match="run: skindb analyze DB components"):
        stored_study(db, "components")


def test_correlations__channels_go_together(database):
    study = workflow.correlations(database, permutations=200)
    header, rows = tabulate_study(study)
    one = {row[0]: dict(zip(header, row, strict=True)) for row in rows}[
        "R_d R with R_d G"
    ]
    assert one["component_correlation"] > 0.95
    assert one["correlation_count"] == 8


def test_analyze__writes_tables_and_plots(database, tmp_path):
    url = str(database.folder)
    for what, options in (
        ("maps", ["--group-by", "age"]),
        ("components", ["--k", "2"]),
        ("correlations", []),
    ):
        path = tmp_path / f"{what}.png"
        few = [] if what == "components" else ["--permutations", "100"]
        done = CliRunner().invoke(
            cli, ["analyze", url, what, *options, *few, "--plot", str(path), "--json"]
        )
        assert done.exit_code == 0, done.output
        assert json.loads(done.stdout)["rows"]
        assert path.stat().st_size > 1000


def test_refresh__repeats_all(database):
    for what, given in (
        ("maps", {"group_by": "gender", "permutations": 100}),
        ("components", {}),
        ("correlations", {}),
    ):
        study = workflow.study(database, what, **given)
        record = database.record("population", study.attrs["study"])
        parameters = record.provenance["parameters"]
        assert (
            repeat_study(database, record.take, parameters).generation
            == record.generation
        )  # the same parameters: nothing to do


def test_albedo__textures_of_registered_takes(database, small_textures):
    texture = workflow.albedo(database)["texture"].to_dataset()
    assert texture.sizes["take"] == 8
    assert np.isfinite(texture["texture_quantile"].sel(region="face")).all()
