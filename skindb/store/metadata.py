"""What the metadata of a stored array may promise: checked before anything of that size is allocated."""

from __future__ import annotations

import math
import re
from typing import Any

from skindb.store.record import json_object

DTYPES = {  # bytes of an element; a text is a reference to one
    "bool": 1, "int8": 1, "int16": 2, "int32": 4, "int64": 8, "uint8": 1, "uint16": 2, "uint32": 4, "uint64": 8,
    "float16": 2, "float32": 4, "float64": 8, "string": 16,
}  # fmt: skip
MAX_CHUNK_BYTES = 1 << 32  # in memory; the samples of 4,096 surfels under 300 lights and 32 cameras are 0.24 GB
MAX_DIMS = 8
MAX_CODECS = 8  # of an array, and of the chunks inside a shard: skindb writes three
SHARDING = "sharding_indexed"


def metadata_faults(content: bytes, chunks: int) -> str:
    """What is wrong with a zarr.json that was committed like this; empty if nothing is.

    Parameters
    ----------
    content
        Of the file.
    chunks
        Number of files with chunks of the array; skindb writes every one, also those that hold nothing but zeros.
    """
    try:
        meta = json_object(content)
        if meta.get("node_type") != "array":
            return ""
        return _array_faults(meta, chunks)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        return f"metadata that cannot be used ({type(error).__name__}: {error})"


def _array_faults(meta: dict[str, Any], chunks: int) -> str:
    dtype = meta["data_type"]
    if not isinstance(dtype, str) or dtype not in DTYPES:
        return f"elements of the type {str(dtype)[:80]}"
    shape, chunk = _lengths(meta["shape"]), _lengths(meta["chunk_grid"]["configuration"]["chunk_shape"])
    if len(shape) != len(chunk) or len(shape) > MAX_DIMS or 0 in chunk:
        return f"{len(shape)} dims in chunks of {len(chunk)}"
    if (size := math.prod(chunk) * DTYPES[dtype]) > MAX_CHUNK_BYTES:
        return f"chunks of {size:.3g} bytes, at most {MAX_CHUNK_BYTES:.3g} are read"
    promised = math.prod(-(-length // part) for length, part in zip(shape, chunk, strict=True))
    if promised != chunks:
        return f"a shape {list(shape)} of {promised} chunks, of which {chunks} are there"
    return _codec_faults(meta["codecs"], depth=0)


def _codec_faults(codecs: list[dict[str, Any]], depth: int) -> str:
    if len(codecs) > MAX_CODECS or depth > 1:
        return "more codecs than skindb writes"
    inner = [one["configuration"]["codecs"] for one in codecs if one["name"] == SHARDING]
    return next((fault for those in inner if (fault := _codec_faults(those, depth + 1))), "")


def _lengths(value: object) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(isinstance(one, int) and one >= 0 for one in value):
        raise ValueError("a shape is a list of lengths")
    return tuple(value)


def array_of(key: str) -> str:
    """Path of the array that the file of a chunk belongs to; empty for other files."""
    match = re.fullmatch(r"(.+)/c(/[0-9]+)*", key)
    return match[1] if match else ""
