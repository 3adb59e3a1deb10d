"""A writer that is suspended at any of its steps while a subject is withdrawn never
brings the subject back.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from functools import partial

import numpy as np
import pytest
from traces import contents

from skindb.errors import InputError
from skindb.schema import dataset
from skindb.store import Database
from skindb.store import lease as lease_module
from skindb.store import stage as stage_module
from skindb.store.bucket import Bucket
from skindb.store.folder import Folder
from skindb.store.log import Log
from skindb.store.markers import WithdrawalGuard, WithdrawnError

SUBJECT = "Xqz7"
HIDDEN = r"the database must hold it|a version must not refer to a withdrawn subject"
SCOPE = {"consent_scope": ["fit", "statistics"]}
# between two of these calls a writer may be suspended
FOLDER_STEPS = [
    (Folder, "_temporary"),
    (Folder, "_try_write"),
    (Folder, "make_durable"),
    (Folder, "writable"),
    (WithdrawalGuard, "__call__"),
    (os, "link"),
    (os, "replace"),
    (stage_module, "require_inputs"),
    (stage_module, "require_consents"),
]
BUCKET_STEPS = [
    (Bucket, "_put_new"),
    (Bucket, "_put"),
    (WithdrawalGuard, "__call__"),
    (stage_module, "require_inputs"),
]


class Steps:
    """Counts the steps of a writer, and calls a function in one of them."""

    def __init__(self, number: int, action) -> None:
        self.left = number
        self.action = action
        self.is_done = False

    def watch(self, patch: pytest.MonkeyPatch, targets) -> None:
        for owner, name in targets:
            patch.setattr(owner, name, partial_method(self, getattr(owner, name)))

    def step(self) -> None:
        if self.is_done:
            return
        self.left -= 1
        if self.left < 0:
            self.is_done = True
            self.action()


def partial_method(steps: Steps, call):
    def run(*args, **options):
        # a file of zarr: one step of all of these is enough
        if str(args[0]).endswith(".partial"):
            return call(*args, **options)
        steps.step()
        result = call(*args, **options)
        steps.step()
        return result

    return run


def _commit(
    url, kind: str, take: str, value: float = 1.0, lease=None, names=(), **about
):
    """A version as small as possible."""
    names = [*names, *(one["take"] for one in about.get("inputs", []))]
    with Database(url).stage(kind, take, lease, names=names) as stage:
        stage.write({"surfels": dataset({"surfel_area": np.full(2, value)})})
        return stage.commit(SCOPE | about)


def _fill(url) -> None:
    for take in (SUBJECT, "B"):
        capture = _commit(url, "capture", take)
        _commit(url, "model", take, inputs=[capture.as_input()])


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder of a database of captures and models of two subjects, which is only copied."""
    root = tmp_path_factory.mktemp("made") / "db"
    _fill(root)
    return root


def _capture(db: Database) -> None:
    _commit(db.url, "capture", f"{SUBJECT}.lotion")


def _capture_under_lease(db: Database) -> None:
    with db.lease(SUBJECT, "capture", "model") as lease:
        _commit(db.url, "capture", SUBJECT, lease=lease)


def _study(db: Database) -> None:
    models = [db.record("model", take) for take in (SUBJECT, "B")]
    _commit(
        db.url, "population", "traits", inputs=[model.as_input() for model in models]
    )


def _study_that_names(db: Database) -> None:
    skipped = [{"take": SUBJECT, "reason": "its consent does not cover statistics"}]
    _commit(db.url, "population", "traits", names=[SUBJECT], skipped=skipped)


WRITERS = {
    "capture": _capture,
    "capture under a lease": _capture_under_lease,
    "study": _study,
    "study that only names the subject": _study_that_names,
    "release": lambda db: db.create_release("r1"),
    "consent": lambda db: db.record_consent(SUBJECT, ["fit"]),
    "cache": lambda db: db.info(),
}


def _withdraw(db: Database) -> None:
    """A withdrawal after the lease of the suspended writer has expired."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lease_module, "_has_ended", lambda *_: True)
        # as another process, which knows nothing of what this one keeps in memory
        Database(db.url).erase(SUBJECT)


def _remains(db: Database, others: dict[str, bytes]) -> list[str]:
    """Files beyond those of others and those that a withdrawal leaves, and everything
    that names the subject.
    """
    left = contents(db.root)
    known = ("secret", "withdrawn/", "tombstones/", "requests/", "heads/population/")
    known += ("log/release/", "data/release/", "heads/release/")  # the next revision
    found = [key for key in left if key not in others and not key.startswith(known)]
    found += [key for key, content in left.items() if SUBJECT.encode() in content]
    return found + [str(path) for path in db.root.rglob(f"*{SUBJECT}*")]


@pytest.mark.slow
@pytest.mark.parametrize("writer", WRITERS)
def test_writer__suspended_at_any_step_of_a_folder_leaves_nothing(
    made, tmp_path, writer
):
    others = {
        key: content for key, content in contents(made).items() if SUBJECT not in key
    }
    refused = 0
    for number in range(1000):
        db = Database(shutil.copytree(made, tmp_path / str(number)))
        steps = Steps(number, partial(_withdraw, db))
        with pytest.MonkeyPatch.context() as patch:
            steps.watch(patch, FOLDER_STEPS)
            try:
                WRITERS[writer](db)
            except InputError:
                refused += 1
        if not steps.is_done:
            break
        shutil.rmtree(db.root / "catalogue", ignore_errors=True)  # of another subject
        assert _remains(db, others) == [], number
        assert contents(db.root).items() >= others.items()
        assert db.verify() == []
        assert db.takes("model") == ["B"]
    assert number > 5
    assert refused > 3 or writer == "cache"


@pytest.mark.slow
def test_writer__of_another_subject_is_never_disturbed(made, tmp_path):
    for number in range(1000):
        db = Database(shutil.copytree(made, tmp_path / str(number)))
        steps = Steps(number, partial(_withdraw, db))
        with pytest.MonkeyPatch.context() as patch:
            steps.watch(patch, FOLDER_STEPS)
            inputs = [db.record("model", "B").as_input()]
            record = _commit(db.url, "population", "traits", 3.0, inputs=inputs)
        if not steps.is_done:
            break
        assert float(db.read("population", "traits")["surfels/surfel_area"][0]) == 3.0
        assert db.record("population", "traits") == record
        assert db.verify() == []
    assert number > 20


@pytest.mark.slow
@pytest.mark.parametrize(
    ("writer", "first"), [("capture", 0), ("study", 1), ("release", 2), ("cache", 0)]
)
def test_writer__suspended_at_every_third_step_of_a_bucket_leaves_nothing(
    made, new_database, writer, first
):
    filled = contents(made)
    for number in range(first, 1000, 3):
        db = Database(new_database("localbucket"))
        for key, content in filled.items():
            db.place.replace(key, content)
        steps = Steps(number, partial(_withdraw, db))
        with pytest.MonkeyPatch.context() as patch:
            steps.watch(patch, BUCKET_STEPS)
            with suppress(InputError):
                WRITERS[writer](db)
        if not steps.is_done:
            break
        found = _keys_with(db, SUBJECT)
        assert found == [], (number, found)
        assert db.verify() == []
        assert db.takes("model") == ["B"]
    assert number > 1


def _keys_with(db: Database, subject: str) -> list[str]:
    place = db.place
    files = [top for top in place.names() or [] if place.file_type(top) == "file"]
    files += [
        f"{top}/{name}"
        for top in place.names() or []
        for name, size in place.sizes(top).items()
        if size >= 0
    ]
    return [
        key for key in files if subject in key or subject.encode() in place.read(key)
    ]


@pytest.fixture(params=["folder", "bucket"])
def late(request, tmp_path):
    """A database in which a writer, whose last check was before a withdrawal, has
    committed and was killed.
    """
    url = (
        str(tmp_path / "db")
        if request.param == "folder"
        else request.getfixturevalue("bucket")
    )
    _fill(url)
    db = Database(url)
    _commit(url, "population", "traits", inputs=[db.record("model", "B").as_input()])
    with pytest.MonkeyPatch.context() as patch:
        steps = Steps(0, partial(_withdraw, db))
        patch.setattr(WithdrawalGuard, "__call__", lambda _: None)
        steps.watch(patch, [(stage_module, "require_consents")])
        _study(db)
        _capture_late(db)
    return Database(url)


def _capture_late(db: Database) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(WithdrawalGuard, "__call__", lambda _: None)
        _capture(db)


@pytest.mark.slow
def test_late_commit__is_not_visible(late):
    for kind, take in (("capture", f"{SUBJECT}.lotion"), ("population", "traits")):
        with pytest.raises(InputError, match=HIDDEN):
            late.record(kind, take)
        with pytest.raises(InputError, match=HIDDEN):
            late.read(kind, take)
    with pytest.raises(InputError, match="the database must hold it"):
        late.consent(f"{SUBJECT}.lotion")
    assert late.takes("capture") == late.takes("model") == ["B"]
    assert late.takes("capture", where="capture_generation > 0") == ["B"]
    assert list(late.table().index) == ["B"]
    assert late.subjects() == ["B"]
    assert SUBJECT not in late.info()["takes"]
    [block] = late.place.children("catalogue")
    assert SUBJECT.encode() not in late.place.read(f"catalogue/{block}")
    assert not late.has("capture", f"{SUBJECT}.lotion")


def test_late_commit__is_named_by_verify_and_removed_by_clean(late):
    places = {
        fault.where
        for fault in late.verify()
        if fault.rule == "nothing of a withdrawn subject must remain"
    }
    study = Log(late.place, "population", "traits")._read(2).path
    keys = (f"data/capture/{SUBJECT}.lotion", study)
    assert {late.place.where(key) for key in keys} <= places
    late.clean()
    assert late.verify() == []
    assert _keys_with(late, SUBJECT) == []
    assert late.record("population", "traits").generation == 1


def test_stage__of_a_withdrawn_subject_is_refused(made, tmp_path):
    db = Database(shutil.copytree(made, tmp_path / "db"))
    db.erase(SUBJECT)
    refused = [
        ("capture", f"{SUBJECT}.b", []),
        ("population", "x", [SUBJECT]),
        ("edit", "B", [SUBJECT]),
    ]
    for kind, take, names in refused:
        with pytest.raises(
            WithdrawnError,
            match=f"{SUBJECT}: the subject must not be withdrawn while a version",
        ):
            db.stage(kind, take, names=names)
    with pytest.raises(WithdrawnError, match=SUBJECT):
        db.lease(f"{SUBJECT}.b", "model").__enter__()
    assert list(db.root.rglob(f"*{SUBJECT}*")) == []
