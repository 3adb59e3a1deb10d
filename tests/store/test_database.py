"""The store's promises: immutable versions, exact commits under races, nothing half visible, damage found."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import skindb
from skindb.errors import InputError
from skindb.schema import dataset
from skindb.store import Conflict, Database
from skindb.store.stage import SHARD


def _groups(value: float = 1.0, n: int = 10) -> dict[str, xr.Dataset]:
    sample = np.full((n, 3, 2, 3), value, np.float16)
    sample[0] = np.nan
    coords = {"light": ["l0", "l1", "l2"], "camera": ["c0", "c1"], "channel": ["R", "G", "B"]}
    return {
        "samples": dataset({"reflectance_sample": sample}, coords=coords),
        "surfels": dataset({"surfel_area": np.full(n, value)}),
    }


def _commit(root, value: float = 1.0, take: str = "A1", kind: str = "capture"):
    with Database(root).stage(kind, take) as stage:
        stage.write(_groups(value))
        return stage.commit({"seeds": [1]})


def test_read__gives_back_what_was_written(tmp_path):
    record = _commit(tmp_path, 0.5)
    tree = skindb.open(str(tmp_path)).read("capture", "A1")
    assert tree["samples/reflectance_sample"].chunks is not None
    for name, ds in _groups(0.5).items():
        xr.testing.assert_identical(tree[name].to_dataset().compute(), ds)
    assert tree.attrs["seeds"] == [1]
    assert tree.attrs["schema_version"] == 1
    assert tree.attrs["software_version"] == skindb.__version__
    plain = xr.open_datatree(tmp_path / record.path, engine="zarr", consolidated=False)  # without skindb
    assert float(plain["surfels/surfel_area"][1]) == 0.5


def test_commit__generations_are_history(tmp_path):
    for value in (1.0, 2.0, 3.0):
        _commit(tmp_path, value)
    db = Database(tmp_path)
    assert [r.generation for r in db.history("capture", "A1")] == [1, 2, 3]
    for generation, value in ((1, 1.0), (3, 3.0), (None, 3.0)):
        tree = db.read("capture", "A1", generation=generation)
        assert float(tree["surfels/surfel_area"][0]) == value
    with pytest.raises(InputError, match="generation 7 must exist"):
        db.read("capture", "A1", generation=7)


def test_stage__left_without_commit_leaves_nothing(tmp_path):
    def interrupted():
        with Database(tmp_path).stage("capture", "A1") as stage:
            stage.write(_groups())
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        interrupted()
    assert not list((tmp_path / "data/capture/A1").iterdir())
    assert Database(tmp_path).takes() == []


def test_stage__lazy_groups_become_whole_shards(tmp_path):
    n = 2 * SHARD + 100
    area = np.arange(n, dtype=np.float32)
    ds = dataset({"surfel_area": area}).chunk(surfel=1000)
    with Database(tmp_path).stage("capture", "A1") as stage:
        stage.write({"surfels": ds})
        stage.put("surfels", "surfel_area", SHARD, area[SHARD : 2 * SHARD] + 1)
        with pytest.raises(ValueError, match="whole shards"):
            stage.put("surfels", "surfel_area", 100, area[:SHARD])
        stage.commit({})
    got = Database(tmp_path).read("capture", "A1")["surfels/surfel_area"]
    assert got.chunks == ((SHARD, SHARD, 100),)
    area[SHARD : 2 * SHARD] += 1
    np.testing.assert_array_equal(got.values, area)


def test_stage__schema_is_checked_at_the_door(tmp_path):
    wrong = _groups()["surfels"]
    wrong["surfel_area"].attrs["units"] = "m2"
    with Database(tmp_path).stage("capture", "A1") as stage, pytest.raises(InputError, match="mm2"):
        stage.write({"surfels": wrong})


def test_commit__racing_writers_each_generation_once(tmp_path):
    def attempt(i):
        try:
            return _commit(tmp_path, i).generation
        except Conflict:
            return None

    with ThreadPoolExecutor(6) as pool:
        won = [g for g in pool.map(attempt, range(24)) if g]
    assert sorted(won) == list(range(1, len(won) + 1))
    assert [r.generation for r in Database(tmp_path).history("capture", "A1")] == sorted(won)
    assert Database(tmp_path).verify() == []


def _race(root, count):
    won = 0
    for i in range(count):
        try:
            _commit(root, float(i))
            won += 1
        except Conflict:
            pass
    os._exit(won)


def test_commit__racing_processes_lose_nothing(tmp_path):
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=_race, args=(tmp_path, 6)) for _ in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert sum(w.exitcode for w in workers) == len(Database(tmp_path).history("capture", "A1")) > 0


KILLED = """
import sys
sys.path.insert(0, {tests!r})
from test_database import _commit
print("ready", flush=True)
while True:
    print(_commit({root!r}, 2.0).generation, flush=True)
"""


@pytest.mark.parametrize("delay", [0.02, 0.07, 0.15])
def test_commit__killed_writer_leaves_whole_versions_only(tmp_path, delay):
    code = KILLED.format(tests=str(Path(__file__).parent), root=str(tmp_path))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as worker:
        assert worker.stdout.readline() == "ready\n"
        time.sleep(delay)
        worker.send_signal(signal.SIGKILL)
        acknowledged = [int(line) for line in worker.stdout.read().split()]
    db = Database(tmp_path)
    history = [r.generation for r in db.history("capture", "A1")] if "A1" in db.takes() else []
    assert history[: len(acknowledged)] == acknowledged  # an acknowledged commit is never lost
    assert len(history) <= len(acknowledged) + 1
    assert db.verify() == []
    for generation in history:
        assert float(db.read("capture", "A1", generation=generation)["surfels/surfel_area"][3]) == 2.0
    assert _commit(tmp_path).generation == len(history) + 1  # and the next writer goes on


def test_verify__all_damage_at_once(tmp_path):
    records = [_commit(tmp_path, take=take) for take in ("A1", "A2", "A3")]
    first = sorted((tmp_path / records[0].path).rglob("c/**/0"))[0]
    raw = bytearray(first.read_bytes())
    raw[len(raw) // 2] ^= 1
    first.write_bytes(raw)
    next((tmp_path / records[1].path).rglob("zarr.json")).unlink()
    (tmp_path / records[2].path / "stray").write_text("x")
    lines = [str(f) for f in Database(tmp_path).verify()]
    assert len(lines) == 3
    assert any("other bytes" in line for line in lines)
    assert any("must exist" in line for line in lines)
    assert any("unknown file" in line for line in lines)


def test_verify__unreadable_record(tmp_path):
    _commit(tmp_path)
    (tmp_path / "log/capture/A1/00000001.json").write_text("{")
    assert "log record" in str(Database(tmp_path).verify()[0])
    assert "fault" in Database(tmp_path).info()["takes"]["A1"]["capture"]


def test_info__paths_open(tmp_path):
    _commit(tmp_path, take="A1.lotion")
    _commit(tmp_path, take="A1")
    _commit(tmp_path, take="A1", kind="model")
    info = json.loads(json.dumps(Database(tmp_path).info()))
    assert set(info["takes"]) == {"A1", "A1.lotion"}
    assert set(info["takes"]["A1"]) == {"capture", "model"}
    assert Path(info["takes"]["A1"]["model"]["path"]).is_dir()
    assert Database(tmp_path).subjects() == ["A1"]


@pytest.mark.parametrize("take", ["", "../x", "a/b", "a.b.c", "x" * 65, "a b"])
def test_stage__names_cannot_leave_the_database(tmp_path, take):
    with pytest.raises(InputError, match="take"):
        Database(tmp_path).stage("capture", take)


def test_read__absent_take_names_what_exists(tmp_path):
    _commit(tmp_path)
    with pytest.raises(InputError, match="takes: A1"):
        Database(tmp_path).read("capture", "B2")
    with pytest.raises(InputError, match="takes: none"):
        Database(tmp_path).read("model", "A1")


def test_database__must_be_a_folder(tmp_path):
    (tmp_path / "f").write_text("")
    with pytest.raises(InputError, match="a database is a folder"):
        Database(tmp_path / "f")
    with pytest.raises(InputError, match="buckets are not supported yet"):
        Database("s3://bucket/x")
