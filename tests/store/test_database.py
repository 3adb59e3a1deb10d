"""The guarantees of the store: immutable versions, atomic commits under races, and
detection of damage.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr
from stored import commit, groups

import skindb
from skindb.errors import InputError
from skindb.schema import SCHEMA_VERSION, dataset
from skindb.schema.label import BLOCK_SURFELS
from skindb.store import Conflict, Database
from skindb.store import stage as stage_module
from skindb.store.stage import _shards


def test_read__gives_back_what_was_written(tmp_path):
    record = commit(tmp_path, 0.5)
    tree = skindb.open(str(tmp_path)).read("capture", "A1")
    assert tree["samples/reflectance_sample"].chunks is not None
    for name, ds in groups(0.5).items():
        xr.testing.assert_identical(tree[name].to_dataset().compute(), ds)
    assert tree.attrs["seeds"] == [1]
    assert tree.attrs["schema_version"] == SCHEMA_VERSION
    assert tree.attrs["software_version"] == skindb.__version__
    part = Database(tmp_path).read("capture", "A1", groups=["surfels"])
    assert list(part.children) == ["surfels"]
    xr.testing.assert_identical(
        part["surfels"].to_dataset().compute(), tree["surfels"].to_dataset().compute()
    )
    assert part.attrs == tree.attrs
    cure = "did you mean surfels[?] choose .*samples"
    with pytest.raises(InputError, match=f"must have the group surfals; .*{cure}"):
        Database(tmp_path).read("capture", "A1", groups=["surfals"])
    # without skindb
    plain = xr.open_datatree(tmp_path / record.path, engine="zarr", consolidated=False)
    assert float(plain["surfels/surfel_area"][1]) == 0.5


def test_commit__generations_are_history(tmp_path):
    for value in (1.0, 2.0, 3.0):
        commit(tmp_path, value)
    db = Database(tmp_path)
    assert [r.generation for r in db.history("capture", "A1")] == [1, 2, 3]
    for generation, value in ((1, 1.0), (3, 3.0), (None, 3.0)):
        tree = db.read("capture", "A1", generation=generation)
        assert float(tree["surfels/surfel_area"][0]) == value
    with pytest.raises(InputError, match="generation 7 must exist"):
        db.read("capture", "A1", generation=7)


def test_history__a_lost_record_is_named(tmp_path):
    """A record that was removed on purpose is skipped; one that is missing without a
    tombstone is an error.
    """
    for value in (1.0, 2.0, 3.0):
        commit(tmp_path, value)
    db = Database(tmp_path)
    (tmp_path / "log/capture/A1/00000001.json").unlink()
    with pytest.raises(
        InputError, match="generation 1 must exist; found no record and no tombstone"
    ):
        db.history("capture", "A1")


def _with(root, kind: str, **provenance):
    with Database(root).stage(kind, "A1") as stage:
        stage.write(groups())
        return stage.commit(provenance)


def test_read__consent_is_that_of_the_newest_capture(tmp_path):
    _with(tmp_path, "capture", consent_scope=["fit", "export"])
    _with(tmp_path, "model", consent_scope=["fit", "export"])
    db = Database(tmp_path)
    assert db.read("model", "A1").attrs["consent_scope"] == ["fit", "export"]
    _with(tmp_path, "capture", consent_scope=["fit"])
    assert db.read("model", "A1").attrs["consent_scope"] == ["fit"]
    # the newest counts for all of them
    assert db.read("capture", "A1", generation=1).attrs["consent_scope"] == ["fit"]


def test_info__studies_are_no_takes(tmp_path):
    _with(tmp_path, "capture")
    # a pseudonym that is also a study's name
    with Database(tmp_path).stage("population", "A1") as stage:
        stage.write(groups())
        stage.commit({})
    told = Database(tmp_path).info()
    assert list(told["takes"]["A1"]) == ["capture"]
    assert list(told["studies"]["A1"]) == ["population"]


def test_source__is_the_version_that_was_used(tmp_path):
    first = commit(tmp_path, 1.0)
    _with(tmp_path, "model", inputs=[first.as_input()])
    commit(tmp_path, 2.0)
    db = Database(tmp_path)
    model = db.read("model", "A1")
    assert model.attrs["generation"] == 1
    assert float(db.source(model)["surfels/surfel_area"][0]) == 1.0
    assert float(db.read("capture", "A1")["surfels/surfel_area"][0]) == 2.0
    with pytest.raises(InputError, match="must name a model"):
        db.source(model, "model")


def test_stage__left_without_commit_leaves_nothing(tmp_path):
    def interrupted():
        with Database(tmp_path).stage("capture", "A1") as stage:
            stage.write(groups())
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        interrupted()
    assert not list((tmp_path / "data/capture/A1").iterdir())
    assert Database(tmp_path).takes() == []


def test_stage__lazy_groups_become_whole_shards(tmp_path, monkeypatch):
    """Two tasks that write one shard would lose data."""
    monkeypatch.setattr(stage_module, "MAX_OBJECT_BYTES", 40_000)  # two blocks of area
    n = 3 * BLOCK_SURFELS + 100
    arrays = {
        "surfel_area": np.arange(n, dtype=np.float32),
        "surfel_position": np.arange(3 * n, dtype=np.float32).reshape(n, 3),
    }
    with Database(tmp_path).stage("capture", "A1") as stage:
        stage.write({"surfels": dataset(arrays).chunk(surfel=1000)})
        record = stage.commit({})
    group = zarr.open_group(tmp_path / record.path, mode="r")["surfels"]
    assert group["surfel_area"].shards == (2 * BLOCK_SURFELS,)
    assert group["surfel_position"].shards == (BLOCK_SURFELS, 3)
    got = Database(tmp_path).read("capture", "A1")["surfels"].to_dataset()
    assert got.chunksizes["surfel"] == (*[BLOCK_SURFELS] * 3, 100)
    for name, values in arrays.items():
        np.testing.assert_array_equal(got[name].values, values)


def test_stage__an_array_of_many_elements_has_few_objects(tmp_path):
    """Objects have 16 MB: one for each small variable, and maps with all channels."""
    n = 1_000_000
    positions = np.arange(3 * n, dtype=np.float32).reshape(n, 3)
    maps = np.ones((512, 512, 3), np.float32)
    with Database(tmp_path).stage("model", "A1") as stage:
        stage.write(
            {
                "fitted": dataset({"surfel_position": positions}),
                "maps": dataset({"texel_diffuse_reflectance": maps}),
            }
        )
        record = stage.commit({})
    files = [file for file in (tmp_path / record.path).rglob("*") if "c" in file.parts]
    assert sum(file.is_file() for file in files) == 2
    group = zarr.open_group(tmp_path / record.path, mode="r")["fitted"]
    assert group["surfel_position"].chunks == (BLOCK_SURFELS, 3)


def test_stage__other_programs_open_a_version_without_a_warning(tmp_path):
    record = commit(tmp_path)
    tree = xr.open_datatree(tmp_path / record.path, engine="zarr")
    assert tree["samples/reflectance_sample"].shape == (10, 3, 2, 3)
    assert tree.attrs["seeds"] == [1]
    root = zarr.open_group(tmp_path / record.path, mode="r")
    consolidated = root.metadata.consolidated_metadata.flattened_metadata
    members = dict(root.members(max_depth=None, use_consolidated_for_children=False))
    assert consolidated.keys() == members.keys()
    group = xr.open_zarr(tmp_path / record.path, group="samples")
    assert group["reflectance_sample"].shape == (10, 3, 2, 3)


def test_stage__large_arrays_are_written_shard_by_shard(tmp_path, monkeypatch):
    n = BLOCK_SURFELS + 300
    samples = np.arange(n * 12, dtype=np.float32).reshape(n, 2, 2, 3)
    mapped = np.memmap(tmp_path / "samples", np.float32, "w+", shape=samples.shape)
    mapped[:] = samples
    ds = dataset({"reflectance_sample": mapped % 1000})
    blocks = []
    monkeypatch.setattr(stage_module, "MAX_UNSHARDED_BYTES", 1000)
    monkeypatch.setattr(stage_module, "MAX_OBJECT_BYTES", 1000)
    monkeypatch.setattr(
        stage_module,
        "_shards",
        lambda *given: blocks.append(_shards(*given)) or blocks[-1],
    )
    with Database(tmp_path / "db").stage("capture", "A1") as stage:
        stage.write({"samples": ds})
        stage.commit({})
    assert blocks[0].chunks[0] == (BLOCK_SURFELS, 300)
    got = Database(tmp_path / "db").read("capture", "A1")["samples/reflectance_sample"]
    np.testing.assert_array_equal(got.values, ds["reflectance_sample"].values)


def test_stage__chunks_of_few_bytes_hold_more_surfels(tmp_path):
    """Chunks have at least half a megabyte or are a whole shard; zeros are stored like
    other values.
    """
    n = BLOCK_SURFELS + 300
    samples = np.arange(n * 6 * 50 * 3).reshape(n, 6, 50, 3) % 1000
    samples[BLOCK_SURFELS:] = 0
    ds = dataset(
        {
            "reflectance_sample": samples.astype(np.float16),
            "sample_count": np.zeros(n, np.int32),
        }
    )
    with Database(tmp_path).stage("capture", "A1") as stage:
        stage.write({"samples": ds})
        stage.commit({})
    group = zarr.open_group(
        next((tmp_path / "data/capture/A1").glob("*.zarr")), mode="r"
    )["samples"]
    assert group["reflectance_sample"].chunks == (512, 6, 50, 3)  # 256 are 460 kB
    assert group["sample_count"].chunks == (BLOCK_SURFELS,)
    got = Database(tmp_path).read("capture", "A1")["samples"].to_dataset()
    np.testing.assert_array_equal(got["reflectance_sample"].values, samples)
    assert not got["sample_count"].values.any()


def test_stage__schema_is_checked_at_the_door(tmp_path):
    wrong = groups()
    wrong["surfels"]["surfel_area"].attrs["units"] = "m2"
    wrong["samples"]["glow"] = ("surfel", np.zeros(10))
    with Database(tmp_path).stage("capture", "A1") as stage:
        with pytest.raises(InputError, match=r"(?s)samples\[glow\].*mm2") as caught:
            stage.write(wrong)
        assert len(caught.value.faults) == 2
        with pytest.raises(InputError, match="group: must match"):
            stage.write({"../x": wrong["surfels"]})
    assert not list((tmp_path).rglob("*zarr*"))


def test_stage__committed_versions_are_closed(tmp_path):
    with Database(tmp_path).stage("capture", "A1") as stage:
        stage.write(groups())
        stage.commit({})
        for call in (
            lambda: stage.write(groups(2.0)),
            lambda: stage.commit({}),
        ):
            with pytest.raises(ValueError, match="never changes"):
                call()
    assert Database(tmp_path).verify() == []


@pytest.mark.parametrize("kind", ["<U3", object])
def test_stage__text_of_any_type_is_stored_as_variable_length_text(tmp_path, kind):
    ds = groups()["samples"].assign_coords(channel=np.array(["R", "G", "blå"], kind))
    with Database(tmp_path).stage("capture", "A1") as stage:
        stage.write({"samples": ds})
        stage.commit({})
    got = Database(tmp_path).read("capture", "A1")["samples"].to_dataset()
    assert got["channel"].dtype == np.dtypes.StringDType()
    assert list(got["channel"].values) == ["R", "G", "blå"]
    assert got["reflectance_sample"].sel(channel="blå").shape == (10, 3, 2)


def test_stage__empty_groups_are_stored(tmp_path):
    empty = dataset(
        {"trait_count": np.zeros((0, 2))},
        coords={"trait": [], "side": ["with", "without"]},
    )
    with Database(tmp_path).stage("population", "traits") as stage:
        stage.write({"traits": empty})
        stage.commit({})
    assert Database(tmp_path).read("population", "traits")["traits"].sizes["trait"] == 0


@pytest.mark.parametrize("when", ["before", "after"])
def test_commit__interrupt_around_the_link(tmp_path, monkeypatch, when):
    commit(tmp_path, 1.0)

    def interrupted(source, target):
        if "log" not in Path(target).parts:  # zarr links its own files
            return link(source, target)
        if when == "after":
            link(source, target)
        raise KeyboardInterrupt

    link = os.link
    monkeypatch.setattr(os, "link", interrupted)
    with pytest.raises(KeyboardInterrupt):
        commit(tmp_path, 2.0)
    monkeypatch.undo()
    db = Database(tmp_path)
    assert len(db.history("capture", "A1")) == (2 if when == "after" else 1)
    assert db.verify() == []  # the data of a record in the log was not removed
    assert float(db.read("capture", "A1")["surfels/surfel_area"][0]) == (
        2.0 if when == "after" else 1.0
    )
    assert len(list((tmp_path / "data/capture/A1").glob("*.zarr"))) == len(
        db.history("capture", "A1")
    )
    assert not [
        name for name in db.place.children("log/capture/A1") if name.endswith(".tmp")
    ]


def test_commit__racing_writers_each_generation_once(tmp_path):
    def attempt(i):
        try:
            return commit(tmp_path, i).generation, float(i)
        except Conflict:
            return None

    with ThreadPoolExecutor(6) as pool:
        won = dict(filter(None, pool.map(attempt, range(24))))
    db = Database(tmp_path)
    assert sorted(won) == list(range(1, len(won) + 1))
    assert [r.generation for r in db.history("capture", "A1")] == sorted(won)
    # each holds what was acknowledged to its writer
    for generation, value in won.items():
        assert (
            float(
                db.read("capture", "A1", generation=generation)["surfels/surfel_area"][
                    5
                ]
            )
            == value
        )
    # other writers left nothing
    assert len(list((tmp_path / "data/capture/A1").glob("*.zarr"))) == len(won)
    assert db.verify() == []


def test_commit__stale_writer_is_refused(tmp_path):
    db = Database(tmp_path)
    with db.stage("capture", "A1") as slow:
        slow.write(groups(1.0))
        commit(tmp_path, 2.0)
        with pytest.raises(
            Conflict, match="generation 1 was committed by another writer"
        ):
            slow.commit({})
    assert float(db.read("capture", "A1")["surfels/surfel_area"][0]) == 2.0
    assert db.verify() == []


def test_read__no_half_version_while_others_commit(tmp_path):
    commit(tmp_path, 0.0)
    db = Database(tmp_path)
    seen = []

    def look():
        tree = db.read("capture", "A1")
        area, sample = (
            tree[n].values
            for n in ("surfels/surfel_area", "samples/reflectance_sample")
        )
        assert len({*area.tolist(), *sample[1:].ravel().tolist()}) == 1
        seen.append(float(area[0]))

    with ThreadPoolExecutor(2) as pool:
        writing = pool.submit(lambda: [commit(tmp_path, float(i)) for i in range(1, 9)])
        while not writing.done():
            pool.submit(look).result()
    look()
    assert seen == sorted(seen)  # never back to an older one
    assert seen[-1] == 8.0


def _race(root, count):
    won = 0
    for i in range(count):
        try:
            commit(root, float(i))
            won += 1
        except Conflict:
            pass
    os._exit(won)


@pytest.mark.slow
def test_commit__racing_processes_lose_nothing(tmp_path):
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=_race, args=(tmp_path, 6)) for _ in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert (
        sum(w.exitcode for w in workers)
        == len(Database(tmp_path).history("capture", "A1"))
        > 0
    )


KILLED = """
import os, signal, sys
sys.path.insert(0, {tests!r})
from test_database import commit
import skindb.store.folder, skindb.store.stage
from pathlib import Path
link = os.link
die = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)
commit({root!r}, 1.0)
{where}
commit({root!r}, 2.0)
"""
LINKED = "linked, not acknowledged"
# where the writer is killed, and how many commits must then be there
DEATHS = {
    "in the middle of the data": (
        "skindb.store.stage._encoding = lambda a: die() if a.name == 'surfel_area' else {}",
        1,
    ),
    "data written, nothing flushed": (
        "skindb.store.folder.Folder.make_durable = die",
        1,
    ),
    "while flushing": ("skindb.store.folder.Folder.digests = die", 1),
    "record written, not linked": (
        "os.link = lambda a, b: die() if 'log' in Path(b).parts else link(a, b)",
        1,
    ),
    LINKED: (
        "os.link = lambda a, b: (link(a, b), 'log' in Path(b).parts and die())",
        2,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("where", DEATHS)
def test_commit__killed_at_every_step(tmp_path, where):
    line, commits = DEATHS[where]
    code = KILLED.format(
        tests=str(Path(__file__).parent), root=str(tmp_path), where=line
    )
    worker = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert worker.returncode == -signal.SIGKILL, worker.stderr
    db = Database(tmp_path)
    assert [r.generation for r in db.history("capture", "A1")] == list(
        range(1, commits + 1)
    )
    left = ["a version without a record, left by a killed run"] * (where != LINKED)
    assert db.verify() == []
    assert [one.what for one in db.garbage() if one.key.endswith(".zarr")] == left
    assert float(db.read("capture", "A1")["surfels/surfel_area"][3]) == float(commits)
    # and the next writer continues
    assert commit(tmp_path, 3.0).generation == commits + 1
    assert db.verify() == []


ENDLESS = """
import sys
sys.path.insert(0, {tests!r})
from test_database import commit
print("ready", flush=True)
while True:
    print(commit({root!r}, 2.0).generation, flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize("commits", [0, 3])
def test_commit__killed_during_a_commit(tmp_path, commits):
    code = ENDLESS.format(tests=str(Path(__file__).parent), root=str(tmp_path))
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
    ) as worker:
        assert worker.stdout.readline() == "ready\n"
        acknowledged = [int(worker.stdout.readline()) for _ in range(commits)]
        worker.send_signal(signal.SIGKILL)
        acknowledged += [int(line) for line in worker.stdout.read().split()]
    db = Database(tmp_path)
    history = (
        [r.generation for r in db.history("capture", "A1")]
        if "A1" in db.takes()
        else []
    )
    # an acknowledged commit is never lost
    assert history[: len(acknowledged)] == acknowledged
    assert len(history) <= len(acknowledged) + 1
    # left by the killed commit
    assert all("must name every version" in fault.rule for fault in db.verify())
    for generation in history:
        assert (
            float(
                db.read("capture", "A1", generation=generation)["surfels/surfel_area"][
                    3
                ]
            )
            == 2.0
        )


def test_verify__all_damage_at_once(tmp_path):
    records = [commit(tmp_path, take=take) for take in ("A1", "A2", "A3")]
    first = sorted((tmp_path / records[0].path).rglob("c/**/0"))[0]
    raw = bytearray(first.read_bytes())
    raw[len(raw) // 2] ^= 1
    first.write_bytes(raw)
    next((tmp_path / records[1].path).rglob("zarr.json")).unlink()
    (tmp_path / records[2].path / "stray").write_text("x")
    for _ in range(2):
        commit(tmp_path, take="A4")
    (tmp_path / "log/capture/A4/00000001.json").unlink()
    lines = [str(f) for f in Database(tmp_path).verify()]
    assert len(lines) == 4
    assert any("generation 1 must exist" in line for line in lines)
    assert any("content that differs" in line for line in lines)
    assert any("must exist" in line for line in lines)
    assert any("unknown file" in line for line in lines)


@pytest.mark.parametrize("text", ["{", "[]", "{}", "null", "\xff"])
def test_verify__unreadable_record(tmp_path, text):
    commit(tmp_path)
    (tmp_path / "log/capture/A1/00000001.json").write_text(text, encoding="latin-1")
    assert "record of the log" in str(Database(tmp_path).verify()[0])
    assert "fault" in Database(tmp_path).info()["takes"]["A1"]["capture"]
    with pytest.raises(InputError, match="record of the log"):
        Database(tmp_path).read("capture", "A1")


def test_verify__any_flipped_byte_is_found(tmp_path):
    commit(tmp_path)
    rng = np.random.default_rng(0)
    files = [p for p in tmp_path.rglob("*") if p.is_file()]
    assert {"log", "data", "heads", "secret"} == {
        p.relative_to(tmp_path).parts[0] for p in files
    }
    # heads are caches
    for file in (file for file in files if "heads" not in file.parts):
        whole = file.read_bytes()
        for at in rng.integers(len(whole), size=3):
            flipped = bytearray(whole)
            flipped[at] ^= 0x04
            file.write_bytes(flipped)
            assert Database(tmp_path).verify(), (file, at)
        file.write_bytes(whole)
    assert Database(tmp_path).verify() == []


def test_info__paths_open(tmp_path):
    commit(tmp_path, take="A1.lotion")
    commit(tmp_path, take="A1")
    commit(tmp_path, take="A1", kind="model")
    info = json.loads(json.dumps(Database(tmp_path).info()))
    assert set(info["takes"]) == {"A1", "A1.lotion"}
    assert set(info["takes"]["A1"]) == {"capture", "model"}
    assert Path(info["takes"]["A1"]["model"]["path"]).is_dir()
    assert Database(tmp_path).subjects() == ["A1"]


@pytest.mark.parametrize(
    "take",
    ["", "..", "../x", "a/b", "/etc", "a.b.c", "x" * 65, "a b", "a\n", "å", "a\0"],
)
def test_stage__names_cannot_leave_the_database(tmp_path, take):
    with pytest.raises(InputError, match="take"):
        Database(tmp_path).stage("capture", take)


def test_read__absent_take_names_what_exists(tmp_path):
    commit(tmp_path)
    with pytest.raises(InputError, match="found B2; choose A1"):
        Database(tmp_path).read("capture", "B2")
    with pytest.raises(InputError, match="no model; kinds: capture"):
        Database(tmp_path).read("model", "A1")
    with pytest.raises(InputError, match="kinds: none"):
        Database(tmp_path / "empty").read("model", "A1")


def test_database__must_be_a_folder(tmp_path):
    (tmp_path / "f").write_text("")
    with pytest.raises(InputError, match="a database must be a folder"):
        Database(tmp_path / "f")
    for url in ("gs://bucket/x", "https://somebody:secret@host/x"):
        with pytest.raises(
            InputError, match="a database must be a local folder or an S3 bucket"
        ) as caught:
            Database(url)
        assert "secret" not in str(caught.value)


@pytest.mark.parametrize("query", ["exists", "is_dir"])
def test_database__opens_while_another_process_creates_the_folder(
    tmp_path, monkeypatch, query
):
    root = tmp_path / "db"
    answer = getattr(Path, query)

    def then_created(path):
        found = answer(path)
        root.mkdir(exist_ok=True)
        return found

    with monkeypatch.context() as patch:
        patch.setattr(Path, query, then_created)
        db = Database(root)
    assert db.takes("capture") == []


def test_open__names_a_database_that_is_not_there(tmp_path):
    url = str(tmp_path / "typo")
    with pytest.warns(UserWarning, match="typo: there is no database"):
        assert skindb.open(url).takes() == []
    with pytest.raises(
        InputError, match=r"typo: the database must exist; found nothing"
    ):
        skindb.open(url, create=False)
    db = skindb.open(url, create=True)
    assert not (tmp_path / "typo").exists()
    commit(db.root)
    assert skindb.open(url).takes() == ["A1"]
