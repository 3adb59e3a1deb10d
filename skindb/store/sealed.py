"""Small JSON files with seals, and what is raised if one is damaged."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

from skindb.errors import Fault, InputError
from skindb.files import json_depth
from skindb.limits import MAX_JSON_DEPTH
from skindb.store.place import UnavailableError

T = TypeVar("T")
# what reading or parsing a damaged file raises
DAMAGE = (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError)


def seal_of(body: Mapping[str, Any]) -> str:
    """SHA-256 digest of a JSON object with sorted keys."""
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()


def sealed(body: Mapping[str, Any]) -> bytes:
    """Content of a file with a JSON object and its seal."""
    return json.dumps({**body, "seal": seal_of(body)}).encode()


def json_object(content: bytes) -> dict[str, Any]:
    """The JSON object in a small file of the database; `ValueError` for any other content."""
    text = content.decode()
    if json_depth(text) > MAX_JSON_DEPTH:
        raise ValueError(f"more than {MAX_JSON_DEPTH} levels of nested brackets")
    body = json.loads(text)
    if not isinstance(body, dict):
        raise ValueError("content that is not a JSON object")
    return body


def sealed_object(content: bytes) -> dict[str, Any]:
    """The JSON object in a file, without its seal; `ValueError` if the seal differs."""
    body = json_object(content)
    if body.pop("seal", None) != seal_of(body):
        raise ValueError("content that does not match its seal")
    return body


def reason_of(error: Exception) -> str:
    """What is wrong with a file that raised an error, as shown in messages."""
    if isinstance(error, InputError):
        return error.faults[0].found
    return getattr(error, "strerror", None) or str(error)


@contextmanager
def damage_as_fault(location: str, rule: str, cure: str) -> Iterator[None]:
    """Context that raises an `InputError` in place of everything that a damaged file raises."""
    try:
        yield
    except UnavailableError:
        raise
    except DAMAGE as error:
        raise InputError(Fault(location, rule, reason_of(error), cure)) from None


def intact_or_none(read: Callable[[], T]) -> T | None:
    """What a function reads; None if a file is missing or damaged."""
    try:
        return read()
    except UnavailableError:
        raise
    except DAMAGE:
        return None


def collect_faults(read: Callable[[], T], faults: list[Fault]) -> T | None:
    """What a function reads; None if it fails, and its faults are added to `faults`."""
    try:
        return read()
    except UnavailableError:
        raise
    except InputError as error:
        faults.extend(error.faults)
        return None
