"""Releases: named and dated records that list one version of every take."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from skindb.errors import Fault, InputError
from skindb.store.paths import RELEASE, TAKE, require_text
from skindb.store.place import Place
from skindb.store.record import Record
from skindb.store.stage import Stage

if TYPE_CHECKING:
    from skindb.store.database import Database
    from skindb.store.known import Snapshot
    from skindb.store.record_cache import RecordCache

# kinds of the versions that a release names for each take
PINNED = ("capture", "model", "registration")
# (kind, take) -> reference to the version in the provenance
Pins = Mapping[tuple[str, str], Mapping[str, Any]]


def create_release(db: Database, name: str, takes: Sequence[str] | None) -> Record:
    """See `Database.create_release`."""
    require_text(name, TAKE, "name of a release")
    if db.has(RELEASE, name):
        there = f"a release of {db.record(RELEASE, name).created}"
        raise InputError(
            Fault(name, "a release must have a new name", there, "choose another name")
        )
    known = db.takes("model")
    names = known if takes is None else list(dict.fromkeys(takes))
    if unknown := [take for take in names if take not in known]:
        rule = "a release must consist of takes with a model"
        cure = f"takes with a model: {', '.join(known) or 'none'}"
        raise InputError(Fault(take, rule, "no model", cure) for take in unknown)
    if not names:
        raise InputError(
            Fault(
                name, "a release needs fitted takes", "no model", "run skindb fit first"
            )
        )
    pins = [
        db.record(kind, take).as_input()
        for take in names
        for kind in PINNED
        if db.has(kind, take)
    ]
    return db.commit_release(name, pins)


def commit_release(
    place: Place, name: str, pins: Iterable[Mapping[str, Any]]
) -> Record:
    """Commit a release, or a new revision of it."""
    inputs = [dict(one) for one in pins]
    with Stage(place, RELEASE, name, names={one["take"] for one in inputs}) as stage:
        return stage.commit({"command": "release", "release": name, "inputs": inputs})


def pins_of(db: Database, name: str) -> Pins:
    """The versions that a release names; `InputError` if the release does not exist."""
    if not db.has(RELEASE, name):
        there = ", ".join(db.takes(RELEASE)) or "none"
        raise InputError(
            Fault(
                name,
                "the release must exist",
                f"releases: {there}",
                "see skindb release",
            )
        )
    return {
        (one["kind"], one["take"]): one for one in db.record(RELEASE, name).made_from
    }


def pinned_record(
    db: Database | Snapshot | RecordCache, pins: Pins, kind: str, take: str
) -> Record:
    """The record of the version that a release names for a take."""
    if (kind, take) not in pins:
        there = sorted(name for of, name in pins if of == kind)
        rule = f"the release must name a {kind} of this take"
        found = f"takes: {', '.join(there) or 'none'}"
        raise InputError(Fault(take, rule, found, "choose one of these"))
    pin = pins[kind, take]
    record = db.record(kind, take, pin["generation"])
    if record.seal != pin["seal"]:
        rule = (
            f"generation {pin['generation']} of its {kind} must be that of the release"
        )
        found = "a different version"
        raise InputError(Fault(take, rule, found, "restore it from a backup"))
    return record
