"""The promises of the store hold in a bucket as in a folder; a server that is there tells, none is imitated."""

from __future__ import annotations

import pickle

import pytest
import xarray as xr
from bucket_server import KEY, SECRET
from stored import commit, groups

import skindb
from skindb.store import Database


@pytest.fixture(params=["folder", "moto", "localbucket"])
def home(request, tmp_path, new_database):
    """Where a new database is to be."""
    return str(tmp_path / "db") if request.param == "folder" else new_database(request.param)


def test_commit__is_read_back_as_it_was(home):
    commit(home, 0.5)
    commit(home, 2.0)
    db = skindb.open(home)
    for generation, value in ((1, 0.5), (2, 2.0), (None, 2.0)):
        tree = db.read("capture", "A1", generation=generation)
        for name, ds in groups(value).items():
            xr.testing.assert_identical(tree[name].to_dataset().compute(), ds)
    assert db.takes() == ["A1"]
    assert db.names() == ["data", "heads", "log"]
    assert db.verify() == []


def test_database__pickles_without_secrets(bucket):
    commit(bucket)
    db = Database(bucket)
    tree = db.read("capture", "A1")
    for thing in (db, db._place, tree):
        content = pickle.dumps(thing)
        assert KEY.encode() not in content
        assert SECRET.encode() not in content
    assert pickle.loads(pickle.dumps(db)) == db
    assert float(pickle.loads(pickle.dumps(tree))["surfels/surfel_area"][3]) == 1.0
    assert not {KEY, SECRET} & set(repr((db, db._place, vars(db._place))).replace("'", " ").split())
