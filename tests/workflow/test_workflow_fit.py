"""The fit of a take, from store to store."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from planted_skin import capture_of

import skindb
from skindb.errors import InputError
from skindb.fit import FitParameters, read_dictionary
from skindb.reflectance.brdf_files import write_tables
from skindb.workflow.derive import groups_of
from skindb.workflow.fit import (
    dictionary_at,
    fit_take,
    parameters_of,
    plan_take,
    takes_to_fit,
)

pytestmark = pytest.mark.slow

SMALL = FitParameters(k=2, rank=6)


def _commit(folder, capture):
    db = skindb.open(str(folder), create=True)
    with db.stage("capture", "S1") as stage:
        stage.write(groups_of(capture))
        stage.commit(capture.attrs)
    return db


def test_fit_take__commits_the_model_and_its_provenance(
    tmp_path, skin, small_dictionary
):
    db = _commit(tmp_path / "db", capture_of(skin))
    record = fit_take(db, "S1", SMALL, dictionary=small_dictionary)
    assert (record.kind, record.take, record.generation) == ("model", "S1", 1)
    assert db.verify() == []
    attrs = db.read("model", "S1").attrs
    neither = {"light_gains": False, "inter_reflection": False}
    assert attrs["parameters"] == SMALL.as_dict() | neither
    assert attrs["seeds"] == {"fit": 0}
    assert attrs["command"] == "fit"
    assert attrs["inputs"] == [db.record("capture", "S1").as_input()]
    assert record.provenance["status"] == attrs["status"]
    assert attrs["traits"] == {"age": 30}


def test_fit_take__fits_the_version_that_is_asked_for(tmp_path, skin, small_dictionary):
    db = _commit(tmp_path / "db", capture_of(skin, probe=False))
    _commit(tmp_path / "db", capture_of(skin, probe=False))
    record = fit_take(db, "S1", SMALL, dictionary=small_dictionary, generation=1)
    assert [one["generation"] for one in record.provenance["inputs"]] == [1]
    record = fit_take(db, "S1", SMALL, dictionary=small_dictionary)
    assert record.provenance["inputs"][0]["generation"] == 2


def test_plan_take__reports_what_the_fit_skips(tmp_path, skin, small_dictionary):
    db = _commit(tmp_path / "db", capture_of(skin, probe=False))
    plan = plan_take(db, "S1", SMALL, dictionary=small_dictionary)
    record = fit_take(db, "S1", SMALL, dictionary=small_dictionary)
    assert plan.explain() == record.provenance["skipped"]


def test_fit_take__refuses_without_consent_and_commits_nothing(tmp_path, skin):
    db = _commit(tmp_path / "db", capture_of(skin, scope=["statistics"]))
    with pytest.raises(
        InputError, match="needs the scope 'fit'; found only statistics"
    ):
        fit_take(db, "S1")
    assert db.takes("model") == []


def test_fit_take__keeps_what_cohorts_need(tmp_path, skin, small_dictionary):
    db = _commit(tmp_path / "db", capture_of(skin))
    record = fit_take(db, "S1", SMALL, dictionary=small_dictionary)
    tables = db.tables(record)
    model = db.read("model", "S1")
    fitted = model["fitted"].to_dataset()
    good = fitted["fit_status"].values == 0
    assert (
        int(tables["prediction_surfels"].sel(region="face", status="fitted"))
        == good.sum()
    )
    area = fitted["surfel_area"].values[good]
    colour = fitted["diffuse_reflectance"].values[good]
    trusted = int(tables["region_surfels"].sel(region="face"))
    if trusted == good.sum():
        want = np.average(colour, axis=0, weights=area)
        np.testing.assert_allclose(
            tables["region_diffuse_reflectance"].sel(region="face"), want, rtol=1e-6
        )
    assert (
        sorted(model["sample/surfel_index"].values.tolist())
        == np.flatnonzero(good).tolist()
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory, skin):
    """Folder of the database `three`, which is only copied."""
    db = _commit(tmp_path_factory.mktemp("made") / "db", capture_of(skin, probe=False))
    for take in ("S2", "S3"):
        capture = capture_of(skin, probe=False)
        with db.stage("capture", take) as stage:
            stage.write(groups_of(capture))
            stage.commit(capture.attrs | {"subject": take})
    fit_take(db, "S1", FitParameters(k=2, rank=6))
    fit_take(db, "S2", FitParameters(k=3, rank=6, eta=1.35))
    return db.root


@pytest.fixture
def three(made, tmp_path):
    """Three takes, fitted with different parameters by the embedded dictionary, the
    third not at all.
    """
    return skindb.open(str(shutil.copytree(made, tmp_path / "db")))


def test_takes_to_fit__a_refit_continues_with_what_is_not_done(three):
    assert takes_to_fit(three) == ["S3"]
    # takes whose model would not change are not fitted again
    assert takes_to_fit(three, refit=True) == ["S3"]
    given = {"eta": 1.4}
    assert takes_to_fit(three, refit=True, changes=given) == ["S1", "S2", "S3"]
    own = parameters_of(three, "S2", given)
    assert (own.k, own.rank, own.eta) == (3, 6, 1.4)
    assert parameters_of(three, "S3", given) == FitParameters(eta=1.4)
    fit_take(three, "S2", own)  # and here the run is interrupted
    assert takes_to_fit(three, refit=True, changes=given) == ["S1", "S3"]


def test_parameters_of__another_surface_drops_what_mixtures_have(three):
    ggx = FitParameters(surface="ggx", eta=1.35)
    assert parameters_of(three, "S2", {"surface": "ggx"}) == ggx


def test_takes_to_fit__a_changed_kernel_or_capture_is_a_reason_to_refit(
    three, skin, change_code
):
    fit_take(three, "S3", FitParameters(k=2, rank=6))
    assert takes_to_fit(three, refit=True) == []
    capture = capture_of(skin, probe=False)
    with three.stage("capture", "S2") as stage:
        stage.write(groups_of(capture))
        stage.commit(capture.attrs)
    assert takes_to_fit(three) == ["S2"]
    change_code("numerics/_nnls_kernels.py", "MIN_PIVOT = 1e-11", "MIN_PIVOT = 1e-12")
    assert takes_to_fit(three, refit=True) == ["S1", "S2", "S3"]


def test_takes_to_fit__fewer_components_than_asked_for_are_no_reason(
    tmp_path, skin, small_dictionary
):
    """A fit records its actual and its requested parameters, so that a rank above the
    number of BRDFs is up to date.
    """
    db = _commit(tmp_path / "db", capture_of(skin, probe=False))
    fit_take(db, "S1", FitParameters(k=2, rank=40), dictionary=small_dictionary)
    assert db.record("model", "S1").provenance["parameters"]["rank"] == 6
    assert parameters_of(db, "S1", {}, dictionary=tmp_path).rank == 40


def test_parameters_of__needs_the_dictionary_of_the_model(
    tmp_path, skin, small_dictionary
):
    db = _commit(tmp_path / "db", capture_of(skin, probe=False))
    fit_take(db, "S1", SMALL, dictionary=small_dictionary)
    with pytest.raises(
        InputError,
        match=r"a fit keeps the dictionary of the take's model.*'six of them'",
    ):
        parameters_of(db, "S1", {})
    assert parameters_of(db, "S1", {}, dictionary=Path("embedded")) == SMALL
    assert dictionary_at(Path("embedded")) is None


def test_takes_to_fit__a_model_that_cannot_be_refitted_stops_no_other(
    three, skin, small_dictionary
):
    fit_take(three, "S1", SMALL, dictionary=small_dictionary)
    assert takes_to_fit(three, refit=True, changes={"eta": 1.4}) == ["S1", "S2", "S3"]


def test_takes_to_fit__dictionaries_are_compared_by_their_values(
    tmp_path, skin, small_dictionary
):
    db = _commit(tmp_path / "db", capture_of(skin, probe=False))
    brighter = replace(small_dictionary, table=small_dictionary.table * np.float32(1.1))
    for folder, one in (("a", small_dictionary), ("b", brighter)):
        (tmp_path / folder).mkdir()
        write_tables(tmp_path / folder / "mine.npz", one)
    fit_take(db, "S1", SMALL, dictionary=read_dictionary(tmp_path / "a/mine.npz"))
    assert takes_to_fit(db, refit=True, dictionary=tmp_path / "a/mine.npz") == []
    assert takes_to_fit(db, refit=True, dictionary=tmp_path / "b/mine.npz") == ["S1"]


def test_fit_take__the_newest_capture_has_the_consent_that_counts(
    tmp_path, skin, small_dictionary
):
    db = _commit(tmp_path / "db", capture_of(skin, probe=False))
    _commit(tmp_path / "db", capture_of(skin, probe=False, scope=["statistics"]))
    with pytest.raises(InputError, match="needs the scope 'fit'"):
        fit_take(db, "S1", SMALL, dictionary=small_dictionary, generation=1)
