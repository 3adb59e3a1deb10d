"""The command line: mistakes are one line, exits are right, no traceback."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

COMMANDS = ["demo", "simulate", "ingest", "fit", "analyze", "edit", "render", "compare", "export", "info", "verify"]


def _run(*args: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", "from skindb.cli import main; main()", *args],
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_cli__every_command_has_help_and_the_common_options(command):
    done = _run(command, "--help")
    assert done.returncode == 0, done.stderr
    for option in ("--json", "--no-progress", "--verbose"):
        assert option in done.stdout


@pytest.mark.parametrize(
    ("args", "code", "said"),
    [
        ((), 2, "Usage"),
        (("nonsense",), 2, "No such command"),
        (("fit",), 2, "Missing argument 'DB'"),
        (("info", "{tmp}/none"), 1, "the database must exist"),
        (("verify", "{tmp}/none"), 1, "the database must exist"),
        (("info", "s3://bucket/x"), 1, "buckets are not supported yet"),
        (("ingest", "{tmp}/db", "{tmp}/none"), 1, "none"),
        (("fit", "{tmp}/db", "X"), 1, "the database must hold it"),
        (("fit", "{tmp}/db", "--basis", "{tmp}"), 1, "MERL"),
        (("analyze", "{tmp}/db", "traits"), 1, "a study needs fitted takes"),
        (("analyze", "{tmp}/db", "everything"), 2, "Invalid value"),
        (("edit", "{tmp}/db", "X", "--trait", "lotion"), 2, "NAME=AMOUNT"),
        (("edit", "{tmp}/db", "X", "--trait", "lotion=1"), 1, "an edit needs trait vectors"),
        (("render", "{tmp}/db", "X", "{tmp}/x.png"), 1, "the database must hold it"),
        (("export", "{tmp}/db", "../X", "{tmp}/x"), 1, "take"),
        (("demo", "--out", "{tmp}/full"), 1, "absent or empty folder"),
        (("demo", "--lights", "1"), 2, "Invalid value"),
    ],
)
def test_cli__mistakes_are_explained(tmp_path, args, code, said):
    (tmp_path / "full").mkdir()
    (tmp_path / "full/notes.txt").write_text("keep me")
    done = _run(*(a.format(tmp=tmp_path) for a in args))
    assert done.returncode == code, done.stdout + done.stderr
    assert said in done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    assert (tmp_path / "full/notes.txt").read_text() == "keep me"


def test_cli__info_of_an_empty_database_is_json(tmp_path):
    done = _run("info", str(tmp_path), "--json")
    assert done.returncode == 0
    assert json.loads(done.stdout) == {"takes": {}}


def test_import__is_fast_and_does_nothing():
    """No numba, no dask, no zarr: what is heavy is imported by the function that needs it."""
    heavy = {"numba", "dask", "zarr", "xarray", "matplotlib", "sklearn"}
    code = f"import sys, skindb; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
