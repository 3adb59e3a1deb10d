"""Permissions of a database: for its owner only, with any umask, or for a group that
the owner chose.
"""

from __future__ import annotations

import os

import pytest
from planted_cohort import PEOPLE, capture

import skindb
from skindb.files import make_private
from skindb.workflow.derive import groups_of


def _commit(db, take="S02"):
    tree = capture(take, PEOPLE[take], 1)
    with db.stage("capture", take) as stage:
        stage.write(groups_of(tree))
        stage.commit(tree.attrs)


def _modes(root):
    """Permissions of the folders and of the files of a database."""
    every = [root, *root.rglob("*")]
    return tuple(
        {one.stat().st_mode & 0o7777 for one in every if one.is_dir() == folders}
        for folders in (True, False)
    )


@pytest.fixture(params=[0o000, 0o022, 0o002])
def umask(request):
    before = os.umask(request.param)
    yield
    os.umask(before)


def test_database__belongs_to_its_owner_alone(tmp_path, umask):
    db = skindb.open(tmp_path / "db", create=True)
    _commit(db)
    db.record_consent("S02", ["fit"])
    _commit(db)
    assert _modes(db.root) == ({0o700}, {0o600})


def test_database__in_an_empty_folder_is_closed_too(tmp_path, umask):
    (tmp_path / "db").mkdir(mode=0o777)
    db = skindb.open(tmp_path / "db", create=True)
    _commit(db)
    assert _modes(db.root) == ({0o700}, {0o600})


def test_database__leaves_the_permissions_of_a_folder_with_other_things(
    tmp_path, umask
):
    root = tmp_path / "home"
    root.mkdir()
    root.chmod(0o755)
    (root / "notes.txt").write_text("mine")
    db = skindb.open(root, create=True)
    _commit(db)
    assert root.stat().st_mode & 0o777 == 0o755
    assert _modes(root / "data")[1] == {0o640}


def test_database__is_shared_with_a_group_where_its_root_is(tmp_path, umask):
    db = skindb.open(tmp_path / "db", create=True)
    _commit(db)
    for folder in (db.root, db.root / "log", db.root / "data"):
        folder.chmod(0o2770)
    db.record_consent("S02", ["fit"])
    record = db.record("consent", "S02")
    folders, files = _modes(db.root / record.path)
    assert (folders, files) == ({0o2770}, {0o660})
    assert (db.root / "log" / "consent" / "S02").stat().st_mode & 0o7777 == 0o2770
    assert db.verify() == []


def test_make_private__makes_what_is_missing(tmp_path, umask):
    make_private(tmp_path / "a" / "b")
    make_private(tmp_path / "a" / "b")
    assert {(tmp_path / name).stat().st_mode & 0o777 for name in ("a", "a/b")} == {
        0o700
    }
