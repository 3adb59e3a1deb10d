"""Backups: consistent, incremental, verified, without withdrawn subjects, and restored
with the same bytes.
"""

from __future__ import annotations

import os
import random
import shutil
import stat
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from traces import MARK, contents, traces

from skindb import workflow
from skindb.errors import InputError
from skindb.schema import dataset
from skindb.store import Database, LeaseLost, backup_states, restore, restoring
from skindb.store import backup as backup_module
from skindb.store import lease as lease_module
from skindb.store.archive import Archive
from skindb.store.bucket import place_at
from skindb.store.folder import Folder

SUBJECT = "Xqz7"
SCOPE = {"consent_scope": ["fit", "statistics"]}
NAMES = [
    "backup",
    "files",
    "states",
    "secret",
    "withdrawn",
    "release",
    "43",
    "-",
    "--verify",
    "__proto__",
    "CON",
]
CACHES = ("catalogue/", "leases/", "staging/", "heads/", "withdrawn/")


def _commit(url, kind, take, value=1.0, names=(), **about):
    """A version as small as possible, with an own value."""
    names = [
        *names,
        *(
            one["take"]
            for one in about.get("inputs", [])
            if one["kind"] != "calibration"
        ),
    ]
    with Database(url).stage(kind, take, names=names) as stage:
        stage.write({"surfels": dataset({"surfel_area": np.array([value, value])})})
        return stage.commit(SCOPE | about)


def _fill(url, subjects=(SUBJECT, "B"), *, is_calibrated=True) -> None:
    """Captures and models of subjects, a calibration of the first that the others use,
    a study and a release.
    """
    db = Database(url)
    lights = (
        [_commit(url, "calibration", "dome", names=[subjects[0]]).as_input()]
        if is_calibrated
        else []
    )
    for take in subjects:
        value = float(MARK) if take == SUBJECT else 2.0
        capture = _commit(url, "capture", take, value, inputs=lights)
        _commit(
            url,
            "model",
            take,
            2 * value if take != SUBJECT else value,
            inputs=[capture.as_input(), *lights],
        )
    models = [db.record("model", take).as_input() for take in subjects]
    _commit(
        url,
        "population",
        "traits",
        3.0,
        inputs=models,
        parameters={"what": "traits", "takes": [*subjects]},
    )
    db.create_release("r1")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder of a database of two subjects, which is only copied."""
    root = tmp_path_factory.mktemp("made") / "db"
    _fill(root)
    return root


@pytest.fixture
def db(made, tmp_path):
    """A database of two subjects."""
    return Database(shutil.copytree(made, tmp_path / "db"))


@pytest.fixture
def dest(tmp_path):
    return tmp_path / "backup"


def _archive(dest) -> Archive:
    return Archive(place_at(str(dest)))


def _state(root) -> dict[str, bytes]:
    """Content of the files of a database, without caches and leases."""
    return {
        key: content
        for key, content in contents(Path(root)).items()
        if not key.startswith(CACHES)
    }


def _restored(db, dest, target, **options) -> Database:
    restore(str(dest), str(target), markers=db.place.marker_file(), **options)
    return Database(target)


def test_restore__gives_the_same_bytes(db, dest, tmp_path):
    report = db.backup(str(dest), verify=True)
    assert (report.number, report.versions, report.present, report.faults) == (
        1,
        7,
        0,
        (),
    )
    copy = _restored(db, dest, tmp_path / "copy")
    assert _state(copy.root) == _state(db.root)
    assert contents(copy.root / "heads") == contents(db.root / "heads")
    assert copy.verify() == []
    assert copy.garbage() == []
    assert float(copy.read("model", "B")["surfels/surfel_area"][0]) == 4.0
    modes = {
        stat.S_IMODE(path.stat().st_mode)
        for path in [*copy.root.rglob("*"), *dest.rglob("*"), copy.root, dest]
    }
    assert modes == {0o700, 0o600}


def test_backup__copies_only_what_is_missing(db, dest):
    first = db.backup(str(dest))
    again = db.backup(str(dest))
    assert (again.copied, again.present, again.bytes) == (0, first.copied, 0)
    _commit(db.url, "model", "B", 5.0)
    later = db.backup(str(dest))
    # the chunk, the manifest and the record; the metadata are the same as those of other versions
    assert (later.number, later.copied, later.present) == (3, 3, first.copied)


def test_restore__of_an_earlier_state(db, dest, tmp_path):
    before = _state(db.root)
    db.backup(str(dest))
    _commit(db.url, "model", "B", 5.0)
    db.backup(str(dest))
    assert [(one.number, one.versions) for one in backup_states(str(dest))] == [
        (1, 7),
        (2, 8),
    ]
    assert _state(_restored(db, dest, tmp_path / "old", number=1).root) == before
    assert _restored(db, dest, tmp_path / "new").record("model", "B").generation == 2
    with pytest.raises(
        InputError,
        match="state 3 must exist; found states 1, 2; see skindb restore --list",
    ):
        _restored(db, dest, tmp_path / "none", number=3)
    assert not (tmp_path / "none").exists()


def test_backup__without_a_deleted_state_frees_its_files(db, dest):
    db.backup(str(dest))
    for generation in (1, 2):
        _commit(db.url, "model", "C", 10.0 + generation)
    db.backup(str(dest))
    db.remove(db.record("model", "C", 1))
    (dest / "states/000002.json").unlink()
    assert db.backup(str(dest)).removed == 3  # chunk, manifest and record
    assert db.backup(str(dest), verify=True).faults == ()


def test_restore__brings_back_nobody_who_was_withdrawn_later(db, dest, tmp_path):
    db.backup(str(dest))
    assert traces(dest, SUBJECT)
    db.erase(SUBJECT)
    copy = _restored(db, dest, tmp_path / "copy")
    assert traces(copy.root, SUBJECT) == []
    assert traces(tmp_path / "copy.markers", SUBJECT) == []
    assert SUBJECT.encode() not in db.place.marker_file().read_bytes()
    assert (
        copy.takes("model"),
        copy.subjects(),
        copy.takes("population"),
        copy.takes("calibration"),
    ) == (
        ["B"],
        ["B"],
        [],
        [],
    )
    assert copy.verify() == []
    assert sorted(str(request) for request in copy.requests()) == [
        "population of traits",
        "release of r1",
    ]
    assert copy.requests() != []
    [stale] = [one.name for one in workflow.stale_results(copy) if one.kind == "model"]
    assert stale == "model 1 of B"  # its calibration was that of the subject
    with pytest.raises(InputError, match="the subject must not be withdrawn"):
        _commit(copy.url, "capture", SUBJECT)


def test_restore__requests_what_a_withdrawal_requests(dest, tmp_path):
    db = Database(tmp_path / "db")
    _fill(db.url, is_calibrated=False)
    db.backup(str(dest))
    db.erase(SUBJECT)
    copy = _restored(db, dest, tmp_path / "copy")
    requests = {request.key: request.parameters for request in copy.requests()}
    assert (
        requests.items()
        >= {request.key: request.parameters for request in db.requests()}.items()
    )
    workflow.repeat_requests(copy, kinds=("release",))
    pins = {
        (one["kind"], one["take"]) for one in copy.record("release", "r1").made_from
    }
    assert pins == {("capture", "B"), ("model", "B")}


def test_backup__erases_subjects_who_were_withdrawn_from_earlier_states(
    db, dest, tmp_path
):
    db.backup(str(dest))
    db.erase(SUBJECT)
    report = db.backup(str(dest), verify=True)
    assert report.removed > 5
    assert report.faults == ()
    assert traces(dest, SUBJECT) == []
    assert [one.versions for one in backup_states(str(dest))] == [2, 3]
    restore(str(dest), str(tmp_path / "copy"), number=1, without_markers=True)
    assert traces(tmp_path / "copy", SUBJECT) == []
    assert Database(tmp_path / "copy").verify() == []


def test_erase_from_backup__leaves_the_bytes_of_others(db, dest, tmp_path):
    others = {
        key: content
        for key, content in _state(db.root).items()
        if SUBJECT.encode() not in content
    }
    others = {
        key: content
        for key, content in others.items()
        if SUBJECT not in key
        and key.startswith(("data/capture", "data/model", "log/capture", "log/model"))
    }
    db.backup(str(dest))
    _commit(db.url, "model", "B", 5.0)
    db.backup(str(dest))
    db.erase(SUBJECT)
    assert db.erase_from_backup(str(dest)) > 5
    assert db.erase_from_backup(str(dest)) == 0
    assert traces(dest, SUBJECT) == []
    for number in (1, 2):
        copy = _restored(db, dest, tmp_path / str(number), number=number)
        assert _state(copy.root).items() >= others.items()
        assert copy.verify() == []


def test_restore__repeats_later_consents(db, dest, tmp_path):
    db.record_consent("B", ["fit", "statistics"])
    db.backup(str(dest))
    assert len(_restored(db, dest, tmp_path / "same").consent_history("B")) == 2
    db.record_consent("B", [])
    db.record_consent("B", ["fit"])
    copy = _restored(db, dest, tmp_path / "copy")
    assert copy.consent("B") == ["fit"]
    assert (
        copy.record("consent", "B").provenance["recorded"]
        == db.record("consent", "B").created
    )
    assert copy.verify() == []


def test_restore__needs_a_marker_file(db, dest, tmp_path):
    db.backup(str(dest))
    target = tmp_path / "copy"
    rule = (
        "a restore needs the marker file, because subjects who were withdrawn after "
        "the backup would come back"
    )
    with pytest.raises(
        InputError,
        match=rf"copy.markers: {rule}; found no such file; give --markers FILE, or",
    ):
        restore(str(dest), str(target))
    assert not target.exists()
    db.erase(SUBJECT)
    restore(str(dest), str(target), without_markers=True)
    assert Database(target).takes("model") == ["B", SUBJECT]


@pytest.mark.parametrize("damage", ["changed", "cut", "other database", "empty"])
def test_restore__refuses_a_damaged_marker_file(db, dest, tmp_path, damage):
    db.backup(str(dest))
    db.erase(SUBJECT)
    file = db.place.marker_file()
    content = file.read_bytes()
    if damage == "other database":
        other = Database(tmp_path / "other")
        _commit(other.url, "capture", "A")
        other.backup(str(tmp_path / "other backup"))
        content = other.place.marker_file().read_bytes()
    elif damage == "changed":
        content = content.replace(b'"removed"', b'"Removed"')
    else:
        content = content[: len(content) // 2 if damage == "cut" else 0]
    file.write_bytes(content)
    with pytest.raises(
        InputError, match="a marker file must be as it was written; found"
    ) as error:
        _restored(db, dest, tmp_path / "copy")
    assert len(str(error.value).splitlines()) == 1
    assert not (tmp_path / "copy").exists()


def test_restore__onto_something_is_refused(db, dest, tmp_path):
    db.backup(str(dest))
    before = contents(db.root)
    with pytest.raises(
        InputError,
        match="a restore needs an empty or missing folder; found a database or a backup",
    ):
        _restored(db, dest, db.root)
    assert contents(db.root) == before
    other = tmp_path / "other"
    other.mkdir()
    (other / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"found other files, such as notes\.txt"):
        _restored(db, dest, other)
    assert contents(other) == {"notes.txt": b"mine"}
    with pytest.raises(InputError, match="a backup must not be inside its database"):
        _restored(db, dest, dest / "copy")


def test_backup__of_another_database_or_elsewhere_is_refused(db, dest, tmp_path):
    db.backup(str(dest))
    other = Database(tmp_path / "other")
    _commit(other.url, "capture", "A")
    before = contents(dest)
    for place, message in [
        (dest, "all states of a backup must be of the same database"),
        (other.root / "backup", "a backup must not be inside its database"),
        (
            db.root,
            "a backup needs an empty folder, or one with a backup; found other files, such as data",
        ),
    ]:
        with pytest.raises(InputError, match=message):
            other.backup(str(place))
    assert {
        key: value for key, value in contents(dest).items() if "leases" not in key
    } == {key: value for key, value in before.items() if "leases" not in key}
    with pytest.raises(
        InputError,
        match="must be a complete database; found a backup; run skindb restore",
    ):
        Database(dest).takes()
    with pytest.raises(InputError, match="found a backup"):
        _commit(dest, "capture", "A")


def _file_of(dest: Path, db: Database, key: str) -> Path:
    """The file of a backup that holds a file of the database."""
    digest = backup_states(str(dest))[-1].files.get(key) or db.place.digests(key).whole
    return dest / "files" / digest[:2] / digest


def test_backup__names_each_damaged_file(db, dest, tmp_path):
    db.backup(str(dest))
    record = db.record("model", "B")
    chunk = _file_of(dest, db, f"{record.path}/surfels/surfel_area/c/0")
    log = _file_of(dest, db, f"log/capture/{SUBJECT}/00000001.json")
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"x")
    log.unlink()
    assert db.backup(str(dest)).faults == ()  # it copies the missing file
    log.write_bytes(b"{}")
    faults = db.backup(str(dest), verify=True).faults
    assert {fault.where for fault in faults} == {str(chunk), str(log)}
    assert all(
        fault.rule == "a file of a backup must be as it was written" for fault in faults
    )
    copy = tmp_path / "copy"
    restored = restore(str(dest), str(copy), markers=db.place.marker_file())
    assert {fault.where for fault in restored.faults} == {str(chunk), str(log)}
    again = Database(copy)
    # damaged here too, never silently absent
    for kind, take in [("model", "B"), ("capture", SUBJECT)]:
        with pytest.raises(
            InputError, match=r"no file|a record of the log must be as committed"
        ):
            again.read(kind, take)
    assert float(again.read("capture", "B")["surfels/surfel_area"][0]) == 2.0
    named = " ".join(str(fault) for fault in again.verify())
    assert f"{record.path}/surfels/surfel_area/c/0" in named
    assert f"log/capture/{SUBJECT}/00000001.json" in named
    chunk.unlink()
    log.unlink()
    assert db.backup(str(dest), verify=True).faults == ()  # as the messages say


def test_backup__of_a_damaged_database_names_the_file_and_saves_the_rest(
    db, dest, tmp_path
):
    path = db.root / db.record("model", "B").path / "surfels/surfel_area/c/0"
    path.write_bytes(b"x" * path.stat().st_size)
    (db.root / f"log/capture/{SUBJECT}/00000001.json").write_text("{}")
    report = db.backup(str(dest))
    assert sorted(fault.where for fault in report.faults) == sorted(
        [str(path), str(db.root / f"log/capture/{SUBJECT}/00000001.json")]
    )
    copy = tmp_path / "copy"
    assert (
        len(restore(str(dest), str(copy), markers=db.place.marker_file()).faults) == 1
    )
    assert float(Database(copy).read("capture", "B")["surfels/surfel_area"][0]) == 2.0
    with pytest.raises(InputError, match="no file"):
        Database(copy).read("model", "B")


def test_restore__refuses_names_that_lead_elsewhere(db, dest, tmp_path):
    db.backup(str(dest))
    [state] = backup_states(str(dest))
    digest = next(iter(state.files.values()))
    for name in (
        "../evil",
        "log/../../evil",
        "/tmp/evil",
        "catalogue/x.json",
        "audit/../x",
        "log/model/../00000001.json",
    ):
        changed = type(state)(**{**vars(state), "files": {name: digest}})
        (dest / state.key).write_bytes(changed.content())
        with pytest.raises(
            InputError, match="found names that are not those of a database"
        ):
            _restored(db, dest, tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


@pytest.mark.slow
def test_backup__of_hostile_names(tmp_path, dest):
    db = Database(tmp_path / "db")
    _fill(db.url, NAMES)
    db.backup(str(dest))
    # folders below `files` are called as digests begin, by chance "43"
    fixed = (dest, dest / "files")
    names = {path.name for path in dest.rglob("*") if path.parent not in fixed}
    # names of folders of its lease
    assert not names & ({*NAMES} - {"backup", "release"})
    assert _state(_restored(db, dest, tmp_path / "all").root) == _state(db.root)
    db.erase("backup")
    db.erase_from_backup(str(dest))
    copy = _restored(db, dest, tmp_path / "copy")
    assert copy.takes("model") == sorted({*NAMES} - {"backup"})
    assert copy.verify() == []
    assert db.backup(str(dest), verify=True).faults == ()


def test_backup__copies_the_audit_log(db, dest, tmp_path):
    for number in (1, 2):
        db.place.create(f"audit/000000/{number:09d}.json", b'{"entry": %d}' % number)
    db.backup(str(dest))
    db.erase(SUBJECT)
    db.erase_from_backup(str(dest))
    assert contents(_restored(db, dest, tmp_path / "copy").root / "audit") == contents(
        db.root / "audit"
    )


def test_backup__of_an_incomplete_withdrawal_is_without_the_subject(
    db, dest, tmp_path, monkeypatch
):
    monkeypatch.setattr("skindb.store.erasure._erase_holdings", _stopped)
    with pytest.raises(KeyboardInterrupt):
        db.erase(SUBJECT)
    db.backup(str(dest))
    assert traces(dest, SUBJECT) == []
    copy = _restored(db, dest, tmp_path / "copy")
    assert copy.verify() == []
    assert {str(one) for one in copy.requests()} == {
        "population of traits",
        "release of r1",
    }


def _stopped(*_args, **_options):
    raise KeyboardInterrupt


class Steps:
    """Calls an action before one of the steps of a run, which are the calls of some methods."""

    def __init__(self, number: int, action) -> None:
        self.left = number
        self.action = action
        self.is_done = False

    def watch(self, patch, owner, names) -> None:
        for name in names:
            patch.setattr(owner, name, self._watched(getattr(owner, name)))

    def _watched(self, call):
        def run(*args, **options):
            self.left -= 1
            if self.left < 0 and not self.is_done:
                self.is_done = True
                self.action()
            return call(*args, **options)

        return run


STEPS = (
    "create",
    "read",
    "read_small",
    "identities",
    "replace",
    "remove",
)


@pytest.fixture
def one_thread(monkeypatch):
    """So that steps have an order, and that leases of interrupted runs are those of
    processes that have ended.
    """
    monkeypatch.setattr("skindb.store.archive.THREADS", 1)
    monkeypatch.setattr(lease_module, "_has_ended", lambda *_: True)


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_backup__while_a_subject_is_withdrawn_at_any_step(made, tmp_path):
    others = 0
    for number in range(0, 10_000, 11):
        work = tmp_path / str(number)
        db = Database(shutil.copytree(made, work / "db"))
        db.backup(str(work / "backup"))
        _commit(db.url, "model", SUBJECT, float(MARK))
        steps = Steps(number, partial(_withdraw_apart, db.url))
        with pytest.MonkeyPatch.context() as patch:
            steps.watch(patch, Folder, STEPS)
            report = db.backup(str(work / "backup"), verify=True)
        if not steps.is_done:
            break
        others += 1
        assert report.faults == (), number
        assert db.verify() == []
        copy = _restored(db, work / "backup", work / "copy")
        assert traces(copy.root, SUBJECT) == [], number
        assert copy.verify() == [], number
        db.erase_from_backup(str(work / "backup"))
        assert traces(work / "backup", SUBJECT) == [], number
        assert _archive(work / "backup").numbers() == [1, 2]
        shutil.rmtree(work)
    assert others > 10


def _withdraw_apart(url, *backups) -> None:
    """Withdraw the subject in a process of its own, which is not watched."""
    process = os.fork()
    if not process:
        code = 1
        with suppress(Exception):
            Database(url).erase(SUBJECT)
            for backup in backups:
                Database(url).erase_from_backup(str(backup))
            code = 0
        os._exit(code)
    assert os.waitpid(process, 0)[1] == 0


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_backup__suspended_while_a_subject_is_erased_from_it_leaves_nothing(
    made, tmp_path
):
    refused = 0
    for number in range(0, 10_000, 11):
        work = tmp_path / str(number)
        db = Database(shutil.copytree(made, work / "db"))
        db.backup(str(work / "backup"))
        _commit(db.url, "model", SUBJECT, float(MARK))
        _commit(db.url, "model", SUBJECT, float(MARK), remark="other bytes")
        steps = Steps(number, partial(_withdraw_apart, db.url, work / "backup"))
        with pytest.MonkeyPatch.context() as patch:
            steps.watch(patch, Folder, STEPS)
            try:
                db.backup(str(work / "backup"))
            except LeaseLost:
                refused += 1
        if not steps.is_done:
            break
        assert traces(work / "backup", SUBJECT) == [], number
        assert db.backup(str(work / "backup"), verify=True).faults == ()
        shutil.rmtree(work)
    assert refused > 3


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_backup__while_others_commit_and_remove_is_one_moment(made, tmp_path):
    """Every version of a restored state has its inputs, and `verify` finds nothing."""
    for seed in range(4):
        draw = random.Random(seed)
        work = tmp_path / str(seed)
        db = Database(shutil.copytree(made, work / "db"))
        steps = Steps(0, partial(_change, db.url, draw))
        with pytest.MonkeyPatch.context() as patch:
            steps.watch(patch, Folder, STEPS)
            for _ in range(2):
                steps.left = draw.randint(0, 60)
                steps.is_done = False
                report = db.backup(str(work / "backup"))
                assert report.faults == (), seed
        for number in _archive(work / "backup").numbers():
            copy = _restored(
                db, work / "backup", work / f"copy {number}", number=number
            )
            assert copy.verify() == [], (seed, number)
            for kind in copy.kinds():
                for take in copy.takes(kind):
                    copy.read(kind, take).load()


def _change(url, draw) -> None:
    """What runs of others do: commit versions that are made from each other, and remove some."""
    process = os.fork()
    if not process:
        with suppress(BaseException):
            for _ in range(draw.randint(1, 3)):
                model = _commit(url, "model", "B", draw.random())
                inputs = [model.as_input()]
                _commit(url, "population", "albedo", draw.random(), inputs=inputs)
            if draw.random() < 0.5:
                Database(url).remove(Database(url).record("population", "traits"))
        os._exit(0)
    os.waitpid(process, 0)
    draw.random()  # of this process, so that the next change is another one


def test_list__is_repeated_until_nothing_changes(db, dest, monkeypatch):
    lists = []
    listed = backup_module._list

    def changing(place):
        lists.append(1)
        if len(lists) in (2, 3):
            _commit(db.url, "model", "C", float(len(lists)))
        return listed(place)

    monkeypatch.setattr(backup_module, "_list", changing)
    assert db.backup(str(dest)).versions == 9
    assert len(lists) == 4


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_backup__interrupted_at_any_step_continues(made, tmp_path):
    for number in range(0, 10_000, 17):
        work = tmp_path / str(number)
        db = Database(shutil.copytree(made, work / "db"))
        steps = Steps(number, _stopped)
        with pytest.MonkeyPatch.context() as patch, suppress(KeyboardInterrupt):
            steps.watch(patch, Folder, STEPS)
            db.backup(str(work / "backup"))
        if not steps.is_done:
            break
        archive = _archive(work / "backup")
        numbers = archive.numbers() if (work / "backup").exists() else []
        if numbers:
            assert _state(
                _restored(db, work / "backup", work / "first").root
            ) == _state(db.root)
        present = len(archive.contents())
        report = db.backup(str(work / "backup"), verify=True)
        assert report.faults == ()
        assert report.number == len(numbers) + 1
        assert report.present == present, number  # nothing is copied twice
        assert _state(_restored(db, work / "backup", work / "copy").root) == _state(
            db.root
        )
        shutil.rmtree(work)
    assert number > 50


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_restore__interrupted_at_any_step_is_refused_and_continues(db, dest, tmp_path):
    db.backup(str(dest))
    db.record_consent("B", ["fit"])
    expected = {
        key: content for key, content in _state(db.root).items() if "consent" not in key
    }
    for number in range(0, 10_000, 17):
        target = tmp_path / str(number)
        steps = Steps(number, _stopped)
        with pytest.MonkeyPatch.context() as patch, suppress(KeyboardInterrupt):
            steps.watch(patch, Folder, STEPS)
            _restored(db, dest, target)
        if not steps.is_done:
            break
        if (target / "log").exists() and (target / "withdrawn/restoring.json").exists():
            half = Database(target)
            for use in (
                half.takes,
                half.verify,
                half.table,
                half.garbage,
                partial(half.read, "model", "B"),
            ):
                with pytest.raises(
                    InputError,
                    match="found a restore that is not complete; run skindb restore again",
                ):
                    use()
            with pytest.raises(InputError, match="a restore that is not complete"):
                _commit(target, "capture", "D")
        if (target / "withdrawn/restoring.json").exists() or not (
            target / "log"
        ).exists():
            _restored(db, dest, target)
        copy = Database(target)
        assert copy.verify() == [], number
        assert _state(target).items() >= expected.items()
        assert copy.consent("B") == ["fit"]
        shutil.rmtree(target)
    assert number > 50


@pytest.mark.usefixtures("one_thread")
def test_restore__that_was_interrupted_before_a_withdrawal_keeps_nothing_of_the_subject(
    db, dest, tmp_path
):
    db.backup(str(dest))
    target = tmp_path / "copy"
    steps = Steps(40, _stopped)
    with pytest.MonkeyPatch.context() as patch, suppress(KeyboardInterrupt):
        steps.watch(patch, Folder, ["create"])
        _restored(db, dest, target)
    assert traces(target, SUBJECT)
    db.erase(SUBJECT)
    copy = _restored(db, dest, target)
    assert traces(target, SUBJECT) == []
    assert copy.verify() == []
    assert copy.takes("model") == ["B"]


def test_restore__beside_one_that_is_completed_meanwhile_changes_nothing(
    db, dest, tmp_path, monkeypatch
):
    db.backup(str(dest))
    target = tmp_path / "copy"
    place_at(str(target)).create(restoring.LOCK, b"{}")  # one is running
    plan = restoring._plan

    def late(*arguments):
        monkeypatch.setattr(restoring, "_plan", plan)
        _restored(db, dest, target)
        _commit(target, "capture", "D")
        return plan(*arguments)

    monkeypatch.setattr(restoring, "_plan", late)
    with pytest.raises(InputError, match="found a database"):
        _restored(db, dest, target)
    assert Database(target).takes() == ["B", "D", SUBJECT]
    assert Database(target).verify() == []


def test_backup__from_a_folder_to_a_bucket_and_back(
    db, new_database, tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "share"))
    archive = new_database("localbucket")
    copy = new_database("localbucket")
    first = db.backup(archive, verify=True)
    assert first.faults == ()
    assert db.backup(archive).copied == 0
    restore(archive, copy, markers=db.place.marker_file())
    assert Database(copy).verify() == []
    back = tmp_path / "back"
    report = Database(copy).backup(str(back), verify=True)
    assert (report.copied, report.faults) == (first.copied, ())
    [file] = (tmp_path / "share/skindb").iterdir()
    restore(str(back), str(tmp_path / "end"), markers=file)
    assert _state(tmp_path / "end") == _state(db.root)
    db.erase(SUBJECT)
    assert db.erase_from_backup(archive) > 5
    restore(archive, str(tmp_path / "without"), without_markers=True)
    assert traces(tmp_path / "without", SUBJECT) == []
    assert Database(tmp_path / "without").verify() == []
