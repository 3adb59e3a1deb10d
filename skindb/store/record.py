"""Small JSON files with seals, and the records of the log among them: commits whose parts are
all validated before they are used.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any, TypeVar

from skindb.errors import InputError, UnavailableError, input_error
from skindb.files import Attributes, Json, json_depth
from skindb.limits import MAX_JSON_DEPTH
from skindb.schema import SCHEMA_VERSION, VARIABLES
from skindb.store.place import (
    GROUP,
    KIND,
    KINDS_WITHOUT_SUBJECT,
    TAKE,
    VERSION,
    subject_of,
)

T = TypeVar("T")
# what reading or parsing a damaged file raises
DAMAGE = (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError)
FORMAT = 4
DIGEST = "[0-9a-f]{64}"
DIGEST_OR_NONE = f"({DIGEST})?"
TEXT = "(?s).*"
AS_RECORDED = "the record must agree with the attributes of its version"
# a pattern of the whole text, [shape of each element], {key: shape of its value, which may
# be missing}, or a test
Shape = str | list[Any] | Json | Callable[[Any], bool]
Key = tuple[str, str, int]  # kind, take and generation of a version
MAX_COUNT = 1 << 53  # number of bytes, or of elements along a dim


def seal_of(body: Attributes) -> str:
    """SHA-256 digest of a JSON object with sorted keys."""
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()


def sealed(body: Attributes) -> bytes:
    """Content of a file with a JSON object and its seal."""
    return json.dumps({**body, "seal": seal_of(body)}).encode()


def json_object(content: bytes) -> Json:
    """The JSON object in a small file of the database; `ValueError` for any other content."""
    text = content.decode()
    if json_depth(text) > MAX_JSON_DEPTH:
        raise ValueError(f"more than {MAX_JSON_DEPTH} levels of nested brackets")
    body = json.loads(text)
    if not isinstance(body, dict):
        raise ValueError("content that is not a JSON object")
    return body


def sealed_object(content: bytes) -> Json:
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
        raise input_error(location, rule, reason_of(error), cure) from None


def intact_or_none(read: Callable[[], T]) -> T | None:
    """What a function reads; None if a file is missing or damaged."""
    try:
        return read()
    except UnavailableError:
        raise
    except DAMAGE:
        return None


@dataclass(frozen=True)
class Record:
    """One commit."""

    kind: str
    take: str
    generation: int
    path: str  # of the version, relative to the database
    created: str  # ISO 8601
    bytes: int
    provenance: Json = field(repr=False)
    # takes that the version refers to, directly or through its inputs, without its own
    names: tuple[str, ...] = field(default=(), repr=False)
    manifest: str = ""  # sha256 of the manifest
    tables: str = ""  # sha256 of the tables, if the version has any
    # group -> sizes, variables and short labels
    contents: Json = field(default_factory=dict, repr=False)
    previous: str = ""  # seal of the record before this one
    seal: str = field(default="", compare=False)

    @property
    def subjects(self) -> set[str]:
        """Subjects of the takes that the version is of or refers to."""
        return subjects_of(self.kind, self.take, self.names)

    @property
    def made_from(self) -> list[Json]:
        """See `inputs_in`."""
        return inputs_in(self.provenance)

    @property
    def key(self) -> Key:
        """Kind, take and generation."""
        return self.kind, self.take, self.generation

    @property
    def input_keys(self) -> list[Key]:
        """Kind, take and generation of each version that the provenance names as an input."""
        return [(one["kind"], one["take"], one["generation"]) for one in self.made_from]

    def is_outdated(self, capture: Record) -> bool:
        """Whether a model was made from earlier captures only than this one."""
        used = [number for kind, _, number in self.input_keys if kind == "capture"]
        return bool(used) and capture.generation not in used

    @property
    def title(self) -> str:
        """Kind, generation and take, as shown in messages."""
        return f"{self.kind} {self.generation} of {self.take}"

    def beside(self, suffix: str) -> str:
        """Key of the file `what` (manifest or tables) beside the version."""
        return f"{self.path.removesuffix('.zarr')}.{suffix}.json"

    def as_input(self) -> Json:
        """Reference to this version in the provenance of another one."""
        return {name: getattr(self, name) for name in INPUT}


def inputs_in(provenance: Attributes) -> list[Json]:
    """The versions that a provenance names as inputs; a capture names files instead."""
    inputs = provenance.get("inputs")
    return inputs if isinstance(inputs, list) else []


def own_takes(kind: str, take: str) -> set[str]:
    """The take of a version; none if its kind has none, such as a study, whose name may
    be that of a take.
    """
    return set() if kind in KINDS_WITHOUT_SUBJECT else {take}


def subjects_of(kind: str, take: str, names: Iterable[str]) -> set[str]:
    """Subjects of the takes that a version is of or names."""
    return {subject_of(name) for name in own_takes(kind, take).union(names)}


def record_to_json(record: Record) -> tuple[bytes, str]:
    """Content of the file of a record, and its seal."""
    body = {name: value for name, value in asdict(record).items() if name in FIELDS}
    body["format"] = FORMAT
    seal = seal_of(body)
    return json.dumps(body | {"seal": seal}, indent=1).encode(), seal


def record_from_json(content: bytes, key: str) -> Record:
    """The record in the file at `key`.

    Raises
    ------
    ValueError
        If the file is not as it was committed, is the record of another version, or was
        written by another release of skindb.
    """
    body = json_object(content)
    require_format("record", body.pop("format", None), FORMAT)
    seal = body.pop("seal", None)
    if seal != seal_of(body | {"format": FORMAT}):
        raise ValueError("content that does not match its seal")
    if body.keys() != FIELDS.keys():
        names = ", ".join(sorted(body))[:200]
        raise ValueError(f"fields that do not match its format: {names}")
    provenance = body["provenance"]
    # before the variables, which another schema may not have
    if isinstance(provenance, dict) and "schema_version" in provenance:
        require_format("schema", provenance["schema_version"], SCHEMA_VERSION)
    if wrong := [name for name, form in FIELDS.items() if not _fits(body[name], form)]:
        raise ValueError(f"invalid values of {', '.join(wrong)}")
    if not {"schema_version", "software_version"} <= provenance.keys():
        raise ValueError("a record without provenance")
    record = Record(**body | {"names": tuple(body["names"])}, seal=seal)
    folder = f"{record.kind}/{record.take}/"
    if f"log/{folder}{record.generation:08d}.json" != key:
        raise ValueError(f"the record of {record.title}")
    if not record.path.startswith(f"data/{folder}"):
        raise ValueError(f"the path of another take, {record.path}")
    return record


def require_format(what: str, found: object, expected: int) -> None:
    """Raise a `ValueError` if a file is of another format than this release writes."""
    if found != expected:
        raise ValueError(
            f"a {what} of format {found!r}; update skindb if that is a later one"
        )


def _is_count(value: object) -> bool:
    return type(value) is int and 0 <= value <= MAX_COUNT


def _fits(value: object, shape: Shape) -> bool:
    """Whether a value in a file has a shape."""
    if isinstance(shape, str):
        return isinstance(value, str) and re.fullmatch(shape, value) is not None
    if isinstance(shape, list):
        return isinstance(value, list) and all(_fits(one, shape[0]) for one in value)
    if isinstance(shape, dict):
        return isinstance(value, dict) and all(
            _fits(value[key], form) for key, form in shape.items() if key in value
        )
    return shape(value)


def _is_input(value: object) -> bool:
    return (
        isinstance(value, dict) and value.keys() >= INPUT.keys() and _fits(value, INPUT)
    )


def _are_contents(value: object) -> bool:
    return isinstance(value, dict) and all(
        _fits(name, GROUP) and _is_group(group) for name, group in value.items()
    )


def _is_group(value: object) -> bool:
    """Whether the description of a group has sizes for the dims of all variables, and
    labels of matching lengths.
    """
    if not isinstance(value, dict) or value.keys() != {"sizes", "variables", "labels"}:
        return False
    sizes = value["sizes"]
    names = value["variables"]
    return (
        all(map(_is_count, sizes.values()))
        and _fits(names, [VARIABLES.__contains__])
        and all(sizes.keys() >= {*VARIABLES[name].dims} for name in names)
        and all(
            _fits(labels, [_is_label]) and len(labels) == sizes.get(dim)
            for dim, labels in value["labels"].items()
        )
    )


def _is_label(value: object) -> bool:
    return isinstance(value, str | int | float)


INPUT: dict[str, Shape] = {
    "kind": KIND,
    "take": TAKE,
    "generation": _is_count,
    "seal": TEXT,
}
# parts of a provenance that skindb reads without opening the version
PROVENANCE: dict[str, Shape] = {
    "software_version": TEXT,
    # a capture names files
    "inputs": lambda value: isinstance(value, dict) or _fits(value, [_is_input]),
    "consent_scope": lambda value: value is None or _fits(value, [TEXT]),
    "calibrated_by": _is_input,
    "relative_exposure": lambda value: isinstance(value, float),
    "traits": {},
    "parameters": {},
    "status": {},
    "summary": {},
    "summary_parameters": {"digest": TEXT, "surfels": _is_count},
}
# fields of a record, beside its format and seal
FIELDS: dict[str, Shape] = {
    "kind": KIND,
    "take": TAKE,
    "generation": _is_count,
    "path": VERSION,
    "created": TEXT,
    "bytes": _is_count,
    "names": [TAKE],
    "provenance": PROVENANCE,
    "manifest": DIGEST,
    "tables": DIGEST_OR_NONE,
    "previous": DIGEST_OR_NONE,
    "contents": _are_contents,
}
