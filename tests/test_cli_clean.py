"""Leases and garbage on the command line."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from test_cli import _run

sys.path.insert(0, str(Path(__file__).parent / "store"))
from stored import commit, groups

from skindb.store import Database
from skindb.store import lease as lease_module
from skindb.store.lease import this_process


@pytest.fixture
def db(tmp_path):
    for _ in range(2):
        commit(tmp_path / "db", consent_scope=["fit"])
    return Database(tmp_path / "db")


def test_fit__a_take_in_use_is_refused_in_one_line(db):
    with db.lease("A1", "model", command="skindb fit"):
        done = _run("fit", str(db.root), "A1", "--wait", "0.1")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(
        "skindb: model of A1: only one run at a time may work on it; found skindb fit on "
    )
    assert line.endswith(
        "(--wait SECONDS) or end it; its lease expires 60 s after its last renewal"
    )
    assert _run("fit", str(db.root), "A1", "--wait", "-1").returncode == 2


def test_clean__lists_first_and_removes_on_request(db, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(
            lease_module, "this_process", lambda: this_process() | {"started": "1"}
        )
        lease = db.lease("A1", "capture", command="skindb ingest")
        lease.__enter__()
        lease._ended.set()
    stage = db.stage("capture", "A1")
    stage.write(groups())
    told = _run("verify", str(db.root))
    assert told.returncode == 0
    assert told.stdout == "Every version is intact.\n"
    listed = _run("clean", str(db.root)).stdout.splitlines()
    assert listed[0].startswith(
        f"{stage.path}  0.0 MB  a version without a record, left by a killed run"
    )
    assert listed[-1] == "1 to remove, 0.0 MB; --yes removes them"
    assert (db.root / stage.path).exists()
    removed = json.loads(_run("clean", str(db.root), "--yes", "--json").stdout)
    assert removed["removed"]
    assert [one["key"] for one in removed["items"]] == [stage.path]
    assert removed["bytes"] == sum(one["bytes"] for one in removed["items"]) > 0
    assert not (db.root / stage.path).exists()
    assert _run("clean", str(db.root)).stdout == "0 to remove, 0.0 MB\n"
    assert _run("verify", str(db.root)).stdout == "Every version is intact.\n"


def test_clean__names_old_generations_and_why_they_are_kept(db):
    (line, total) = _run(
        "clean", str(db.root), "--generations", "1"
    ).stdout.splitlines()
    assert line.startswith(
        "log/capture/A1/00000001.json  0.0 MB  generation 1, which is not an input "
        "of a kept version"
    )
    assert "(kept: written 0 minutes ago, kept for 1 h)" in line
    assert total == "0 to remove, 0.0 MB"
    assert _run("clean", str(db.root), "--generations", "0").returncode == 2
