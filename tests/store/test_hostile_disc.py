"""Commands on a full disk, in a read-only folder, and with wrong clocks."""

from __future__ import annotations

import datetime as datetime_module
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from stored import commit, groups

import skindb
from skindb.errors import InputError
from skindb.store import lease as lease_module
from skindb.store.lease import this_process

sys.path.insert(0, str(Path(__file__).parents[1]))
from test_cli import _run

pytestmark = pytest.mark.slow

APART = ["unshare", "--mount", "--map-root-user"]
TRIED = "mount -t tmpfs -o size=64k tmpfs /mnt"
HAS_MOUNTS = (
    shutil.which("unshare") is not None
    and not subprocess.run(
        [*APART, "sh", "-c", TRIED], check=False, capture_output=True
    ).returncode
)
needs_mounts = pytest.mark.skipif(
    not HAS_MOUNTS, reason="needs user namespaces of Linux with mounts of their own"
)
YEAR = 365 * 86400.0


@pytest.fixture(scope="module")
def made(pristine, tmp_path_factory):
    """A folder with captures and a database: two takes, of which one is fitted."""
    out = tmp_path_factory.mktemp("hostile")
    for condition, take in (("normal", "V001"), ("lotion", "V001.lotion")):
        about = Path(shutil.copytree(pristine, out / "c" / take), "capture.json")
        changed = {"subject": "V001", "condition": condition}
        about.write_text(json.dumps(json.loads(about.read_text()) | changed))
        _done("ingest", out / "db", out / "c" / take, "--spacing", "8")
    _done("fit", out / "db", "V001")
    return out


def _done(*args):
    done = _run(*map(str, args))
    assert done.returncode == 0, done.stderr
    return done.stdout


def _writing(place, captures, name):
    """Every command that writes, with the least number of bytes that it writes."""
    db = str(place / "db")
    return [
        (
            "ingest",
            db,
            str(captures / "V001.lotion"),
            "--spacing",
            "8",
            "--again",
            "--no-progress",
        ),
        ("fit", db, "V001.lotion", "--no-progress"),
        ("consent", db, "V001", "--scope", "fit,statistics"),
        ("release", db, name),
    ]


def _reading(place):
    db = str(place / "db")
    return [
        ("info", db),
        ("info", db, "-v", "--json"),
        ("info", db, "--where", "age > 0"),
        ("verify", db),
        ("clean", db),
        ("consent", db, "V001"),
        ("release", db),
        ("refresh", db, "--dry-run"),
    ]


@pytest.fixture(scope="module")
def apart():
    """Function that returns the output of `hostile_disc.py` for a place, how it is
    mounted, and steps; one process for all of them.
    """
    program = [sys.executable, str(Path(__file__).with_name("hostile_disc.py"))]
    env = os.environ | {"PYTHONPATH": str(Path(skindb.__file__).parents[1])}
    with subprocess.Popen(
        [*APART, *program],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=env,
    ) as process:

        def run(place, mount, steps):
            process.stdin.write(json.dumps([str(place), mount, steps]) + "\n")
            process.stdin.flush()
            return json.loads(process.stdout.readline())

        yield run


def _one_line(code, stderr, found, cure, place):
    """Check that a refused command prints one line that names a file of the database."""
    assert code == 1, stderr
    (line,) = stderr.splitlines()
    assert line.startswith("skindb: "), line
    assert str(place) in line
    assert f"found {found}; {cure}" in line


@needs_mounts
def test_full_disk__is_one_line_of_every_command_and_harms_nothing(
    made, apart, tmp_path
):
    place = tmp_path / "full"
    tries = []
    place.mkdir()
    mount = f"mount -t tmpfs -o size=24m tmpfs {place} && cp -a {made / 'db'} {place}"
    steps = []
    # the others write less than what is left, and are tried without any space
    for left, names in ((0, ("consent", "release")), (400_000, ("ingest", "fit"))):
        steps.append(["leave", left])
        for command in _writing(place, made / "c", f"left{left}"):
            if command[0] in names:
                steps += [["run", command], ["run", ("verify", str(place / "db"))]]
                tries.append((left, command[0]))
        steps += [["read"], ["free"]]
    again = [*_writing(place, made / "c", "free"), ("verify", str(place / "db"))]
    told = apart(
        place, mount, [*steps, *(["run", command] for command in again), ["read"]]
    )
    ended = iter(told)
    for left, name in tries:
        code, _, stderr = next(ended)
        if code or left == 0:
            cure = "free some space there, then run the command again"
            _one_line(code, stderr, "No space left on device", cure, place)
        code, stdout, stderr = next(ended)
        assert (code, stdout.splitlines()[0]) == (0, "Every version is intact."), (
            name,
            left,
            stderr,
        )
        if name in ("release", "fit"):
            assert next(ended)["takes"] == ["V001", "V001.lotion"]
    assert [one[0] for one in (next(ended) for _ in again)] == [0] * len(again)
    assert set(next(ended)["table"]["model_generation"]) == {"V001", "V001.lotion"}


@needs_mounts
def test_full_disk__a_withdrawal_needs_no_space(made, apart, tmp_path):
    place = tmp_path / "full"
    place.mkdir()
    mount = f"mount -t tmpfs -o size=24m tmpfs {place} && cp -a {made / 'db'} {place}"
    db = str(place / "db")
    steps = [
        ["leave", 0],
        *(
            ["run", command]
            for command in (("withdraw", db, "V001", "--yes"), ("verify", db))
        ),
    ]
    (code, stdout, stderr), verified = apart(place, mount, [*steps, ["free"]])
    assert (code, stderr) == (0, "")
    assert (
        stdout.splitlines()[-1]
        == "removed versions: 2 of kind capture, 1 of kind model"
    )
    assert verified == [0, "Every version is intact.\n", ""]


@needs_mounts
def test_read_only_folder__reads_everything_and_refuses_to_write_in_one_line(
    made, apart
):
    steps = [["run", command] for command in _reading(made)] + [["read"]]
    shutil.rmtree(made / "db/catalogue", ignore_errors=True)
    read_only = f"mount --bind {made} {made} && mount -o remount,bind,ro {made}"
    writes = _writing(made, made / "c", "none")
    told = apart(made, read_only, [*steps, *(["run", command] for command in writes)])
    assert not (made / "db/catalogue").exists()
    for mine, its in zip(told, apart(made, f"umount {made}", steps), strict=False):
        if isinstance(mine, dict):
            assert mine == its
        else:
            assert mine[:2] == its[:2]  # with -v, standard error has the run time
            assert mine[0] == 0
    for code, _, stderr in told[len(steps) :]:
        cure = "make its file system writable, or copy it to one that is"
        _one_line(code, stderr, "Read-only file system", cure, made)


@pytest.fixture
def clock(monkeypatch):
    """A function that sets the clock of this machine by so many seconds, as skindb
    reads it; files keep theirs.
    """
    real = datetime_module.datetime
    now = time.time

    def set_by(seconds):
        class Shifted(real):
            @classmethod
            def now(cls, tz=None):
                return real.now(tz) + datetime_module.timedelta(seconds=seconds)

        monkeypatch.setattr(time, "time", lambda: now() + seconds)
        monkeypatch.setattr(time, "time_ns", lambda: int((now() + seconds) * 1e9))
        for name, module in list(sys.modules.items()):
            if name.startswith("skindb.") and issubclass(
                getattr(module, "datetime", int), real
            ):
                monkeypatch.setattr(module, "datetime", Shifted)

    return set_by


def test_commands__by_a_clock_that_is_a_year_back(made, tmp_path, clock):
    shutil.copytree(made / "db", tmp_path / "db")
    db = skindb.open(str(tmp_path / "db"))
    before = db.record("capture", "V001.lotion")
    clock(-YEAR)
    for command in _writing(tmp_path, made / "c", "back"):
        _done(*command)
    # so the clock of the commands was set
    assert db.record("capture", "V001.lotion").created < before.created
    assert db.record("capture", "V001.lotion").generation == 2
    assert db.record("model", "V001.lotion").made_from[0]["generation"] == 2
    assert db.consent("V001") == ["fit", "statistics"]
    for set_by in (-YEAR, 0.0):
        clock(set_by)
        for command in _reading(tmp_path):
            _done(*command)
        assert db.verify() == []
        assert db.takes(where="age > 0 and not outdated") == ["V001", "V001.lotion"]
        assert list(db.cohort("tables").take.values) == ["V001", "V001.lotion"]
        assert [one.kept for one in db.garbage()] == []
    _done("consent", tmp_path / "db", "V001", "--scope", "fit")
    # the newest by its generation, whatever its date
    assert db.consent("V001") == ["fit"]


@pytest.mark.parametrize("hours", [-1, 1])
def test_lease__of_a_machine_whose_clock_is_an_hour_off(
    tmp_path, clock, monkeypatch, hours
):
    """That machine holds a lease and has left a version; files have the time of the storage."""
    db = skindb.open(str(tmp_path / "db"), create=True)
    commit(db.root)
    with monkeypatch.context() as other:
        other.setattr(
            lease_module,
            "this_process",
            lambda: this_process() | {"host": "other", "boot": "another"},
        )
        clock(3600.0 * hours)
        lease = db.lease("A1", "capture")
        lease.__enter__()
        lease._ended.set()
        stage = db.stage("capture", "A1")
        stage.write(groups())
    clock(0.0)
    (file,) = (db.root / "leases/capture/A1").glob("*.json")
    for age, is_held in ((50, True), (70, False)):
        os.utime(file, (time.time() - age,) * 2)
        for machine in (-3600.0, 0.0, 3600.0):
            clock(machine)
            assert bool(lease_module.holder_of(db.place, "capture", "A1")) == is_held
        clock(0.0)
    file.unlink()  # without its lease, the age of the version decides
    for minutes, is_kept in ((50, True), (70, False)):
        for path in sorted((db.root / stage.path).rglob("*")):
            os.utime(path, (time.time() - 60 * minutes,) * 2)
        os.utime(db.root / stage.path, (time.time() - 60 * minutes,) * 2)
        for machine in (-3600.0, 0.0, 3600.0):
            clock(machine)
            (left,) = [one for one in db.garbage() if one.key == stage.path]
            assert bool(left.kept) == is_kept, (minutes, machine)
        clock(0.0)


def test_commit__of_two_machines_an_hour_apart_is_in_order(tmp_path, clock):
    for number, seconds in enumerate((3600.0, -3600.0, 3600.0, 0.0), 1):
        clock(seconds)
        assert commit(tmp_path / "db", float(number)).generation == number
    db = skindb.open(str(tmp_path / "db"))
    assert db.read("capture", "A1")["surfels/surfel_area"].values[3] == 4.0
    assert db.verify() == []


@pytest.mark.parametrize("call", ["write", "fsync", "link"])
def test_commit__that_the_disk_refuses_leaves_the_version_before_it(
    tmp_path, monkeypatch, call
):
    commit(tmp_path / "db", 1.0)

    def refuse(*_, **__):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        if call == "write":
            patch.setattr("skindb.store.folder.Folder._temporary", refuse)
        else:
            patch.setattr(os, call, refuse)
        with pytest.raises((OSError, InputError), match="No space left on device"):
            commit(tmp_path / "db", 2.0)
    db = skindb.open(str(tmp_path / "db"))
    assert db.read("capture", "A1")["surfels/surfel_area"].values[3] == 1.0
    assert db.verify() == []
    assert commit(tmp_path / "db", 3.0).generation == 2


@needs_mounts
def test_full_disk__a_backup_and_a_restore_end_in_one_line_and_continue(
    made, apart, tmp_path
):
    place = tmp_path / "full"
    place.mkdir()
    mount = f"mount -t tmpfs -o size=24m tmpfs {place}"
    db, backup, copy = (
        str(one) for one in (made / "db", place / "backup", place / "copy")
    )
    commands = [
        ("backup", db, backup),
        ("restore", backup, copy, "--markers", f"{db}.markers"),
    ]
    steps = []
    checked = []
    for command in commands:
        for left in (0, 400_000):
            steps += [
                ["leave", left],
                ["run", command],
                ["run", ("info", copy)],
                ["free"],
            ]
        steps += [["run", command]]
        checked += [(command[0], left) for left in (0, 400_000, None)]
    told = iter(
        apart(
            place,
            mount,
            [*steps, ["run", ("verify", copy)], ["run", (*commands[0], "--verify")]],
        )
    )
    for name, left in checked:
        code, _, stderr = next(told)
        if left is None:
            assert (code, stderr) == (0, ""), name
            continue
        _one_line(
            code,
            stderr,
            "No space left on device",
            "free some space there, then run the command again",
            place,
        )
        # the copy is never taken for a database with takes
        code, stdout, stderr = next(told)
        assert (code, len(stderr.splitlines())) == (
            1,
            1,
        ) or stdout == "The database holds no takes.\n"
    assert next(told) == [0, "Every version is intact.\n", ""]
    assert next(told)[0] == 0
