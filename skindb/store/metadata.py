"""Checks of the metadata of a stored array before memory is allocated for it."""

from __future__ import annotations

import math
import re
from typing import Any

from skindb.store.record import json_object

DTYPES = {  # bytes per element; that of a string is a reference
    "bool": 1,
    "int8": 1,
    "int16": 2,
    "int32": 4,
    "int64": 8,
    "uint8": 1,
    "uint16": 2,
    "uint32": 4,
    "uint64": 8,
    "float16": 2,
    "float32": 4,
    "float64": 8,
    "string": 16,
}
# in memory; samples of 4,096 surfels with 300 lights and 32 cameras have 0.24 GB
MAX_CHUNK_BYTES = 1 << 32
MAX_DIMS = 8
MAX_CODECS = 8  # of an array, and of the chunks inside a shard; skindb writes three
SHARDING = "sharding_indexed"


def metadata_faults(content: bytes, chunks: int) -> str:
    """Description of what is wrong with a committed zarr.json; empty if it is valid.

    Parameters
    ----------
    content
        Content of the file.
    chunks
        Number of chunk files of the array; skindb writes every chunk, including those
        that contain only zeros.
    """
    try:
        meta = json_object(content)
        if meta.get("node_type") != "array":
            return ""
        return _array_faults(meta, chunks)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        return f"invalid metadata ({type(error).__name__}: {error})"


def _array_faults(meta: dict[str, Any], chunks: int) -> str:
    dtype = meta["data_type"]
    if not isinstance(dtype, str) or dtype not in DTYPES:
        return f"elements of the type {str(dtype)[:80]}"
    shape = _lengths(meta["shape"])
    chunk = _lengths(meta["chunk_grid"]["configuration"]["chunk_shape"])
    if len(shape) != len(chunk) or len(shape) > MAX_DIMS or 0 in chunk:
        return f"a shape {list(shape)} with chunks {list(chunk)}"
    if (size := math.prod(chunk) * DTYPES[dtype]) > MAX_CHUNK_BYTES:
        return f"chunks of {size:.3g} bytes, more than the maximum of {MAX_CHUNK_BYTES:.3g}"
    promised = math.prod(
        -(-length // part) for length, part in zip(shape, chunk, strict=True)
    )
    if promised != chunks:
        return f"a shape {list(shape)} with {promised} chunks, but {chunks} chunk files"
    return _codec_faults(meta["codecs"], depth=0)


def _codec_faults(codecs: list[dict[str, Any]], depth: int) -> str:
    if len(codecs) > MAX_CODECS or depth > 1:
        return "more codecs than skindb writes"
    inner = [
        one["configuration"]["codecs"] for one in codecs if one["name"] == SHARDING
    ]
    return next(
        (fault for those in inner if (fault := _codec_faults(those, depth + 1))), ""
    )


def _lengths(value: object) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(
        isinstance(one, int) and one >= 0 for one in value
    ):
        raise ValueError("a shape must be a list of non-negative integers")
    return tuple(value)


def array_of(key: str) -> str:
    """Path of the array to which a chunk file belongs; empty for other files."""
    match = re.fullmatch(r"(.+)/c(/[0-9]+)*", key)
    return match[1] if match else ""
