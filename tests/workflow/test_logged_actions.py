"""Functions of notebooks are logged once, also in other processes, and where the log
cannot be written.
"""

from __future__ import annotations

import errno
import inspect
import pickle
import shutil
from functools import partial

import pytest
from planted_cohort import PARAMETERS, few_materials

from skindb import workflow
from skindb.errors import InputError
from skindb.store import Database
from skindb.store.folder import Folder
from skindb.workflow.audit import NotLoggedWarning, as_part, logged, logged_action

pytestmark = pytest.mark.slow

# functions that use `logged_action` themselves
LOG_THEMSELVES = {
    "backup",
    "calibrate",
    "calibrate_rig",
    "clean",
    "create_release",
    "ingest_if_changed",
    "ingest_take",
    "record_consent",
    "reproduce",
    "study",
    "tidy_table",
    "withdraw",
}
# functions that compute or list what a command needs, and neither change nor disclose
# data of subjects
NOT_LOGGED = {
    "describe_calibration",
    "describe_rig",
    "next_visits",
    "parameters_of",
    "plan_withdrawal",
    "registered_datasets",
    "stale_results",
    "superseded_calibrations",
    "takes_to_fit",
    "takes_without_consent",
}


@pytest.fixture
def db(fitted_database):
    """A database whose audit log is empty, with its number of entries."""
    shutil.rmtree(fitted_database.root / "audit")
    return fitted_database


def _actions(db):
    entries, faults = db.audit()
    assert faults == []
    return [(entry.action, entry.counts.get("takes", 0)) for entry in entries]


def _takes_a_database(function):
    return (
        inspect.isfunction(function) and "db" in inspect.signature(function).parameters
    )


def _is_decorated(function):
    """Whether `logged` is one of the decorators of a function."""
    while hasattr(function, "__wrapped__"):
        if function.__code__.co_filename == logged.__code__.co_filename:
            return True
        function = function.__wrapped__
    return False


def test_logged__every_function_of_a_database_is_decorated_or_named_here():
    functions = {
        name: getattr(workflow, name)
        for name in workflow.__all__
        if name not in ("logged_action", "STUDY_FUNCTIONS")
    }
    plain = {
        name
        for name, one in functions.items()
        if _takes_a_database(one) and not _is_decorated(one)
    }
    assert plain == LOG_THEMSELVES | NOT_LOGGED


def test_logged__a_call_in_a_notebook_is_one_entry(db, tmp_path):
    workflow.show_take(db, "S01", "fit_status", tmp_path / "a.png")
    workflow.fit_take(db, "S02", PARAMETERS, dictionary=few_materials())
    workflow.coverage(db, takes=["S01"])
    workflow.summarise(db, ["S01", "S02"])
    workflow.record_consent(db, "S02", ["fit"])
    assert _actions(db) == [
        ("show", 1),
        ("fit", 1),
        ("study", 1),
        ("summarise", 2),
        ("consent", 0),
    ]
    assert db.audit(subject="S02")[0][-1].counts == {"scopes": 1}


def test_logged__reads_of_the_store_are_not_logged(db):
    db.read("model", "S01").load()
    db.cohort("tables").load()
    db.table()
    assert _actions(db) == []


def test_logged_action__has_one_entry_of_everything_in_it(db, tmp_path):
    with logged_action(db, "show", ["S01", "S02"]):
        for take in ("S01", "S02"):
            workflow.show_take(db, take, "fit_status", tmp_path / f"{take}.png")
    workflow.show_take(db, "S01", "fit_status", tmp_path / "a.png")
    assert _actions(db) == [("show", 2), ("show", 1)]


def test_logged_action__of_another_database_is_logged_apart(db, tmp_path):
    other = Database(shutil.copytree(db.root, tmp_path / "other"))
    with logged_action(db, "show", ["S01"]):
        workflow.show_take(other, "S01", "fit_status", tmp_path / "a.png")
    assert _actions(db) == _actions(other) == [("show", 1)]


def test_logged_action__ends_with_an_error(db, tmp_path):
    with pytest.raises(InputError, match="no_such_variable"):
        workflow.show_take(db, "S01", "no_such_variable", tmp_path / "a.png")
    workflow.show_take(db, "S01", "fit_status", tmp_path / "a.png")
    assert _actions(db) == [("show", 1)] * 2


def test_as_part__is_a_part_of_the_action_also_in_another_process(db, tmp_path):
    draw = partial(
        workflow.show_take, db, variable="fit_status", out=tmp_path / "a.png"
    )
    with logged_action(db, "show", ["S01"]):
        sent = pickle.dumps(as_part(draw))
    pickle.loads(sent)("S01")
    assert _actions(db) == [("show", 1)]
    pickle.loads(pickle.dumps(as_part(draw)))("S01")
    assert _actions(db) == [("show", 1)] * 2


def test_map_takes__in_processes_does_not_log_again(db, tmp_path):
    draw = partial(workflow.explain_view, db)
    with logged_action(db, "view", ["S01", "S02"]):
        outcomes = list(workflow.map_takes(draw, ["S01", "S02"], workers=2))
    assert all(outcome.error is None for outcome in outcomes)
    assert _actions(db) == [("view", 2)]


def test_logged__records_flags_and_numbers_but_no_text(db):
    @logged("render", what="picture")
    def draw(db, take, *, edited=False, generation=None, title="", **options):
        return title

    assert (
        draw(
            db,
            "S01",
            generation=2,
            title="Anna",
            explain="Anna",
            edited=True,
            gltf=False,
        )
        == "Anna"
    )
    [entry] = db.audit()[0]
    assert entry.parameters == {"what": "picture", "generation": 2, "edited": True}


def test_logged__a_mistaken_path_does_not_become_a_database(tmp_path):
    with pytest.raises(InputError, match="none"):
        workflow.show_take(
            Database(tmp_path / "absent"), "S01", "fit_status", tmp_path / "a.png"
        )
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "letter.txt").write_text("x")
    with pytest.raises(InputError, match="none"):
        workflow.show_take(
            Database(tmp_path / "folder"), "S01", "fit_status", tmp_path / "a.png"
        )
    assert [path.name for path in (tmp_path / "folder").iterdir()] == ["letter.txt"]


class _Disc:
    """Refuses to create files until it is repaired."""

    def __init__(self, monkeypatch, error):
        self.error = OSError(error, "refused by the disk", "staging")
        self.create = Folder.create
        monkeypatch.setattr(
            Folder, "create", lambda *args, **options: self(*args, **options)
        )

    def __call__(self, *args, **options):
        if self.error is not None:
            raise self.error
        return self.create(*args, **options)


def test_logged__what_only_reads_is_done_with_a_warning(db, tmp_path, monkeypatch):
    _Disc(monkeypatch, errno.EROFS)
    with pytest.warns(
        NotLoggedWarning,
        match=r"^show was not written to the audit log of .*: refused by the disk$",
    ):
        workflow.show_take(db, "S01", "fit_status", tmp_path / "a.png")
    assert (tmp_path / "a.png").exists()


def test_logged__a_damaged_secret_does_not_prevent_reading(db, tmp_path):
    workflow.show_take(db, "S01", "fit_status", tmp_path / "a.png")
    (db.root / "secret").write_text("{}")
    with pytest.warns(NotLoggedWarning, match="does not match its seal"):
        workflow.show_take(db, "S01", "fit_status", tmp_path / "b.png")
    with pytest.raises(InputError, match="audit log need it"):
        workflow.record_consent(db, "S01", [])
    assert db.consent("S01") == ["fit", "statistics", "export"]


def test_logged__a_change_that_cannot_be_logged_is_refused(db, monkeypatch):
    _Disc(monkeypatch, errno.EACCES)
    monkeypatch.setattr(
        Database, "record_consent", lambda *_: pytest.fail("it was recorded")
    )
    with pytest.raises(OSError, match="refused by the disk"):
        workflow.record_consent(db, "S01", [])


def test_withdraw__that_frees_the_disk_is_logged_at_its_end(db, monkeypatch):
    disc = _Disc(monkeypatch, errno.ENOSPC)
    erase = Database.erase

    def freed(*args, **options):
        disc.error = None
        return erase(*args, **options)

    monkeypatch.setattr(Database, "erase", freed)
    done = workflow.withdraw(db, "S02")
    [entry] = db.audit(subject="S02")[0]
    assert (entry.action, entry.counts) == ("withdrawal", done.removed)
    assert db.takes("model") == ["S01", "S01.lotion"]
    assert db.verify() == []


def test_withdraw__is_logged_before_anything_is_removed(db, monkeypatch):
    monkeypatch.setattr(
        Database, "erase", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt)
    )
    with pytest.raises(KeyboardInterrupt):
        workflow.withdraw(db, "S02")
    assert _actions(db) == [("withdrawal", 0)]
    assert "S02" in db.takes("model")


def test_view_server__is_logged_when_it_is_made(db, monkeypatch):
    monkeypatch.setattr(workflow.pictures, "_faces", lambda *_, **__: iter(()))
    with pytest.raises(ValueError, match="zip"):
        workflow.view_server(db, ["S01"])
    assert _actions(db) == [("view", 1)]
