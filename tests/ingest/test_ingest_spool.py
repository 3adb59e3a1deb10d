"""Samples of an ingest before they are stored."""

from __future__ import annotations

import errno
import os
import subprocess
import sys

import numpy as np
import pytest

from skindb.calibration._merge_kernels import DARK, OK, SATURATED
from skindb.ingest import IngestParameters, ingest_capture, read_capture
from skindb.ingest._sample_kernels import NONE
from skindb.ingest.spool import Spool
from skindb.schema.label import BLOCK_SURFELS
from skindb.store import Database
from skindb.workflow import ingest_take


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
    with Spool(tmp_path, (3, 2, n)) as target:
        content = put_all(target, np.random.default_rng(1))
        lazy = target.samples()
        assert lazy.chunks[0] == (BLOCK_SURFELS, BLOCK_SURFELS, 17)
        np.testing.assert_array_equal(
            lazy.compute().view(np.uint16), np.moveaxis(content, -1, 0)
        )
        # j + c = 0; 1, 1; 2, 2; and one with no sample
        assert target.counts[:, 0].tolist() == [1, 2, 2]
        assert target.views.sum() == n
        assert [*tmp_path.iterdir()] == []  # the file has no name


def test_ingest_capture__removes_nothing_of_its_callers(pristine, tmp_path):
    """The scratch folder is the caller's: what else it holds stays."""
    mine = tmp_path / "scratch/mine"
    mine.mkdir(parents=True)
    (mine / "thesis.tex").touch()
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


def test_spool__samples_that_are_cut_off_are_an_error(tmp_path):
    with Spool(tmp_path, (2, 2, 5)) as target:
        put_all(target, np.random.default_rng(1))
        os.ftruncate(target._file.fileno(), 60)
        with pytest.raises(OSError, match="truncated"):
            target.samples().compute()


def test_spool__a_full_disk_leaves_nothing(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with Spool(tmp_path, (1, 1, 5)) as target:
        monkeypatch.setattr("skindb.ingest.spool.os.pwrite", full)
        with pytest.raises(OSError, match="No space"):
            put_all(target, np.random.default_rng(1))
        assert not target.done.any()
    assert [*tmp_path.iterdir()] == []


DIE = """
import os, sys
from skindb.workflow import ingest_take
from skindb.store import Database
from skindb.store.stage import Stage
from skindb.types import silent

def die(stage, step, _):
    if (stage, step) == ("sample", 5):
        os._exit(9)

if sys.argv[3] == "write":
    die = silent
    Stage.commit = lambda *_: os._exit(9)
ingest_take(Database(sys.argv[1]), sys.argv[2], spacing_mm=8.0, progress=die)
"""


@pytest.mark.slow
@pytest.mark.parametrize("point", ["sample", "write"])
def test_ingest_capture__survives_a_kill_without_goodbye(pristine, tmp_path, point):
    """No `finally` is run; written data are garbage, and photographs are in no file."""
    whole = Database(tmp_path / "whole")
    ingest_take(whole, pristine, spacing_mm=8.0)
    folder = tmp_path / "db"
    killed = subprocess.run(
        [sys.executable, "-c", DIE, folder, pristine, point], check=False
    )
    assert killed.returncode == 9
    db = Database(folder)
    assert db.takes() == []
    assert [*(folder / "tmp").iterdir()] == []
    ingest_take(db, pristine, spacing_mm=8.0)
    found, expected = (one.read("capture", "T001")["samples"] for one in (db, whole))
    for name, values in found.data_vars.items():
        np.testing.assert_array_equal(values.values, expected[name].values)
    versions = {path.stem for path in (folder / "data/capture/T001").glob("*.zarr")}
    garbage = {one.key.rpartition("/")[2].partition(".zarr")[0] for one in db.garbage()}
    assert len(versions - garbage) == 1
    assert len(versions) == (1 if point == "sample" else 2)
    assert db.verify() == []
