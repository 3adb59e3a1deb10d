"""The studies of pigments and of coverage, from a database to a table and a plot."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner
from planted_sheet import face_take
from scipy.ndimage import gaussian_filter

from skindb import workflow
from skindb.analysis import describe_study, tabulate_study
from skindb.cli import cli
from skindb.store import Database
from skindb.virtual.skin import skin_tables
from skindb.workflow.upkeep import repeat_study

pytestmark = pytest.mark.slow

AGES = [21, 35, 62]


def pigmented(seed, **about):
    """A face with freckles and flushed patches; surfels are nodes of a square grid."""
    model = face_take(seed=seed)
    fitted = model["fitted"].to_dataset()
    n = round(fitted.sizes["surfel"] ** 0.5)
    rng = np.random.default_rng(seed)
    melanin = (
        3 * gaussian_filter((rng.random((n, n)) < 0.02).astype(float), 1.2) + 0.5 * seed
    )
    field = gaussian_filter(rng.standard_normal((n, n)), 2)
    amounts = np.stack([melanin, 0.2 * (field > 0.5 * field.std())], axis=-1).reshape(
        -1, 2
    )
    amounts = np.resize(amounts, (fitted.sizes["surfel"], 2))
    tables = skin_tables()
    colour = np.exp(
        np.log([0.45, 0.27, 0.2])
        - amounts @ np.stack([tables.melanin, tables.haemoglobin])
    )
    dims = fitted["diffuse_reflectance"].dims
    model["fitted"] = fitted.assign(
        diffuse_reflectance=fitted["diffuse_reflectance"]
        .copy(data=colour)
        .transpose(*dims)
    )
    model.attrs |= about
    return model


def stored(folder, models):
    db = Database(folder / "db")
    for take, model in models.items():
        with db.stage("model", take) as stage:
            stage.write(
                {str(name): node.to_dataset() for name, node in model.children.items()}
            )
            stage.commit(model.attrs)
    return db


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    people = {
        f"S{i}": pigmented(
            i,
            subject=f"S{i}",
            traits={"age": age, "gender": "male" if i == 3 else "female"},
        )
        for i, age in enumerate(AGES, 1)
    }
    return stored(tmp_path_factory.mktemp("pigments"), people)


def test_chromophores__study_is_repeatable_and_reports_its_axes(database):
    study = workflow.chromophores(database, group_by="gender")
    assert study.attrs["study"] == "chromophores.group_by-gender"
    assert set(study.children) == {"chromophores", "chromophore_table"}
    header, rows = tabulate_study(study)
    assert header[:4] == ["group", "region", "chromophore", "group_chromophore_count"]
    assert {(row[0], row[3]) for row in rows if row[1] == "face"} == {
        ("female", 2),
        ("male", 1),
    }
    assert describe_study(study)[0].startswith("axes: ")
    melanin = (
        study["chromophores"]["take_chromophore"]
        .sel(region="no_beard", chromophore="melanin")
        .values
    )
    assert (np.diff(melanin) > 0).all()  # each is darker than the one before
    again = workflow.chromophores(database, group_by="gender")
    np.testing.assert_array_equal(
        again["chromophores"]["chromophore_axis"].values,
        study["chromophores"]["chromophore_axis"].values,
    )


def test_analyze__writes_tables_and_plots(database, tmp_path):
    url = str(database.folder)
    done = CliRunner().invoke(
        cli,
        ["analyze", url, "chromophores", "--plot", str(tmp_path / "a.png"), "--json"],
    )
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["study"] == "chromophores"
    done = CliRunner().invoke(
        cli, ["analyze", url, "coverage", "--plot", str(tmp_path / "b.png")]
    )
    assert done.exit_code == 0, done.output
    assert "age band: no subjects in 40-49, 50-59" in " ".join(done.stdout.split())
    assert {path.name for path in tmp_path.iterdir()} == {"a.png", "b.png"}
    refused = CliRunner().invoke(cli, ["analyze", url, "coverage", "--seed", "1"])
    assert refused.exit_code != 0


def test_refresh__repeats_both(database):
    for what in ("chromophores", "coverage"):
        workflow.study(database, what)
        record = database.record("population", what)
        again = repeat_study(database, record.take, record.provenance["parameters"])
        # the same parameters: nothing to do
        assert again.generation == record.generation


def test_chromophores__takes_without_landmarks(tmp_path):
    model = face_take()
    model["mesh"] = model["mesh"].to_dataset().drop_dims("landmark")
    db = stored(tmp_path, {"A": model})
    done = CliRunner().invoke(cli, ["analyze", str(db.folder), "chromophores"])
    assert done.exit_code != 0
    assert "none of 1 takes has landmarks" in done.output + str(done.exception)
    assert workflow.coverage(db)["coverage"].attrs["subjects"] == 1
