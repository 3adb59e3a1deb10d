"""`skindb capture` without --virtual: devices behind sockets, in real time, and frames
in watched folders.
"""

from __future__ import annotations

import json
import socket
import threading

import pytest
from click.testing import CliRunner
from served_devices import Server

from skindb.cli import cli
from skindb.clock import SYSTEM_CLOCK
from skindb.ingest import read_capture
from skindb.virtual.laboratory import Laboratory

pytestmark = pytest.mark.slow

SMALL = [
    "--takes",
    "1",
    "--lights",
    "8",
    "--cameras",
    "2",
    "--width",
    "24",
    "--height",
    "30",
]


@pytest.fixture(scope="module")
def setup(tmp_path_factory):
    folder = tmp_path_factory.mktemp("simulated")
    result = CliRunner().invoke(cli, ["simulate", str(folder / "lab"), *SMALL])
    assert result.exit_code == 0, str(result.exception)
    return next(path for path in (folder / "lab").iterdir() if path.is_dir())


def _capture(setup, out, *options):
    """A session with a laboratory in real time."""
    laboratory = Laboratory(setup, out.parent / "frames", clock=SYSTEM_CLOCK)
    with Server(laboratory.dome) as dome:
        own = [
            "--setup",
            str(setup),
            "--dome",
            dome.url,
            "--cameras",
            str(laboratory.watched),
            "--subject",
            "S1",
        ]
        own += [
            "--consent",
            "fit",
            "--reference",
            "form 1",
            "--scan",
            str(setup / "scan.ply"),
        ]
        return laboratory, CliRunner().invoke(
            cli, ["capture", str(out), *own, *options]
        )


def test_capture__a_real_session_records_who_confirmed_its_flashes(setup, tmp_path):
    _, result = _capture(
        setup, tmp_path / "C", "--confirm-screening", "--operator", "OP-1"
    )
    assert result.exit_code == 0, str(result.exception)
    override = read_capture(tmp_path / "C").override
    assert (override["operator"], override["screened"], override["eyes_closed"]) == (
        "OP-1",
        True,
        True,
    )
    assert override["flashes_per_second"] > 3
    record = json.loads((tmp_path / "C/capture.json").read_text())
    assert not {"virtual", "rehearsal"} & record.keys()


def test_capture__a_real_session_without_a_confirmation_is_refused(setup, tmp_path):
    laboratory, result = _capture(setup, tmp_path / "C")
    assert (
        "sequence: an operator must confirm screening, consent and closed eyes"
        in str(result.exception)
    )
    assert laboratory.dome._runs == 0


def test_check_device__a_line_that_is_closed():
    """The program at the other end leaves at the first line."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        leave = threading.Thread(target=lambda: listener.accept()[0].close())
        leave.start()
        url = f"socket://127.0.0.1:{listener.getsockname()[1]}"
        result = CliRunner().invoke(cli, ["check-device", url])
        leave.join()
    assert f"{url}: must stay connected; found " in str(result.exception)
