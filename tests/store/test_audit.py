"""Entries of the audit log: numbers, chain, races, kills and places that cannot be written."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from faulty_proxy import faulty_proxy
from stored import commit

from skindb.errors import InputError
from skindb.store import Database, UnavailableError, audit
from skindb.store.audit import BLOCK, append_entry, entry_key, read_audit
from skindb.store.bucket import Bucket
from skindb.store.folder import Folder
from skindb.store.markers import keyed_hash, keyed_seal, require_secret

WRITER = """
import sys
from skindb.store import Database
db = Database(sys.argv[1])
for number in range(int(sys.argv[3])):
    db.log_action("render", actor=sys.argv[2], takes=["S01.lotion"], counts={"turn": number})
"""


@pytest.fixture
def db(tmp_path):
    """A database with five entries."""
    found = Database(tmp_path / "db")
    for number, take in enumerate(("S01", "S01.lotion", "S02", "S01", "S03"), 1):
        found.log_action(
            "export", actor="anna", takes=[take], parameters={"generation": number}
        )
    return found


def _file(db, number):
    return db.root / entry_key(number)


def _sealed_again(db, number, **changes):
    """Write an entry with changes as somebody who knows the secret."""
    body = json.loads(_file(db, number).read_text()) | changes
    body.pop("seal")
    seal = keyed_seal(require_secret(Folder(db.root)), entry_key(number), body)
    _file(db, number).write_text(json.dumps(body | {"seal": seal}))


def test_append_entry__states_who_what_and_whose(db):
    first, second, *_ = db.audit()[0]
    assert (first.number, first.actor, first.action) == (1, "anna", "export")
    assert (
        first.subjects
        == second.subjects
        == [keyed_hash(require_secret(Folder(db.root)), "S01")]
    )
    assert (first.counts, first.parameters) == ({"takes": 1}, {"generation": 1})
    assert (first.previous, second.previous) == ("", first.seal)
    assert first.when.endswith("+00:00")


def test_append_entry__of_many_takes_is_one_entry(tmp_path):
    db = Database(tmp_path / "db")
    db.log_action(
        "fit", actor="anna", takes=[f"S{n:04d}.lotion" for n in range(1000)] * 2
    )
    [entry] = db.audit()[0]
    assert len(set(entry.subjects)) == len(entry.subjects) == 1000
    assert entry.counts == {"takes": 1000}


def test_append_entry__writes_no_pseudonym_and_only_private_files(db):
    for path in (db.root / "audit").rglob("*"):
        assert not path.stat().st_mode & 0o077
        assert path.is_dir() or not any(
            name in path.read_bytes() for name in (b"S01", b"S02", b"S03", b"lotion")
        )


def test_append_entry__accepts_any_text_as_take(tmp_path):
    db = Database(tmp_path / "db")
    db.log_action(
        "render", actor="anna", takes=["a/x", "\udcff", "", "S01\x00", "a" * 10_000]
    )
    assert len(db.audit()[0][0].subjects) == 5


@pytest.mark.slow
def test_append_entry__processes_that_race_lose_nothing(tmp_path):
    db = Database(tmp_path / "db")
    command = [sys.executable, "-c", WRITER, str(db.root)]
    writers = [
        subprocess.Popen([*command, name, "50"]) for name in ("a", "b", "c", "d")
    ]
    assert [writer.wait() for writer in writers] == [0] * 4
    entries, faults = db.audit()
    assert faults == []
    assert [entry.number for entry in entries] == [*range(1, 201)]
    turns = {
        name: [entry.counts["turn"] for entry in entries if entry.actor == name]
        for name in "abcd"
    }
    assert turns == {name: [*range(50)] for name in "abcd"}


def test_append_entry__writers_of_a_bucket_race_also_with_the_same_action(bucket):
    """A writer whose number is taken must not take the entry of another one for its own."""

    def write(_):
        place = Bucket(bucket)
        for _ in range(6):
            append_entry(place, "render", actor="anna")

    with ThreadPoolExecutor(4) as threads:
        list(threads.map(write, range(4)))
    entries, faults = read_audit(Bucket(bucket))
    assert faults == []
    assert [entry.number for entry in entries] == [*range(1, 25)]


def test_append_entry__a_lost_answer_of_a_bucket_is_no_second_entry(
    bucket, monkeypatch
):
    append_entry(Bucket(bucket), "render", actor="anna")
    with faulty_proxy(os.environ["AWS_ENDPOINT_URL"]) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.address)
        proxy.part = "000000002.json"
        proxy.fraction = 0.5
        proxy.faults = ("lost answer",)
        append_entry(Bucket(bucket), "render", actor="anna")
        proxy.fraction = 0.0
        entries, faults = read_audit(Bucket(bucket))
    assert (len(entries), faults) == (2, [])


class _Requests(Folder):
    """A folder that counts the names and files that are read."""

    def __init__(self, root):
        super().__init__(root)
        self.count = 0

    def children(self, key, *, links=False):
        names = super().children(key, links=links)
        self.count += len(names)
        return names

    def read_small(self, key):
        self.count += 1
        return super().read_small(key)


def test_append_entry__costs_the_same_after_many_entries(tmp_path):
    """The last number is found among the blocks and the names of the last block."""
    place = _Requests(tmp_path / "db")
    append_entry(place, "render", actor="anna")
    for block in range(20):
        for number in range(50):
            file = place.root / entry_key(block * BLOCK + number)
            file.parent.mkdir(exist_ok=True)
            file.touch()
    (place.root / "audit" / "000020").mkdir()
    (place.root / entry_key(20 * BLOCK)).touch()
    place.count = 0
    append_entry(place, "render", actor="anna")
    assert (place.root / entry_key(20 * BLOCK + 1)).exists()
    # blocks, names in the last one, and the files that are read
    assert place.count <= 21 + 1 + 3


@pytest.mark.slow
@pytest.mark.parametrize(
    "step", ["before the temporary file", "before the link", "after the link"]
)
def test_append_entry__a_killed_writer_leaves_a_whole_log(db, step):
    code = f"""
import os
from skindb.store import Database
step, link, open_ = {step!r}, os.link, os.fsync
def end(*args):
    os._exit(9)
def linked(*args):
    link(*args)
    os._exit(9)
if step == "after the link":
    os.link = linked
elif step == "before the link":
    os.link = end
else:
    os.fchmod = end
Database({str(db.root)!r}).log_action("render", actor="bert")
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 9
    entries, faults = db.audit()
    assert faults == []
    assert len(entries) == (6 if step == "after the link" else 5)
    db.log_action("render", actor="anna")
    assert db.audit()[0][-1].number == len(entries) + 1
    assert db.verify() == []


def test_append_entry__continues_in_the_block_before_an_empty_one(db):
    (db.root / "audit" / "000001").mkdir()
    db.log_action("render", actor="anna")
    assert _file(db, 6).exists()


def test_read_audit__selects_by_subject(db):
    numbers = [entry.number for entry in db.audit(subject="S01")[0]]
    assert numbers == [1, 2, 4]
    assert db.audit(subject="S0")[0] == db.audit(subject="")[0] == []


def test_read_audit__of_a_database_without_a_log_is_empty_and_writes_nothing(tmp_path):
    assert Database(tmp_path / "db").audit() == ([], [])
    assert not (tmp_path / "db").exists()


def _remove(db):
    _file(db, 2).unlink()
    _file(db, 3).unlink()


def _change(db):
    text = _file(db, 3).read_text()
    _file(db, 3).write_text(text.replace("anna", "bert"))


def _swap(db):
    third = _file(db, 3).read_bytes()
    _file(db, 3).write_bytes(_file(db, 4).read_bytes())
    _file(db, 4).write_bytes(third)


def _forge_without_the_secret(db):
    body = json.loads(_file(db, 3).read_text()) | {"actor": "bert", "seal": "0" * 64}
    _file(db, 3).write_text(json.dumps(body))


def _exchange_for_an_entry_of_another_database(db):
    other = Database(db.root.parent / "other")
    for _ in range(3):
        other.log_action("export", actor="anna")
    shutil.copy(_file(other, 3), _file(db, 3))


def _link(db):
    _file(db, 3).unlink()
    _file(db, 3).symlink_to(_file(db, 2))


def _misplace(db):
    (db.root / "audit" / "000001").mkdir()
    shutil.move(_file(db, 3), db.root / "audit" / "000001" / "000000003.json")


def _link_the_block(db):
    shutil.move(db.root / "audit" / "000000", db.root.parent / "block")
    (db.root / "audit" / "000000").symlink_to(db.root.parent / "block")


def _link_the_log(db):
    shutil.move(db.root / "audit", db.root.parent / "log")
    (db.root / "audit").symlink_to(db.root.parent / "log")


def _nest(db):
    _file(db, 3).write_text(
        '{"number": 3, "seal": "\\u00e4\\ud800", "counts": '
        + "[" * 500
        + "]" * 500
        + "}"
    )


def _seal_of_other_letters(db):
    body = json.loads(_file(db, 3).read_text()) | {"seal": "\u00e4\ud800"}
    _file(db, 3).write_text(json.dumps(body))


@pytest.mark.parametrize(
    ("tamper", "reasons"),
    [
        (_remove, ["entries 2 to 3 must exist"]),
        (_change, ["000000003.json: .* does not match its seal"]),
        (
            _swap,
            [
                "000000003.json: .* the entry of number 4",
                "000000004.json: .* the entry of number 3",
            ],
        ),
        (_forge_without_the_secret, ["000000003.json: .* does not match its seal"]),
        (
            _exchange_for_an_entry_of_another_database,
            ["000000003.json: .* does not match its seal"],
        ),
        (_link, ["000000003.json: .* symbolic link"]),
        (
            _misplace,
            ["entry 3 must exist"],
        ),
        (_link_the_block, ["audit/000000.*: .* a symbolic link at audit/000000"]),
        (_link_the_log, ["audit: must be a folder; found a link"]),
        (_nest, ["000000003.json: .* nested brackets"]),
        (_seal_of_other_letters, ["000000003.json: .* does not match its seal"]),
    ],
)
def test_read_audit__tampering_is_named(db, tamper, reasons):
    tamper(db)
    faults = db.audit()[1]
    assert len(faults) == len(reasons)
    for fault, reason in zip(faults, reasons, strict=True):
        with pytest.raises(InputError, match=reason):
            raise InputError(fault)
    assert set(faults) <= set(db.verify())


def test_read_audit__an_entry_of_somebody_with_the_secret_must_follow_the_one_before(
    db,
):
    _sealed_again(db, 3, actor="bert")
    [fault] = db.audit()[1]
    assert "entry 4 must follow the entry before it" in str(fault)


def test_read_audit__a_later_format_asks_for_an_update(db):
    _sealed_again(db, 5, format=2)
    assert "update skindb" in str(db.audit()[1][0])


def test_read_audit__a_truncated_log_is_not_recognised(db):
    """The page on the store format says so."""
    _file(db, 5).unlink()
    assert db.audit()[1] == []


def test_read_audit__a_damaged_entry_that_was_restored_is_no_fault(db):
    content = _file(db, 5).read_bytes()
    _file(db, 5).write_bytes(b"{}")
    db.log_action("render", actor="anna")
    assert len(db.audit()[1]) == 1
    _file(db, 5).write_bytes(content)
    assert db.audit()[1] == []


def test_secret__is_not_made_again_while_there_is_an_audit_log(db):
    (db.root / "secret").unlink()
    with pytest.raises(InputError, match=r"secret.*audit log need it"):
        db.log_action("render", actor="anna")
    entries, faults = db.audit()
    assert entries == []
    assert [Path(fault.where).name for fault in faults] == ["secret"]
    assert not (db.root / "secret").exists()


def test_verify__names_unknown_files_of_the_audit_log(db):
    commit(db.root)
    (db.root / "audit" / "notes.txt").write_text("x")
    (db.root / "audit" / "000000" / "notes.txt").write_text("x")
    found = db.verify()
    assert sorted(Path(fault.where).parent.name for fault in found) == [
        "000000",
        "audit",
    ]
    assert {fault.found for fault in found} == {"an unknown name"}


def test_erasure__keeps_the_audit_log(db):
    commit(db.root, take="S01")
    commit(db.root, take="S02")
    db.erase("S01")
    entries, faults = db.audit(subject="S01")
    assert (len(entries), faults) == (3, [])
    assert db.verify() == []


def test_append_entry__a_bucket_without_permission_is_refused_at_once(
    bucket, monkeypatch
):
    append_entry(Bucket(bucket), "render", actor="anna")
    with faulty_proxy(
        os.environ["AWS_ENDPOINT_URL"], fraction=1.0, faults=("403",)
    ) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.address)
        proxy.part = "000000002.json"
        with pytest.raises(UnavailableError, match="credentials must permit"):
            append_entry(Bucket(bucket), "render", actor="anna")
    assert [method for method, path in proxy.requests if "000000002.json" in path] == [
        "PUT"
    ]


def test_append_entry__a_log_without_a_free_number_is_a_fault(db, monkeypatch):
    monkeypatch.setattr(audit, "MAX_ATTEMPTS", 3)
    monkeypatch.setattr(Folder, "create", lambda *_, **__: False)
    with pytest.raises(InputError, match="must have a free number"):
        db.log_action("render", actor="anna")
