"""Reads of damaged versions: an error that names file and cure, never a fill value."""

from __future__ import annotations

import pickle
from unittest import mock

import dask
import numpy as np
import pytest
import zarr
from stored import commit

from skindb.errors import InputError
from skindb.schema import dataset
from skindb.schema.label import BLOCK_SURFELS
from skindb.store import Database, stage
from skindb.store.place import BLOCK_BYTES
from skindb.store.verified import VerifiedStore

N = BLOCK_SURFELS + 500  # two shards
NAMES = ("samples/reflectance_sample", "surfels/surfel_area")


@pytest.fixture
def db(tmp_path, monkeypatch):
    monkeypatch.setattr(stage, "MAX_OBJECT_BYTES", 1)  # a block in each
    commit(tmp_path, n=N)
    return Database(tmp_path)


def _files(db):
    root = db.root / db.record("capture", "A1").path
    return sorted(p for p in root.rglob("*") if p.is_file())


def _chunks(db):
    return [p for p in _files(db) if p.name != "zarr.json"]


def _flip(file, at):
    raw = bytearray(file.read_bytes())
    raw[at] ^= 0x10
    file.write_bytes(raw)


def _read_all(db):
    tree = db.read("capture", "A1")
    return [tree[name].values for name in NAMES]


def test_read__reports_a_missing_file_before_any_work(db):
    assert len(_files(db)) > 6
    for file in _files(db):
        content = file.read_bytes()
        file.unlink()
        with pytest.raises(
            InputError,
            match=f"{file.name}: a version must be as it was committed; found no file; rest",
        ):
            db.read("capture", "A1")
        file.write_bytes(content)
    _read_all(db)


def test_read__reports_a_cut_or_longer_file_before_any_work(db):
    for file in _files(db):
        content = file.read_bytes()
        for wrong in (content[:-1], content + b"x", b""):
            file.write_bytes(wrong)
            with pytest.raises(
                InputError, match=f"found {len(wrong)} bytes instead of {len(content)}"
            ):
                db.read("capture", "A1")
        file.write_bytes(content)


@pytest.mark.slow
def test_read__any_changed_byte_is_an_error_of_what_needs_it(db):
    rng = np.random.default_rng(5)
    root = db.root / db.record("capture", "A1").path / "zarr.json"
    for file in [root, *_chunks(db)]:
        content = file.read_bytes()
        for at in rng.integers(len(content), size=8):
            _flip(file, at)
            with pytest.raises(
                InputError,
                match=r"as it was committed; found content that differs .*; restore this file",
            ):
                _read_all(db)
            file.write_bytes(content)
    for values, name in zip(_read_all(db), NAMES, strict=True):
        assert np.nanmin(values) == np.nanmax(values) == 1.0, name


def test_read__metadata_are_those_of_the_root(db):
    """Those of single nodes are for other programs; `verify` compares them too."""
    root = db.root / db.record("capture", "A1").path
    copies = [p for p in _files(db) if p.name == "zarr.json" and p.parent != root]
    assert len(copies) > 3
    for file in copies:
        _flip(file, file.stat().st_size // 2)
    assert all(np.nanmin(values) == 1.0 for values in _read_all(db))
    faults = [str(fault) for fault in db.verify()]
    assert all(any(str(file) in fault for fault in faults) for file in copies)


def test_read__what_does_not_need_the_damaged_chunk_is_still_read(db):
    (second,) = (p for p in _chunks(db) if "surfel_area" in p.parts and p.name == "1")
    _flip(second, 40)
    area = db.read("capture", "A1")["surfels/surfel_area"]
    np.testing.assert_array_equal(area[:BLOCK_SURFELS], 1.0)
    with pytest.raises(InputError, match="surfel_area/c/1"):
        area[BLOCK_SURFELS:].compute()


def test_read__a_chunk_of_another_version_is_refused(db, tmp_path):
    """Its checksum fits, its contents do not."""
    other = commit(tmp_path / "other", 2.0, n=N)
    for file in _chunks(db):
        relative = file.relative_to(db.root / db.record("capture", "A1").path)
        file.write_bytes((tmp_path / "other" / other.path / relative).read_bytes())
    with pytest.raises(
        InputError, match=r"found (content that differs|\d+ bytes instead)"
    ):
        _read_all(db)


def test_read__parts_of_an_object_are_compared_too(db):
    """Whatever changes after an object was opened, or read in part, is found."""
    tree = db.read("capture", "A1")
    samples = tree["samples/reflectance_sample"]
    few = zarr.open_array(
        VerifiedStore(db.place, db.record("capture", "A1")),
        path="samples/reflectance_sample",
        mode="r",
    )
    assert few[3:5].shape == (2, 3, 2, 3)
    (shard,) = (
        p for p in _chunks(db) if "reflectance_sample" in p.parts and p.parts[-4] == "0"
    )
    _flip(shard, shard.stat().st_size // 3)
    with pytest.raises(InputError, match="found content that differs"):
        _ = few[3:5]
    with pytest.raises(InputError, match="found content that differs"):
        samples[:2].compute()


def _flipped_block(content, number):
    at = number * BLOCK_BYTES + BLOCK_BYTES // 3
    return content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]


def _exchanged_blocks(content, number):
    begin, end = number * BLOCK_BYTES, (number + 1) * BLOCK_BYTES
    block, following = content[begin:end], content[end : end + BLOCK_BYTES]
    return content[:begin] + following + block + content[end + BLOCK_BYTES :]


def test_read__every_block_of_an_object_is_compared(tmp_path):
    """Chunks in blocks that did not change are still read."""
    n = 350_000
    values = np.random.default_rng(7).random((n, 3), np.float32)
    with Database(tmp_path).stage("capture", "A1") as staged:
        staged.write({"surfels": dataset({"surfel_position": values})})
        record = staged.commit({})
    db = Database(tmp_path)
    file = tmp_path / record.path / "surfels/surfel_position/c/0/0"
    content = file.read_bytes()
    blocks = -(-len(content) // BLOCK_BYTES)
    assert blocks == 4
    array = zarr.open_array(
        VerifiedStore(db.place, record), path="surfels/surfel_position", mode="r"
    )
    starts = range(0, n, BLOCK_SURFELS)
    damaged = [(_flipped_block, number) for number in range(blocks - 1)]
    damaged += [(_exchanged_blocks, number) for number in range(blocks - 2)]
    for damage, number in damaged:
        file.write_bytes(damage(content, number))
        refused = 0
        for start in starts:
            part = slice(start, start + BLOCK_SURFELS)
            try:
                np.testing.assert_array_equal(array[part], values[part])
            except InputError:
                refused += 1
        assert len(starts) // 8 < refused < len(starts)
        with pytest.raises(InputError, match="restore this file"):
            db.read("capture", "A1")["surfels/surfel_position"].load()
        assert len(db.verify()) == 1
    # the index of the chunks, which every read needs
    file.write_bytes(content[:-9] + bytes([content[-9] ^ 1]) + content[-8:])
    for start in starts:
        with pytest.raises(InputError, match="found content that differs"):
            array[start : start + 1]
    # an object that is cut after it was opened
    file.write_bytes(content[: 2 * BLOCK_BYTES])
    with pytest.raises(InputError, match="found content that differs"):
        array[-1]
    file.write_bytes(content)
    np.testing.assert_array_equal(array[:], values)


@pytest.mark.parametrize("scheduler", ["synchronous", "threads"])
def test_read__an_error_reaches_the_caller_through_any_scheduler(db, scheduler):
    for file in _chunks(db):
        _flip(file, file.stat().st_size // 2)
    with (
        dask.config.set(scheduler=scheduler),
        pytest.raises(InputError, match="restore this file from a backup"),
    ):
        db.read("capture", "A1")["surfels/surfel_area"].mean().compute()


def test_read__links_and_foreign_files_are_not_followed(db):
    secret = db.root.parent / "secret"
    (chunk, *_) = _chunks(db)
    secret.write_bytes(chunk.read_bytes())
    chunk.unlink()
    chunk.symlink_to(secret)
    with pytest.raises(InputError, match="must be as it was committed"):
        db.read("capture", "A1")
    chunk.unlink()
    chunk.write_bytes(secret.read_bytes())
    (db.root / db.record("capture", "A1").path / "surfels/stray").mkdir()
    (db.root / db.record("capture", "A1").path / "surfels/stray/zarr.json").write_text(
        "{}"
    )
    assert "stray" not in db.read("capture", "A1")["surfels"].to_dataset()
    assert any("an unknown file" in str(fault) for fault in db.verify())


@pytest.mark.parametrize("change", [b"{}", b"", None])
def test_read__reports_a_damaged_manifest(db, change):
    manifest = db.root / db.record("capture", "A1").beside("manifest")
    manifest.write_bytes(change) if change is not None else manifest.unlink()
    with pytest.raises(
        InputError, match=r"manifest.json: a version must be as it was committed"
    ):
        db.read("capture", "A1")
    assert "manifest.json" in str(db.verify()[0])


def test_read__says_that_a_manifest_has_another_layout(db, monkeypatch):
    """As in a database of an earlier commit: its digest is right."""
    content = b'{"zarr.json": ["0f", 5]}'
    monkeypatch.setattr("skindb.store.verified.read_beside", lambda *_: content)
    with pytest.raises(InputError, match=r"another release.*compute the version again"):
        db.read("capture", "A1")


def test_verified_store__is_small_in_another_process(db):
    store = VerifiedStore(db.place, db.record("capture", "A1"))
    # dask copies stores for names
    with mock.patch("skindb.store.verified.read_manifest", side_effect=AssertionError):
        again = pickle.loads(pickle.dumps(store))
    assert len(pickle.dumps(store)) < 6000
    assert again.files == store.files
    with pytest.raises(ValueError, match="read-only"):
        zarr.open_group(store, mode="a").create_array("x", shape=(1,), dtype="f4")


def test_stage__tables_are_kept_beside_the_version_and_verified(db):
    tables = dataset(
        {"region_area": [1.0, np.nan]}, coords={"region": ["face", "nose"]}
    )
    with db.stage("model", "A1") as staged:
        staged.write({"surfels": dataset({"surfel_area": np.ones(3)})}, tables=tables)
        record = staged.commit({})
    assert db.tables(record).equals(tables)
    assert record.contents["tables"]["labels"] == {"region": ["face", "nose"]}
    assert db.verify() == []
    _flip(db.root / record.beside("tables"), 12)
    assert "tables.json" in str(db.verify()[0])
    with pytest.raises(
        InputError, match=r"tables\.json: a version must be as it was committed"
    ):
        db.tables(record)
