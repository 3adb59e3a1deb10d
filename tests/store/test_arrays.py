"""Arrays that are decoded straight into the result, against zarr."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
import zarr
from zarr.codecs import BloscCodec, TransposeCodec
from zarr.storage import LocalStore

from skindb.schema import dataset
from skindb.schema.label import BLOCK_SURFELS
from skindb.store import Database
from skindb.store import stage as stage_module
from skindb.store.arrays import ShardedArray, _is_direct
from skindb.store.verified import VerifiedStore

N = 2 * BLOCK_SURFELS + 300
SAMPLES = "samples/reflectance_sample"
KEYS = (
    (slice(None),),
    (slice(0, BLOCK_SURFELS),),
    (slice(BLOCK_SURFELS - 3, BLOCK_SURFELS + 700), slice(1, 3)),
    (slice(5, 5),),
    (slice(N - 1, N),),
    (slice(7, None, 1000), 1, slice(None), [2, 0]),
    (slice(None, None, -977),),
    (-1,),
    (BLOCK_SURFELS,),
    ([N - 1, 3, BLOCK_SURFELS, 3],),
    ([], slice(None)),
    ([4, 8000, 12], [3, 0], 1, slice(0, 2)),
)


@pytest.fixture
def written(tmp_path, monkeypatch):
    """A version with two objects of samples, and its samples by zarr alone."""
    monkeypatch.setattr(stage_module, "MAX_OBJECT_BYTES", 1)
    rng = np.random.default_rng(3)
    samples = rng.random((N, 4, 5, 3), np.float32).astype(np.float16)
    with Database(tmp_path).stage("capture", "A1") as stage:
        stage.write({"samples": dataset({"reflectance_sample": samples})})
        record = stage.commit({})
    path = tmp_path / record.path
    plain = zarr.open_array(LocalStore(path, read_only=True), path=SAMPLES, mode="r")
    return Database(tmp_path), samples, plain


def _selected(values, key):
    """By one dim after the other, as xarray selects."""
    for dim, index in reversed([*enumerate(key)]):
        index = np.asarray(index, int) if isinstance(index, list) else index
        values = values[(slice(None),) * dim + (index,)]
    return values


def test_array__equals_zarr_for_every_kind_of_selection(written):
    db, samples, plain = written
    np.testing.assert_array_equal(plain[:], samples)
    lazy = db.read("capture", "A1")[SAMPLES]
    assert lazy.chunks[0] == (BLOCK_SURFELS, BLOCK_SURFELS, 300)
    for key in KEYS:
        chosen = dict(zip(lazy.dims, key, strict=False))
        got = lazy.isel(chosen).values
        assert got.dtype == np.float16
        np.testing.assert_array_equal(got, _selected(samples, key), err_msg=str(key))


def test_array__every_variable_of_a_group_is_decoded_directly(tmp_path):
    """Of any type and shape, with chunks that are not full, and through any scheduler."""
    rng = np.random.default_rng(4)
    arrays = {
        "surfel_position": rng.random((N, 3)).astype(np.float32),
        "region_mask": rng.integers(0, 2, (N, 2)).astype(np.int8),
        "sample_count": rng.integers(0, 150, N).astype(np.int32),
        "light_visible_fraction": rng.random((N, 150)).astype(np.float16),
    }
    ds = dataset(arrays)
    with Database(tmp_path).stage("capture", "A1") as stage:
        stage.write({"surfels": ds})
        record = stage.commit({})
    group = xr.open_zarr(tmp_path / record.path, group="surfels", chunks=None)
    assert all(_is_direct(group[name].encoding) for name in arrays)
    tree = Database(tmp_path).read("capture", "A1")
    for scheduler in ("synchronous", "threads"):
        got = tree["surfels"].to_dataset().compute(scheduler=scheduler)
        xr.testing.assert_identical(got, ds)


@pytest.mark.parametrize(
    "layout",
    [
        {"filters": [TransposeCodec(order=(3, 2, 1, 0))]},
        {"compressors": None},
        {"serializer": zarr.codecs.BytesCodec(endian="big")},
        {"chunks": (256, 2, 5, 3)},
        {"shards": None},
    ],
)
def test_array__other_codecs_are_left_to_zarr(tmp_path, layout):
    options = {
        "chunks": (256, 4, 5, 3),
        "shards": (1024, 4, 5, 3),
        "compressors": [BloscCodec()],
    } | layout
    root = zarr.create_group(tmp_path / "x")
    array = root.create_array(
        "x",
        shape=(1024, 4, 5, 3),
        dtype="f2",
        dimension_names=[*"abcd"],
        fill_value=0,
        **options,
    )
    array[:] = 1
    opened = xr.open_zarr(tmp_path / "x", chunks=None, consolidated=False)
    assert not _is_direct(opened["x"].encoding)


def test_array__an_object_is_read_once_and_a_part_by_its_chunks(written, monkeypatch):
    db, samples, plain = written
    reads = []
    read = type(db.place).read

    def noted(place, key, *part):
        content = read(place, key, *part)
        reads.append((key.rpartition("reflectance_sample/")[2], len(content)))
        return content

    lazy = db.read("capture", "A1")[SAMPLES]
    monkeypatch.setattr(type(db.place), "read", noted)
    lazy.load(scheduler="synchronous")
    assert sorted(name for name, _ in reads) == [f"c/{i}/0/0/0" for i in range(3)]
    reads.clear()
    store = VerifiedStore(db.place, db.record("capture", "A1"))
    array = ShardedArray(
        store, SAMPLES, samples.shape, samples.dtype, plain.chunks[0], plain.shards[0]
    )
    np.testing.assert_array_equal(array.rows(5, 9), samples[5:9])
    parts = -(-plain.shards[0] // plain.chunks[0])
    # the object, if it is one chunk; else its index and the chunk
    assert [name for name, _ in reads] == ["c/0/0/0/0"] * min(parts, 2)
