"""The files of a backup: contents under their digests, states of a database, and the
withdrawals that were applied.

| key | content |
|---|---|
| `files/<2 digits>/<digest>` | a file of the database, under the SHA-256 digest of its content |
| `states/<number>.json` | a state: digests of records and small files; manifests have the others |
| `secret`, `withdrawn/` | as in the database; `withdrawn/backup.json` keeps other commands away |
| `leases/`, `staging/` | as in a database |
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import TypeVar

from skindb.errors import Fault, attempt, input_error, require, require_none
from skindb.store.bucket import place_at
from skindb.store.erasure import remainder_of
from skindb.store.lease import Lease
from skindb.store.log import tombstone_content, tombstone_of
from skindb.store.markers import (
    BACKUP,
    ENTRY,
    WITHDRAWN,
    Markers,
    marker_faults,
    read_markers,
    require_secret,
    withdrawn_hashes,
)
from skindb.store.place import (
    KIND,
    TAKE,
    TIME_HEX,
    Place,
    in_parallel,
)
from skindb.store.record import (
    DIGEST,
    Record,
    damage_as_fault,
    record_from_json,
    require_format,
    seal_of,
    sealed_object,
)
from skindb.store.stale import (
    REQUEST_NAME,
    REQUESTS,
    Request,
    request_from_json,
)
from skindb.store.verified import Manifest, manifest_from_json

FORMAT = 1
FILES = "files"
STATES = "states"
CONTENT = re.compile(r"[0-9a-f]{2}/([0-9a-f]{64})")
STATE = re.compile(r"([0-9]{6})\.json")
RECORD_KEY = re.compile(rf"log/({KIND})/({TAKE})/[0-9]{{8}}\.json")
# keys of the files that a state names; a name from a file never leads elsewhere
STATE_KEY = re.compile(
    rf"{RECORD_KEY.pattern}|data/{KIND}/{TAKE}/{TIME_HEX}\.names\.json|tombstones/[0-9a-f]{{64}}\.json"
    rf"|{REQUESTS}/{REQUEST_NAME}|audit(/[A-Za-z0-9_-][A-Za-z0-9_.-]{{0,80}}){{1,3}}"
)
AS_WRITTEN = "a file of a backup must be as it was written"
CURE_CONTENT = "remove it, then run skindb backup again; or restore another state"
CURE_STATE = "remove it; other states can be restored"
THREADS = 8  # that read and write files; a server answers many requests in parallel
T = TypeVar("T")
R = TypeVar("R")
# key in the database, digest and, if it is known, size in bytes
Item = tuple[str, str, int | None]


# an event: the database or the backup was changed, and the caller starts again
class Changed(Exception):  # noqa: N818
    """A version or a subject was removed while a backup was written."""


@dataclass(frozen=True)
class State:
    """What a database held at one moment."""

    number: int
    created: str  # ISO 8601 in UTC
    software_version: str
    versions: int
    # seal of the withdrawals without whose subjects the state was written
    withdrawals: str
    files: dict[str, str] = field(repr=False)  # key in the database -> digest

    @property
    def key(self) -> str:
        """Key of its file."""
        return f"{STATES}/{self.number:06d}.json"

    def items(self, top: str = "") -> list[Item]:
        """Its small files whose keys begin with `top`, ascending."""
        return [
            (key, digest, None)
            for key, digest in sorted(self.files.items())
            if key.startswith(top)
        ]

    def content(self) -> bytes:
        """Content of its file."""
        body = asdict(self) | {"format": FORMAT}
        return json.dumps(
            body | {"seal": seal_of(body)}, separators=(",", ":")
        ).encode()


class Archive:
    """A backup.

    Parameters
    ----------
    place
        Location of the backup.
    """

    def __init__(self, place: Place) -> None:
        place.is_unlocked = True
        self.place = place

    def require(self) -> None:
        """Raise an `InputError` unless there is a backup, whose withdrawals are as they
        were written.
        """
        if self.place.file_type(f"{WITHDRAWN}/{BACKUP}") != "file":
            finding = "another folder" if self.place.names() else "nothing"
            raise input_error(
                self.place.name,
                "must be a backup",
                finding,
                "give the folder of skindb backup",
            )
        require_none(marker_faults(self.place))

    def require_of(self, place: Place) -> None:
        """Raise an `InputError` unless it is a backup of this database."""
        require(
            require_secret(place) == require_secret(self.place),
            self.place.name,
            "all states of a backup must be of the same database",
            "a backup of another database",
            "give another folder",
        )

    def adopt(self, place: Place) -> Markers:
        """Copy the withdrawals of a database, which must be that of the backup; returns
        those of the backup.
        """
        self.require_of(place)
        for name in place.sizes(WITHDRAWN):
            key = f"{WITHDRAWN}/{name}"
            if ENTRY.fullmatch(name) and not self.place.file_type(key):
                self.place.create(key, place.read_small(key))
        # from now on, no suspended writer adds a content of a withdrawn subject, see
        # `markers`
        self.place.sweep()
        return read_markers(self.place)

    def numbers(self) -> list[int]:
        """Numbers of the states, ascending."""
        return [
            int(match[1])
            for name in self.place.children(STATES)
            if (match := STATE.fullmatch(name))
        ]

    def state(self, number: int) -> State:
        """A state; `InputError` if it does not exist or is damaged."""
        key = f"{STATES}/{number:06d}.json"
        numbers = self.numbers()
        require(
            number in numbers,
            self.place.name,
            f"state {number} must exist",
            f"states {', '.join(map(str, numbers)) or 'none'}",
            "see skindb restore --list",
        )
        with damage_as_fault(self.place.where(key), AS_WRITTEN, CURE_STATE):
            body = sealed_object(self.place.read_small(key))
            require_format("state", body.pop("format"), FORMAT)
            if body["number"] != number:
                raise ValueError("another state")
            if not all(
                STATE_KEY.fullmatch(name) and re.fullmatch(DIGEST, digest)
                for name, digest in body["files"].items()
            ):
                raise ValueError("names that are not those of a database")
            return State(**body)

    def states(self) -> tuple[list[State], list[Fault]]:
        """All readable states, and the faults of the others."""
        faults: list[Fault] = []
        states = [
            attempt(faults, partial(self.state, number)) for number in self.numbers()
        ]
        return [state for state in states if state is not None], faults

    def contents(self) -> set[str]:
        """Digests of all contents."""
        return {
            match[1]
            for name in self.place.sizes(FILES)
            if (match := CONTENT.fullmatch(name))
        }

    def parsed(self, parse: Callable[[bytes], R], item: Item) -> R:
        """What a function makes of the content of a file of the database, which is
        compared with its digest.
        """
        key = content_key(item[1])
        with damage_as_fault(self.place.where(key), AS_WRITTEN, CURE_CONTENT):
            return parse(read_item(self.place, key, item))

    def put(self, content: bytes, digest: str, guard: Callable[[], None]) -> None:
        """Write a content under its digest, unless the guard raises."""
        key = content_key(digest)
        try:
            self.place.create(key, content, guard=guard)
        except Changed:
            # in a bucket, where the guard is called afterwards too
            self.place.remove(key)
            raise

    def guard(self, markers: Markers) -> Callable[[], None]:
        """Function that raises `Changed` if a subject was withdrawn from the backup
        since these markers were read.
        """

        def check() -> None:
            if withdrawn_hashes(self.place.sizes(WITHDRAWN)) != markers.hashes:
                raise Changed

        return check

    def records(self, state: State, faults: list[Fault]) -> dict[str, Record]:
        """The records of a state by their keys, ascending; faults of others are added
        to `faults`.
        """
        read = intact(self._record, state.items("log/"), faults)
        return {key: record for (key, _, _), record in read}

    def requests(self, state: State, faults: list[Fault]) -> list[Request]:
        """The requests of a state; faults of others are added to `faults`."""
        parse = partial(self.parsed, request_from_json)
        read = intact(parse, state.items(f"{REQUESTS}/"), faults)
        return [request for _, request in read]

    def version_items(self, record: Record) -> list[Item]:
        """All files of a version except for its record; `InputError` if its manifest is damaged."""
        beside = (record.beside("manifest"), record.manifest, None)
        return items_of(record, self.parsed(manifest_from_json, beside))

    def uses(self, state: State, seen: set[str], faults: list[Fault]) -> list[Item]:
        """Every content that a state needs.

        Parameters
        ----------
        state
            State.
        seen
            Digests of records whose versions are skipped; those of this state are added.
        faults
            List to which faults of records and manifests are added.
        """
        records = self.records(state, faults)
        fresh = [
            record for key, record in records.items() if state.files[key] not in seen
        ]
        seen |= {state.files[key] for key in records}
        items = state.items()
        for _, those in intact(self.version_items, fresh, faults):
            items += those
        return items

    def prune(self, contents: set[str], keep: set[str], lease: Lease) -> int:
        """Remove contents that no state needs; returns their number.

        Parameters
        ----------
        contents
            Contents that were there before the states were read. Later ones may be
            those of another run that has taken over the lease of this one.
        keep
            Contents that are needed.
        lease
            Lease under which the backup is written, which is checked before each removal.
        """
        unused = sorted(contents - keep)
        for digest in unused:
            lease.check()
            self.place.remove(content_key(digest))
        return len(unused)

    def _record(self, item: Item) -> Record:
        return self.parsed(lambda content: record_from_json(content, item[0]), item)


def backup_states(url: str) -> list[State]:
    """The states of the backup at a folder or bucket, oldest first; `InputError` if one
    is damaged.
    """
    archive = Archive(place_at(url))
    archive.require()
    states, faults = archive.states()
    require_none(faults)
    return states


def require_apart(backup: Place, database: Place) -> None:
    """Raise an `InputError` if a backup is inside its database, or the database inside
    the backup.
    """
    inner = backup.url(FILES).removesuffix(FILES)
    outer = database.url(FILES).removesuffix(FILES)
    require(
        not (inner.startswith(outer) or outer.startswith(inner)),
        backup.name,
        "a backup must not be inside its database, nor the database inside it",
        f"the database {database.name}",
        "give another folder",
    )


def read_item(place: Place, key: str, item: Item) -> bytes:
    """The content of a file; `ValueError` if it does not have the digest that is known."""
    name, digest, size = item
    content = place.read_small(key) if size is None else place.read(key, 0, size)
    if digest not in ("", hashlib.sha256(content).hexdigest()):
        raise ValueError(f"different content for {name}")
    return content


def content_key(digest: str) -> str:
    """Key of a content."""
    return f"{FILES}/{digest[:2]}/{digest}"


def items_of(record: Record, manifest: Manifest) -> list[Item]:
    """All files of a version except for its record."""
    items: list[Item] = [(record.beside("manifest"), record.manifest, None)]
    for name, file in manifest.items():
        items.append((f"{record.path}/{name}", file.digests.whole, file.size))
    if record.tables:
        items.append((record.beside("tables"), record.tables, None))
    return items


def seal_of_withdrawals(markers: Markers) -> str:
    """Seal of the withdrawals at one moment."""
    return seal_of({WITHDRAWN: sorted(markers.hashes)})


def surviving(
    records: Mapping[str, Record],
    requests: Iterable[Request],
    tombstones: Iterable[str],
    markers: Markers,
) -> tuple[dict[str, Record], dict[str, bytes]]:
    """Records without those of withdrawn subjects, and the requests and tombstones to be written.

    Parameters
    ----------
    records
        Records by their keys, ascending.
    requests, tombstones
        Requests, and keys of the tombstones. A record with a tombstone was about to be removed.
    markers
        Withdrawals.
    """
    tombstoned = {*tombstones}
    present = {
        key: record
        for key, record in records.items()
        if tombstone_of(record.seal) not in tombstoned
    }
    remaining, removed, needed = remainder_of(present.values(), requests, markers)
    seals = {record.seal for record in remaining}
    additions = {request.key: request.content() for request in needed}
    for record in removed:
        additions[tombstone_of(record.seal)] = tombstone_content(record)
    return {
        key: record for key, record in present.items() if record.seal in seals
    }, additions


def other_files(
    files: Mapping[str, str], records: Mapping[str, Record]
) -> dict[str, str]:
    """Those of the small files of a state that belong to these records or to no version."""
    names = {record.beside("names") for record in records.values()}
    return {
        key: digest
        for key, digest in files.items()
        if key in names or key.startswith(("audit/", "tombstones/"))
    }


def intact(
    function: Callable[[T], R], values: Iterable[T], faults: list[Fault]
) -> list[tuple[T, R]]:
    """Values and the results of a function that waits for files; where it fails, its
    faults are added to `faults`.
    """

    def read_one(value: T) -> tuple[R | None, list[Fault]]:
        damage: list[Fault] = []
        return attempt(damage, partial(function, value)), damage

    values = list(values)
    read = []
    for value, (result, damage) in zip(
        values, in_parallel(read_one, values, THREADS), strict=True
    ):
        faults += damage
        if result is not None:
            read.append((value, result))
    return read
