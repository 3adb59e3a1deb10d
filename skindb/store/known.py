"""Takes and records of a database or of one of its releases; each is looked up only once."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from skindb.schema.consent import CONSENT, consent_scope
from skindb.store.paths import subject_of
from skindb.store.record import Record
from skindb.store.release import PINNED, Pins, pinned_record, pins_of

if TYPE_CHECKING:
    from skindb.store.database import Database
    from skindb.store.record_cache import RecordCache


class Snapshot:
    """Versions of a database, with the withdrawals at one moment, which are listed only once.

    Parameters
    ----------
    db
        Database.
    """

    def __init__(self, db: Database) -> None:
        self.db = db
        self._markers = db.markers()

    def takes(self, kind: str) -> list[str]:
        """See `Database.takes`."""
        return self.db.takes(kind)

    def has(self, kind: str, take: str) -> bool:
        """See `Database.has`."""
        return self.db.has(kind, take, markers=self._markers)

    def record(self, kind: str, take: str, generation: int | None = None) -> Record:
        """See `Database.record`."""
        return self.db.record(kind, take, generation, markers=self._markers)


def consent_of(records: Snapshot | RecordCache, take: str) -> tuple[str, ...]:
    """See `Database.consent`."""
    if records.has(CONSENT, subject_of(take)):
        return consent_scope(records.record(CONSENT, subject_of(take)).provenance)
    return consent_scope(
        records.record(
            "capture" if records.has("capture", take) else "model", take
        ).provenance
    )


class Known:
    """Cached lookups of takes and records, for example while a cohort or a table is created.

    Parameters
    ----------
    db
        Database.
    release
        Name of a release, whose versions are used instead of the newest ones.
    records
        Source of takes and records, by default the database itself.
    """

    def __init__(
        self,
        db: Database,
        release: str | None = None,
        records: RecordCache | None = None,
    ) -> None:
        self.db = db
        self._cache = records
        self._source: Snapshot | RecordCache = records or Snapshot(db)
        self._pins: Pins | None = None if release is None else pins_of(db, release)
        self._takes: dict[str, frozenset[str]] = {}
        self._records: dict[tuple[str, str, bool], Record] = {}

    def takes(self, kind: str) -> frozenset[str]:
        """Takes with a version of this kind."""
        if kind not in self._takes:
            pinned = self._pins is not None and kind in PINNED
            names = (
                [take for of, take in self._pins or () if of == kind]
                if pinned
                else self._source.takes(kind)
            )
            self._takes[kind] = frozenset(names)
        return self._takes[kind]

    def read_ahead(self, kinds: Iterable[str]) -> None:
        """Read the records of these kinds in parallel, if they come from a `RecordCache`."""
        if self._cache is not None:
            pins = (
                {}
                if self._pins is None
                else {key: int(one["generation"]) for key, one in self._pins.items()}
            )
            newest = [
                kind for kind in kinds if self._pins is None or kind not in PINNED
            ]
            self._cache.read_ahead(newest, pins)

    def save(self) -> None:
        """Save the records that were read to the cache, if there is one."""
        if self._cache is not None:
            self._cache.save()

    def has(self, kind: str, take: str) -> bool:
        """Whether a take has a version of this kind."""
        return take in self.takes(kind)

    def record(self, kind: str, take: str) -> Record:
        """The newest record of a take, or that of the release."""
        pinned = self._pins is not None and kind in PINNED
        key = (kind, take, pinned)
        if key not in self._records:
            released = (
                pinned_record(self._source, self._pins, kind, take)
                if pinned and self._pins
                else None
            )
            self._records[key] = released or self._source.record(kind, take)
        return self._records[key]

    def about(self, take: str) -> dict[str, Any]:
        """Provenance of the capture of a take, or of its model if there is no capture."""
        return self.record(
            "capture" if self.has("capture", take) else "model", take
        ).provenance

    def scope(self, take: str) -> tuple[str, ...]:
        """Scopes of the present consent of the subject of a take; see `Database.consent`."""
        subject = subject_of(take)
        if self.has(CONSENT, subject):
            return consent_scope(self.record(CONSENT, subject).provenance)
        return (
            consent_of(self._source, take)
            if self._pins is not None
            else consent_scope(self.about(take))
        )
