"""Versions committed with metadata of impossible sizes; records of later versions; clocks."""

from __future__ import annotations

import json
import resource
from collections import Counter

import pytest
from stored import commit, groups

from skindb.errors import InputError
from skindb.store import Database
from skindb.store.verified import array_of, metadata_fault

AREA = "surfels/surfel_area/zarr.json"


def _nested(depth: int) -> dict:
    codec = {"name": "bytes", "configuration": {"endian": "little"}}
    for _ in range(depth):
        inner = {
            "chunk_shape": [1],
            "codecs": [codec],
            "index_codecs": [],
            "index_location": "end",
        }
        codec = {"name": "sharding_indexed", "configuration": inner}
    return codec


HOSTILE = {
    "absurd shape": (
        {"shape": [10**12]},
        "a shape .* with .* chunks, but 1 chunk files",
    ),
    "absurd number of dims": ({"shape": [1] * 30}, r"a shape .* with chunks \[10\]"),
    "absurd chunk": (
        {"chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [2**40]}}},
        "chunks of 4.4e",
    ),
    "shape and chunk": (
        {
            "shape": [2**40],
            "chunk_grid": {
                "name": "regular",
                "configuration": {"chunk_shape": [2**40]},
            },
        },
        "chunks of 4.4e",
    ),
    "negative shape": (
        {"shape": [-5]},
        "a shape must be a list of non-negative integers",
    ),
    "empty chunk": (
        {"chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [0]}}},
        r"a shape .* with chunks \[0\]",
    ),
    "huge elements": (
        {
            "data_type": {
                "name": "fixed_length_utf32",
                "configuration": {"length_bytes": 2**40},
            }
        },
        "elements of the type .*fixed_length_utf32",
    ),
    "shards nested deeply": (
        {"codecs": [_nested(60)]},
        "levels of nested brackets",
    ),
}


def _commit_hostile(root, change: dict, take: str = "A1") -> None:
    """Commit a version whose metadata were changed before they were sealed."""
    with Database(root).stage("capture", take) as stage:
        stage.write(groups())
        write_metadata = stage._write_metadata

        def write_hostile_metadata(attrs: dict) -> None:
            write_metadata(attrs)
            for path in (root / stage.path).rglob("zarr.json"):
                content = json.loads(path.read_text())
                if path == root / stage.path / AREA:
                    content |= change
                else:
                    _change_copies(content, change)
                path.write_text(json.dumps(content))

        stage._write_metadata = write_hostile_metadata
        stage.commit({"consent_scope": ["fit", "statistics"], "subject": take})


def _change_copies(content: object, change: dict) -> None:
    """Change the copies of the metadata of the array in those of its groups."""
    if not isinstance(content, dict):
        return
    for name, node in content.items():
        if name.rpartition("/")[2] == AREA.split("/")[-2]:
            node |= change
        else:
            _change_copies(node, change)


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE)
def test_read__metadata_that_promise_too_much_are_refused_before_allocation(
    tmp_path, name
):
    change, found = HOSTILE[name]
    _commit_hostile(tmp_path, change)
    commit(tmp_path, 2.0, take="B2")
    db = Database(tmp_path)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(
        InputError,
        match=rf"zarr.json: the metadata of an array must .* found .*{found}",
    ):
        db.read("capture", "A1").load()
    faults = [str(fault) for fault in db.verify()]
    assert len(faults) == 1
    assert "zarr.json: the metadata of an array must match its files" in faults[0]
    # the rest stays readable
    assert float(db.read("capture", "B2")["surfels/surfel_area"][3]) == 2.0
    assert list(db.table().index) == ["A1", "B2"]
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # kB


def test_metadata_fault__none_in_what_skindb_writes(tmp_path):
    record = commit(tmp_path)
    files = json.loads((tmp_path / record.beside("manifest")).read_text())
    chunks = Counter(map(array_of, files))
    for name in [name for name in files if name.endswith("zarr.json")]:
        content = (tmp_path / record.path / name).read_bytes()
        node = name.removesuffix("zarr.json").rstrip("/")
        assert metadata_fault(content, node, chunks) == ""


@pytest.mark.parametrize("years", [-1, 1])
def test_commit__a_clock_that_jumps_by_a_year_changes_no_order(
    tmp_path, monkeypatch, years
):
    import skindb.store.stage as module

    commit(tmp_path, 1.0)
    now = module.datetime.now

    class Jumped(module.datetime):
        @classmethod
        def now(cls, tz=None):
            return now(tz).replace(year=now(tz).year + years)

    monkeypatch.setattr(module, "datetime", Jumped)
    commit(tmp_path, 2.0)
    monkeypatch.undo()
    commit(tmp_path, 3.0)
    db = Database(tmp_path)
    assert [record.generation for record in db.history("capture", "A1")] == [1, 2, 3]
    assert float(db.read("capture", "A1")["surfels/surfel_area"][3]) == 3.0
    assert db.verify() == []
    assert db.garbage() == []


def test_read__a_record_of_a_later_schema_hides_nothing_else(tmp_path):
    commit(tmp_path, schema_version=99)
    commit(tmp_path, 2.0, take="B2")
    db = Database(tmp_path)
    with pytest.raises(
        InputError, match="a schema of format 99; update skindb if that is a later one"
    ):
        db.read("capture", "A1")
    assert len(db.verify()) == 1
    assert float(db.read("capture", "B2")["surfels/surfel_area"][3]) == 2.0
