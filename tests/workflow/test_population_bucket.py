"""Leases, studies, releases, queries and withdrawal of a database in a bucket."""

from __future__ import annotations

import obstore
import pytest
from click.testing import CliRunner
from planted_population import TABLES, population

import skindb
from skindb import workflow
from skindb.cli import cli
from skindb.errors import InputError
from skindb.store import stale_versions
from skindb.workflow import studies

WORD = "marker-of-nobody"  # planted in the attributes of the subject


@pytest.fixture
def db(bucket, monkeypatch):
    """Takes A, A.lotion, B, C in a bucket."""
    # 8 of the 59
    monkeypatch.setattr(studies, "dictionary_tables", lambda *_: TABLES)
    db = skindb.open(bucket, create=True)
    for take, model in population().items():
        with db.stage("model", take) as stage:
            stage.write(
                {str(name): node.to_dataset() for name, node in model.children.items()}
            )
            stage.commit(
                model.attrs | ({"remark": WORD} if take.startswith("A") else {})
            )
    return db


def test_withdraw__of_the_only_subject_of_a_bucket(bucket):
    db = skindb.open(bucket, create=True)
    with db.stage("capture", "A") as stage:
        stage.commit({"consent_scope": ["fit"]})
    for command in (
        ["withdraw", bucket, "A", "--yes"],
        ["verify", bucket],
        ["info", bucket],
        ["clean", bucket],
    ):
        result = CliRunner().invoke(cli, command)
        assert result.exit_code == 0, result.exception
    assert db.names() == ["audit", "secret", "withdrawn"]


@pytest.mark.slow
def test_population__of_a_bucket(db):
    workflow.translucency(db)
    workflow.traits(db, k=3)
    workflow.edit(db, "B", {"lotion": 0.5})
    db.create_release("r1")
    released = workflow.translucency(db, release="r1")
    assert db.takes("model", where="condition == 'lotion'") == ["A.lotion"]
    # by the catalogue
    assert db.takes("model", where="condition == 'lotion'") == ["A.lotion"]
    with (
        db.lease("A", "model"),
        pytest.raises(
            InputError,
            match="model of A: only one run at a time may work on it; found python on",
        ),
    ):
        workflow.withdraw(db, "A")
    assert db.has("model", "A")
    done = workflow.withdraw(db, "A")
    assert done.removed == {
        "edit": 1,
        "model": 2,
        "population": 3,
        "release": 1,
        "summary": 2,
    }
    keys = [meta["path"] for page in obstore.list(db.place._store) for meta in page]
    assert len(keys) > 20
    for key in keys:
        content = bytes(obstore.get(db.place._store, key).bytes())
        assert WORD.encode() not in content
        # three bytes can be anything in compressed values
        assert not key.endswith(".json") or b'"A"' not in content
        assert not {"A", "A.lotion", "A.json", "A.lotion.json"} & set(key.split("/"))
    assert stale_versions(db) == []
    assert db.verify() == []
    again = db.read("population", "translucency.release-r1")
    assert [one["take"] for one in again.attrs["inputs"]] == ["B", "C"]
    assert len(released.attrs["inputs"]) == 4
