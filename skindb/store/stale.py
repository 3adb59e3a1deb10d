"""Results that must be computed again: stale versions, whose inputs were withdrawn,
superseded or are no longer covered by consent, and requests for results that a
withdrawal removed.

A withdrawal writes a request before it removes a result of others, and `refresh`
computes the result and removes the request. No result is therefore lost if a withdrawal
is killed, or if a result cannot be computed at once.
"""

from __future__ import annotations

import hashlib
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache as cached
from functools import partial
from typing import Any, Literal

from skindb.errors import Fault, InputError, SkindbWarning, UnavailableError, attempt
from skindb.schema.consent import CONSENT
from skindb.store.entries import CACHED_KINDS
from skindb.store.log import Log
from skindb.store.markers import WithdrawnError
from skindb.store.place import (
    KIND,
    KINDS_WITHOUT_SUBJECT,
    STUDY,
    TAKE,
    Located,
    Place,
    subject_of,
)
from skindb.store.record import (
    Key,
    Record,
    damage_as_fault,
    intact_or_none,
    sealed,
    sealed_object,
)
from skindb.store.snapshot import Records, Snapshot, consent_of

Why = Literal["withdrawn", "unreadable", "not covered", "superseded"]
REASONS: dict[Why, str] = {
    "withdrawn": "was removed from the database",
    "unreadable": "cannot be read (skindb verify gives the reason)",
    "not covered": "consent no longer covers statistics",
    "superseded": "was superseded",
}
# kinds that can be stale, in order of dependence
DERIVED = ("model", "registration", STUDY, "edit")
# made from data of several subjects, whose consent must cover statistics
KINDS_OF_MANY_SUBJECTS = ("registration", STUDY, "edit")
CURE = "run: skindb refresh DB"
CURE_DAMAGE = "restore the damaged records from a backup"
REQUESTS = "requests"
REQUEST_NAME = r"[0-9a-f]{64}\.json"
# parameters that name takes: those that a result is limited to, one of a registration,
# and the versions of a release
TAKES = "takes"
REFERENCE = "reference"
PINS = "pins"


class StaleWarning(SkindbWarning):
    """A result was made from versions that have been superseded."""


@dataclass(frozen=True)
class Reason:
    """Reason why a version is stale: the state of one of its direct or indirect inputs."""

    why: Why
    kind: str
    take: str
    generation: int

    def __str__(self) -> str:
        """The reason as shown in messages."""
        if self.why == "not covered":
            return f"{self.take}: {REASONS[self.why]}"
        return f"{self.kind} {self.generation} of {self.take} {REASONS[self.why]}"


class Staleness:
    """Reasons why versions of a database are stale; each record is looked up only once.

    Parameters
    ----------
    db
        Database.
    cache
        Source of records of the kinds `CACHED_KINDS`, by default the database itself.
    """

    def __init__(self, db: Located, cache: Records | None = None) -> None:
        self._cache = cache
        self._snapshot = Snapshot(db.place)
        self._known: dict[Key, tuple[Reason, ...]] = {}
        self._newest_of = cached(
            lambda kind, take: self._records(kind).record(kind, take).generation
        )
        self._is_covered = cached(self._find_cover)

    def reasons(self, record: Record) -> tuple[Reason, ...]:
        """Reasons why a version is stale; empty if it is not.

        A version that was made from a release is not superseded by later commits.
        """
        key = record.key
        if key not in self._known:
            # inputs are earlier versions; this ends the recursion in a forged cycle
            self._known[key] = ()
            finding = dict.fromkeys(
                reason
                for reference in record.made_from
                for reason in self._input_reasons(record, reference)
            )
            self._known[key] = tuple(finding)
        return self._known[key]

    def _input_reasons(
        self, record: Record, one: Mapping[str, Any]
    ) -> Iterator[Reason]:
        kind, take, generation = key = one["kind"], one["take"], one["generation"]
        try:
            made_from = self._records(kind).record(*key)
        except UnavailableError:
            raise
        except InputError as error:
            listed = Log(self._snapshot.place, kind, take).generations()
            is_damaged = generation in listed and not isinstance(error, WithdrawnError)
            yield Reason("unreadable" if is_damaged else "withdrawn", *key)
            return
        if one["seal"] != made_from.seal:
            yield Reason("withdrawn", *key)
            return
        if (
            record.kind in KINDS_OF_MANY_SUBJECTS
            and kind != STUDY
            and not self._is_covered(take)
        ):
            yield Reason("not covered", *key)
        is_of_release = record.provenance.get("parameters", {}).get("release")
        if not is_of_release and self._newest_of(kind, take) > generation:
            yield Reason("superseded", *key)
        if kind in DERIVED:
            for reason in self.reasons(made_from):
                if not (is_of_release and reason.why == "superseded"):
                    yield reason

    def _find_cover(self, take: str) -> bool:
        """Whether the consent of the subject of a take covers statistics; False if it is
        unknown.
        """
        scope = intact_or_none(partial(consent_of, self._records(CONSENT), take))
        return scope is not None and "statistics" in scope

    def _records(self, kind: str) -> Records:
        if self._cache is not None and kind in CACHED_KINDS:
            return self._cache
        return self._snapshot


def require_fresh(db: Located, kind: str, take: str) -> None:
    """Raise an error or warn if a version is stale.

    Warns
    -----
    StaleWarning
        If an input has been superseded.

    Raises
    ------
    InputError
        If an input was withdrawn or cannot be read, or if the consent of its subject no
        longer covers statistics.
    """
    record = Snapshot(db.place).record(kind, take)
    title = record.title
    reasons = Staleness(db).reasons(record)
    if refused := [reason for reason in reasons if reason.why != "superseded"]:
        rule = "its inputs must exist and be covered by consent"
        is_damaged = any(reason.why == "unreadable" for reason in refused)
        cure = CURE_DAMAGE if is_damaged else CURE
        raise InputError(
            Fault(title, rule, finding, cure)
            for finding in dict.fromkeys(map(str, refused))
        )
    if reasons:
        rest = f" and {len(reasons) - 1} more" if len(reasons) > 1 else ""
        warnings.warn(
            f"{title} is out of date: {reasons[0]}{rest}; {CURE}",
            StaleWarning,
            stacklevel=3,
        )


def stale_versions(db: Located) -> list[tuple[Record, tuple[Reason, ...]]]:
    """The newest versions that are stale, with the reasons, in order of dependence.

    Damaged versions and results that were made from them are omitted, because results
    that are computed again would lack the damaged data.
    """
    staleness = Staleness(db)
    snapshot = Snapshot(db.place)

    def judged(kind: str, take: str) -> tuple[Record, tuple[Reason, ...]]:
        record = snapshot.record(kind, take)
        return record, staleness.reasons(record)

    newest = [
        intact_or_none(partial(judged, kind, take))
        for kind in DERIVED
        for take in snapshot.takes(kind)
    ]
    return [
        (record, reasons)
        for record, reasons in filter(None, newest)
        if reasons and all(reason.why != "unreadable" for reason in reasons)
    ]


@dataclass(frozen=True)
class Request:
    """A result that is to be computed again."""

    kind: str
    take: str  # empty for the registration of all takes
    parameters: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.kind} of {self.take}" if self.take else self.kind

    @property
    def key(self) -> str:
        """Key of its file; there is one request for each kind and take."""
        name = hashlib.sha256(f"{self.kind}/{self.take}".encode()).hexdigest()
        return f"{REQUESTS}/{name}.json"

    def without(self, is_withdrawn: Callable[[str], bool]) -> Request | None:
        """The request without takes of withdrawn subjects; None if nothing remains to
        be computed.
        """

        def remains(take: str) -> bool:
            return not is_withdrawn(subject_of(take))

        if self.kind not in KINDS_WITHOUT_SUBJECT and not remains(self.take):
            return None
        parameters = dict(self.parameters)
        if parameters.get(TAKES):
            parameters[TAKES] = [*filter(remains, parameters[TAKES])]
            # an empty list would mean all takes
            if not parameters[TAKES] and not parameters.get(PINS):
                return None
        if PINS in parameters:
            pins = [pin for pin in parameters[PINS] if remains(pin["take"])]
            parameters[PINS] = pins
            if not any(pin["kind"] == "model" for pin in pins):
                return None
        if not remains(parameters.get(REFERENCE) or ""):
            parameters[REFERENCE] = ""
        return Request(self.kind, self.take, parameters)

    def content(self) -> bytes:
        """Content of its file."""
        return sealed(asdict(self))


def write_request(place: Place, request: Request) -> None:
    """Write a request durably; it replaces one for the same result."""
    place.replace(request.key, request.content())


def read_requests(place: Place) -> tuple[list[Request], list[Fault]]:
    """The readable requests, and the faults of the others."""
    requests = []
    faults: list[Fault] = []
    for name in place.children(REQUESTS):
        if not re.fullmatch(REQUEST_NAME, name):
            continue
        key = f"{REQUESTS}/{name}"
        request = attempt(faults, partial(_read_request, place, key))
        if request is not None:
            requests.append(request)
    return requests, faults


def _read_request(place: Place, key: str) -> Request | None:
    """A request; None if it was fulfilled meanwhile."""
    rule = "a request must be as it was written"
    cure = "remove it, and run the analysis that is missing again"
    with damage_as_fault(place.where(key), rule, cure):
        try:
            content = place.read_small(key)
        except FileNotFoundError:
            return None
        return request_from_json(content)


def request_from_json(content: bytes) -> Request:
    """The request in a file; `ValueError`, `TypeError` or `KeyError` if it is not as it
    was written.
    """
    request = Request(**sealed_object(content))
    names = [
        request.take,
        *request.parameters.get(TAKES, []),
        request.parameters.get(REFERENCE, ""),
    ]
    names += [pin["take"] for pin in request.parameters.get(PINS, [])]
    if not re.fullmatch(KIND, request.kind) or not all(
        re.fullmatch(TAKE, name) for name in names if name
    ):
        raise ValueError("names that are not those of kinds and takes")
    return request
