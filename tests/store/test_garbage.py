"""Files to which no record refers are listed and removed, and no others."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path

import pytest
from stored import commit, groups

from skindb.errors import InputError
from skindb.store import Database
from skindb.store import lease as lease_module
from skindb.store.garbage import RELEASE, STILL_WRITING_SECONDS
from skindb.store.lease import this_process

HEX = "0" * 32
OLD = STILL_WRITING_SECONDS + 60


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder of two captures of A1 and a model of the second one, which is only copied."""
    root = tmp_path_factory.mktemp("made")
    for value in (1.0, 2.0):
        record = commit(root, value)
    commit(root, kind="model", inputs=[record.as_input()])
    return root


@pytest.fixture
def db(made, tmp_path):
    """Two captures of A1 and a model of the second one."""
    return Database(shutil.copytree(made, tmp_path, dirs_exist_ok=True))


def _left(db, kind="capture", take="A1", age=OLD, *, whole=False, lease=None):
    """Path of a version whose writer was killed so long ago, before it wrote the record."""
    stage = db.stage(kind, take, lease)
    stage.write(groups())
    if whole:
        (db.root / stage.path.replace(".zarr", ".manifest.json")).write_text("{}")
    for path in (db.root / stage.path).parent.glob(f"{Path(stage.path).stem}.*"):
        _age(path, age)
    return stage.path


def _age(path, seconds):
    for one in [path, *path.rglob("*")] if path.exists() else []:
        os.utime(one, (time.time() - seconds,) * 2)


def _abandon(db, monkeypatch, *kinds, take="A1"):
    """Leases whose holder was killed."""
    with monkeypatch.context() as patch:
        patch.setattr(
            lease_module, "this_process", lambda: this_process() | {"started": "1"}
        )
        lease = db.lease(take, *kinds, command="skindb fit")
        lease.__enter__()
        lease._ended.set()


def _kept(db, **options):
    return {one.key: one.kept for one in db.garbage(**options)}


def _snapshot(db):
    return {
        str(path.relative_to(db.root)): path.read_bytes()
        for path in db.root.rglob("*")
        if path.is_file()
    }


def test_garbage__of_a_whole_database_is_nothing(db):
    with db.lease("A1", "model"):
        assert db.garbage() == []
    shutil.rmtree(db.root / "leases")
    before = sorted(db.root.rglob("*"))
    assert db.garbage() == []
    assert db.clean() == []
    assert sorted(db.root.rglob("*")) == before


@pytest.mark.parametrize("whole", [False, True])
def test_clean__removes_a_version_without_a_record(db, whole):
    before = _snapshot(db)
    path = _left(db, whole=whole)
    assert db.verify() == []
    (found,) = db.garbage()
    assert (found.key, found.kept) == (path, "")
    assert found.bytes == sum(
        len(v) for k, v in _snapshot(db).items() if k not in before
    )
    assert db.garbage() == [found]  # listing changes nothing
    assert db.clean() == [found]
    assert {
        k: v for k, v in _snapshot(db).items() if not k.startswith("leases/")
    } == before
    assert db.garbage() == []


def test_clean__keeps_what_may_be_written_at_this_moment(db, monkeypatch):
    path = _left(db, age=60)
    assert _kept(db)[path].startswith("written 1 minutes ago, kept for 1 h")
    assert db.clean() == []
    assert (db.root / path).exists()
    _abandon(db, monkeypatch, "capture", "model")
    removed = {one.key for one in db.clean()}  # the writer is known to be dead
    assert path in removed
    assert db.garbage() == []


def test_clean__touches_nothing_of_a_take_that_is_worked_on(db, monkeypatch):
    path = _left(db)
    other = _left(db, take="B1")
    with db.lease("A1", "capture", command="skindb ingest"):
        assert _kept(db)[path].startswith("in use by skindb ingest on")
        assert [one.key for one in db.clean()] == [other]
        # the lease was taken after the listing
        monkeypatch.setattr("skindb.store.garbage.holder_of", lambda *_: "")
        assert db.clean() == []
    assert [one.key for one in db.clean()] == [path]


def test_clean__a_version_that_may_have_lost_its_record_stays(db):
    """It is only removed if a head shows that it never had a record."""
    lost = db.record("capture", "A1")
    _age(db.root / "data", OLD)
    (db.root / "log/capture/A1/00000002.json").unlink()
    assert _kept(db) == {lost.path: "its log is damaged, see skindb verify"}
    (db.root / "heads/capture/A1.json").unlink()
    assert _kept(db)[lost.path].startswith(
        "its record may have been lost; remove it by hand"
    )
    assert (
        "a record of the log must name every version that was written completely"
        in {f.rule for f in db.verify()}
    )
    assert db.clean() == []
    assert (db.root / lost.path).exists()


def test_clean__keeps_a_whole_version_of_a_take_without_any_record(db):
    """Its first commit was killed, or its log was lost: this is not damage, but it is
    not removed automatically.
    """
    path = _left(db, "registration", whole=True)
    assert db.verify() == []
    assert "remove it by hand" in _kept(db)[path]
    assert db.clean() == []
    unfinished = _left(db, "registration")
    assert [one.key for one in db.clean()] == [unfinished]


def test_verify__the_first_commit_of_a_take_that_was_killed_is_no_damage(
    db, monkeypatch
):
    _abandon(db, monkeypatch, "model", take="B1")
    path = _left(db, "model", "B1", age=0, whole=True)
    assert db.verify() == []
    assert path in {one.key for one in db.clean()}
    assert db.garbage() == []


def test_clean__removes_temporary_files_of_killed_writers(db):
    for number, age in (("1", 60), ("2", OLD)):
        file = db.root / "staging" / f".{number * 32}.tmp"
        file.write_text("x")
        _age(file, age)
    assert db.verify() == []
    old = f"staging/.{'2' * 32}.tmp"
    assert [key for key, kept in _kept(db).items() if not kept] == [old]
    assert [one.key for one in db.clean()] == [old]
    assert len(_kept(db)) == 1


def test_clean__keeps_the_scratch_of_an_ingest_for_a_day(db):
    names = {"A1-0123456789abcdef": 23, "A1-123456789abcdef0": 25, f"{HEX}.new": 2}
    for name, hours in names.items():
        (db.root / "tmp" / name).mkdir(parents=True)
        (db.root / "tmp" / name / "samples").write_bytes(b"12345")
        _age(db.root / "tmp" / name, hours * 3600)
    assert (
        "kept for 24 h so that the same run can resume"
        in _kept(db)["tmp/A1-0123456789abcdef"]
    )
    with db.lease("A1", "capture"):
        assert [one.key for one in db.clean()] == [f"tmp/{HEX}.new"]
    removed = db.clean()
    assert [(one.key, one.bytes) for one in removed] == [("tmp/A1-123456789abcdef0", 5)]
    assert [path.name for path in (db.root / "tmp").iterdir()] == [
        "A1-0123456789abcdef"
    ]


def test_clean__drops_old_generations_that_nothing_names(db):
    """Captures 1 to 5; model 1 is from capture 2, model 2 from capture 4; a release
    names capture 3; consents stay.
    """
    for value in (3.0, 4.0, 5.0):
        commit(db.root, value)
    commit(db.root, kind="model", inputs=[db.record("capture", "A1", 4).as_input()])
    commit(
        db.root,
        kind=RELEASE,
        take="paper",
        inputs=[db.record("capture", "A1", 3).as_input()],
    )
    commit(db.root, kind=RELEASE, take="paper")
    for scope in (["fit"], []):
        db.record_consent("A1", scope)
    _age(db.root / "data", OLD)
    old = {
        f"log/{kind}/A1/0000000{n}.json"
        for kind, n in (("capture", 1), ("capture", 2), ("model", 1))
    }
    assert db.garbage(generations=3) == [
        one
        for one in db.garbage(generations=3)
        if one.key.endswith("capture/A1/00000001.json")
    ]
    assert set(_kept(db, generations=1)) == old
    assert db.garbage() == []
    removed = db.clean(generations=1)
    assert {one.key for one in removed} == old
    assert [one.generation for one in db.history("capture", "A1")] == [3, 4, 5]
    assert [one.generation for one in db.history("model", "A1")] == [2]
    assert len(db.history("consent", "A1")) == len(db.history(RELEASE, "paper")) == 2
    assert len(list((db.root / "tombstones").iterdir())) == 3
    assert db.verify() == []
    assert db.garbage(generations=1) == []
    assert float(db.source(db.read("model", "A1"))["surfels/surfel_area"][0]) == 4.0


def test_clean__keeps_what_a_kept_version_was_made_from_at_any_distance(db):
    """A study names model 1, which names capture 2."""
    commit(
        db.root,
        kind="population",
        take="traits",
        inputs=[db.record("model", "A1").as_input()],
    )
    for value in (3.0, 4.0):
        capture = commit(db.root, value)
    commit(db.root, kind="model", inputs=[capture.as_input()])
    _age(db.root / "data", OLD)
    assert set(_kept(db, generations=1)) == {
        "log/capture/A1/00000001.json",
        "log/capture/A1/00000003.json",
    }


def test_clean__keeps_an_old_generation_that_is_young_or_in_use(db):
    assert _kept(db, generations=1)["log/capture/A1/00000001.json"].startswith(
        "written 0 minutes ago"
    )
    _age(db.root / "data", OLD)
    with db.lease("A1", "model", "capture"):
        assert _kept(db, generations=1)["log/capture/A1/00000001.json"].startswith(
            "in use"
        )
        assert db.clean(generations=1) == []


def test_clean__drops_nothing_while_a_record_cannot_be_read(db):
    commit(db.root, take="B1")
    (db.root / "log/capture/B1/00000001.json").write_text("{")
    _age(db.root / "data", OLD)
    with pytest.raises(InputError, match="a record of the log must be as committed"):
        db.clean(generations=1)
    with pytest.raises(InputError, match="must be at least 1"):
        db.garbage(generations=0)
    assert len(db.history("capture", "A1")) == 2


def test_garbage__of_a_database_that_cannot_be_written_is_listed(db, monkeypatch):
    path = _left(db)

    def full(_):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(type(db.place), "now", full)
    assert _kept(db) == {path: ""}


def test_commit__of_a_stage_whose_data_were_removed_is_refused(db):
    """The program has no lease and was suspended for more than an hour."""
    with db.stage("capture", "A1") as stage:
        stage.write(groups())
        _age(db.root / stage.path, OLD)
        assert [one.key for one in db.clean()] == [stage.path]
        with pytest.raises(
            InputError,
            match=(
                "must exist when it is committed; found that another process removed "
                "samples, surfels"
            ),
        ):
            stage.commit({})
    assert len(db.history("capture", "A1")) == 2
    assert db.garbage() == []


def test_clean__killed_between_its_steps_is_continued(db):
    """There is a tombstone of a record that still exists, and a version whose record is
    already removed.
    """
    _age(db.root / "data", OLD)
    data = shutil.copytree(db.root / "data", db.root.parent / "data")
    record = db.record("capture", "A1", 1)
    log = (db.root / "log/capture/A1/00000001.json").read_bytes()
    db.clean(generations=1)
    (db.root / "log/capture/A1/00000001.json").write_bytes(log)
    # its version is removed, as in the middle of a removal
    half = [str(fault) for fault in db.verify()]
    line = "its removal must be completed; found both a record and a tombstone; run skindb clean"
    assert half == [f"capture 1 of A1: {line}"]
    assert _kept(db) == {"log/capture/A1/00000001.json": ""}
    assert [one.generation for one in db.clean()] == [1]
    assert (db.verify(), db.garbage()) == ([], [])
    shutil.copytree(data, db.root / "data", dirs_exist_ok=True)
    _age(db.root / "data", OLD)
    assert db.verify() == []
    assert [one.key for one in db.clean()] == [record.path]
    assert (
        json.loads(next((db.root / "tombstones").iterdir()).read_text())["seal"]
        == record.seal
    )
