"""Releases: the versions that a name refers to do not change with later commits."""

from __future__ import annotations

import numpy as np
import pytest
from planted_cohort import PARAMETERS, few_materials
from stored import commit

import skindb
from skindb import workflow
from skindb.errors import InputError


@pytest.fixture
def db(fitted_database):
    return fitted_database


@pytest.mark.slow
def test_create_release__cohort_and_reads_stay_the_same(db):
    db.create_release("first", ["S01", "S02"])
    before = db.cohort("tables", release="first").load()
    everything = db.cohort("surfels", surfels=40, release="first").load()
    other = workflow.fit_take(
        db,
        "S01",
        skindb.fit.FitParameters(k=1, rank=3, hold_out_lights=0.1),
        dictionary=few_materials(),
    )
    assert db.cohort("tables", takes=["S01"])["fit_k"].values.tolist() == [1]
    assert before["fit_k"].values.tolist() == [PARAMETERS.k] * 2
    assert before.identical(db.cohort("tables", release="first").load())
    assert everything.identical(
        db.cohort("surfels", surfels=40, release="first").load()
    )
    assert db.takes(release="first") == ["S01", "S02"]
    assert (
        db.read("model", "S01", release="first").attrs["generation"]
        == other.generation - 1
    )
    assert (
        db.table(release="first").loc["S01", "model_generation"] == other.generation - 1
    )
    np.testing.assert_array_equal(
        db.table().loc[["S01"], "model_generation"], other.generation
    )


def test_create_release__newest_consent_counts(db):
    db.create_release("first")
    db.record_consent("S02", ["fit"])
    assert db.cohort("tables", release="first")["take"].values.tolist() == [
        "S01",
        "S01.lotion",
    ]


@pytest.mark.parametrize(
    ("name", "takes", "pattern"),
    [
        (
            "first",
            None,
            "a release must have a new name; found a release of .*choose another name",
        ),
        ("no/name", None, "name of a release: must match"),
        (
            "second",
            ["S09"],
            (
                "S09: a release must consist of takes with a model; found no model; "
                "takes with a model: S01"
            ),
        ),
        ("second", [], "a release needs fitted takes"),
    ],
)
def test_create_release__refuses(db, name, takes, pattern):
    db.create_release("first", ["S01"])
    with pytest.raises(InputError, match=pattern):
        db.create_release(name, takes)


def test_release__unknown_names_are_refused(db):
    db.create_release("first", ["S01"])
    with pytest.raises(
        InputError, match="other: the release must exist; found releases: first"
    ):
        db.cohort("tables", release="other")
    with pytest.raises(
        InputError,
        match="S02: the release must name a model of this take; found takes: S01",
    ):
        db.read("model", "S02", release="first")
    with pytest.raises(InputError, match="every take of a cohort must have a model"):
        db.cohort("tables", release="first", takes=["S02"])


def test_release__another_version_of_that_generation_is_refused(tmp_path):
    db = skindb.open(str(tmp_path / "db"), create=True)
    commit(db.root, kind="model")
    db.create_release("first")
    for place in ("log/model/A1/00000001.json", "heads/model/A1.json"):
        (db.root / place).unlink()
    commit(db.root, 2.0, kind="model")
    with pytest.raises(
        InputError,
        match="generation 1 of its model must be that of the release; found a different version",
    ):
        db.read("model", "A1", release="first")
