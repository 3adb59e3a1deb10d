"""The guarantees of the store hold in a bucket as in a folder; the servers are real ones."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from bucket_server import KEY, SECRET
from faulty_proxy import FAULTS, faulty_proxy
from place_operations import require_refused
from stored import commit, groups
from waiting import PATIENCE_SECONDS

import skindb
from skindb.errors import InputError, UnavailableError
from skindb.schema import dataset
from skindb.schema.label import BLOCK_SURFELS
from skindb.store import Conflict, Database, s3
from skindb.store import bucket as bucket_module
from skindb.store import stage as stage_module
from skindb.store.bucket import Bucket
from skindb.store.folder import Folder
from skindb.store.lease import LEASE_SECONDS
from skindb.store.log import Log
from skindb.store.verified import CHANGED

WRITERS = 8


@pytest.fixture(params=["folder", "moto", "localbucket"])
def home(request, tmp_path, new_database):
    """Place of a new database."""
    return (
        str(tmp_path / "db")
        if request.param == "folder"
        else new_database(request.param)
    )


@pytest.fixture(params=["folder", "localbucket"])
def atomic_home(request, tmp_path, new_database):
    """A place whose server tests the condition and writes in one step; moto does so in two."""
    return (
        str(tmp_path / "db")
        if request.param == "folder"
        else new_database(request.param)
    )


def _area(db, generation=None, take="A1"):
    return float(
        db.read("capture", take, generation=generation)["surfels/surfel_area"][3]
    )


@pytest.mark.slow
def test_commit__is_read_back_as_it_was(home):
    commit(home, 0.5)
    commit(home, 2.0)
    db = skindb.open(home)
    for generation, value in ((1, 0.5), (2, 2.0), (None, 2.0)):
        tree = db.read("capture", "A1", generation=generation)
        for name, ds in groups(value).items():
            xr.testing.assert_identical(tree[name].to_dataset().compute(), ds)
    assert db.takes() == ["A1"]
    # a bucket needs no temporary files
    assert {*db.names()} - {"staging"} == {"data", "heads", "log", "secret"}
    assert db.verify() == []


def test_stage__whole_shards_are_written_and_read_in_parts(home, monkeypatch):
    monkeypatch.setattr(stage_module, "MAX_OBJECT_BYTES", 1)
    area = np.arange(2 * BLOCK_SURFELS + 100, dtype=np.float32)
    with Database(home).stage("capture", "A1") as stage:
        stage.write({"surfels": dataset({"surfel_area": area}).chunk(surfel=1000)})
        stage.commit({})
    db = Database(home)
    np.testing.assert_array_equal(
        db.read("capture", "A1")["surfels/surfel_area"].values, area
    )
    part = db.read("capture", "A1")["surfels/surfel_area"][
        BLOCK_SURFELS + 5 : BLOCK_SURFELS + 300 : 17
    ]
    np.testing.assert_array_equal(
        part.values, area[BLOCK_SURFELS + 5 : BLOCK_SURFELS + 300 : 17]
    )
    assert db.verify() == []


def test_stage__left_without_commit_leaves_nothing(home):
    place = Database(home).place

    def interrupted():
        with Database(home).stage("capture", "A1") as stage:
            stage.write(groups())
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        interrupted()
    assert place.children("data/capture/A1") == []
    assert Database(home).takes() == []


def test_remove__leaves_a_tombstone(home):
    records = [commit(home, value) for value in (1.0, 2.0, 3.0)]
    place = Database(home).place
    Log(place, "capture", "A1").remove(2)
    assert not place.sizes(records[1].path)
    assert place.file_type(records[1].beside("manifest")) == ""
    assert len(place.children("tombstones")) == 1
    assert Database(home).verify() == []
    assert _area(Database(home)) == 3.0


def _flip(place, key):
    data = bytearray(place.read(key))
    data[len(data) // 2] ^= 1
    place.replace(key, bytes(data))


@pytest.mark.slow
def test_verify__finds_changed_missing_and_foreign_objects(home):
    records = {take: commit(home, take=take) for take in ("A1", "A2", "A3", "A4", "A5")}
    place = Database(home).place
    _flip(place, f"{records['A1'].path}/surfels/surfel_area/c/0")
    place.remove(f"{records['A2'].path}/samples/light/zarr.json")
    place.replace(f"{records['A3'].path}/stray", b"x")
    _flip(place, "log/capture/A4/00000001.json")
    place.replace("log/capture/A5/note.txt", b"x")
    found = sorted(
        (fault.where.removeprefix(f"{home}/").split("/")[2], fault.found)
        for fault in Database(home).verify()
    )
    assert [take for take, _ in found] == ["A1", "A2", "A3", "A4", "A5"]
    assert [what for _, what in found[:3]] == [
        CHANGED,
        "no file",
        "an unknown file or folder",
    ]
    for take, message in {
        "A1": CHANGED,
        "A2": "found no file",
        "A4": "a record of the log must be",
    }.items():
        with pytest.raises(InputError, match=message):
            Database(home).read("capture", take)["surfels/surfel_area"].compute()


@pytest.mark.slow
def test_commit__racing_writers_on_one_key(atomic_home):
    def attempt(i):
        try:
            return commit(atomic_home, i).generation, float(i)
        except Conflict:
            return None

    with ThreadPoolExecutor(WRITERS) as pool:
        won = dict(filter(None, pool.map(attempt, range(3 * WRITERS))))
    db = Database(atomic_home)
    assert sorted(won) == list(range(1, len(won) + 1))
    # each holds what was acknowledged to its writer
    for generation, value in won.items():
        assert _area(db, generation) == value
    assert len(won) < 3 * WRITERS  # there was a race
    assert db.verify() == []


@pytest.mark.slow
def test_commit__racing_writers_on_eight_keys(home):
    db = Database(home)  # shared by all of them
    takes = [f"A{i}" for i in range(8)]

    def attempt(take, generation):
        with db.stage("capture", take) as stage:
            stage.write(groups(float(take[1:])))
            assert stage.commit({}).generation == generation

    with ThreadPoolExecutor(WRITERS) as pool:
        for generation in (1, 2):
            list(pool.map(attempt, takes, [generation] * 8))
    assert [_area(db, take=take) for take in takes] == [
        float(take[1:]) for take in takes
    ]
    assert db.verify() == []


def test_create__one_of_many_wins(atomic_home):
    place = Database(atomic_home).place
    for number in range(20):
        with ThreadPoolExecutor(WRITERS) as pool:
            won = list(
                pool.map(
                    lambda i, n=number: place.create(f"log/{n}", b"%d" % i),
                    range(WRITERS),
                )
            )
        assert won.count(True) == 1
        assert place.read(f"log/{number}") == b"%d" % won.index(True)


ENDLESS = """
import sys
sys.path.insert(0, {tests!r})
from stored import commit
print("ready", flush=True)
while True:
    print(commit({url!r}, 2.0).generation, flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize("commits", [0, 3])
def test_commit__killed_during_a_commit(bucket, commits):
    code = ENDLESS.format(tests=str(Path(__file__).parent), url=bucket)
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
    ) as worker:
        assert worker.stdout.readline() == "ready\n"
        acknowledged = [int(worker.stdout.readline()) for _ in range(commits)]
        worker.send_signal(signal.SIGKILL)
        acknowledged += [int(line) for line in worker.stdout.read().split()]
    db = Database(bucket)
    history = (
        [r.generation for r in db.history("capture", "A1")]
        if "A1" in db.takes()
        else []
    )
    assert history[: len(acknowledged)] == acknowledged
    assert len(history) <= len(acknowledged) + 1
    assert all("must name every version" in fault.rule for fault in db.verify())
    assert all(_area(db, generation) == 2.0 for generation in history)


def test_database__is_pickled_without_secrets(bucket):
    commit(bucket)
    db = Database(bucket)
    tree = db.read("capture", "A1")
    for thing in (db, db.place, tree):
        content = pickle.dumps(thing)
        assert KEY.encode() not in content
        assert SECRET.encode() not in content
    assert pickle.loads(pickle.dumps(db)) == db
    assert float(pickle.loads(pickle.dumps(tree))["surfels/surfel_area"][3]) == 1.0
    text = repr((db, db.place, vars(db.place)))
    assert KEY not in text
    assert SECRET not in text


@pytest.mark.parametrize(
    "key",
    [
        "..",
        "../victim",
        "data/../../victim",
        "/etc",
        "",
        "a//b",
        "a/./b",
        "a/",
        "a\\..\\b",
    ],
)
def test_bucket__no_operation_leaves_the_prefix(bucket, key):
    place = Bucket(bucket)
    outside = Bucket(bucket.rpartition("/")[0])
    outside.replace("victim", b"keep me")
    require_refused(place, key)
    with pytest.raises(InputError, match="every path must stay inside the database"):
        place.file_type(key)
    assert outside.sizes("victim") == {}
    assert outside.read("victim") == b"keep me"


@pytest.mark.parametrize(
    "limits", [(0, None), (3, None), (2, 7), (-4, None), (4, 4), (7, 99)]
)
def test_read__parts_are_those_of_a_folder(bucket, tmp_path, limits):
    parts = []
    for place in (Bucket(bucket), Folder(tmp_path)):
        place.replace("data/x", b"0123456789")
        parts.append(place.read("data/x", *limits))
    assert parts[0] == parts[1]


def test_place__answers_are_those_of_a_folder(home, tmp_path):
    """The calls that `verify`, the log and the lists of takes make."""
    answers = []
    for place in (Database(home).place, Folder(tmp_path / "other")):
        assert place.names() is None
        place.replace("log/a/x.json", b"1")
        place.replace("log/a/y/z.json", b"12")
        place.replace("log/ab", b"123")
        one = [
            {*place.names()} - {"staging"},
            place.children("log"),
            place.children("log/a"),
            place.children("none"),
        ]
        one += [
            place.file_type(key)
            for key in ("log", "log/a", "log/a/x.json", "log/a/x", "none")
        ]
        one += [place.sizes("log"), place.sizes("log/a"), place.sizes("none")]
        one += [
            place.create("log/ab", b"other"),
            place.read_small("log/ab"),
            place.digests("log/ab"),
        ]
        place.remove("log/a")
        place.remove("none")
        answers.append([*one, place.sizes("log")])
        for call in (place.read, place.read_small, place.digests):
            with pytest.raises(OSError, match="no such") as caught:
                call("log/none")
            assert caught.value.strerror
    assert answers[0] == answers[1]


def test_identities__change_with_the_object(bucket):
    place = Bucket(bucket)
    place.replace("data/x", b"1")
    first = place.identities("data")
    assert place.identities("data") == first
    place.replace("data/x", b"2")
    assert place.identities("data") != first


def test_read_small__has_a_limit(bucket, monkeypatch):
    place = Bucket(bucket)
    place.replace("log/x", b"x" * 11)
    monkeypatch.setattr(bucket_module, "MAX_STORE_JSON_BYTES", 10)
    with pytest.raises(OSError, match=r"0\.0 MB"):
        place.read_small("log/x")


def test_commit__reads_nothing_back(bucket, s3_address, monkeypatch):
    """Digests are computed from what was put, and the metadata of a version are put once."""
    with (
        faulty_proxy(s3_address("localbucket")) as proxy,
        monkeypatch.context() as patched,
    ):
        patched.setenv("AWS_ENDPOINT_URL", proxy.address)
        commit(bucket)
    data = [(method, path) for method, path in proxy.requests if ".zarr/" in path]
    assert {method for method, _ in data} == {"PUT"}
    assert len(data) == len(set(data))
    assert Database(bucket).verify() == []


@pytest.mark.parametrize("what", ["replaced", "removed"])
def test_commit__refuses_if_what_was_put_is_not_there(bucket, what):
    with Database(bucket).stage("capture", "A1") as stage:
        stage.write(groups())
        key = f"{stage.path}/surfels/surfel_area/c/0"
        other = Bucket(bucket)
        other.remove(key)
        if what == "replaced":
            other.replace(key, b"of another writer")
        found = (
            "a different object than was written"
            if what == "replaced"
            else "no object where one was written"
        )
        with pytest.raises(OSError, match=found):
            stage.commit({})
    assert Database(bucket).takes() == []


def test_create__refuses_a_server_that_overwrites(bucket, s3_address, monkeypatch):
    """Some gateways ignore the condition of a put; they are refused before there is any record."""
    with (
        faulty_proxy(s3_address("localbucket"), without=("if-none-match",)) as proxy,
        monkeypatch.context() as patched,
    ):
        patched.setenv("AWS_ENDPOINT_URL", proxy.address)
        with pytest.raises(InputError, match="the server must support conditional put"):
            commit(bucket)
    assert Bucket(bucket).children("log") == []


@pytest.fixture
def impatient(monkeypatch):
    """Short pauses, and a time limit that only late answers exceed."""
    monkeypatch.setattr(s3, "REQUEST_TIMEOUT", timedelta(seconds=2))
    monkeypatch.setattr(s3, "FIRST_PAUSE", timedelta(seconds=0.01))
    monkeypatch.setattr(bucket_module, "PAUSES_S", (0.01, 0.05, 0.2))


@pytest.mark.slow
def test_bucket__one_request_in_ten_fails(
    new_database, s3_address, monkeypatch, impatient
):
    # localbucket would store half an object if half of one arrives
    url = new_database("moto")
    with faulty_proxy(s3_address("moto"), fraction=0.1, faults=FAULTS, seed=3) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.address)
        for value in range(5):
            assert commit(url, value).generation == value + 1
        Log(Database(url).place, "capture", "A1").remove(2)
        db = Database(url)
        assert db.verify() == []
        assert [
            _area(db, record.generation) for record in db.history("capture", "A1")
        ] == [0.0, 2.0, 3.0, 4.0]
    assert sum(proxy.failed.values()) >= 15
    assert set(proxy.failed) == set(FAULTS)


@pytest.mark.parametrize("fault", ["lost answer", "late answer", "503"])
def test_create__a_lost_answer_is_no_lost_commit(
    bucket, s3_address, monkeypatch, impatient, fault
):
    """The writer gets no answer, asks again, and finds its own object, or that of
    another writer.
    """
    with faulty_proxy(s3_address("localbucket"), faults=(fault,)) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.address)
        place = Bucket(bucket)
        proxy.next = [fault]
        assert place.create("log/mine", b"mine")
        proxy.next = [fault]
        assert not place.create("log/mine", b"of another")
        assert place.read("log/mine") == b"mine"


def test_replace__half_an_upload_is_never_visible(
    new_database, s3_address, monkeypatch, impatient
):
    url = new_database("moto")
    monkeypatch.setattr(s3, "MAX_RETRIES", 1)
    with faulty_proxy(
        s3_address("moto"), fraction=1.0, faults=("half a request",)
    ) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.address)
        place = Bucket(url)
        for call in (place.replace, place.write, place.create):
            with pytest.raises(UnavailableError, match="the server must answer"):
                call("data/x", b"x" * 100_000)
        proxy.fraction = 0.0
        assert place.sizes("data") == {}
        place.replace("data/x", b"old")
        proxy.fraction = 1.0
        with pytest.raises(UnavailableError, match="the server must answer"):
            place.replace("data/x", b"x" * 100_000)
        proxy.fraction = 0.0
        assert place.read("data/x") == b"old"


def test_write__large_objects_are_one_request(bucket, s3_address, monkeypatch):
    """Parts of an unfinished upload would remain in the bucket, and cause costs."""
    with faulty_proxy(s3_address("localbucket")) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.address)
        Bucket(bucket).write("data/x", b"x" * 12_000_000)
        assert [method for method, _ in proxy.requests] == ["PUT"]


def test_stage__keeps_what_may_be_committed_where_the_server_is_gone(
    new_database, s3_address, monkeypatch, impatient
):
    """It is then unknown whether the record has arrived, so that nothing is removed."""
    url = new_database("localbucket")
    monkeypatch.setattr(s3, "MAX_RETRIES", 1)
    with faulty_proxy(s3_address("localbucket"), faults=("503",)) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.address)
        stage = Database(url).stage("capture", "A1")
        proxy.part = "/log/"

        def refused():
            with stage:
                stage.write(groups())
                proxy.fraction = 1.0
                stage.commit({})

        with pytest.raises(UnavailableError, match="503"):
            refused()
        proxy.fraction = 0.0
        assert Bucket(url).sizes(stage.path)


def test_heads__an_unreachable_server_is_no_damage(
    bucket, s3_address, monkeypatch, impatient
):
    commit(bucket)
    monkeypatch.setattr(s3, "MAX_RETRIES", 1)
    with faulty_proxy(
        s3_address("localbucket"), fraction=1.0, faults=("503",)
    ) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.address)
        db = Database(bucket)
        for part in ("/heads/", "/log/", "/data/"):
            proxy.part = part
            with pytest.raises(UnavailableError, match="503 Service Unavailable"):
                db.read("capture", "A1")["surfels/surfel_area"].compute()


def test_bucket__a_forked_process_is_refused(bucket):
    commit(bucket)
    refused = pytest.raises(
        InputError,
        match="must not be forked from another one that does; found a forked process",
    )
    with multiprocessing.get_context("fork").Pool(1) as pool, refused:
        pool.apply_async(_takes, (bucket,)).get(PATIENCE_SECONDS)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply_async(_takes, (bucket,)).get(PATIENCE_SECONDS) == ["A1"]


def _takes(url):
    return Database(url).takes()


HOLDER = """
import sys
sys.path.insert(0, {tests!r})
from skindb.store import Database
from stored import groups
db = Database({url!r})
with db.lease("A1", "model") as lease, db.stage("model", "A1", lease) as stage:
    stage.write(groups(5.0))
    print("holds it", flush=True)
    sys.stdin.readline()
    stage.commit({{}})
"""


@pytest.mark.slow
@pytest.mark.parametrize("end", ["killed", "asleep"])
def test_lease__ends_with_a_killed_holder_and_a_sleeping_one_commits_nothing(
    bucket, end, monkeypatch
):
    code = HOLDER.format(tests=str(Path(__file__).parent), url=bucket)
    pipes = {
        "stdin": subprocess.PIPE,
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
        "text": True,
    }
    with subprocess.Popen([sys.executable, "-c", code], **pipes) as holder:
        assert holder.stdout.readline() == "holds it\n"
        holder.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, holder.pid, os.WSTOPPED)
        db = Database(bucket)
        with pytest.raises(
            InputError,
            match=(
                r"only one run at a time may work on it; found python on .* \(process "
                rf"{holder.pid}\)"
            ),
        ):
            db.lease("A1", "model").__enter__()
        if end == "killed":
            holder.kill()
            holder.wait()
        else:
            now = Bucket.now
            monkeypatch.setattr(
                Bucket, "now", lambda place: now(place) + LEASE_SECONDS + 2
            )
        with db.lease("A1", "model") as lease:
            holder.send_signal(signal.SIGCONT)
            said = holder.communicate("commit\n" if end == "asleep" else None)[1]
            assert ("LeaseLost: model of A1: only one run at a time" in said) == (
                end == "asleep"
            )
            with db.stage("model", "A1", lease) as stage:
                stage.write(groups(1.0))
                stage.commit({})
    assert float(db.read("model", "A1")["surfels/surfel_area"][3]) == 1.0
    assert [record.generation for record in db.history("model", "A1")] == [1]


def test_scratch__belongs_to_the_user_and_the_bucket(bucket, monkeypatch, tmp_path):
    monkeypatch.setenv("SKINDB_CACHE", str(tmp_path / "cache"))
    one, same, other = (
        Database(url).scratch() for url in (bucket, f"{bucket}/", f"{bucket}x")
    )
    assert one == same != other
    assert (tmp_path / "cache") in one.parents
    assert one.stat().st_mode & 0o777 == 0o700
    one.chmod(0o755)
    with pytest.raises(InputError, match="must be a folder of this user"):
        Database(bucket).scratch()


def test_info__names_objects(bucket):
    record = commit(bucket)
    told = json.loads(json.dumps(Database(bucket).info()))
    assert told["takes"]["A1"]["capture"]["path"] == f"{bucket}/{record.path}"
    with pytest.raises(InputError, match="the database must be in a local folder"):
        _ = Database(bucket).root
