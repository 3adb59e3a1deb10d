"""Queries over the catalogue."""

from __future__ import annotations

import json
import os
import shutil

import pandas as pd
import pytest
from faulty_proxy import faulty_proxy
from stored import commit

import skindb
from skindb.errors import InputError
from skindb.store.entries import DIGEST_BYTES, block_of, packed, unpacked
from skindb.store.log import Log

SCOPE = {"consent_scope": ["fit", "statistics"]}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder of a database of four takes, which is only copied."""
    root = tmp_path_factory.mktemp("made") / "db"
    about = {
        "A1": (30, "normal"),
        "A1.lotion": (30, "lotion"),
        "B2": (50, "normal"),
        "C3": (None, "normal"),
    }
    for take, (age, condition) in about.items():
        traits = {} if age is None else {"age": age}
        where = {"subject": take[:2], "condition": condition, "traits": traits}
        capture = commit(root, take=take, **SCOPE, **where)
        if take != "C3":
            inputs = [capture.as_input()]
            fit = {
                "parameters": {"k": 4 if take == "A1" else 6},
                "status": {"fitted": 0.9},
                "inputs": inputs,
            }
            commit(root, take=take, kind="model", **SCOPE, **where, **fit)
    return root


@pytest.fixture
def db(made, tmp_path):
    return skindb.open(str(shutil.copytree(made, tmp_path / "db")))


@pytest.mark.parametrize(
    ("where", "takes"),
    [
        ("condition == 'lotion'", ["A1.lotion"]),
        ("age > 40", ["B2"]),
        ("age < 40 and fit_k == 4", ["A1"]),
        ("'A1' in take", ["A1", "A1.lotion"]),
        ("age is missing or not age > 40", ["A1", "A1.lotion", "C3"]),
        (
            "fit_k is not missing and model_created > '2020-01-01' and status_fitted > 0.5",
            ["A1", "A1.lotion", "B2"],
        ),
        ("capture_created < '2020-01-01'", []),
        ("model_generation is missing", ["C3"]),  # not fitted
        ("subject in ['B2', 'C3']", ["B2", "C3"]),
    ],
)
@pytest.mark.filterwarnings("ignore::skindb.store.MissingWarning")
def test_takes__where(db, where, takes):
    assert db.takes(where=where) == takes


def test_takes__where_names_takes_that_lack_a_value(db):
    line = (
        r"1 of 4 takes \(C3\) lack age and are not selected by 'not age > 40'; add 'or "
        r"age is missing' to select"
    )
    with pytest.warns(skindb.store.MissingWarning, match=line):
        assert db.takes(where="not age > 40") == ["A1", "A1.lotion"]


def test_takes__where_quotes_the_name_of_an_attribute_in_the_cure(db):
    commit(db.root, take="B2", **SCOPE, subject="B2", traits={"skin type": "II"})
    with pytest.warns(
        skindb.store.MissingWarning,
        match="add 'or `skin type` is missing' to select them",
    ):
        assert db.takes(where="`skin type` == 'II'") == ["B2"]


def test_takes__where_of_outdated_models(db):
    assert db.takes(where="outdated == True") == []
    commit(db.root, take="B2", **SCOPE, subject="B2", traits={"age": 50})
    assert db.takes(where="outdated == True") == ["B2"]


def test_takes__where_is_only_asked_of_takes_of_that_kind(db):
    assert db.takes("model", where="condition == 'normal'") == ["A1", "B2"]


def test_takes__where_with_an_unknown_column_lists_those_of_the_catalogue(db):
    with pytest.raises(
        InputError,
        match=r"did you mean age\? choose False, True, age, .*; text needs quotes",
    ):
        db.takes(where="agee > 40")


def _count_reads(monkeypatch):
    """Kind, take and generation of every record that is read from now on."""
    reads = []
    read = Log._read

    def counted(self, generation):
        reads.append((self.kind, self.take, generation))
        return read(self, generation)

    monkeypatch.setattr(Log, "_read", counted)
    return reads


def test_table__reads_what_is_new_and_nothing_else(db, monkeypatch):
    reads = _count_reads(monkeypatch)
    first = db.table()
    assert len(reads) == 7
    reads.clear()
    pd.testing.assert_frame_equal(skindb.open(db.url).table(), first)
    assert reads == []
    commit(db.root, take="B2", kind="model", **SCOPE, subject="B2", parameters={"k": 7})
    reads.clear()
    assert skindb.open(db.url).table().fit_k["B2"] == 7
    assert reads == [("model", "B2", 2)]


def test_table__of_a_bucket_needs_as_many_requests_for_many_takes_as_for_few(
    bucket, monkeypatch
):
    with faulty_proxy(os.environ["AWS_ENDPOINT_URL"]) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.address)
        counts = []
        for take in ("A1", "B2", "C3", "D4"):
            commit(bucket, take=take, **SCOPE)
            db = skindb.open(bucket)
            db.table()
            proxy.requests.clear()
            assert take in db.takes(where="capture_generation == 1")
            counts.append(len(proxy.requests))
    # the log, the heads, the withdrawals, the list of blocks of the cache, and the blocks
    takes = ("A1", "B2", "C3", "D4")
    blocks = [len({*map(block_of, takes[:count])}) for count in (1, 2, 3, 4)]
    assert counts == [4 + count for count in blocks]


@pytest.mark.parametrize("is_seen", [True, False])
def test_table__a_record_that_was_lost_is_no_older_one(db, is_seen):
    db.table()
    commit(db.root, take="B2", **SCOPE, subject="B2", traits={"age": 51})
    if is_seen:
        assert db.table().age["B2"] == 51
    (db.root / "log/capture/B2/00000002.json").unlink()
    with pytest.raises(InputError, match="capture of B2: generation 2 must exist"):
        db.table()
    assert "generation 2 must exist" in db.info()["takes"]["B2"]["capture"]["fault"]


def test_table__a_record_that_was_damaged_after_it_was_read_is_named(db):
    assert db.table().age["B2"] == 50
    path = db.root / "log/capture/B2/00000001.json"
    path.write_text(path.read_text().replace('"age": 50', '"age": 60'))
    with pytest.raises(
        InputError,
        match=r"B2/00000001.json: .* found content that does not match its seal",
    ):
        db.table()


def test_table__of_a_restored_database_is_that_of_its_records(db, tmp_path):
    """The cache is newer than the backup, and contains another second generation."""
    shutil.copytree(db.root, tmp_path / "backup")
    commit(db.root, take="B2", **SCOPE, subject="B2", traits={"age": 51})
    assert db.table().age["B2"] == 51
    blocks = tmp_path / "backup/catalogue"
    shutil.copytree(db.root / "catalogue", blocks, dirs_exist_ok=True)
    restored = skindb.open(str(tmp_path / "backup"))
    assert restored.table().age["B2"] == 50
    shutil.rmtree(blocks)
    shutil.copytree(db.root / "catalogue", blocks)
    commit(restored.root, take="B2", **SCOPE, subject="B2", traits={"age": 61})
    assert restored.table().age["B2"] == 61


@pytest.mark.parametrize("damage", ["cut", "value", "head", "empty", "list"])
def test_table__a_damaged_cache_changes_nothing(db, damage):
    whole = db.table()
    key = block_of("B2")
    path = db.root / key
    content = path.read_bytes()
    body = json.loads(unpacked(key, content))
    if damage == "value":
        body["rows"][0][1]["traits"] = {"age": 99}
        path.write_bytes(content[:DIGEST_BYTES] + json.dumps(body).encode())
    elif damage == "cut":
        path.write_bytes(content[: len(content) // 2])
    else:  # written with its digest
        body["rows"][0][-1] = None
        wrong = {"head": body, "list": [body], "empty": {}}[damage]
        path.write_bytes(packed(key, json.dumps(wrong).encode()))
    pd.testing.assert_frame_equal(skindb.open(db.url).table(), whole)
    # a row that was not checked is read again, too
    assert path.read_bytes() == content


def test_info__lists_the_same_stale_versions_with_and_without_the_cache(db):
    models = [db.record("model", take).as_input() for take in db.takes("model")]
    commit(db.root, take="A1", kind="registration", **SCOPE, inputs=models)
    db.table()
    commit(db.root, take="B2", **SCOPE, subject="B2")
    commit(
        db.root,
        take="A1.lotion",
        kind="model",
        **SCOPE,
        inputs=[db.record("capture", "A1.lotion").as_input()],
    )
    cached = db.info()
    again = db.info()
    shutil.rmtree(db.root / "catalogue")
    assert cached == again == db.info()
    assert cached["takes"]["B2"]["model"]["stale"] == ["capture 1 of B2 was superseded"]
    assert len(cached["takes"]["A1"]["registration"]["stale"]) == 2
    assert db.takes(where="registration_generation == 1") == ["A1"]


def test_takes__a_folder_in_place_of_a_record_hides_no_take(db):
    path = db.root / "log/capture/C3/00000001.json"
    path.unlink()
    (path / "inside").mkdir(parents=True)
    (path / "inside/file").touch()
    (db.root / "heads/capture/C3.json").unlink()
    assert "C3" in db.takes()
    assert "fault" in db.info()["takes"]["C3"]["capture"]


def test_takes__log_and_heads_that_were_exchanged_are_named(db):
    log, heads = (db.root / name / "capture" for name in ("log", "heads"))
    log.rename(log.with_name("aside"))
    heads.rename(log)
    log.with_name("aside").rename(heads)
    with pytest.raises(InputError, match=r"log/capture/\w+\.json: the log must hold"):
        db.takes("capture")
    assert any("must exist" in str(fault) for fault in db.verify())


def test_info__where_agrees_with_the_table(db):
    with pytest.warns(skindb.store.MissingWarning, match="C3"):
        found = db.info(where="age > 20")["takes"]
    assert list(found) == ["A1", "A1.lotion", "B2"]
    assert found == {
        take: one for take, one in db.info()["takes"].items() if take != "C3"
    }
    assert list(
        db.info(takes=["B2", "C3"], where="age is not missing and age > 20")["takes"]
    ) == ["B2"]
    db.create_release("first", ["A1", "B2"])
    assert list(db.info(where="age > 20", release="first")) == ["takes"]
    assert list(db.info(where="age > 20", release="first")["takes"]) == ["A1", "B2"]
