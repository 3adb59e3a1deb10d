"""Leases: one run at a time, free when the holder has ended, and no commit after
another run took over.
"""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from stored import groups

from skindb.clock import SimulatedClock
from skindb.errors import InputError
from skindb.store import Database, LeaseLost
from skindb.store import lease as lease_module
from skindb.store.lease import LEASE_SECONDS, POLL_SECONDS, Lease, this_process


@pytest.fixture
def db(tmp_path):
    return Database(tmp_path / "db")


def _files(db, kind="model", take="A1"):
    return sorted((db.root / "leases" / kind / take).glob("*.json"))


def _hold(db, seconds=60.0, **options):
    return db.lease("A1", "model", seconds=seconds, **options)


def _age(file, seconds):
    """Let the storage have written a file so many seconds ago."""
    moment = time.time() - seconds
    os.utime(file, (moment, moment))


def _elsewhere(monkeypatch):
    """From now on leases are taken as by a process of another machine."""
    other = this_process() | {"host": "other", "boot": "another boot"}
    monkeypatch.setattr(lease_module, "this_process", lambda: other)


def _abandon(db, **options):
    """Create a lease whose holder has stopped without releasing it."""
    lease = _hold(db, **options)
    lease.__enter__()
    lease._ended.set()
    return lease


def test_lease__refuses_a_second_run_and_names_the_holder(db):
    with _hold(db, command="skindb fit"):
        said = (
            r"model of A1: only one run at a time .*; found skindb fit on \S+ "
            rf"\(process {os.getpid()}\) since 2"
        )
        with pytest.raises(InputError, match=said) as error, _hold(db):
            pass
        assert len(error.value.faults) == 1
        assert "\n" not in str(error.value)
        with db.lease("A2", "model"), db.lease("A1", "capture"):
            pass
    with _hold(db):
        pass


def test_lease__can_be_taken_again(db):
    lease = _hold(db)
    for number in (1, 2):
        with lease:
            lease.require()
            assert [file.name for file in _files(db)] == [f"0000000{number}.json"]
    with pytest.raises(
        ValueError, match="must be above 0 and at most 3600; found 7200"
    ):
        _hold(db, 7200)


def test_lease__of_several_kinds_is_all_or_nothing(db):
    with _hold(db):
        with (
            pytest.raises(InputError, match="model of A1"),
            db.lease("A1", "capture", "model"),
        ):
            pass
        with db.lease("A1", "capture"):
            pass


def _waiting(db, wait, clock):
    return Lease(db.place, "A1", ("model",), wait=wait, clock=clock)


def test_lease__waits_for_the_other_run(db):
    clock = SimulatedClock()
    other = _hold(db)
    other.__enter__()

    def release():
        if clock.monotonic() > 2.0 and other._held:
            other.__exit__(None, None, None)

    clock.attach(release)
    with _waiting(db, 30.0, clock) as lease:
        lease.require()
    assert 2.0 < clock.monotonic() <= 2.0 + POLL_SECONDS


def test_lease__waits_no_longer_than_it_may(db):
    clock = SimulatedClock()
    with (
        _hold(db),
        pytest.raises(InputError, match="one run at a time"),
        _waiting(db, 1.3, clock),
    ):
        pass
    assert clock.monotonic() == pytest.approx(1.3)


def test_lease__does_not_name_a_holder_that_has_finished(db):
    with _hold(db, command="skindb fit"):
        body = json.loads(_files(db)[0].read_text())
        assert set(body["holder"]) == {
            "host",
            "process",
            "started",
            "boot",
            "namespace",
            "command",
        }
    (left,) = _files(db)
    assert list(json.loads(left.read_text())) == ["released"]


def test_lease__that_a_full_disk_cannot_mark_as_free_is_free(db, monkeypatch):
    """Also while the process that held it still runs, such as a notebook."""

    def refuse(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    with _hold(db):
        monkeypatch.setattr(type(db.place), "replace", refuse)
    monkeypatch.undo()
    assert _files(db) == []
    with _hold(db) as lease:
        lease.require()


class Turns(threading.Event):
    """The end of a lease, for which the renewing thread waits until the test lets it renew."""

    def __init__(self):
        super().__init__()
        self.waits = []
        self.begun = threading.Semaphore(0)
        self.passed = threading.Semaphore(0)

    def wait(self, timeout=None):
        self.waits.append(timeout)
        self.begun.release()
        self.passed.acquire()
        return self.is_set()

    def set(self):
        super().set()
        self.passed.release()


def test_lease__is_renewed_while_it_is_held(db, monkeypatch):
    _elsewhere(monkeypatch)
    lease = _hold(db)
    lease._ended = Turns()
    with lease:
        lease._ended.begun.acquire()
        _age(_files(db)[0], LEASE_SECONDS + 1)
        lease._ended.passed.release()  # the time of a renewal has come
        lease._ended.begun.acquire()  # it is done
        with pytest.raises(InputError, match="one run at a time"), _hold(db):
            pass
        lease.require()
    assert set(lease._ended.waits) == {LEASE_SECONDS / lease_module.RENEWALS}


def test_lease__of_another_machine_ends_by_the_clock_of_the_storage(db, monkeypatch):
    _elsewhere(monkeypatch)
    lost = _abandon(db)
    (file,) = _files(db)
    _age(file, LEASE_SECONDS / 2)
    with pytest.raises(InputError, match="on other"), _hold(db):
        pass
    _age(file, LEASE_SECONDS + 1)
    # the clock of this machine does not matter
    monkeypatch.setattr(time, "time", lambda: 0.0)
    with _hold(db) as own:
        own.require()
        with pytest.raises(ValueError, match="inside its with statement"):
            _hold(db).require()
        lost._ended.clear()
        with pytest.raises(
            LeaseLost,
            match="another run took over, because this one did not renew its lease: python on",
        ):
            lost.require()


def test_lease__from_the_future_is_free(db, monkeypatch):
    """The clock of the storage was set back by a year, and the holder renews it no more."""
    _elsewhere(monkeypatch)
    _abandon(db)
    _age(_files(db)[0], -LEASE_SECONDS / 2)
    with pytest.raises(InputError, match="one run at a time"), _hold(db):
        pass
    _age(_files(db)[0], -3e7)
    with _hold(db) as lease:
        lease.require()


def test_lease__from_the_future_stays_with_a_holder_on_this_machine(db):
    """The clock of the storage was set back, and the holder renews it in some seconds."""
    with _hold(db) as lease:
        _age(_files(db)[0], -3e7)
        with pytest.raises(InputError, match="one run at a time"), _hold(db):
            pass
        lease.require()


def test_lease__that_is_damaged_ends_like_any_other(db):
    _abandon(db)
    (file,) = _files(db)
    file.write_text("{")
    with (
        pytest.raises(InputError, match="found a lease that cannot be read"),
        _hold(db),
    ):
        pass
    for body in (
        {"seconds": 1e9},
        {"seconds": True},
        {"seconds": "1"},
        {"holder": 7},
        {"holder": {"process": "x"}},
    ):
        file.write_text(json.dumps(body))
        _age(file, LEASE_SECONDS + 1)
        assert lease_module.holder_of(db.place, "model", "A1") == ""
    with _hold(db):
        pass


def _child(db, code):
    """A process that holds the lease, and prints a line."""
    program = f"""
import sys
from skindb.store import Database
db = Database({str(db.root)!r})
{code}
"""
    env = os.environ | {
        "PYTHONPATH": f"{Path(lease_module.__file__).parents[2]}:{Path(__file__).parent}"
    }
    pipes = {
        "stdin": subprocess.PIPE,
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
        "text": True,
    }
    child = subprocess.Popen([sys.executable, "-c", program], env=env, **pipes)
    assert child.stdout.readline() == "holds it\n", child.stderr.read()
    return child


@pytest.mark.slow
def test_lease__of_a_killed_process_of_this_machine_is_free_at_once(db):
    child = _child(
        db,
        "with db.lease('A1', 'model'): print('holds it', flush=True); sys.stdin.read()",
    )
    with pytest.raises(InputError, match=rf"process {child.pid}"), _hold(db):
        pass
    child.kill()
    # it has ended, and is still in the table of processes
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    with _hold(db):
        child.communicate()
    assert [file.name for file in _files(db)] == ["00000002.json"]


def test_lease__another_process_with_the_number_of_a_dead_one_is_another(
    db, monkeypatch
):
    monkeypatch.setattr(
        lease_module, "this_process", lambda: this_process() | {"started": "1"}
    )
    _abandon(db)
    with _hold(db):
        pass


STOPPED = """
from stored import groups
with db.lease('A1', 'model') as lease, db.stage('model', 'A1', lease) as stage:
    stage.write(groups(5.0))
    print('holds it', flush=True)
    sys.stdin.readline()
    stage.commit({})
"""


def test_commit__of_a_process_that_slept_beyond_its_lease_is_refused(db, monkeypatch):
    """Also if the other run has not committed yet, so that the generation is still free."""
    child = _child(db, STOPPED)
    child.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, child.pid, os.WSTOPPED)
    _age(_files(db)[0], LEASE_SECONDS + 1)
    monkeypatch.setattr(lease_module, "has_ended", lambda _: False)
    with _hold(db) as lease:
        child.send_signal(signal.SIGCONT)
        _, said = child.communicate("commit\n")
        assert child.returncode == 1
        assert said.splitlines()[-1].startswith(
            "skindb.store.lease.LeaseLost: model of A1: only one run at a time may "
            "work on it; found ano"
        )
        assert not db.has("model", "A1")
        with db.stage("model", "A1", lease) as stage:
            stage.write(groups(1.0))
            stage.commit({})
    assert float(db.read("model", "A1")["surfels/surfel_area"][0]) == 1.0
    assert [one.suffix for one in (db.root / "data/model/A1").iterdir()].count(
        ".zarr"
    ) == 1


def test_commit__of_a_process_that_slept_while_nobody_asked_is_kept(db):
    """For example, a laptop that was suspended."""
    with _hold(db) as lease, db.stage("model", "A1", lease) as stage:
        stage.write(groups(1.0))
        _age(_files(db)[0], 2 * LEASE_SECONDS)
        stage.commit({})
    assert db.has("model", "A1")


def _race(root, takes, count):
    db = Database(root)
    for number in range(count):
        take = takes[number % len(takes)]
        with (
            db.lease(take, "capture", wait=120) as lease,
            db.stage("capture", take, lease) as stage,
        ):
            stage.write(groups(float(stage.base + 1), 1))
            stage.commit({})


@pytest.mark.slow
@pytest.mark.parametrize("takes", [["A1"], [f"A{i}" for i in range(4)]])
def test_lease__racing_writers_lose_nothing_and_conflict_never(db, takes, monkeypatch):
    """Without leases, four writers of one take make each other fail."""
    monkeypatch.setattr(lease_module, "POLL_SECONDS", 0.01)  # inherited by the writers
    writers = multiprocessing.get_context("fork")
    processes = [
        writers.Process(target=_race, args=(db.root, takes, 4)) for _ in range(4)
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0] * 4
    assert sum(len(db.history("capture", take)) for take in takes) == 16
    for take in takes:
        areas = [
            db.read("capture", take, generation=n)["surfels/surfel_area"].values[0]
            for n in (1, 4)
        ]
        assert areas == [1.0, 4.0]
