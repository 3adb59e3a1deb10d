"""Records: sealed, chained, removed with a tombstone; heads are caches."""

from __future__ import annotations

import hashlib
import json
import shutil

import pytest
from stored import commit

from skindb.errors import InputError
from skindb.store import Database
from skindb.store.log import Log
from skindb.store.record import FORMAT


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder of three generations of A1, one of B1, which is only copied."""
    root = tmp_path_factory.mktemp("made")
    for value in (1.0, 2.0, 3.0):
        commit(root, value)
    commit(root, take="B1")
    return root


@pytest.fixture
def db(made, tmp_path):
    """Three generations of A1, one of B1."""
    return Database(shutil.copytree(made, tmp_path, dirs_exist_ok=True))


def _log(db):
    return Log(db.place, "capture", "A1")


def _record(db, generation, take="A1"):
    return db.root / f"log/capture/{take}/{generation:08d}.json"


def test_record__is_sealed_and_carries_the_seal_before_it(db):
    bodies = [json.loads(_record(db, g).read_text()) for g in (1, 2, 3)]
    for body in bodies:
        seal = body.pop("seal")
        assert (
            seal
            == hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()
        )
        body["seal"] = seal
    assert [body["previous"] for body in bodies] == [
        "",
        bodies[0]["seal"],
        bodies[1]["seal"],
    ]
    assert all(body["format"] == FORMAT for body in bodies)
    # digests of files are in the manifest
    assert max(_record(db, g).stat().st_size for g in (1, 2, 3)) < 3000


def test_record__describes_the_contents_of_the_version(db):
    contents = db.record("capture", "A1").contents
    assert contents["samples"]["sizes"] == {
        "surfel": 10,
        "light": 3,
        "camera": 2,
        "channel": 3,
    }
    assert contents["samples"]["labels"]["light"] == ["l0", "l1", "l2"]
    assert contents["surfels"]["variables"] == ["surfel_area"]


def test_log__a_removed_record_leaves_a_tombstone_and_a_whole_chain(db):
    seal = db.record("capture", "A1", 2).seal
    _log(db).remove(2)
    assert db.verify() == []
    assert [r.generation for r in db.history("capture", "A1")] == [1, 3]
    (stone,) = (db.root / "tombstones").iterdir()
    assert json.loads(stone.read_text()).keys() == {
        "format",
        "seal",
        "previous",
        "removed",
    }
    assert json.loads(stone.read_text())["seal"] == seal
    assert "A1" not in stone.read_text() + stone.name
    assert commit(db.root, 4.0).generation == 4
    assert db.verify() == []


def test_log__all_records_may_be_removed(db):
    for generation in (1, 2, 3):
        _log(db).remove(generation)
    assert db.verify() == []
    assert db.takes() == ["B1"]


@pytest.mark.parametrize("lost", [1, 2, 3])
def test_verify__a_record_that_vanished_is_damage(db, lost):
    """This includes the newest record, to which only the head refers."""
    _record(db, lost).unlink()
    (fault,) = db.verify()
    assert f"generation {lost} must exist" in str(fault)


def test_verify__all_records_of_a_take_vanished(db):
    shutil.rmtree(db.root / "log/capture/A1")
    assert "generation 3 must exist; found nothing" in str(db.verify()[0])


def test_verify__a_record_of_another_history(db, tmp_path):
    """The last record replaced by one that followed another second record."""
    other = tmp_path / "other"
    for value in (1.0, 5.0, 6.0):
        record = commit(other, value)
    shutil.copy(_record(Database(other), 3), _record(db, 3))
    shutil.copytree(other / record.path, db.root / record.path)
    for what in ("manifest",):
        shutil.copy(other / record.beside(what), db.root / record.beside(what))
    assert any(
        "a record that names a different predecessor" in str(fault)
        for fault in db.verify()
    )


def test_read__a_record_copied_over_that_of_another_take_is_refused(db):
    shutil.copy(_record(db, 1, "B1"), _record(db, 1))
    with pytest.raises(InputError, match="found the record of capture 1 of B1"):
        db.read("capture", "A1", generation=1)
    assert any("record of capture 1 of B1" in str(fault) for fault in db.verify())


def _reseal(file, changes):
    body = json.loads(file.read_text()) | changes
    body.pop("seal")
    seal = hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()
    file.write_text(json.dumps(body | {"seal": seal}))


@pytest.mark.parametrize(
    "changes",
    [
        {"path": "../victim"},
        {"path": "/etc"},
        {"path": "data/capture/A1/../../../victim"},
        {"path": "data/capture/B1/20260101T000000-0123abcd.zarr"},
        {"path": 7},
        {"format": FORMAT + 1},
        {"generation": 2},
        {"extra": 1},
    ],
)
def test_read__an_edited_record_is_refused_even_if_its_seal_fits(db, changes):
    victim = db.root.parent / "victim"
    victim.mkdir(exist_ok=True)
    (victim / "secret").write_text("x")
    _reseal(_record(db, 3), changes)
    with pytest.raises(InputError, match="a record of the log must be as committed"):
        db.read("capture", "A1")
    told = "\n".join(map(str, db.verify()))
    assert "must be as committed" in told
    assert "secret" not in told


def test_head__is_a_cache_that_may_be_missing_or_behind(db):
    head = db.root / "heads/capture/A1.json"
    assert json.loads(head.read_text())["generation"] == 3
    head.write_text(
        json.dumps({"generation": 2, "seal": db.record("capture", "A1", 2).seal})
    )
    assert db.verify() == []
    for content in ("{", "[]", "null", '{"generation": "7"}', "\x00"):
        head.write_text(content)
        assert db.verify() == []
    shutil.rmtree(db.root / "heads")
    assert db.verify() == []
    assert float(db.read("capture", "A1")["surfels/surfel_area"][0]) == 3.0
    assert commit(db.root, 4.0).generation == 4
    assert json.loads(head.read_text())["generation"] == 4


def test_source__a_replaced_version_is_not_taken_for_the_one_used(db, monkeypatch):
    # no commit would accept this
    monkeypatch.setattr("skindb.store.stage.require_inputs", lambda *_: None)
    with db.stage("model", "A1") as stage:
        stage.write({})
        stage.commit(
            {
                "take": "A1",
                "inputs": [db.record("capture", "A1").as_input() | {"seal": "another"}],
            }
        )
    with pytest.raises(InputError, match="the capture it was made from must exist"):
        db.source(db.read("model", "A1"))


def test_stage__reports_a_damaged_newest_record_before_the_work(db):
    _record(db, 3).write_text("{")
    with pytest.raises(InputError, match="a record of the log must be as committed"):
        db.stage("capture", "A1")
