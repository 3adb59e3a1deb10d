"""Names from files become paths in one module, which makes files outside the database
unreachable.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from place_operations import require_refused
from stored import commit

from skindb.errors import InputError
from skindb.store import Database
from skindb.store.folder import Folder
from skindb.store.log import remove_version
from skindb.store.place import inside

OUTSIDE = [
    "..",
    "../victim",
    "data/../../victim",
    "/etc/passwd",
    "",
    "a//b",
    "a/./b",
    "a/",
    "a\\..\\b",
    "a\0b",
]


@pytest.fixture
def place(tmp_path):
    """A folder with a victim beside it, and links to that inside."""
    root = tmp_path / "db"
    victim = tmp_path / "victim"
    (root / "data").mkdir(parents=True)
    victim.mkdir()
    (victim / "file").write_text("keep me")
    (root / "linked").symlink_to(victim)
    (root / "data/file").symlink_to(victim / "file")
    return Folder(root)


@pytest.mark.parametrize("removed", ["log/A", "log/A/1", "log/A/2"])
def test_identities__what_is_removed_during_the_listing_is_left_out(
    tmp_path, removed, monkeypatch
):
    place = Folder(tmp_path)
    for key in ("log/A/1", "log/A/2", "log/B/1"):
        place.create(key, b"x")
    listed = set(place.identities("log"))
    gone = tmp_path / removed
    scan = os.scandir

    def scandir(folder):
        entries = list(scan(folder))
        if Path(folder) == gone.parent and gone.exists():
            gone.rename(tmp_path / "removed")
        return entries

    monkeypatch.setattr(os, "scandir", scandir)
    lost = {name for name in listed if f"log/{name}".startswith(removed)}
    assert lost
    assert set(place.identities("log")) == listed - lost


@pytest.mark.parametrize("key", [*OUTSIDE, "linked", "linked/file", "data/file"])
def test_folder__no_operation_leaves_the_root(place, key):
    victim = place.root.parent / "victim"
    require_refused(place, key)
    assert (victim / "file").read_text() == "keep me"
    assert [p.name for p in victim.iterdir()] == ["file"]


def test_inside__the_root_itself_may_be_a_link(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "db").symlink_to(tmp_path / "real")
    commit(tmp_path / "db")
    assert Database(tmp_path / "db").takes() == ["A1"]
    assert inside(tmp_path / "db", "log/capture") == tmp_path / "db/log/capture"


def test_sizes__links_and_loops_are_no_files(place):
    (place.root / "data/loop").symlink_to(place.root / "data")
    (place.root / "data/real").write_text("1234")
    assert place.sizes("data") == {"file": -1, "loop": -1, "real": 4}


@pytest.mark.parametrize(
    "path",
    [
        "data/capture/A1",
        "data/capture/A1/../../../victim",
        "../victim",
        "tmp/x.zarr",
        "data/capture/A1/20260101T000000-0123abcd.zarr/samples",
        "data/capture/A1/20260101T000000-0123abcd",
    ],
)
def test_remove_version__removes_versions_only(place, path):
    with pytest.raises(InputError, match=r"path of a version: must match|stay inside"):
        remove_version(place, path)


def test_make_durable__flushes_every_file_and_folder_up_to_the_root(
    tmp_path, monkeypatch
):
    place = Folder(tmp_path / "db")
    version = tmp_path / "db/data/A1"
    for number in range(20):
        (version / f"v{number}/c/0").mkdir(parents=True)
        (version / f"v{number}/c/0/1").write_bytes(b"x")
    flushed = []
    read = os.readlink
    monkeypatch.setattr(
        os, "fsync", lambda number: flushed.append(read(f"/proc/self/fd/{number}"))
    )
    place.make_durable("data/A1")
    expected = {*version.rglob("*"), version, version.parent, place.root, tmp_path}
    assert {*map(Path, flushed)} == expected
    assert len(flushed) == len(expected)

    def refused(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", refused)
    with pytest.raises(OSError, match="No space left"):
        place.make_durable("data/A1")
