"""Restoring a database from a backup, without subjects who were withdrawn since.

A restore writes into an empty place only. Until it is complete,
`withdrawn/restoring.json` refuses every reader and writer, and the same call begins
again. Nothing of a withdrawn subject is copied.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from skindb.errors import Fault, input_error, require
from skindb.schema.consent import CONSENT
from skindb.store.archive import (
    Archive,
    Item,
    State,
    intact,
    other_files,
    require_apart,
    surviving,
)
from skindb.store.bucket import place_at
from skindb.store.lease import Lease
from skindb.store.log import Log
from skindb.store.markers import (
    ENTRY,
    RESTORING,
    SECRET,
    WITHDRAWN,
    Markers,
    Notes,
    keyed_hash,
    note_consents,
    note_withdrawals,
    read_marker_file,
    require_secret,
    withdrawn_hashes,
)
from skindb.store.place import RELEASE, STAGING, Place
from skindb.store.record import Record, subjects_of
from skindb.store.stage import Stage
from skindb.store.stale import REQUESTS

LOCK = f"{WITHDRAWN}/{RESTORING}"
# folders that a restore has written before its first file
OF_A_RESTORE = (STAGING, WITHDRAWN, "leases")


@dataclass(frozen=True)
class Restored:
    """What was restored."""

    number: int  # of the state
    created: str  # when the state was written
    versions: int
    bytes: int
    # versions of the state that refer to a subject who was withdrawn since
    skipped: int
    requests: int  # results that wait to be computed again
    consents: int  # records of consent that came after the backup
    unknown_consents: int  # those of subjects that the state does not hold
    # damaged files of the backup, which are not restored
    faults: tuple[Fault, ...] = ()


@dataclass(frozen=True)
class Plan:
    """The files of a database to be restored."""

    items: list[Item]
    texts: dict[str, bytes]  # files that are not copied from the backup
    records: Mapping[str, Record]
    markers: Markers
    notes: Notes = field(repr=False)
    skipped: int
    faults: list[Fault]


def restore(
    source: str,
    url: str,
    *,
    number: int | None = None,
    markers: Path | None = None,
    without_markers: bool = False,
) -> Restored:
    """Restore a database from a backup, without subjects who were withdrawn since, and
    with later consents.

    Parameters
    ----------
    source
        Folder or bucket of the backup.
    url
        Folder or bucket of the database, which must be empty or missing. A restore that
        was interrupted begins again.
    number
        Number of the state; default the newest.
    markers
        Marker file of the database that was lost; default the file beside `url` with
        the ending ".markers", and for a bucket that in the user's data folder.
    without_markers
        Restore without a marker file. Subjects who were withdrawn after the backup then come back.

    Raises
    ------
    InputError
        If there is no such backup, state or marker file, if one of them is damaged, or
        if there is something at `url`. Damaged versions do not stop the restore: they
        are reported, and refused when they are read.
    """
    place = place_at(url)
    file = markers or place.marker_file()
    require(
        without_markers or file.exists(),
        str(file),
        "a restore needs the marker file, because subjects who were withdrawn "
        "after the backup would come back",
        "no such file",
        "give --markers FILE, or --without-markers to accept this risk",
    )
    archive = Archive(place_at(source))
    archive.require()
    place.is_unlocked = True
    require_apart(archive.place, place)
    _require_empty(place)
    newest = max(archive.numbers(), default=0)
    state = archive.state(newest if number is None else number)
    notes = Notes()
    if not without_markers:
        notes = read_marker_file(file, require_secret(archive.place))
    plan = _plan(archive, state, notes)
    written, consents = _write(archive, place, plan)
    return Restored(
        number=state.number,
        created=state.created,
        versions=len(plan.records),
        bytes=written,
        skipped=plan.skipped,
        requests=sum(key.startswith(f"{REQUESTS}/") for key in plan.texts),
        consents=len(consents),
        unknown_consents=len(notes.consents.keys() - _subjects(plan).keys()),
        faults=tuple(plan.faults),
    )


def _write(archive: Archive, place: Place, plan: Plan) -> tuple[int, list[Record]]:
    """Write the files of a database, which is locked meanwhile, and the later consents;
    returns the number of bytes, and the records of these consents.
    """
    with Lease(place, "restore", (RELEASE,), command="skindb restore"):
        _require_empty(place)  # another restore may have been completed meanwhile
        place.create(LOCK, b"{}")
        written = _copy_all(archive, place, plan)
        consents = _repeat_consents(place, plan)
        place.remove(LOCK)
    place.is_unlocked = False
    note_withdrawals(place)
    note_consents(place, [*consents, *plan.records.values()])
    return written, consents


def _plan(archive: Archive, state: State, notes: Notes) -> Plan:
    """The files of a state without withdrawn subjects, of which nothing is read."""
    entries = {
        f"{WITHDRAWN}/{name}": archive.place.read_small(f"{WITHDRAWN}/{name}")
        for name in archive.place.sizes(WITHDRAWN)
        if ENTRY.fullmatch(name)
    }
    entries |= {
        key: json.dumps(body).encode()
        for key, body in notes.entries.items()
        if key not in entries
    }
    hashes = withdrawn_hashes(key.removeprefix(f"{WITHDRAWN}/") for key in entries)
    markers = Markers(hashes, require_secret(archive.place))
    faults: list[Fault] = []
    stored = archive.records(state, faults)
    tombstones = [key for key in state.files if key.startswith("tombstones/")]
    records, texts = surviving(
        stored, archive.requests(state, faults), tombstones, markers
    )
    texts |= entries | {SECRET: archive.place.read_small(SECRET)}
    for record in records.values():  # in ascending order
        log = Log(archive.place, record.kind, record.take)
        texts[log.head_key] = log.head_content(record.generation, record.seal)
    for key in state.files.keys() - stored.keys():
        _, kind, take, *_ = [*key.split("/"), "", ""]
        if key.startswith("log/") and not markers.hides(kind, take):
            # an unreadable record, so that none before it takes its place
            texts[key] = b""
    files = {key: state.files[key] for key in records} | other_files(
        state.files, records
    )
    items: list[Item] = [(key, digest, None) for key, digest in files.items()]
    for _, those in intact(archive.version_items, records.values(), faults):
        items += those
    return Plan(
        items, texts, records, markers, notes, len(stored) - len(records), faults
    )


def _require_empty(place: Place) -> None:
    """Raise an `InputError` if there is anything at a place, except for a restore that
    was interrupted.
    """
    if place.file_type(LOCK):
        return
    names = place.names() or []
    foreign = [name for name in names if name not in OF_A_RESTORE]
    if foreign or place.sizes(WITHDRAWN):
        finding = (
            "a database or a backup"
            if {"log", WITHDRAWN} & {*names}
            else f"other files, such as {foreign[0]}"
        )
        raise input_error(
            place.name,
            "a restore needs an empty or missing folder",
            finding,
            "give another folder; nothing was changed",
        )


def _copy_all(archive: Archive, place: Place, plan: Plan) -> int:
    """Copy all files; returns the number of their bytes.

    Everything that an interrupted restore has written is removed first: it may be of a
    subject who was withdrawn since.
    """
    place.sweep()
    for name in place.children(WITHDRAWN):
        if name != RESTORING:
            place.remove(f"{WITHDRAWN}/{name}")
    for top in place.names() or []:
        if top not in OF_A_RESTORE:
            place.remove(top)
    copied = intact(partial(_copy, archive, place), plan.items, plan.faults)
    written = sum(size for _, size in copied)
    for key, content in plan.texts.items():
        place.create(key, content)
    return written


def _copy(archive: Archive, place: Place, item: Item) -> int:
    """Copy a file; returns its size."""
    content = archive.parsed(bytes, item)
    place.create(item[0], content)
    return len(content)


def _subjects(plan: Plan) -> dict[str, str]:
    """Keyed hash of every subject of the restored versions -> pseudonym."""
    return {
        keyed_hash(plan.markers.secret, subject): subject
        for record in plan.records.values()
        for subject in subjects_of(record.kind, record.take, ())
    }


def _repeat_consents(place: Place, plan: Plan) -> list[Record]:
    """Record the newest consents that came after the backup."""
    subjects = _subjects(plan)
    seals = {
        keyed_hash(plan.markers.secret, record.seal)
        for record in plan.records.values()
        if record.kind == CONSENT
    }
    records = []
    for name, consent in sorted(plan.notes.consents.items()):
        if name in subjects and consent["record"] not in seals:
            provenance = {
                "subject": subjects[name],
                "consent_scope": consent["consent"],
                "command": "restore",
                "recorded": consent["created"],
            }
            with Stage(place, CONSENT, subjects[name]) as stage:
                records.append(stage.commit(provenance))
    return records
