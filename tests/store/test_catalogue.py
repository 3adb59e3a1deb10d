"""Queries over the catalogue."""

from __future__ import annotations

import pytest
from stored import commit

import skindb
from skindb.errors import InputError

SCOPE = {"consent_scope": ["fit", "statistics"]}


@pytest.fixture
def db(tmp_path):
    about = {"A1": (30, "normal"), "A1.lotion": (30, "lotion"), "B2": (50, "normal"), "C3": (None, "normal")}
    for take, (age, condition) in about.items():
        traits = {} if age is None else {"age": age}
        where = {"subject": take[:2], "condition": condition, "traits": traits}
        capture = commit(tmp_path / "db", take=take, **SCOPE, **where)
        if take != "C3":
            inputs = [capture.as_input()]
            fit = {"parameters": {"k": 4 if take == "A1" else 6}, "status": {"fitted": 0.9}, "inputs": inputs}
            commit(tmp_path / "db", take=take, kind="model", **SCOPE, **where, **fit)
    return skindb.open(str(tmp_path / "db"))


@pytest.mark.parametrize(
    ("where", "takes"),
    [
        ("condition == 'lotion'", ["A1.lotion"]),
        ("age > 40", ["B2"]),
        ("age < 40 and fit_k == 4", ["A1"]),
        ("not (age > 40)", ["A1", "A1.lotion", "C3"]),  # unknown is not above 40
        ("take.str.startswith('A')", ["A1", "A1.lotion"]),
        ("model_created > '2020-01-01' and status_fitted > 0.5", ["A1", "A1.lotion", "B2"]),
        ("capture_created < '2020-01-01'", []),
        ("model_generation != model_generation", ["C3"]),  # NaN: not fitted
        ("subject in ['B2', 'C3']", ["B2", "C3"]),
    ],
)
def test_takes__where(db, where, takes):
    assert db.takes(where=where) == takes


def test_takes__where_of_outdated_models(db):
    assert db.takes(where="outdated == True") == []
    commit(db.root, take="B2", **SCOPE, subject="B2", traits={"age": 50})
    assert db.takes(where="outdated == True") == ["B2"]


def test_takes__where_is_only_asked_of_takes_of_that_kind(db):
    assert db.takes("model", where="condition == 'normal'") == ["A1", "B2"]


@pytest.mark.parametrize(
    "where",
    ["agee > 40", "age >", "age + 1", "1 == 1", "@db.root", "age.__class__", "import os", "'x'", "", "age = 4"],
)
def test_takes__where_that_is_no_condition_is_one_line(db, where):
    with pytest.raises(
        InputError, match=r"where: a condition compares columns of the catalogue; found .*columns: take, subject"
    ):
        db.takes(where=where)
