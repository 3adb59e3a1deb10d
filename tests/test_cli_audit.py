"""Every command that changes or discloses data logs one entry before it does so."""

from __future__ import annotations

import json
import shutil

import pytest
from test_cli import _run

import skindb
from skindb.store import Database
from skindb.store.folder import Folder
from skindb.store.markers import keyed_hash, require_secret
from skindb.workflow import audit, pictures

pytestmark = pytest.mark.slow

ALL = ("S01", "S02")
# arguments; action, subjects and parameters of the entry
LOGGED = [
    (("fit", "{db}", "S02", "--explain"), "fit", ("S02",), {"explain": True}),
    (("fit", "{db}", "--refit", "--rank", "3"), "fit", ALL, {"refit": True}),
    # refused, because the takes have no landmarks
    (("register", "{db}"), "register", ALL, {}),
    (("analyze", "{db}", "coverage"), "study", ALL, {"what": "coverage"}),
    (
        ("analyze", "{db}", "translucency", "--take", "S01"),
        "study",
        ("S01",),
        {"what": "translucency"},
    ),
    # refused without a study of traits
    (("edit", "{db}", "S01", "--trait", "lotion=1"), "edit", ("S01",), {}),
    (
        ("edit", "{db}", "S01", "--trait", "lotion=1", "--grid", "{out}/grid.png"),
        "render",
        ("S01",),
        {},
    ),
    (
        ("render", "{db}", "--out", "{out}", "--explain"),
        "render",
        ALL,
        {"explain": True},
    ),
    (
        ("render", "{db}", "S02", "--out", "{out}/a.png", "--size", "16"),
        "render",
        ("S02",),
        {},
    ),
    # refused without photographs
    (("compare", "{db}", "S01"), "compare", ("S01",), {}),
    (("show", "{db}", "S01", "fit_status", "{out}/a.png"), "show", ("S01",), {}),
    (("info", "{db}", "-v"), "show", ALL, {}),
    (
        ("export", "{db}", "S01", "S01.lotion", "--out", "{out}", "--gltf"),
        "export",
        ("S01",),
        {"gltf": True},
    ),
    (("view", "{db}", "--out", "{out}/page.html"), "view", ALL, {}),
    (("view", "{db}", "--explain"), "view", ALL, {"explain": True}),
    (("consent", "{db}", "S02", "--scope", "fit"), "consent", ("S02",), {}),
    (("release", "{db}", "r1", "--take", "S02"), "release", ("S02",), {}),
    (("refresh", "{db}"), "refresh", ALL, {}),
    (("withdraw", "{db}", "S02", "--yes"), "withdrawal", ("S02",), {}),
    (("backup", "{db}", "{out}/backup"), "backup", ALL, {}),
    (("clean", "{db}", "--yes", "--generations", "1"), "clean", (), {"generations": 1}),
]
NOT_LOGGED = [
    ("info", "{db}"),
    ("verify", "{db}"),
    ("audit", "{db}"),
    ("release", "{db}"),
    ("consent", "{db}", "S01"),
    ("refresh", "{db}", "--dry-run"),
    ("withdraw", "{db}", "S01", "--dry-run"),
    ("clean", "{db}"),
    ("fit", "{db}"),  # all takes have a model
]


@pytest.fixture
def called(fitted_database, tmp_path, monkeypatch):
    """Function that calls a command, and returns its result and the new entries."""
    # the lights of these takes have no intensities, which a page needs
    monkeypatch.setattr(pictures, "_faces", lambda *_, **__: iter(()))
    out = tmp_path / "out"
    out.mkdir()

    def call(args):
        before = len(fitted_database.audit()[0])
        done = _run(
            *(arg.format(db=fitted_database.root, out=out) for arg in args),
            "--no-progress",
        )
        entries, faults = fitted_database.audit()
        assert faults == []
        return done, entries[before:]

    return call


@pytest.mark.parametrize(("args", "action", "subjects", "parameters"), LOGGED)
def test_command__logs_one_entry(
    fitted_database, called, args, action, subjects, parameters
):
    done, entries = called((*args, "--actor", "anna"))
    assert "Traceback" not in done.stderr
    [entry] = entries
    assert (entry.action, entry.actor, entry.parameters) == (action, "anna", parameters)
    assert entry.subjects == sorted(
        keyed_hash(require_secret(Folder(fitted_database.root)), one)
        for one in subjects
    )


def _files(folder):
    """Files of a folder with their content, without the cache of the catalogue."""
    files = [
        path
        for path in folder.rglob("*")
        if path.is_file() and path.parent.name != "catalogue"
    ]
    return {str(path): path.read_bytes() for path in files}


class _StopError(Exception):
    pass


@pytest.mark.parametrize("args", [args for args, *_ in LOGGED])
def test_command__logs_before_anything_is_changed_or_disclosed(
    fitted_database, called, tmp_path, monkeypatch, args
):
    before = _files(tmp_path)

    def stop(*_, **__):
        raise _StopError

    monkeypatch.setattr(Database, "log_action", stop)
    with pytest.raises(_StopError):
        called(args)
    assert _files(tmp_path) == before


@pytest.mark.parametrize("args", NOT_LOGGED)
def test_command__that_shows_names_and_states_logs_nothing(called, args):
    done, entries = called(args)
    assert done.returncode == 0
    assert entries == []


def test_audit__lists_entries_and_checks_the_chain(fitted_database, called):
    log = ["fit", "fit", "fit"]  # of the fixture
    called(("show", "{db}", "S01", "fit_status", "{out}/a.png", "--actor", "anna"))
    done, _ = called(("audit", "{db}"))
    lines = done.stdout.splitlines()
    assert lines[0].split() == [
        "number",
        "when",
        "actor",
        "action",
        "subjects",
        "counts",
        "parameters",
    ]
    assert [line.split()[3] for line in lines[1:]] == [*log, "show"]
    assert lines[-1].split()[2:] == ["anna", "show", "1", "takes", "1"]
    assert "S01" not in done.stdout
    of_subject, _ = called(("audit", "{db}", "--subject", "S02", "--json"))
    assert [entry["number"] for entry in json.loads(of_subject.stdout)] == [3]
    (fitted_database.root / "audit" / "000000" / "000000002.json").unlink()
    for command in ("audit", "verify"):
        damaged = _run(command, str(fitted_database.root))
        assert damaged.returncode == 1
        assert (
            "entry 2 must exist; found no such file; restore it from a backup"
            in damaged.stderr
        )


@pytest.mark.parametrize("actor", ["", " anna", "a" * 65, "anna\x1b[31m", "a\nb"])
def test_actor__must_be_short_and_printable(called, monkeypatch, actor):
    args = ("clean", "{db}", "--yes")
    done, entries = called((*args, "--actor", actor))
    assert (done.returncode, entries) == (1, [])
    assert "actor: must be 1 to 64 characters that can be printed" in done.stderr
    if actor:
        monkeypatch.setenv("SKINDB_ACTOR", actor)
        done, entries = called(args)
        assert (done.returncode, entries) == (1, [])
        assert "SKINDB_ACTOR: must be" in done.stderr


def test_actor__is_that_of_the_option_or_the_environment_or_the_user(
    called, monkeypatch
):
    monkeypatch.delenv("SKINDB_ACTOR", raising=False)
    args = ("clean", "{db}", "--yes")
    monkeypatch.setattr(
        audit.pwd,
        "getpwuid",
        lambda _: audit.pwd.struct_passwd(("carla", "", 0, 0, "", "", "")),
    )
    actors = [called(args)[1][0].actor]
    monkeypatch.setenv("SKINDB_ACTOR", "Bärbel")
    actors.append(called(args)[1][0].actor)
    actors.append(called((*args, "--actor", "anna"))[1][0].actor)
    actors.append(called(args)[1][0].actor)  # the option counts for its own call only
    assert actors == ["carla", "Bärbel", "anna", "Bärbel"]


def test_ingest__of_each_capture_is_an_entry(tmp_path):
    size = ("--cameras", "3", "--lights", "12", "--width", "48", "--height", "60")
    assert _run("simulate", str(tmp_path / "c"), "--takes", "2", *size).returncode == 0
    db = skindb.open(str(tmp_path / "db"), create=True)
    takes = [str(tmp_path / "c" / take) for take in ("V001", "V001.lotion")]
    (tmp_path / "c" / "broken").mkdir()
    (tmp_path / "c" / "broken" / "capture.json").write_text("[")
    done = _run(
        "ingest", str(db.root), *takes, str(tmp_path / "c" / "broken"), "--spacing", "8"
    )
    assert done.returncode == 1
    entries = db.audit()[0]
    assert [(entry.action, entry.counts) for entry in entries] == [
        ("ingest", {"takes": 1})
    ] * 2
    assert entries[0].subjects == [keyed_hash(require_secret(Folder(db.root)), "V001")]
    assert _run("ingest", str(db.root), takes[0], "--spacing", "7").returncode == 0
    assert len(db.audit(subject="V001")[0]) == 3
    shutil.rmtree(tmp_path / "db")
    assert _run("ingest", str(db.root), str(tmp_path / "c" / "broken")).returncode == 1
    assert not db.root.exists()  # a capture that was refused creates no database
