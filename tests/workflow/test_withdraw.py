"""Withdrawal: no data of the subject remain in the raw bytes of a database, and the rest is intact."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr
from planted_population import TABLES, population
from planted_sheet import face_take

from skindb import workflow
from skindb.errors import InputError
from skindb.store import Database, stale_versions
from skindb.store.bucket import Bucket
from skindb.store.log import Log
from skindb.workflow import study_inputs

MARKER = np.float32(0.12345679)  # planted in the data of the subject
WORD = "marker-of-nobody"  # planted in its attributes


pytestmark = pytest.mark.usefixtures("small_textures")


@pytest.fixture(scope="module", autouse=True)
def _tables():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study_inputs, "dictionary_tables", lambda *_: TABLES)  # 8 of the 59
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder of a database made by `_planted`, which is only copied."""
    return _planted(tmp_path_factory.mktemp("planted") / "db").root


@pytest.fixture
def db(made, tmp_path):
    """A database made by `_planted`."""
    return Database(shutil.copytree(made, tmp_path / "db"))


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Folder of a database of takes A, A.lotion, B, C, a study and a release, which is only copied."""
    db = Database(tmp_path_factory.mktemp("small") / "db")
    for take, model in population().items():
        if take.startswith("A"):
            model.attrs["remark"] = WORD
        _commit(db, "model", take, model)
    workflow.translucency(db)
    db.create_release("r1")
    return db.root


def _commit(db, kind, take, tree, **about):
    with db.stage(kind, take) as stage:
        stage.write({str(name): node.to_dataset() for name, node in tree.children.items()})
        return stage.commit(tree.attrs | about)


def _planted(url: Path | str) -> Database:
    """Takes A, A.lotion, B, C in two generations each; studies, an edit and a release that used all of them."""
    db = Database(url)
    for take, model in population().items():
        if take.startswith("A"):
            fitted = model["fitted"].to_dataset()
            fitted["diffuse_reflectance"][3] = MARKER
            model["fitted"] = fitted
            model.attrs["remark"] = WORD
        _commit(db, "model", take, model)
    workflow.translucency(db)
    for take in db.takes("model"):
        _commit(db, "model", take, db.read("model", take).load())
    workflow.traits(db, k=3)
    workflow.translucency(db)
    workflow.edit(db, "B", {"lotion": 0.5})
    db.create_release("r1")
    workflow.translucency(db, release="r1")
    return db


def _found(root: Path, subject: str) -> list[str]:
    """Files that hold the marker, the word or the name of the subject: raw, and with every chunk decompressed."""
    name = re.compile(rf"(?<![A-Za-z0-9_-]){subject}(?![A-Za-z0-9_-])".encode())
    hits = []
    for path in root.rglob("*"):
        if name.search(path.name.encode()):
            hits.append(f"named: {path}")
        if path.is_file():
            raw = path.read_bytes()
            hits += [str(path)] * (MARKER.tobytes() in raw or WORD.encode() in raw)
            if path.suffix == ".json" and name.search(raw):
                hits.append(f"name: {path}")
    for path in root.rglob("*.zarr"):
        for key, array in zarr.open_group(path, mode="r").members(max_depth=None):
            if isinstance(array, zarr.Array):
                values = np.asarray(array[...])
                if values.dtype.kind == "f" and np.isclose(values.astype("f8"), float(MARKER), rtol=1e-7, atol=0).any():
                    hits.append(f"values: {path}/{key}")
                if values.dtype.kind == "T" and any(name.search(str(one).encode()) for one in values.ravel()):
                    hits.append(f"labels: {path}/{key}")
    return hits


def _outcomes(done) -> dict[str, str]:
    """Kind and take of every result that was removed -> fault of its computation, or an empty text."""
    return {one.name: one.fault for one in done.repeated}


def test_withdraw__leaves_nothing_of_a_subject(db):
    assert len(_found(db.root, "A")) > 10  # the search works
    plan = workflow.plan_withdrawal(db, "A")
    assert plan.versions[-2:] == ("model of A: 2 versions", "model of A.lotion: 2 versions")
    assert "population 2 of translucency" in plan.users
    assert "edit 1 of B" in plan.users
    assert len(_found(db.root, "A")) > 10  # a plan removes nothing
    done = workflow.withdraw(db, "A")
    assert _found(db.root, "A") == []
    assert db.subjects() == []
    assert db.takes("model") == ["B", "C"]
    assert db.verify() == []
    assert stale_versions(db) == []
    assert done.revised == ("r1",)
    fault = _outcomes(done).pop("edit of B")
    assert "lotion" in fault  # which no other subject used
    assert _outcomes(done) | {"edit of B": ""} == {
        "edit of B": "",
        "population of traits.k-3": "",
        "population of translucency": "",
        "population of translucency.release-r1": "",
    }
    assert not db.has("edit", "B")
    study = db.read("population", "translucency")
    assert [one["take"] for one in study.attrs["inputs"]] == ["B", "C"]
    assert db.takes("model", release="r1") == ["B", "C"]
    removed = {"edit": 1, "model": 4, "population": 4, "release": 1, "summary": 4}
    assert done.removed == plan.removed == removed
    (entry,) = (db.root / "withdrawn").rglob("*.json")
    assert json.loads(entry.read_text())["removed"] == removed


def _copy(url: str, folder: Path) -> Path:
    """Every object of a bucket as a file."""
    place = Bucket("/".join(url.split("/")[:3]))
    for top in place.names() or ():
        for name in place.sizes(top):
            path = folder / top / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(place.read(f"{top}/{name}"))
    return folder


@pytest.mark.slow
def test_withdraw__leaves_nothing_of_a_subject_in_a_bucket(bucket, tmp_path):
    db = _planted(bucket)
    assert len(_found(_copy(bucket, tmp_path / "before"), "A")) > 10
    done = workflow.withdraw(db, "A")
    assert _found(_copy(bucket, tmp_path / "after"), "A") == []
    assert db.takes("model") == ["B", "C"] == db.takes("model", release="r1")
    assert db.takes("model", where="subject == 'B'") == ["B"]
    assert db.verify() == []
    assert stale_versions(db) == []
    assert done.removed["model"] == 4
    assert [name for name, fault in _outcomes(done).items() if fault] == ["edit of B"]  # as in a folder
    assert db.garbage() == db.clean() == []


def test_withdraw__registrations_of_others_are_made_without_the_subject(tmp_path):
    db = Database(tmp_path / "db")
    for seed, take in enumerate(("A", "B", "C"), 1):
        _commit(db, "model", take, face_take(seed=seed))
    workflow.register_takes(db)
    workflow.albedo(db)
    db.create_release("r1")
    alone = Database(tmp_path / "alone")
    for seed, take in enumerate(("B", "C"), 2):
        _commit(alone, "model", take, face_take(seed=seed))
    wanted = workflow.register_takes(alone)
    done = workflow.withdraw(db, "A")
    assert _outcomes(done) == {"registration": "", "population of albedo": "", "release of r1": ""}
    assert db.requests() == []
    assert _found(db.root, "A") == []
    for take in "BC":
        found = db.read("registration", take)["registration"].to_dataset().load()
        xr.testing.assert_identical(found, alone.read("registration", take)["registration"].to_dataset().load())
        assert [one["take"] for one in db.record("registration", take).made_from] == ["B", "C"]
    assert db.takes("registration", release="r1") == ["B", "C"] == sorted(wanted)
    assert db.verify() == []
    assert stale_versions(db) == []


def test_withdraw__a_study_that_only_named_the_subject_as_skipped(tmp_path):
    db = Database(tmp_path / "db")
    for take, model in population().items():
        _commit(db, "model", take, model, **({"consent_scope": ["fit"]} if take == "C" else {}))
    workflow.translucency(db)
    assert any("population" in hit for hit in _found(db.root, "C"))
    workflow.withdraw(db, "C")
    assert _found(db.root, "C") == []
    assert db.read("population", "translucency").attrs["skipped"] == []


@pytest.mark.parametrize("step", range(0, 60, 4))
def test_withdraw__killed_at_any_step_the_same_call_completes_it(small, tmp_path, monkeypatch, step):
    """The process may be killed after every change of a file or folder; no result of others is lost."""
    db = Database(shutil.copytree(small, tmp_path / "db"))
    left = [step]

    def counted(call):
        def run(*args, **options):
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
            return call(*args, **options)

        return run

    for name in ("remove", "create", "replace", "sweep"):
        monkeypatch.setattr(type(db._place), name, counted(getattr(type(db._place), name)))
    with contextlib.suppress(KeyboardInterrupt):
        workflow.withdraw(db, "A")
    monkeypatch.undo()
    shutil.rmtree(db.root / "leases", ignore_errors=True)  # of this process, which has not ended
    if db.withdrawal("A"):
        assert db.cohort("tables")["take"].values.tolist() == ["B", "C"]
    with contextlib.suppress(InputError):  # everything was removed before it was killed
        workflow.withdraw(db, "A")
    workflow.refresh(db)
    assert _found(db.root, "A") == []
    assert [fault for fault in db.verify() if "tmp" not in str(fault)] == []
    assert [one["take"] for one in db.record("population", "translucency").made_from] == ["B", "C"]
    assert db.takes("model", release="r1") == ["B", "C"]
    assert db.requests() == []


@pytest.mark.parametrize("complete", [lambda db: db.clean(), workflow.refresh])
def test_withdraw__interrupted_is_completed_by_other_commands(small, tmp_path, monkeypatch, complete):
    db = Database(shutil.copytree(small, tmp_path / "db"))
    monkeypatch.setattr("skindb.store.erasure.erase_withdrawn", lambda _: None)
    db.erase("A")
    monkeypatch.undo()
    assert len(_found(db.root, "A")) > 5
    faults = db.verify()
    assert {fault.rule for fault in faults} == {"nothing of a withdrawn subject must remain"}
    assert {fault.cure for fault in faults} == {"run skindb clean --yes"}
    assert any(one.what == "it is of a withdrawn subject, or refers to one" for one in db.garbage())
    complete(db)
    assert _found(db.root, "A") == []
    assert db.verify() == []
    workflow.refresh(db)
    assert [one["take"] for one in db.record("population", "translucency").made_from] == ["B", "C"]


def test_withdraw__damaged_records_and_scratch_of_the_subject_go_too(db):
    (db.root / "log/model/A/00000002.json").write_text(WORD)
    scratch = db.root / "tmp" / "A.lotion-0123456789abcdef"
    other = db.root / "tmp" / "AB-0123456789abcdef"
    for folder in (scratch, other):
        folder.mkdir(parents=True)
        (folder / "samples").write_text("pictures")
    workflow.withdraw(db, "A")
    assert not scratch.exists()
    assert other.exists()
    assert _found(db.root, "A") == []


def test_withdraw__of_an_unknown_subject(db):
    for name in ("nobody", "A.lotion", "..", ""):
        with pytest.raises(InputError, match="the database must hold the subject"):
            workflow.withdraw(db, name)
    assert Log(db._place, "model", "A").generations() == [1, 2]
