"""Takes at a time: in this process, in local processes, and what is reported of those that fail."""

from __future__ import annotations

import json
import os
import pkgutil
import signal
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import cloudpickle
import dask
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits
from waiting import wait_until
from xarray import DataArray

# the processes of takes import this module: nothing large
import skindb
from skindb import workflow
from skindb.analysis.face_models import face_vector
from skindb.analysis.study import each_take
from skindb.errors import Fault, InputError
from skindb.workflow.takes import (
    computing_on,
    connected,
    faults_of,
    map_takes,
    results_of,
)

FAULT = Fault("a.exr", "must be readable", "nothing", "write it again")
pytestmark = pytest.mark.slow

SMALL = {"takes": 2, "cameras": 3, "lights": 12, "width": 48, "height": 60}
GIVEN = {"k": 2, "hold_out_lights": 0.1}
# seals of the inputs hold their time of creation
OF_THE_RUN = ("seconds", "created", "inputs")


def _square(take: int) -> tuple[int, int, int | None]:
    return take * take, os.getpid(), dask.config.get("num_workers", None)


def _mixed(take: int) -> int:
    """Odd takes succeed; the others fail in all possible ways."""
    if take == 0:
        raise InputError([FAULT, FAULT])
    if take == 2:
        raise ZeroDivisionError("a defect")
    if take == 4:
        raise OSError(28, "No space left on device", "disk")
    return take


def _killed(folder: Path, take: int) -> int:
    """The third take kills its process while the fourth is in progress, which ends
    with it and is tried again.
    """
    begun = folder / "fourth"
    if take == 2:
        wait_until(begun.exists)
        os.kill(os.getpid(), signal.SIGKILL)
    if take == 3 and not begun.exists():
        begun.touch()
        threading.Event().wait()
    return take


class _Odd(OSError):
    """An error that cannot be made again from its arguments."""

    def __init__(self, one, two, three, four):
        super().__init__(5, "Input/output error")


def _strange(take: int):
    """Return or raise objects that cannot be pickled."""
    if take == 0:
        return threading.Lock()
    if take == 1:
        sys.exit(3)
    if take == 2:
        raise _Odd(1, 2, 3, 4)
    return take


@pytest.mark.slow
@pytest.mark.parametrize("workers", [None, 2])
def test_map_takes__results_and_errors_that_cannot_be_pickled_are_outcomes(workers):
    outcomes = {one.take: one for one in map_takes(_strange, range(6), workers=workers)}
    assert {take for take, one in outcomes.items() if one.error is None} == {
        3,
        4,
        5,
    } | ({0} if not workers else set())
    assert "SystemExit: 3" in str(outcomes[1].error)
    assert "Input/output error" in str(faults_of(outcomes[2])[0])


@pytest.mark.slow
def test_map_takes__a_process_that_dies_while_the_caller_is_busy():
    outcomes = map_takes(lambda take: (take, os.getpid()), range(8), workers=2)
    seen = []
    for outcome in outcomes:
        take, process = outcome.result()
        seen.append(take)
        if len(seen) == 2:
            os.kill(process, signal.SIGKILL)
            wait_until(lambda process=process: not _is_running(process))
    assert sorted(seen) == list(range(8))


def _check_mixed(outcomes):
    by_take = {outcome.take: outcome for outcome in outcomes}
    assert {take: one.value for take, one in by_take.items() if one.error is None} == {
        1: 1,
        3: 3,
        5: 5,
    }
    assert faults_of(by_take[0]) == [FAULT, FAULT]
    assert "ZeroDivisionError: a defect" in str(by_take[2].error)
    assert "in _mixed" in by_take[2].traceback
    assert str(faults_of(by_take[4])[0]).startswith(
        "disk: must be readable and writable"
    )
    with pytest.raises(InputError, match="must be readable"):
        by_take[0].result()


def test_map_takes__in_this_process_in_order():
    assert [outcome.result()[:2] for outcome in map_takes(_square, range(3))] == [
        (x * x, os.getpid()) for x in range(3)
    ]
    _check_mixed(map_takes(_mixed, range(6)))
    assert list(map_takes(_square, [], workers=4)) == []


def test_map_takes__in_other_processes_that_stay_warm_and_share_the_cores(monkeypatch):
    monkeypatch.setattr("skindb.elementwise.cpu_count", lambda: 4)
    first = [outcome.result() for outcome in map_takes(_square, range(6), workers=2)]
    again = [outcome.result() for outcome in map_takes(_square, range(6), workers=2)]
    assert {value for value, _, _ in first} == {x * x for x in range(6)}
    processes = {process for _, process, _ in first + again}
    assert os.getpid() not in processes
    assert len(processes) <= 2  # no process was started for the second call
    assert {threads for _, _, threads in first} == {2}
    _check_mixed(map_takes(_mixed, range(6), workers=2))


def test_map_takes__functions_of_a_notebook():
    offset = 10
    assert sorted(
        o.result() for o in map_takes(lambda take: take + offset, range(4), workers=2)
    ) == [10, 11, 12, 13]


@pytest.mark.slow
def test_map_takes__a_killed_process_fails_its_take_alone(tmp_path):
    call = partial(_killed, tmp_path)
    outcomes = {one.take: one for one in map_takes(call, range(6), workers=2)}
    assert {take for take, one in outcomes.items() if one.error is None} == {
        0,
        1,
        3,
        4,
        5,
    }
    assert "a lack of memory is the usual reason" in str(outcomes[2].error)
    assert outcomes[2].attempts == 2
    assert outcomes[5].attempts == 1


@pytest.mark.slow
def test_map_takes__who_stops_asking_stops_the_work(tmp_path):
    def mark(take: int) -> int:
        (tmp_path / str(take)).touch()
        if take:
            wait_until((tmp_path / "closed").exists)
        return os.getpid()

    outcomes = map_takes(mark, range(20), workers=2)
    workers = {next(outcomes).result()}
    outcomes.close()
    wait_until(lambda: not any(map(_is_running, workers)))
    (tmp_path / "closed").touch()
    # those that were being processed, and the file of this test
    assert len(list(tmp_path.iterdir())) <= 1 + 3


DRIVER = """
import os, sys, threading
from pathlib import Path
from skindb.workflow import map_takes

def note_and_wait(take):
    Path(sys.argv[1], str(take)).write_text(str(os.getpid()))
    threading.Event().wait()

list(map_takes(note_and_wait, range(4), workers=2))
"""


@pytest.mark.slow
def test_map_takes__worker_processes_end_with_a_caller_that_is_killed(tmp_path):
    """Otherwise they would keep their takes, continue with waiting ones, and occupy
    memory for ten minutes.
    """
    with subprocess.Popen([sys.executable, "-c", DRIVER, str(tmp_path)]) as driver:
        wait_until(
            lambda: sum(bool(path.read_text()) for path in tmp_path.iterdir()) >= 2
        )
        driver.kill()
    workers = [int(path.read_text()) for path in tmp_path.iterdir()]
    assert len(workers) == 2
    try:
        wait_until(lambda: not any(map(_is_running, workers)))
    finally:
        for worker in filter(_is_running, workers):
            os.kill(worker, signal.SIGKILL)


def _is_running(process):
    try:
        return (
            Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
            not in "ZX"
        )
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("workers", [None, 2])
def test_map_takes__libraries_use_one_thread_on_every_engine(monkeypatch, workers):
    """The order of sums in matrix products depends on the number of threads, and with
    it the last digit of a result.
    """
    monkeypatch.setattr("skindb.elementwise.cpu_count", lambda: 8)

    def pools(_):
        np.ones((50, 50)) @ np.ones((50, 50))
        return [pool["num_threads"] for pool in threadpool_info()]

    found = [
        outcome.result() for outcome in map_takes(pools, range(4), workers=workers)
    ]
    assert found
    assert all(threads == [1] * len(threads) for threads in found)


def test_results_of__all_results_then_all_faults():
    results = results_of(map_takes(_mixed, range(6)))
    seen = []
    with pytest.raises(InputError) as error:
        seen.extend(results)
    assert seen == [1, 3, 5]
    assert len(error.value.faults) == 4


@pytest.mark.slow
def test_map_takes__on_a_dask_client():
    distributed = pytest.importorskip("distributed")
    options = {
        "n_workers": 1,
        "threads_per_worker": 2,
        "processes": False,
        "dashboard_address": "127.0.0.1:0",
    }
    with (
        distributed.LocalCluster(**options) as cluster,
        distributed.Client(cluster) as client,
    ):
        _check_mixed(map_takes(_mixed, range(6), client=client))
        threads = {
            outcome.result()[2]
            for outcome in map_takes(partial(_square), range(3), client=client)
        }
    assert threads == {2}


def test_map_takes__functions_of_a_notebook_may_use_every_package():
    """A package with a function that has the name of one of its modules has a type that
    cannot be pickled.
    """
    packages = [
        one.name
        for one in pkgutil.iter_modules(skindb.__path__)
        if one.ispkg and one.name in dir(skindb)
    ]
    assert "workflow" in packages
    for name in packages:
        cloudpickle.dumps(getattr(skindb, name))


def test_map_takes__a_call_that_cannot_be_sent_is_explained():
    lock = threading.Lock()
    outcomes = list(map_takes(lambda take: (take, lock), [1, 2], workers=2))
    assert all(
        "cannot pickle '_thread.lock' object" in str(one.error) for one in outcomes
    )


@pytest.fixture(scope="module", autouse=True)
def _several_blas_threads():
    """As in a separate process; results must not depend on it."""
    with threadpool_limits(2):
        yield


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    return workflow.simulate(tmp_path_factory.mktemp("captures"), **SMALL)


@pytest.fixture(scope="module")
def address():
    options = {
        "n_workers": 2,
        "threads_per_worker": 1,
        "dashboard_address": "127.0.0.1:0",
    }
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(**options) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def dictionary(tmp_path_factory, small_dictionary):
    """File of six materials, of which fits and studies take less time."""
    from skindb.reflectance.brdf_files import write_tables

    path = tmp_path_factory.mktemp("dictionary") / "six.npz"
    write_tables(path, small_dictionary)
    return path


def _filled(root, captures, dictionary, **where):
    """A database of captures, models and registrations."""
    db = skindb.open(str(root), create=True)
    ingest = partial(workflow.ingest_take, db, spacing_mm=6.0)
    list(results_of(map_takes(ingest, captures, **where)))
    takes = db.takes("capture")[:: -1 if "client" in where else 1]
    fit = partial(workflow.fit_with, db, changes=GIVEN, dictionary=dictionary)
    list(results_of(map_takes(fit, takes, **where)))
    workflow.register_takes(db, **where)
    if "workers" in where:  # studies are computed in this process or on a cluster
        return db
    with computing_on(where.get("client"), db.root):
        workflow.brdf(db, dictionary=dictionary)
        workflow.traits(db, k=3, dictionary=dictionary)
        workflow.albedo(db, group_by="gender")
    return db


def _contents(db):
    """Digest of every file of every version; provenance is compared without the values
    of the run.
    """
    found = {}
    for kind in db.kinds():
        for take in db.takes(kind):
            record = db.record(kind, take)
            manifest = json.loads((db.root / record.beside("manifest")).read_text())
            digests = {
                name: digests
                for name, (_, digests) in manifest.items()
                if name != "zarr.json"
            }
            about = {
                name: value
                for name, value in record.provenance.items()
                if name not in OF_THE_RUN
            }
            made_from = [
                [one.get(name) for name in ("kind", "take", "generation")]
                for one in record.made_from
            ]
            found[kind, take] = (
                digests,
                about,
                made_from,
                record.contents,
                record.tables,
            )
    return found


@pytest.mark.slow
def test_map_takes__the_same_bytes_on_every_engine_and_in_any_order(
    captures, dictionary, address, tmp_path, small_textures
):
    expected = _contents(_filled(tmp_path / "here", captures, dictionary))
    assert len(expected) == 11  # two takes of four kinds, three studies
    assert min(len(digests) for digests, *_ in expected.values()) > 5
    by_processes = _contents(
        _filled(tmp_path / "processes", captures, dictionary, workers=2)
    )
    assert by_processes == {key: expected[key] for key in by_processes}
    assert len(by_processes) == 6
    cohort = skindb.open(str(tmp_path / "here")).cohort("maps")
    vectors = partial(each_take, face_vector, cohort, list(cohort.data_vars))
    whole = vectors()
    with connected(address) as client:
        with computing_on(client):
            assert all(map(DataArray.identical, vectors(), whole))
        cluster = _filled(
            tmp_path / "cluster", captures[::-1], dictionary, client=client
        )
        assert _contents(cluster) == expected
