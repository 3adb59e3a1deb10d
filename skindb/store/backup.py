"""Backups of a database: consistent while others write, incremental, and without
withdrawn subjects.

A backup is written in attempts. An attempt lists the database until two lists agree, so
that the state is that of one moment. It removes contents that no state needs any more,
copies those that are missing, and creates the state last, unless a subject was
withdrawn meanwhile. If a version was removed meanwhile, the next attempt lists the
database again.
"""

import hashlib
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

from skindb import __version__
from skindb.clock import utc_time
from skindb.errors import Fault, input_error, require, require_none
from skindb.store.archive import (
    RECORD_KEY,
    STATE_KEY,
    Archive,
    Changed,
    Item,
    State,
    intact,
    items_of,
    other_files,
    read_item,
    require_apart,
    seal_of_withdrawals,
    surviving,
)
from skindb.store.lease import Lease
from skindb.store.log import read_record
from skindb.store.markers import (
    BACKUP,
    SECRET,
    WITHDRAWN,
    Markers,
    marker_faults,
    note_consents,
    note_withdrawals,
    read_markers,
)
from skindb.store.place import KINDS_OF_ONE_SUBJECT, RELEASE, Place
from skindb.store.record import Record, damage_as_fault
from skindb.store.stale import REQUESTS, read_requests
from skindb.store.verified import AS_COMMITTED, CURE, read_manifest

T = TypeVar("T")
MAX_LISTS = 100
MAX_ATTEMPTS = 20
# requests first, because they can appear and vanish again
LISTED = (REQUESTS, WITHDRAWN, "log", "tombstones", "audit")
Listing = dict[str, Hashable]  # key of a file -> identity


@dataclass(frozen=True)
class BackupReport:
    """A state that was written, and what was copied for it."""

    number: int
    versions: int
    copied: int  # number of contents
    present: int  # that were there already
    bytes: int  # that were copied
    removed: int  # contents that no state needed any more
    # files that could not be copied, and damaged files of the backup
    faults: tuple[Fault, ...] = ()


@dataclass(frozen=True)
class Draft:
    """A state to be written."""

    listing: Listing
    records: Mapping[str, Record]
    files: dict[str, str]  # see `State`
    items: list[Item]  # contents that are files of the database
    additions: dict[str, bytes]  # digest -> content that the database does not have
    faults: list[Fault]


def create_backup(
    place: Place, archive: Archive, *, verify: bool = False
) -> BackupReport:
    """Write a new state of a database to a backup, which is created if there is nothing.

    Parameters
    ----------
    place, archive
        Location of the database, and the backup.
    verify
        Also read the whole backup, and report every damaged file.

    Raises
    ------
    InputError
        If the database or the location of the backup cannot be used, or if another run
        writes to the backup.
    """
    _begin(place, archive)
    with Lease(archive.place, "backup", (RELEASE,), command="skindb backup") as lease:
        report = _repeated(lambda: _write_state(place, archive, lease), place)
    faults = (*report.faults, *(verify_archive(archive) if verify else ()))
    return replace(report, faults=tuple(dict.fromkeys(faults)))


def erase_from_archive(place: Place, archive: Archive, *, wait: float = 0.0) -> int:
    """Remove subjects who were withdrawn from a database from all states of a backup;
    returns the number of contents.

    Raises
    ------
    InputError
        If it is not a backup of this database, if a state is damaged, or if another run
        writes to it.
    """
    archive.require()
    command = "skindb withdraw"
    with Lease(
        archive.place, "backup", (RELEASE,), wait=wait, command=command
    ) as lease:

        def erase() -> int:
            markers = archive.adopt(place)
            contents = archive.contents()
            states, faults = _erased_states(archive, markers)
            require_none(faults)
            return archive.prune(contents, _needed(archive, states), lease)

        return _repeated(erase, place)


def verify_archive(archive: Archive) -> list[Fault]:
    """Read every content that a state needs, and return all faults of the backup."""
    archive.require()
    states, faults = archive.states()
    checked: set[str] = set()
    seen: set[str] = set()
    for state in states:
        items = {item[1]: item for item in archive.uses(state, seen, faults)}
        fresh = [items[digest] for digest in items.keys() - checked]
        checked |= items.keys()
        intact(partial(archive.parsed, bool), fresh, faults)
    return list(dict.fromkeys(faults))


def _repeated(step: Callable[[], T], place: Place) -> T:
    """The result of a step, which is repeated if something was removed meanwhile."""
    for _ in range(MAX_ATTEMPTS):
        try:
            return step()
        except Changed:
            continue
    raise input_error(
        place.name,
        "versions and subjects must not be removed all the time while a backup is written",
        f"changes in {MAX_ATTEMPTS} attempts",
        "run the command again",
    )


def _begin(place: Place, archive: Archive) -> None:
    """Create a backup, or require that there is one of this database."""
    if not place.file_type(SECRET):
        finding = "nothing" if place.names() is None else "a folder without its secret"
        raise input_error(
            place.name, "must be a database", finding, "give the folder of a database"
        )
    require_none(marker_faults(place))
    dest = archive.place
    require_apart(dest, place)
    if not dest.file_type(f"{WITHDRAWN}/{BACKUP}"):
        foreign = [
            name
            for name in dest.names() or []
            if name not in ("staging", SECRET, WITHDRAWN)
        ]
        require(
            not foreign,
            dest.name,
            "a backup needs an empty folder, or one with a backup",
            f"other files, such as {', '.join(foreign[:1])}",
            "give another folder",
        )
        dest.create(SECRET, place.read_small(SECRET))
        dest.create(f"{WITHDRAWN}/{BACKUP}", b"{}")
    archive.require()


def _write_state(place: Place, archive: Archive, lease: Lease) -> BackupReport:
    markers = archive.adopt(place)
    guard = archive.guard(markers)
    contents = archive.contents()
    states, faults = _erased_states(archive, markers)
    draft = _draft(place, markers)
    note_withdrawals(place)
    note_consents(place, draft.records.values())
    lease.require()
    digests = {digest for _, digest, _ in draft.items} | draft.additions.keys()
    removed = 0
    if not faults:  # otherwise it is unknown what the damaged state needs
        removed = archive.prune(contents, _needed(archive, states) | digests, lease)
    stored = archive.contents()
    missing = {item[1]: item for item in draft.items if item[1] not in stored}
    faults += draft.faults
    copy = partial(_copy, place, archive, guard)
    sizes = [size for _, size in intact(copy, missing.values(), faults)]
    for digest, content in draft.additions.items():
        archive.put(content, digest, guard)
    state = State(
        number=max(archive.numbers(), default=0) + 1,
        created=utc_time(),
        software_version=__version__,
        versions=len(draft.records),
        withdrawals=seal_of_withdrawals(markers),
        files=draft.files,
    )
    _require_unchanged(place, draft.listing, markers, faults)
    lease.require()
    if not archive.place.create(state.key, state.content(), guard=guard):
        raise Changed
    return BackupReport(
        state.number,
        state.versions,
        copied=len(sizes),
        present=len(digests & stored),
        bytes=sum(sizes),
        removed=removed,
        faults=tuple(faults),
    )


def _needed(archive: Archive, states: Iterable[State]) -> set[str]:
    """Digests of all contents of states."""
    seen: set[str] = set()
    return {
        digest for state in states for _, digest, _ in archive.uses(state, seen, [])
    }


def _erased_states(
    archive: Archive, markers: Markers
) -> tuple[list[State], list[Fault]]:
    """All states, from which withdrawn subjects were removed, and the faults of those
    that cannot be read.

    Records that cannot be read, and therefore cannot be restored, are removed from a state as well.
    """
    states, faults = archive.states()
    guard = archive.guard(markers)
    withdrawals = seal_of_withdrawals(markers)
    for number, state in enumerate(states):
        if state.withdrawals == withdrawals:
            continue
        tombstones = [key for key in state.files if key.startswith("tombstones/")]
        remaining, additions = surviving(
            archive.records(state, []), archive.requests(state, []), tombstones, markers
        )
        files = {key: state.files[key] for key in remaining} | other_files(
            state.files, remaining
        )
        for key, content in additions.items():
            files[key] = hashlib.sha256(content).hexdigest()
            archive.put(content, files[key], guard)
        changed = replace(
            state,
            files=files,
            versions=len(remaining),
            withdrawals=withdrawals,
        )
        archive.place.replace(state.key, changed.content(), guard=guard)
        states[number] = changed
    return states, faults


def _draft(place: Place, markers: Markers) -> Draft:
    """The state of a database at one moment, without withdrawn subjects."""
    listing = _list_twice(place)
    keys = [key for key in sorted(listing) if RECORD_KEY.fullmatch(key)]
    faults: list[Fault] = []
    readable = dict(intact(partial(read_record, place), keys, faults))
    tombstones = [key for key in listing if key.startswith("tombstones/")]
    records, texts = surviving(
        {key: record for key, (record, _) in readable.items()},
        read_requests(place)[0],
        tombstones,
        markers,
    )
    files = {key: readable[key][1] for key in records}
    small_files = [
        record.beside("names")
        for record in records.values()
        if record.kind not in KINDS_OF_ONE_SUBJECT
    ]
    small_files += [
        key
        for key in listing
        if key.startswith(("audit/", "tombstones/")) and STATE_KEY.fullmatch(key)
    ]
    items = []
    files |= intact(partial(_digest, place), small_files, faults)
    for record, manifest in intact(
        partial(read_manifest, place), records.values(), faults
    ):
        items += items_of(record, manifest)
    items += [(key, digest, None) for key, digest in files.items()]
    additions = {}
    for key, content in texts.items():
        files[key] = hashlib.sha256(content).hexdigest()
        additions[files[key]] = content
    _require_unchanged(place, listing, markers, faults)
    return Draft(listing, records, files, items, additions, faults)


def _list_twice(place: Place) -> Listing:
    """The files of a database that decide what it holds; two equal lists are those of
    one moment between them.
    """
    before = _list(place)
    for _ in range(MAX_LISTS):
        if (listing := _list(place)) == before:
            return listing
        before = listing
    raise input_error(
        place.name,
        "the database must not change all the time while its files are listed",
        f"changes in {MAX_LISTS} lists",
        "run the command again",
    )


def _list(place: Place) -> Listing:
    return {
        f"{top}/{name}": identity
        for top in LISTED
        for name, identity in place.identities(top).items()
    }


def _require_unchanged(
    place: Place, listing: Listing, markers: Markers, faults: list[Fault]
) -> None:
    """Raise `Changed` if a subject was withdrawn since a list, or a version removed
    that may be the cause of faults.
    """
    if not read_markers(place).hashes <= markers.hashes:
        raise Changed
    tombstones = {f"tombstones/{name}" for name in place.children("tombstones")}
    if faults and not tombstones <= listing.keys():
        raise Changed


def _digest(place: Place, key: str) -> str:
    """Digest of a small file."""
    return hashlib.sha256(_read(place, (key, "", None))).hexdigest()


def _copy(place: Place, archive: Archive, guard: Callable[[], None], item: Item) -> int:
    """Copy a file of the database that is as it was committed; returns its size."""
    content = _read(place, item)
    archive.put(content, item[1], guard)
    return len(content)


def _read(place: Place, item: Item) -> bytes:
    with damage_as_fault(place.where(item[0]), AS_COMMITTED, CURE):
        return read_item(place, item[0], item)
