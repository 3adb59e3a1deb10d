"""Takes and records of a database, or of one of its releases, each looked up only once."""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterable, Mapping
from functools import partial
from typing import Any, Protocol

from skindb.errors import Fault, InputError
from skindb.schema.consent import CONSENT, consent_scope
from skindb.store.log import GENERATION, Log
from skindb.store.markers import Markers, WithdrawnError, read_markers
from skindb.store.paths import (
    KIND,
    KINDS_WITHOUT_SUBJECT,
    RELEASE,
    TAKE,
    TRANSIENT,
    require_text,
    subject_of,
)
from skindb.store.place import Located, Place
from skindb.store.record import Record
from skindb.store.sealed import intact_or_none

# kinds of the versions that a release names for each take
PINNED = ("capture", "model", "registration")
# (kind, take) -> reference to the version in the provenance
Pins = Mapping[tuple[str, str], Mapping[str, Any]]


class Records(Protocol):
    """A source of takes and records."""

    def takes(self, kind: str) -> list[str]:
        """Takes with a version of this kind."""

    def has(self, kind: str, take: str) -> bool:
        """Whether a take has a version of this kind."""

    def record(self, kind: str, take: str, generation: int | None = None) -> Record:
        """The record of a version, by default the current one."""


class CachedRecords(Records, Protocol):
    """A source that keeps the records that it has read."""

    snapshot: Snapshot  # with the withdrawals when the source was made

    def read_ahead(
        self, kinds: Iterable[str], pins: Mapping[tuple[str, str], int]
    ) -> None:
        """Read the newest records of these kinds, and these generations, in parallel."""

    def save(self) -> None:
        """Write the cache."""


class Snapshot:
    """Versions of a database, with the withdrawals at one moment.

    Parameters
    ----------
    place
        Location of the database.
    markers
        The withdrawals; default those of now.
    """

    def __init__(self, place: Place, markers: Markers | None = None) -> None:
        self.place = place
        self.markers = read_markers(place) if markers is None else markers

    def kinds(self, take: str | None = None) -> list[str]:
        """Kinds of the versions of one take or of all takes, without the transient kinds."""
        names = {*self.place.children("log"), *self._head_names("")} - {*TRANSIENT}
        kinds = [name for name in sorted(names) if re.fullmatch(KIND, name)]
        takes = {kind: self.takes(kind) for kind in kinds}
        return [
            kind for kind in kinds if (take in takes[kind] if take else takes[kind])
        ]

    def takes(self, kind: str) -> list[str]:
        """Takes with a version of this kind, including those whose records were lost."""
        require_text(kind, KIND, "kind")
        listed = {take for _, take, _ in list_records(self.place, kind)}
        cached = {name.removesuffix(".json") for name in self._head_names(kind)}
        lost = {
            take
            for take in cached - listed
            if re.fullmatch(TAKE, take) and not Log(self.place, kind, take).is_empty()
        }
        takes = sorted(listed | lost)
        return [take for take in takes if not self.markers.hides(kind, take)]

    def has(self, kind: str, take: str) -> bool:
        """Whether a take has a version of this kind."""
        is_empty = Log(self.place, kind, take).is_empty()
        return not is_empty and not self.markers.hides(kind, take)

    def record(self, kind: str, take: str, generation: int | None = None) -> Record:
        """The record of a version; see `Database.record`."""
        try:
            record = Log(self.place, kind, take).read(generation)
        except InputError:
            if not self.has(kind, take):
                raise self._missing_error(kind, take) from None
            raise
        if self.markers.admits(record):
            return record
        if self.markers.hides(kind, take):
            raise self._missing_error(kind, take)
        rule = "a version must not refer to a withdrawn subject"
        finding = "a withdrawal that is not complete"
        raise WithdrawnError(Fault(record.title, rule, finding, "run skindb refresh"))

    def history(self, kind: str, take: str) -> list[Record]:
        """All records, oldest first; see `Database.history`."""
        current = self.record(kind, take)
        log = Log(self.place, kind, take)
        before = [number for number in log.generations() if number < current.generation]
        if len(before) < current.generation - 1 and (faults := log.faults()[1]):
            raise InputError(faults)
        earlier = [log.read(generation) for generation in before]
        return [*filter(self.markers.admits, earlier), current]

    def readable_history(self, kind: str, take: str) -> list[Record]:
        """All readable records, oldest first; damaged ones are skipped."""
        records = Log(self.place, kind, take).readable()
        return [*filter(self.markers.admits, records)]

    def subjects(self) -> list[str]:
        """Subjects with a version of any kind."""
        kinds = [kind for kind in self.kinds() if kind not in KINDS_WITHOUT_SUBJECT]
        return sorted({subject_of(take) for kind in kinds for take in self.takes(kind)})

    def _head_names(self, kind: str) -> list[str]:
        """Names of the heads of a kind, or of the kinds with heads; empty if this cache
        is damaged.
        """
        key = f"heads/{kind}".rstrip("/")
        return intact_or_none(partial(self.place.children, key)) or []

    def _missing_error(self, kind: str, take: str) -> InputError:
        takes = self.takes(kind)
        finding = f"takes: {', '.join(takes)}"
        if not takes:
            finding = f"no {kind}; kinds: {', '.join(self.kinds()) or 'none'}"
        title = f"{self.place.name}: {kind} of {take}"
        return InputError(
            Fault(title, "the database must hold it", finding, "see skindb info")
        )


class Lookup:
    """Cached lookups of takes and records, for example while a cohort or a table is created.

    Parameters
    ----------
    db
        Database.
    release
        Name of a release, whose versions are used instead of the newest ones.
    cache
        Source of takes and records, by default the database itself.
    """

    def __init__(
        self,
        db: Located,
        release: str | None = None,
        cache: CachedRecords | None = None,
    ) -> None:
        self.place = db.place
        self._cache = cache
        self._snapshot = Snapshot(db.place) if cache is None else cache.snapshot
        self._source: Records = cache or self._snapshot
        self._pins = None if release is None else pins_of(self._snapshot, release)
        self._takes: dict[str, frozenset[str]] = {}
        self._records: dict[tuple[str, str], Record] = {}

    def takes(self, kind: str) -> frozenset[str]:
        """Takes with a version of this kind."""
        if kind not in self._takes:
            if self._is_pinned(kind):
                names = [
                    take
                    for pinned_kind, take in self._pins or ()
                    if pinned_kind == kind
                ]
            else:
                names = self._source.takes(kind)
            self._takes[kind] = frozenset(names)
        return self._takes[kind]

    def read_ahead(self, kinds: Iterable[str]) -> None:
        """Read the records of these kinds in parallel, if they are cached."""
        if self._cache is not None:
            pins = self._pins or {}
            generations = {key: int(pin["generation"]) for key, pin in pins.items()}
            newest = [kind for kind in kinds if not self._is_pinned(kind)]
            self._cache.read_ahead(newest, generations)

    def save(self) -> None:
        """Save the records that were read to the cache, if there is one."""
        if self._cache is not None:
            self._cache.save()

    def has(self, kind: str, take: str) -> bool:
        """Whether a take has a version of this kind."""
        return take in self.takes(kind)

    def record(self, kind: str, take: str) -> Record:
        """The newest record of a take, or that of the release."""
        key = (kind, take)
        if key not in self._records:
            if self._pins and self._is_pinned(kind):
                record = pinned_record(self._source, self._pins, kind, take)
            else:
                record = self._source.record(kind, take)
            self._records[key] = record
        return self._records[key]

    def history(self, kind: str, take: str) -> list[Record]:
        """All records of a take, oldest first; none if it has no such version."""
        return self._snapshot.history(kind, take) if self.has(kind, take) else []

    def generation(self, kind: str, take: str, generation: int) -> Record:
        """The record of any generation."""
        return self._snapshot.record(kind, take, generation)

    def about(self, take: str) -> dict[str, Any]:
        """Provenance of the capture of a take, or of its model if there is no capture."""
        kind = "capture" if self.has("capture", take) else "model"
        return self.record(kind, take).provenance

    def scope(self, take: str) -> tuple[str, ...]:
        """Scopes of the present consent of the subject of a take; see `Database.consent`."""
        subject = subject_of(take)
        if self.has(CONSENT, subject):
            return consent_scope(self.record(CONSENT, subject).provenance)
        if self._pins is not None:
            return consent_of(self._source, take)
        return consent_scope(self.about(take))

    def _is_pinned(self, kind: str) -> bool:
        return self._pins is not None and kind in PINNED


def list_records(place: Place, kind: str = "") -> dict[tuple[str, str, int], str]:
    """Identity of the file of every record in the log, of one kind or of all kinds."""
    identities: dict[tuple[str, str, int], str] = {}
    for name, identity in place.identities(f"log/{kind}".rstrip("/")).items():
        path = f"{kind}/{name}" if kind else name
        listed_kind, take, file, *_ = [*path.split("/"), "", ""]
        match = GENERATION.fullmatch(file)
        if match and re.fullmatch(KIND, listed_kind) and re.fullmatch(TAKE, take):
            identities[listed_kind, take, int(match[1])] = identity_text(identity)
    return identities


def identity_text(identity: tuple[Hashable, ...]) -> str:
    """Identity of a file as text."""
    return " ".join(map(str, identity))


def consent_of(records: Records, take: str) -> tuple[str, ...]:
    """See `Database.consent`."""
    if records.has(CONSENT, subject_of(take)):
        record = records.record(CONSENT, subject_of(take))
    else:
        kind = "capture" if records.has("capture", take) else "model"
        record = records.record(kind, take)
    return consent_scope(record.provenance)


def pins_of(records: Records, release: str) -> Pins:
    """The versions that a release names; `InputError` if the release does not exist."""
    if not records.has(RELEASE, release):
        finding = f"releases: {', '.join(records.takes(RELEASE)) or 'none'}"
        rule = "the release must exist"
        raise InputError(Fault(release, rule, finding, "see skindb release"))
    named = records.record(RELEASE, release).made_from
    return {(pin["kind"], pin["take"]): pin for pin in named}


def pinned_record(records: Records, pins: Pins, kind: str, take: str) -> Record:
    """The record of the version that a release names for a take."""
    if (kind, take) not in pins:
        takes = sorted(name for pinned_kind, name in pins if pinned_kind == kind)
        rule = f"the release must name a {kind} of this take"
        finding = f"takes: {', '.join(takes) or 'none'}"
        raise InputError(Fault(take, rule, finding, "choose one of these"))
    pin = pins[kind, take]
    record = records.record(kind, take, pin["generation"])
    if record.seal != pin["seal"]:
        rule = (
            f"generation {pin['generation']} of its {kind} must be that of the release"
        )
        cure = "restore it from a backup"
        raise InputError(Fault(take, rule, "a different version", cure))
    return record
