"""Takes on a Dask cluster on 127.0.0.1: small tasks, killed workers, other versions,
lost and absent schedulers.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from functools import partial
from itertools import pairwise
from pathlib import Path

import pytest
from waiting import wait_until

from skindb.errors import InputError
from skindb.files import package_digest
from skindb.workflow import connected, map_takes
from skindb.workflow.takes import Expected, shared_token

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def distributed():
    return pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def address(distributed):
    """A scheduler and two worker processes; a worker that is killed is started again."""
    import dask

    options = {
        "n_workers": 2,
        "threads_per_worker": 1,
        "dashboard_address": "127.0.0.1:0",
    }
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        distributed.LocalCluster(**options) as cluster,
    ):
        yield cluster.scheduler_address


def _dies_once(folder: Path, take: int) -> int:
    if take == 2 and not (folder / "died").exists():
        (folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return take


def _dies(take: int) -> int:
    if take == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return take


def _span(take: int) -> tuple[int, float, float]:
    begin = time.monotonic()
    time.sleep(0.1)
    return os.getpid(), begin, time.monotonic()


def _first_waits_for_the_others(folder: Path, take: int) -> int:
    """The first take ends when all others have ended; returns how many have."""
    if take == 0:
        wait_until(lambda: len(list(folder.iterdir())) == 7)
    else:
        (folder / str(take)).touch()
    return len(list(folder.iterdir()))


def test_map_takes__what_all_tasks_share_is_sent_once(address):
    """A closure of 1 MB and 50 takes: not 50 MB, and some 1 kB for each further take."""
    large = os.urandom(1_000_000)
    with connected(address) as client:
        before = client.scheduler_comm.byte_count
        lengths = [
            one.result()
            for one in map_takes(lambda take: len(large), range(50), client=client)
        ]
        sent = client.scheduler_comm.byte_count - before
    assert lengths == [len(large)] * 50
    assert len(large) < sent < len(large) + 50 * 3000


def test_map_takes__a_take_whose_worker_was_killed_is_tried_again(address, tmp_path):
    with connected(address) as client:
        outcomes = {
            one.take: one
            for one in map_takes(partial(_dies_once, tmp_path), range(5), client=client)
        }
    assert {take: one.value for take, one in outcomes.items()} == {
        take: take for take in range(5)
    }
    assert outcomes[2].attempts == 2


def test_map_takes__a_take_that_kills_its_workers_fails_alone(address):
    with connected(address) as client:
        outcomes = {one.take: one for one in map_takes(_dies, range(5), client=client)}
    assert {take for take, one in outcomes.items() if one.error is None} == {0, 1, 3, 4}
    assert "2: the process of a take must run to its end; found it was killed" in str(
        outcomes[2].error
    )


def test_map_takes__a_worker_with_several_threads_does_one_take_at_a_time(distributed):
    options = {
        "n_workers": 1,
        "threads_per_worker": 4,
        "processes": False,
        "dashboard_address": "127.0.0.1:0",
    }
    with (
        distributed.LocalCluster(**options) as cluster,
        distributed.Client(cluster) as client,
    ):
        spans = sorted(
            one.result()[1:] for one in map_takes(_span, range(5), client=client)
        )
    assert all(end <= begin for (_, end), (begin, _) in pairwise(spans))


def test_map_takes__takes_behind_a_long_one_go_to_another_worker(
    distributed, tmp_path, monkeypatch
):
    """They are handed to a worker with threads to spare, which is busy with the long one."""
    options = {
        "n_workers": 2,
        "threads_per_worker": 4,
        "dashboard_address": "127.0.0.1:0",
    }
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path])
    )
    with (
        distributed.LocalCluster(**options) as cluster,
        distributed.Client(cluster) as client,
    ):
        client.run(_wait_briefly)
        call = partial(_first_waits_for_the_others, tmp_path)
        ended = {
            outcome.take: outcome.result()
            for outcome in map_takes(call, range(8), client=client)
        }
    assert sorted(ended) == list(range(8))
    assert ended[0] == 7


def _wait_briefly() -> None:
    import skindb.workflow.takes

    skindb.workflow.takes.WAIT_SECONDS = 0.2


def test_map_takes__workers_with_another_skindb_end_the_run(address, monkeypatch):
    with connected(address) as client:
        monkeypatch.setattr(
            "skindb.workflow.takes.package_digest", lambda: "of other files"
        )
        with pytest.raises(
            InputError,
            match=r"worker tcp:.*must run the same skindb.*with other source code; install",
        ):
            list(map_takes(_span, range(3), client=client))


def test_expected__names_the_other_version_and_the_folder_that_is_not_shared(tmp_path):
    with pytest.raises(
        InputError,
        match=r"worker w: must run the same skindb as this process \(9\.9\); found version",
    ):
        Expected("9.9", package_digest(), "").require("w")
    from skindb import __version__

    with shared_token(tmp_path / "db") as token:
        Expected(__version__, package_digest(), token).require("w")
    with pytest.raises(
        InputError,
        match=r"must see the database .*/db; found no such folder, or another one",
    ):
        Expected(__version__, package_digest(), token).require("w")


def test_map_takes__workers_see_the_shared_folder_while_they_work(address, tmp_path):
    with connected(address) as client:
        outcomes = list(
            map_takes(_span, range(2), client=client, shared=tmp_path / "db")
        )
    assert all(one.error is None for one in outcomes)
    assert list((tmp_path / "db/tmp").iterdir()) == []


@pytest.mark.parametrize(
    "where",
    [
        "nowhere",
        "tcp://127.0.0.1",
        "http://127.0.0.1:8787",
        "{tmp}/none.json",
        "silent",
    ],
)
@pytest.mark.usefixtures("distributed")
def test_connected__what_is_no_scheduler_is_one_line(where, tmp_path, monkeypatch):
    monkeypatch.setattr("skindb.workflow.takes.CONNECT_SECONDS", 1)
    # it accepts the connection, and does not answer
    with socket.create_server(("127.0.0.1", 0)) as server:
        text = where.format(tmp=tmp_path).replace(
            "silent", f"tcp://127.0.0.1:{server.getsockname()[1]}"
        )
        with (
            pytest.raises(
                InputError,
                match=f"{text}: a Dask scheduler must answer there; found .*Error",
            ),
            connected(text),
        ):
            pass


def test_connected__an_absent_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(
            InputError,
            match=r"needs the package distributed.*pip install 'skindb\[cluster\]'",
        ),
        connected("x"),
    ):
        pass


@pytest.mark.usefixtures("distributed")
def test_map_takes__a_scheduler_that_ends_is_one_line(tmp_path):
    """The scheduler of a command in another process is killed; the command reports it and ends."""
    file = tmp_path / "s.json"
    command = [
        sys.executable,
        "-m",
        "distributed.cli.dask_scheduler",
        "--no-dashboard",
        "--port",
        "0",
    ]
    scheduler = subprocess.Popen(
        [*command, "--scheduler-file", str(file)], stderr=subprocess.DEVNULL
    )
    try:
        wait_until(file.exists)
        with connected(str(file)) as client:

            def kill_while_takes_wait():
                wait_until(lambda: len(client.futures) == 3)
                scheduler.kill()

            threading.Thread(target=kill_while_takes_wait).start()
            with pytest.raises(
                InputError,
                match=r"the scheduler must answer until the work is done.*run the command again",
            ):
                # without a worker they would wait forever
                list(map_takes(_span, range(3), client=client))
    finally:
        scheduler.kill()
        scheduler.wait()
