"""Serving models of a database to a browser."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from page_session import Session, running
from small_face import small_face

import skindb
from skindb.errors import InputError
from skindb.workflow.derive import groups_of

sys.path.insert(0, str(Path(__file__).parents[1] / "store"))
from stored import commit

pytestmark = pytest.mark.slow

PROGRAM = "from skindb.cli import main; main()"


@pytest.fixture
def faces(tmp_path):
    """A database of models of two subjects that can be shown."""
    db = skindb.open(str(tmp_path / "db"), create=True)
    for take, age in (("S01", 30), ("S02", 60)):
        tree = small_face()
        about = {
            "subject": take,
            "consent_scope": ["fit", "export"],
            "traits": {"age": age},
        }
        capture = commit(db.root, take=take, **about)
        with db.stage("model", take) as stage:
            stage.write(groups_of(tree))
            stage.commit({**about, "inputs": [capture.as_input()]})
    return db


def listed(session):
    """Takes that the page of a session lists."""
    embedded = (
        session.request("GET", "")
        .body.decode()
        .partition('id="takes">')[2]
        .partition("</script>")[0]
    )
    return [take["take"] for take in json.loads(embedded)]


def test_view_server__serves_a_face_as_long_as_its_subject_consents(faces):
    db = faces
    with running(skindb.workflow.view_server(db, ["S01", "S02"])) as server:
        session = Session.opened(server.address)
        assert listed(session) == ["S01", "S02"]
        record = json.loads(session.request("GET", "faces/S02.json").body)
        assert record["about"]["attributes"]["age"] == "60"
        db.record_consent("S02", ["fit", "statistics"])
        assert listed(session) == ["S01"]
        # given again: the face was removed from the memory
        db.record_consent("S02", ["export"])
        refused = session.request("GET", "faces/S02.json")
        assert refused.status == 404
        assert b"S02: its subject must consent to exports" in refused.body
        skindb.workflow.withdraw(db, "S01")
        assert session.status("GET", "faces/S01.json") == 404
        assert listed(session) == []


def test_view_server__refuses_a_take_without_consent(faces):
    faces.record_consent("S02", ["fit"])
    with pytest.raises(InputError, match="this step needs the scope 'export'"):
        skindb.workflow.view_server(faces, ["S02"])


def test_view__leaves_nothing_in_temporary_folders_when_it_is_killed(faces, tmp_path):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    command = [sys.executable, "-c", PROGRAM, "view", str(faces.root), "--no-progress"]
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(temporary)},
    )
    try:
        session = Session.opened(process.stdout.readline().split()[0])
        assert listed(session) == ["S01", "S02"]
        assert session.status("GET", "faces/S01.json") == 200
        assert not [*temporary.rglob("*")]
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    assert not [*temporary.rglob("*")]
