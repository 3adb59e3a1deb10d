"""A stored version is used as long as it would be derived in the same way."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import xarray as xr

from skindb.schema import dataset
from skindb.store import Database
from skindb.workflow import cohorts, edits, fit
from skindb.workflow.cohorts import summary_parameters
from skindb.workflow.derive import Derivation, code_digest, derive

NNLS = ("numerics/_nnls_kernels.py", "MIN_PIVOT = 1e-11", "MIN_PIVOT = 1e-12")
TEXTURE = ("geometry/_texture_kernels.py", "0.0", "-0.0")


def _version(calls, **attrs):
    """A small version, and a note that it was computed."""
    calls.append(attrs)
    labels = dataset({"common_uv": np.zeros((3, 2), np.float32)})
    tree = xr.DataTree.from_dict({"registration": labels})
    tree.attrs = attrs
    return tree


@pytest.fixture
def db(tmp_path):
    db = Database(tmp_path / "db")
    for take in ("A", "B"):
        with db.stage("model", take) as stage:
            stage.commit({"consent_scope": ["statistics"]})
    return db


def _derived(db, calls, **changed):
    options = {
        "inputs": [db.record("model", take) for take in ("A", "B")],
        "code": cohorts.REGISTRATION_METHOD,
        "parameters": {"reference": ""},
        "names": ["A", "B"],
    }
    derivation = Derivation.of(db, "registration", "A", **options | changed)
    return derive(derivation, partial(_version, calls, take="A"))


def test_derive__computes_once(db):
    calls = []
    record = _derived(db, calls)
    assert _derived(db, calls) == record
    assert len(calls) == 1
    assert record.provenance["command"] == "register"
    assert [of["take"] for of in record.made_from] == ["A", "B"]


@pytest.mark.parametrize(
    "change", ["input", "parameters", "decisive", "code", "removal"]
)
def test_derive__computes_again_after_a_change(db, change_code, change):
    calls = []
    before = _derived(db, calls)
    changed = {}
    if change == "input":
        with db.stage("model", "B") as stage:
            stage.commit({"consent_scope": ["statistics"]})
    elif change == "parameters":
        changed = {"parameters": {"reference": "A"}}
    elif change == "decisive":
        changed = {"dictionary_digest": "d"}
    elif change == "code":
        change_code(*TEXTURE)
        change_code("geometry/warp.py", "return ", "return 1 and ")
    else:
        db.remove(before)
    after = _derived(db, calls, **changed)
    assert len(calls) == 2
    assert after.seal != before.seal


@pytest.mark.parametrize(
    ("method", "change"),
    [
        (fit.METHOD, NNLS),
        (cohorts.SUMMARY_METHOD, TEXTURE),
        (cohorts.REGISTRATION_METHOD, TEXTURE),
        (edits.METHOD, NNLS),
        (edits.METHOD, TEXTURE),
    ],
)
def test_method__depends_on_the_kernels_that_it_uses(method, change, change_code):
    before = code_digest(*method)
    change_code(*change)
    assert code_digest(*method) != before


def test_derivation__describes_only_what_was_derived_alike(db):
    models = [db.record("model", "A")]
    options = {"inputs": models, "code": cohorts.REGISTRATION_METHOD, "names": ["A"]}
    derivation = Derivation.of(db, "registration", "A", **options, parameters={"k": 1})
    assert derivation.current() is None
    record = derivation.commit(_version([]))
    assert derivation.current() == record
    other = Derivation.of(db, "registration", "A", **options, parameters={"k": 2})
    assert not other.describes(record)


def test_summary_parameters__name_the_code(change_code):
    before = summary_parameters()["digest"]
    change_code(*TEXTURE)
    assert summary_parameters()["digest"] != before
