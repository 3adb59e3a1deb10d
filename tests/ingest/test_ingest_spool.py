from __future__ import annotations

import errno
import fcntl
import os
import shutil
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from skindb.calibration._merge_kernels import DARK, OK, SATURATED
from skindb.errors import InputError
from skindb.ingest import IngestParameters, ingest_capture, lumitexels, read_capture
from skindb.ingest._sample_kernels import NONE
from skindb.ingest.spool import STALE_SECONDS, Spool, remove_stale
from skindb.schema.label import BLOCK_SURFELS
from skindb.store import Database
from skindb.workflow import ingest_take

FRAMES = {"a": [1, 2]}


class Killed(BaseException):
    pass


def put_all(target, rng):
    """Every view, with random bits; returns (light, camera, 3, n)."""
    lights, cameras, n = target.shape
    content = rng.integers(0, 0x7C00, (lights, cameras, 3, n)).astype(np.uint16)
    for j, c in np.ndindex(lights, cameras):
        target.put(
            j,
            c,
            content[j, c],
            np.full(n, (OK, SATURATED, DARK, NONE)[j + c], np.uint8),
            {f"{j}{c}": "d"},
        )
    return content


def test_spool__gives_back_what_was_put_by_shards(tmp_path):
    n = 2 * BLOCK_SURFELS + 17
    with Spool(tmp_path / "a", (3, 2, n), FRAMES, key="run") as target:
        content = put_all(target, np.random.default_rng(1))
        lazy = target.samples()
        assert lazy.chunks[0] == (BLOCK_SURFELS, BLOCK_SURFELS, 17)
        np.testing.assert_array_equal(
            lazy.compute().view(np.uint16), np.moveaxis(content, -1, 0)
        )
        # j + c = 0; 1, 1; 2, 2; and one with no sample
        assert target.counts[:, 0].tolist() == [1, 2, 2]
        assert target.views.sum() == n
    assert not (tmp_path / "a").exists()


def interrupted(folder, frames, *, put):
    """A run that ends by an interrupt; what it found when it began."""
    found = []
    with pytest.raises(KeyboardInterrupt):
        interrupt(folder, frames, put, found)
    return found


def interrupt(folder, frames, put, found):
    with Spool(folder, (2, 2, 5), frames, key="run") as target:
        found += [
            target.done.tolist(),
            target.counts.tolist(),
            dict(target.digests),
            target.samples().compute(),
        ]
        for view, bits in put.items():
            target.put(*view, bits, np.zeros(5, np.uint8), {"f": "x"})
            target.keep("picture", bits)
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    "spoil",
    [lambda b: b[:-40], lambda b: b[:60], lambda b: b"", lambda b: b"x" * len(b)],
)
def test_spool__a_damaged_journal_is_no_journal(tmp_path, spoil):
    interrupted(tmp_path / "a", FRAMES, put={(1, 0): np.zeros((3, 5), np.uint16)})
    journal = tmp_path / "a/journal"
    journal.write_bytes(spoil(journal.read_bytes()))
    done, counts, digests, _ = interrupted(tmp_path / "a", FRAMES, put={})
    assert not np.any(done)
    assert not np.any(counts)
    assert digests == {}


def test_ingest_capture__removes_nothing_of_its_callers(pristine, tmp_path):
    """The scratch folder is the caller's: old neighbours and what else it holds stay,
    and its own folder goes.
    """
    mine = tmp_path / "scratch/mine"
    mine.mkdir(parents=True)
    (mine / "thesis.tex").touch()
    os.utime(mine, (time.time() - 3 * STALE_SECONDS,) * 2)
    parameters = IngestParameters(spacing_mm=8.0)
    with ingest_capture(
        read_capture(pristine), parameters, scratch=tmp_path / "scratch"
    ) as tree:
        count = int(tree["samples/sample_count"].values.sum())
        assert (
            np.isfinite(tree["samples/reflectance_sample"].values).all(-1).sum()
            == count
            > 0
        )
    assert [path.name for path in (tmp_path / "scratch").iterdir()] == ["mine"]
    assert (mine / "thesis.tex").exists()


def test_spool__samples_that_are_a_link_are_not_written(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "victim").write_bytes(b"x" * 1000)
    (tmp_path / "a/samples").symlink_to(tmp_path / "victim")
    with (
        pytest.raises(OSError, match="symbolic link"),
        Spool(tmp_path / "a", (1, 1, 5), FRAMES, key="run"),
    ):
        pass
    assert (tmp_path / "victim").stat().st_size == 1000


@pytest.mark.parametrize("key", ["another", ""])
def test_spool__what_another_run_sealed_is_not_trusted(tmp_path, key):
    """A planted journal or note could name views that were never sampled, or files that
    are not its own.
    """
    with (
        suppress(KeyboardInterrupt),
        Spool(tmp_path / "a", (2, 2, 5), FRAMES, key=key) as target,
    ):
        target.put(1, 0, np.zeros((3, 5), np.uint16), np.zeros(5, np.uint8), {"f": "x"})
        target.keep("photograph", np.ones(3))
        target.checkpoint()
        raise KeyboardInterrupt
    assert (tmp_path / "a/journal").exists()
    with Spool(tmp_path / "a", (2, 2, 5), FRAMES, key="run") as target:
        assert target.kept("photograph") is None
        assert not target.done.any()


def test_spool__a_link_is_no_note(tmp_path):
    with Spool(tmp_path / "a", (2, 2, 5), FRAMES, key="run") as target:
        target.keep("photograph", np.ones(3))
        np.testing.assert_array_equal(target.kept("photograph"), np.ones(3))
        (tmp_path / "a/photograph.npy").rename(tmp_path / "elsewhere.npy")
        (tmp_path / "a/photograph.npy").symlink_to(tmp_path / "elsewhere.npy")
        assert target.kept("photograph") is None


def test_spool__goes_on_from_its_journal_unless_frames_changed(tmp_path):
    one = np.arange(15, dtype=np.uint16).reshape(3, 5)
    interrupted(tmp_path / "a", FRAMES, put={(1, 0): one})
    done, counts, digests, samples = interrupted(tmp_path / "a", FRAMES, put={})
    assert done == [[False, False], [True, False]]
    assert counts == [[1] * 5, [0] * 5, [0] * 5]
    assert digests == {"f": "x"}
    np.testing.assert_array_equal(samples[:, 1, 0].T.view(np.uint16), one)
    with Spool(tmp_path / "a", (2, 2, 5), {"a": [1, 3]}, key="run") as target:
        assert not target.done.any()
        assert not target.counts.any()
        assert target.kept("picture") is None


def test_spool__an_older_note_never_replaces_a_newer_one(tmp_path, monkeypatch):
    """Two threads note their views; the note of the first is held up until the other's
    is written, or in vain.
    """
    monkeypatch.setattr("skindb.ingest.spool.JOURNAL_INTERVAL_SECONDS", 0.0)
    plain = Spool._replace
    begun = threading.Event()
    over = threading.Event()

    def slow(self, name, content):
        if not begun.is_set():
            begun.set()
            over.wait(0.5)
        plain(self, name, content)
        over.set()

    bits = np.zeros((3, 5), np.uint16)
    none = np.full(5, 3, np.uint8)
    with Spool(tmp_path / "a", (2, 2, 5), FRAMES, key="run") as target:
        monkeypatch.setattr(Spool, "_replace", slow)
        first = threading.Thread(target=target.put, args=(0, 0, bits, none, {}))
        first.start()
        begun.wait()
        target.put(1, 1, bits, none, {})
        first.join()
        with np.load(target._sealed("journal")) as journal:
            assert journal["done"].tolist() == [[True, False], [False, True]]


def test_spool__belongs_to_one_process(tmp_path):
    with Spool(tmp_path / "a", (1, 1, 5), FRAMES, key="run"):
        with (
            pytest.raises(InputError, match="one process ingests a capture"),
            Spool(tmp_path / "a", (1, 1, 5), FRAMES, key="run"),
        ):
            pass
        assert (tmp_path / "a/samples").exists()


def test_spool__removes_what_nobody_went_on_with(tmp_path):
    for name, age in (("old", STALE_SECONDS + 60), ("young", STALE_SECONDS - 60)):
        interrupted(tmp_path / name, FRAMES, put={(0, 0): np.zeros((3, 5), np.uint16)})
        for path in (tmp_path / name, tmp_path / name / "journal"):
            os.utime(path, (time.time() - age,) * 2)
    with Spool(tmp_path / "new", (1, 1, 5), FRAMES, key="run"):
        # a spool minds its own
        assert sorted(path.name for path in tmp_path.iterdir()) == [
            "new",
            "old",
            "young",
        ]
    remove_stale(tmp_path / "new")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["young"]


def test_spool__does_not_remove_what_another_process_works_on(tmp_path):
    with Spool(tmp_path / "old", (2, 2, 5), FRAMES, key="run"):
        os.utime(tmp_path / "old", (time.time() - STALE_SECONDS - 60,) * 2)
        remove_stale(tmp_path / "new")
        assert (tmp_path / "old/samples").exists()


def test_spool__passes_over_what_vanishes_while_it_looks(tmp_path, monkeypatch):
    interrupted(tmp_path / "old", FRAMES, put={(0, 0): np.zeros((3, 5), np.uint16)})
    plain = Path.stat

    def vanish(self, **options):
        if self.parent.name == "old" or self.name == "old":
            raise FileNotFoundError(self)
        return plain(self, **options)

    monkeypatch.setattr(Path, "stat", vanish)
    remove_stale(tmp_path / "new")
    monkeypatch.undo()
    assert (tmp_path / "old/samples").exists()


@pytest.mark.parametrize("length", [None, 0, 10])
def test_spool__a_journal_without_its_samples_is_not_believed(tmp_path, length):
    interrupted(tmp_path / "a", FRAMES, put={(1, 0): np.ones((3, 5), np.uint16)})
    if length is None:
        (tmp_path / "a/samples").unlink()
    else:
        os.truncate(tmp_path / "a/samples", length)
    for _ in range(2):  # nor is it a run later, when the file has its length again
        done, *_ = interrupted(tmp_path / "a", FRAMES, put={})
        assert done == [[False, False], [False, False]]
        with Spool(tmp_path / "a", (2, 2, 5), FRAMES, key="run"):
            assert not (tmp_path / "a/journal").exists()


@pytest.mark.slow
def test_spool__old_frames_come_back_after_samples_of_others_were_written(tmp_path):
    """A, then B is killed before its first note, then A again: the view B wrote over
    must not count as one of A.
    """
    interrupted(tmp_path / "a", FRAMES, put={(1, 0): np.ones((3, 5), np.uint16)})
    script = "import os\nfrom skindb.ingest.spool import Spool\nimport numpy as np\n"
    script += (
        f"target = Spool(__import__('pathlib').Path({str(tmp_path / 'a')!r}), (2, 2, "
        f"5), {{'a': [1, 3]}}, key='run')\n"
    )
    script += "target.__enter__()\ntarget._write(1, 0, np.zeros((3, 5), np.uint16))\nos._exit(9)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 9
    done, *_ = interrupted(tmp_path / "a", FRAMES, put={})
    assert done == [[False, False], [False, False]]


def finished(folder):
    with Spool(folder, (2, 2, 5), FRAMES, key="run") as target:
        put_all(target, np.random.default_rng(1))
        target.checkpoint()


@pytest.mark.parametrize("name", ["samples", "journal"])
def test_spool__killed_while_it_is_removed(tmp_path, monkeypatch, name):
    """Whatever is deleted first, the next run begins anew, and the rest is removed by it."""

    def killed(folder, **_):
        (folder / name).unlink()
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr("skindb.ingest.spool.shutil.rmtree", killed)
        with pytest.raises(Killed):
            finished(tmp_path / "a")
    remove_stale(tmp_path / "a")
    with Spool(tmp_path / "a", (2, 2, 5), FRAMES, key="run") as target:
        assert not target.done.any()
        assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_spool__samples_that_are_cut_off_are_an_error(tmp_path):
    with Spool(tmp_path / "a", (2, 2, 5), FRAMES, key="run") as target:
        put_all(target, np.random.default_rng(1))
        os.truncate(tmp_path / "a/samples", 100)
        with pytest.raises(OSError, match="samples are truncated"):
            target.samples().compute(scheduler="synchronous")


@pytest.mark.parametrize("fails", ["ftruncate", "fstat"])
def test_spool__lets_go_of_everything_when_it_cannot_begin(
    tmp_path, monkeypatch, fails
):
    def full(*_):
        raise OSError(errno.ENOSPC, "no space")

    opened = []
    closed = []
    begin = os.open
    end = os.close
    with monkeypatch.context() as patch:
        patch.setattr(
            "skindb.ingest.spool.os.open",
            lambda *a: opened.append(begin(*a)) or opened[-1],
        )
        patch.setattr(
            "skindb.ingest.spool.os.close", lambda one: closed.append(one) or end(one)
        )
        patch.setattr(f"skindb.ingest.spool.os.{fails}", full)
        with (
            pytest.raises(OSError, match="no space"),
            Spool(tmp_path / "a", (2, 2, 5), FRAMES, key="run"),
        ):
            pass
    assert len(opened) == (2 if fails == "ftruncate" else 1)
    assert sorted(closed) == sorted(opened)
    with Spool(tmp_path / "a", (2, 2, 5), FRAMES, key="run"):
        pass


def test_spool__a_file_system_without_locks_is_not_another_process(
    tmp_path, monkeypatch
):
    def none(*_):
        raise OSError(errno.ENOLCK, "no locks available")

    monkeypatch.setattr("skindb.ingest.spool.fcntl.flock", none)
    with (
        pytest.raises(OSError, match="no locks available"),
        Spool(tmp_path / "a", (1, 1, 5), FRAMES, key="run"),
    ):
        pass


def test_spool__the_lock_of_a_folder_that_was_removed_meanwhile_is_not_one(
    tmp_path, monkeypatch
):
    plain = fcntl.flock
    times = []

    def late(descriptor, how):
        times.append(descriptor)
        if len(times) == 1:
            shutil.rmtree(tmp_path / "a")
        plain(descriptor, how)

    monkeypatch.setattr("skindb.ingest.spool.fcntl.flock", late)
    with Spool(tmp_path / "a", (2, 2, 5), FRAMES, key="run"):
        assert (tmp_path / "a/lock").exists()


@pytest.fixture(scope="module")
def whole(pristine, tmp_path_factory):
    db = Database(tmp_path_factory.mktemp("whole"))
    ingest_take(db, pristine, spacing_mm=8.0)
    return db.read("capture", "T001").load()


@pytest.mark.slow
@pytest.mark.parametrize(
    "point", [("visibility", 1), ("sample", 3), ("sample", 8), ("write", 1)]
)
def test_ingest_capture__killed_goes_on_where_it_was(
    pristine, tmp_path, monkeypatch, whole, point
):
    """Nothing is visible after the kill; the second run reads only the frames that lack
    and gives the same bits.
    """
    db = Database(tmp_path / "db")
    read = []

    def killer(stage, step, _):
        if (stage, step) == point:
            raise Killed

    with pytest.raises(Killed):
        ingest_take(db, pristine, spacing_mm=8.0, progress=killer)
    assert db.takes() == []
    assert db.verify() == []

    plain = lumitexels.read_view
    monkeypatch.setattr(
        lumitexels, "read_view", lambda *a, **k: read.append(a) or plain(*a, **k)
    )
    record = ingest_take(db, pristine, spacing_mm=8.0)
    assert len(read) <= (
        8 if point[0] == "visibility" else 8 - point[1] if point[0] == "sample" else 0
    )
    take = db.read("capture", "T001")
    for group in ("samples", "surfels", "dome", "photographs"):
        for name, values in take[group].data_vars.items():
            np.testing.assert_array_equal(
                values.values, whole[group][name].values, err_msg=name
            )
    assert take.attrs["inputs"] == whole.attrs["inputs"]
    assert record.provenance["summary"] == whole.attrs["summary"]
    assert list((tmp_path / "db/tmp").iterdir()) == []


DIE = """
import os, sys
from skindb.ingest import spool
from skindb.workflow import ingest_take
from skindb.store import Database
from skindb.store.stage import Stage
from skindb.types import silent

def die(stage, step, _):
    if (stage, step) == ("sample", 5):
        os._exit(9)

spool.JOURNAL_INTERVAL_SECONDS = 0.0
if sys.argv[3] == "write":
    die = silent
    Stage.commit = lambda *_: os._exit(9)
ingest_take(Database(sys.argv[1]), sys.argv[2], spacing_mm=8.0, progress=die)
"""


@pytest.mark.slow
@pytest.mark.parametrize("point", ["sample", "write"])
def test_ingest_capture__survives_a_kill_without_goodbye(
    pristine, tmp_path, monkeypatch, whole, point
):
    """No `finally` is run: the lock falls with the process, the journal says what is
    done, written data are garbage.
    """
    folder = tmp_path / "db"
    assert (
        subprocess.run(
            [sys.executable, "-c", DIE, folder, pristine, point], check=False
        ).returncode
        == 9
    )
    db = Database(folder)
    read = []
    assert db.takes() == []
    plain = lumitexels.read_view
    monkeypatch.setattr(
        lumitexels, "read_view", lambda *a, **k: read.append(a) or plain(*a, **k)
    )
    ingest_take(db, pristine, spacing_mm=8.0)
    assert len(read) <= (3 if point == "sample" else 0)
    found = db.read("capture", "T001")["samples"]
    for name, values in found.data_vars.items():
        np.testing.assert_array_equal(values.values, whole["samples"][name].values)
    versions = {path.stem for path in (folder / "data/capture/T001").glob("*.zarr")}
    garbage = {Path(one.key).stem for one in db.garbage()}
    assert len(versions - garbage) == 1
    assert len(versions) == (1 if point == "sample" else 2)
    assert db.verify() == []


@pytest.mark.slow
def test_ingest_capture__a_frame_that_changed_is_read_again(
    capture_folder, tmp_path, whole
):
    db = Database(tmp_path / "db")

    def killer(stage, step, _):
        if (stage, step) == ("sample", 8):
            raise Killed

    frame = capture_folder / "dome/frames/long/l1_c0.png"
    content = frame.read_bytes()
    frame.write_bytes((capture_folder / "dome/frames/long/l2_c0.png").read_bytes())
    with pytest.raises(Killed):
        ingest_take(db, capture_folder, spacing_mm=8.0, progress=killer)
    frame.write_bytes(content)
    ingest_take(db, capture_folder, spacing_mm=8.0)
    take = db.read("capture", "T001")
    for name, values in take["samples"].data_vars.items():
        np.testing.assert_array_equal(values.values, whole["samples"][name].values)
    assert take.attrs["inputs"]["frames"] == whole.attrs["inputs"]["frames"]
