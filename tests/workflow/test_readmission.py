"""Captures of a withdrawn subject: refused, suspended while the subject is withdrawn,
and admitted by a new consent.
"""

from __future__ import annotations

import json
import shutil
from datetime import date, timedelta
from pathlib import Path

import pytest
from click.testing import CliRunner
from sphere import write_capture
from traces import contents, traces

from skindb import workflow
from skindb.cli import cli
from skindb.errors import InputError
from skindb.store import Database, WithdrawnError
from skindb.store import lease as lease_module

SUBJECT = "Xqz7"
OPTIONS = {"spacing_mm": 8.0, "photographs": 0}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A capture folder of the subject."""
    found = tmp_path_factory.mktemp("captures") / SUBJECT
    write_capture(found)
    _edit(found, subject=SUBJECT)
    return found


@pytest.fixture(scope="module")
def withdrawn(folder, tmp_path_factory):
    """Folder of a database whose only subject was withdrawn, which is only copied."""
    db = Database(tmp_path_factory.mktemp("made") / "db")
    workflow.ingest_take(db, folder, **OPTIONS)
    workflow.withdraw(db, SUBJECT)
    return db.root


@pytest.fixture
def db(withdrawn, tmp_path):
    """A database whose only subject was withdrawn."""
    return Database(shutil.copytree(withdrawn, tmp_path / "db"))


def _edit(folder, **changes):
    file = folder / "capture.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def test_ingest__of_a_withdrawn_subject_is_refused_in_one_line(db, folder):
    before = contents(db.root)
    result = CliRunner().invoke(
        cli, ["ingest", str(db.root), str(folder), "--spacing", "8"]
    )
    [line] = str(result.exception).splitlines()
    assert (
        f"{SUBJECT}: a withdrawn subject must consent again before a capture is "
        "ingested; found a withdra"
    ) in line
    assert line.endswith("if there is a new consent, state its date with --new-consent")
    after = contents(db.root)
    attempt = "audit/000000/000000003.json"  # the attempt is logged
    assert after.pop(attempt)
    assert after == before


@pytest.mark.slow
def test_ingest__with_a_new_consent_is_admitted_from_then_on(db, folder):
    record = workflow.ingest_take(db, folder, new_consent=date.today(), **OPTIONS)
    assert record.admissions == {SUBJECT: 2}
    assert db.takes() == [SUBJECT]
    assert db.consent(SUBJECT) == ["fit", "statistics"]  # of the capture
    assert db.withdrawal(SUBJECT).body["readmitted"] == date.today().isoformat()
    again = workflow.ingest_take(db, folder, **OPTIONS)
    assert again.generation == 2
    assert db.verify() == []


def test_ingest__that_was_killed_after_the_new_consent_continues_by_the_same_call(
    db, folder, monkeypatch
):
    def die(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("skindb.workflow.captures.scratch_name", die)
        with pytest.raises(KeyboardInterrupt):
            workflow.ingest_take(db, folder, new_consent=date.today(), **OPTIONS)
    assert db.takes() == []
    assert (
        workflow.ingest_take(db, folder, new_consent=date.today(), **OPTIONS).generation
        == 1
    )


@pytest.mark.parametrize("days", [-3, 3])
def test_ingest__with_an_impossible_date_is_refused(db, folder, days):
    day = date.today() + timedelta(days=days)
    with pytest.raises(
        InputError,
        match=f"a new consent must be given after the withdrawal .* found {day}",
    ):
        workflow.ingest_take(db, folder, new_consent=day, **OPTIONS)
    assert db.withdrawal(SUBJECT).is_withdrawal


def test_ingest__of_a_capture_without_consent_admits_nobody(db, folder, tmp_path):
    other = Path(shutil.copytree(folder, tmp_path / SUBJECT))
    _edit(other, consent={"scope": ["statistics"], "reference": "form 7"})
    with pytest.raises(InputError, match="this step needs the scope 'fit'"):
        workflow.ingest_take(db, other, new_consent=date.today(), **OPTIONS)
    assert db.withdrawal(SUBJECT).is_withdrawal


def test_ingest__a_new_consent_is_stated_for_one_withdrawn_subject(
    db, folder, tmp_path
):
    other = Path(shutil.copytree(folder, tmp_path / "P2"))
    _edit(other, subject="P2")
    with pytest.raises(
        InputError, match="P2: a new consent is only for a subject who was withdrawn"
    ):
        workflow.ingest_take(db, other, new_consent=date.today(), **OPTIONS)
    today = date.today().isoformat()
    result = CliRunner().invoke(
        cli, ["ingest", str(db.root), str(folder), str(other), "--new-consent", today]
    )
    assert str(result.exception).startswith(
        "--new-consent: a new consent is stated for one capture; found 2 captures"
    )
    assert db.takes() == []


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["check", "visibility", "sample", "write"])
def test_ingest__suspended_while_the_subject_is_withdrawn_leaves_nothing(
    folder, tmp_path, monkeypatch, stage
):
    db = Database(tmp_path / "db")
    workflow.ingest_take(db, folder, **OPTIONS)

    def suspend(name, *_):
        if name == stage and not db.withdrawal(SUBJECT):
            # the lease of this run has expired
            monkeypatch.setattr(lease_module, "_has_ended", lambda *_: True)
            db.erase(SUBJECT)

    with pytest.raises(
        WithdrawnError, match=f"{SUBJECT}: a withdrawn subject must consent again"
    ):
        workflow.ingest_take(db, folder, progress=suspend, **OPTIONS)
    assert db.withdrawal(SUBJECT)
    assert traces(db.root, SUBJECT) == []
    assert list((db.root / "tmp").iterdir()) == []
    assert db.verify() == []
