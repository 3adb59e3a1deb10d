"""What a database holds of withdrawn subjects, and its permanent removal.

Erasure computes nothing and needs no free space. `withdrawn/` alone determines what is
removed, so that any run can complete an erasure that was interrupted.
"""

import errno
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TypeVar

from skindb.errors import InputError, UnavailableError, input_error
from skindb.schema.consent import CONSENT
from skindb.store.decisions import commit_release, require_subject
from skindb.store.entries import catalogue_blocks_of
from skindb.store.folder import remove_tree
from skindb.store.gathered import blocks_of
from skindb.store.lease import Lease
from skindb.store.log import Log, committed_logs, remove_version, takes_below
from skindb.store.markers import Markers, mark_withdrawn, note_withdrawals, read_markers
from skindb.store.place import (
    KINDS_OF_ONE_SUBJECT,
    RELEASE,
    STUDY,
    SUMMARY,
    TAKE,
    TIME_HEX,
    Place,
    in_parallel,
    subject_of,
)
from skindb.store.record import Record, subjects_of
from skindb.store.stage import read_names
from skindb.store.stale import (
    PINS,
    TAKES,
    Request,
    read_requests,
    write_request,
)

T = TypeVar("T")
# folders with one entry per kind, and below it one per take
FOLDERS_WITH_TAKES = ("log", "data", "heads", "leases")
# results before their inputs, and all others last
REMOVAL_ORDER = ("edit", STUDY, RELEASE, SUMMARY, "registration")
REGISTRATION = "registration"
# name of the scratch folder of the first pass of a fit
SCRATCH_NAME = re.compile(rf"({TAKE})-[0-9a-f]{{16}}")
# start of the names of a version and of the files beside it
STEM = re.compile(rf"({TIME_HEX})\.")


@dataclass(frozen=True)
class Holdings:
    """What a database holds of withdrawn subjects."""

    # kind and take of everything that is of a subject itself -> number of versions
    takes: Mapping[tuple[str, str], int] = field(default_factory=dict)
    # other versions that refer to a subject, in the order of their removal
    versions: tuple[Record, ...] = ()
    # seals of those that are the newest of their kind and take
    current: frozenset[str] = frozenset()
    # paths of unfinished versions of others that may contain data of a subject
    unrecorded: tuple[str, ...] = ()
    damaged: tuple[str, ...] = ()  # keys of unreadable records of such versions
    requests: tuple[Request, ...] = ()
    scratch: tuple[Path, ...] = ()  # first passes of killed fits on this machine
    caches: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.keys)

    @property
    def keys(self) -> list[str]:
        """Keys of the data of everything that is held."""
        return [
            *(f"data/{kind}/{take}" for kind, take in self.takes),
            *(record.path for record in self.versions),
            *self.unrecorded,
            *(request.key for request in self.requests),
            *self.caches,
            *(f"tmp/{folder.name}" for folder in self.scratch),
        ]

    @property
    def counts(self) -> Counter[str]:
        """Number of versions of each kind."""
        counts = Counter(record.kind for record in self.versions)
        for (kind, _), number in self.takes.items():
            counts[kind] += number
        return +counts


@dataclass
class Erasure:
    """What an erasure has removed."""

    removed: Counter[str] = field(default_factory=Counter)  # kind -> number of versions
    revised: list[str] = field(default_factory=list)  # releases with a new revision
    lost: list[str] = field(default_factory=list)  # results of which no take is left


def holdings_of(place: Place, markers: Markers) -> Holdings:
    """What a database holds of the subjects that these entries declare withdrawn;
    nothing is read if there are none.
    """
    if not markers.hashes:
        return Holdings()
    # the newest of each kind and take after the others
    records = list(chain(*in_parallel(Log.readable, committed_logs(place))))
    doomed = _doomed(records, markers)
    newest = {(record.kind, record.take): record.seal for record in records}
    named = {record.path for record in records}
    # unfinished versions and leases, too
    own = {
        (kind, take)
        for top in FOLDERS_WITH_TAKES
        for kind, take in takes_below(place, top)
        if markers.hides(kind, take)
    }
    unrecorded, damaged = _unrecorded(place, markers, named)
    return Holdings(
        takes={
            (kind, take): len(Log(place, kind, take).generations())
            for kind, take in sorted(own, key=lambda key: (_rank(key[0]), key))
        },
        versions=tuple(doomed),
        current=frozenset(newest.values()) & {record.seal for record in doomed},
        unrecorded=tuple(unrecorded),
        damaged=tuple(damaged),
        requests=tuple(
            request
            for request in read_requests(place)[0]
            if request.without(markers.is_withdrawn) != request
        ),
        scratch=tuple(
            path
            for path in sorted(place.scratch().glob("*"))
            if (match := SCRATCH_NAME.fullmatch(path.name))
            and markers.is_withdrawn(subject_of(match[1]))
        ),
        caches=(
            *catalogue_blocks_of(place, markers.is_withdrawn),
            *blocks_of(place, markers.is_withdrawn),
        ),
    )


def remainder_of(
    records: Iterable[Record], requests: Iterable[Request], markers: Markers
) -> tuple[list[Record], list[Record], list[Request]]:
    """What an erasure leaves if these entries declare subjects withdrawn.

    Parameters
    ----------
    records
        All records of a database, the newest of each kind and take after the others.
    requests, markers
        Requests and withdrawals of the database.

    Returns
    -------
    remaining, removed, requests
        Records that remain; those of others that are removed, each of which leaves a
        tombstone; requests.
    """
    listed = list(records)
    removed = _doomed(listed, markers)
    gone = {record.seal for record in removed}
    newest = {(record.kind, record.take): record.seal for record in listed}
    current = set(newest.values())
    replacements = (
        _replacement(record, gone) for record in removed if record.seal in current
    )
    needed = [*requests, *filter(None, replacements)]
    changed = {request.key: request.without(markers.is_withdrawn) for request in needed}
    remaining = [
        record
        for record in listed
        if record.seal not in gone and not markers.hides(record.kind, record.take)
    ]
    return remaining, removed, [*filter(None, changed.values())]


def erase(place: Place, subject: str, *, wait: float = 0.0) -> Erasure:
    """Withdraw a subject, and remove everything that is of the subject or refers to it.

    Parameters
    ----------
    place
        Location of the database.
    subject
        Pseudonym.
    wait
        Seconds to wait for a run that works on a take of the subject.

    Raises
    ------
    InputError
        If the database holds nothing of the subject, or if another run works on one of
        its takes. Nothing was changed then.
    """
    holdings = subject_holdings(place, subject)
    if not read_markers(place).is_withdrawn(subject):
        takes = {
            take
            for kind, take in holdings.takes
            if kind != CONSENT and subject_of(take) == subject
        }
        with_space = partial(_with_space, place, holdings)
        command = "skindb withdraw"
        with ExitStack() as leases:
            for take in sorted(takes):
                kinds = ("capture", "model")
                lease = Lease(place, take, kinds, wait=wait, command=command)
                with_space(partial(leases.enter_context, lease))
            with_space(partial(mark_withdrawn, place, subject, holdings.counts))
        note_withdrawals(place, is_repeated=True)
    return erase_withdrawn(place)


def erase_withdrawn(place: Place) -> Erasure:
    """Remove everything that is of a withdrawn subject or refers to one; the same call
    completes an interrupted one.
    """
    erasure = Erasure()
    markers = read_markers(place)
    while markers.hashes:
        place.sweep()  # before anything is listed, see `markers`
        _erase_holdings(place, holdings_of(place, markers), markers, erasure)
        later = read_markers(place)
        # otherwise a release or a request may name a subject who was withdrawn
        # meanwhile
        if later == markers:
            break
        markers = later
    if markers.hashes:
        note_withdrawals(place)  # again, because there may be more space
    return erasure


def _erase_holdings(
    place: Place, holdings: Holdings, markers: Markers, erasure: Erasure
) -> None:
    """Remove everything that was found, results after the requests to compute them again."""
    for folder in holdings.scratch:
        remove_tree(folder)
    for (kind, take), number in holdings.takes.items():
        # No tombstones remain, because no other version refers to these versions any more.
        # The records last, so that the same call completes a removal that was interrupted.
        for key in (
            f"data/{kind}/{take}",
            f"leases/{kind}/{take}",
            f"heads/{kind}/{take}.json",
            f"log/{kind}/{take}",
        ):
            place.remove(key)
        erasure.removed += Counter({kind: number})
    with_space = partial(_with_space, place, holdings)
    for request in holdings.requests:
        changed = request.without(markers.is_withdrawn)
        if changed is None:
            place.remove(request.key)
        else:
            with_space(partial(write_request, place, changed))
    prepare = partial(_before_removal, place, holdings, markers, erasure)
    for record in holdings.versions:
        if record.seal in holdings.current:
            with_space(partial(prepare, record))
    for record in holdings.versions:
        with_space(partial(_remove_record, place, record))
        erasure.removed[record.kind] += 1
    for key in (*holdings.damaged, *holdings.caches):
        place.remove(key)
    for path in holdings.unrecorded:
        remove_version(place, path)


def subject_holdings(place: Place, subject: str) -> Holdings:
    """What `erase` removes if this subject is withdrawn.

    Raises
    ------
    InputError
        If the database holds nothing of the subject.
    """
    markers = read_markers(place)
    holdings = holdings_of(place, markers.with_withdrawn(subject))
    if markers.is_withdrawn(subject):
        if holdings:
            return holdings
        raise input_error(
            subject,
            "the database must hold the subject",
            "that the subject was withdrawn, and nothing is left",
            "see skindb info",
        )
    # blocks of caches come and go, and damaged ones may name anyone
    present = holdings_of(place, markers)
    if holdings == replace(present, caches=holdings.caches):
        require_subject(place, subject)
    return holdings


def _remove_record(place: Place, record: Record) -> None:
    """Remove a version, which another withdrawal may have removed meanwhile."""
    log = Log(place, record.kind, record.take)
    try:
        log.remove(record.generation)
    except UnavailableError:
        raise
    except InputError:
        if record.generation in log.generations():
            raise


def _doomed(records: Iterable[Record], markers: Markers) -> list[Record]:
    """Versions that refer to a withdrawn subject, directly or through their inputs,
    without those of the subject.

    Captures and models of other subjects remain. If one was made from a product of many
    subjects that is removed, it is stale.
    """
    listed = list(records)
    refused = {record.seal for record in listed if not markers.admits(record)}
    affected = set(refused)
    while (
        added := {version.seal for version in listed if _uses(version, affected)}
        - affected
    ):
        affected |= added
    kept = (*KINDS_OF_ONE_SUBJECT, RELEASE)
    doomed = [
        record
        for record in listed
        if record.seal in affected
        and not markers.hides(record.kind, record.take)
        and (record.seal in refused or record.kind not in kept)
    ]
    gone = {record.seal for record in doomed}
    # a release holds no data: it only names versions, and those that remain do it no harm
    doomed += [
        record
        for record in listed
        if record.kind == RELEASE and record.seal not in refused and _uses(record, gone)
    ]
    return sorted(
        doomed, key=lambda record: (_rank(record.kind), record.take, record.generation)
    )


def _uses(record: Record, seals: set[str]) -> bool:
    """Whether one of these versions is an input of a version."""
    return any(reference["seal"] in seals for reference in record.made_from)


def _unrecorded(
    place: Place, markers: Markers, named: set[str]
) -> tuple[list[str], list[str]]:
    """Paths of versions of many subjects that no record names and that may contain data
    of a withdrawn one.

    These are versions that name a withdrawn subject, and those whose names are unknown:
    a running writer writes the names first. Keys of unreadable records of the same kind
    and take are returned too, as one of them may be theirs.
    """
    paths = []
    damaged = []
    for kind, take in takes_below(place, "data"):
        if kind in KINDS_OF_ONE_SUBJECT or markers.hides(kind, take):
            continue
        stems = {
            match[1]
            for name in place.children(f"data/{kind}/{take}")
            if (match := STEM.match(name))
        }
        refused = []
        for stem in sorted(stems):
            path = f"data/{kind}/{take}/{stem}.zarr"
            if path in named:
                continue
            names = read_names(place, path)
            if names is None or any(
                map(markers.is_withdrawn, subjects_of(kind, take, names))
            ):
                refused.append(path)
        if refused:
            log = Log(place, kind, take)
            readable = {record.generation for record in log.readable()}
            damaged += [
                log.record_key(number)
                for number in log.generations()
                if number not in readable
            ]
        paths += refused
    return paths, damaged


def _before_removal(
    place: Place, holdings: Holdings, markers: Markers, erasure: Erasure, record: Record
) -> None:
    """Prepare the replacement of the newest version of a kind and take that is to be removed."""
    gone = {version.seal for version in holdings.versions}
    request = _replacement(record, gone)
    if request is None:
        return
    changed = request.without(markers.is_withdrawn)
    if changed is None:
        erasure.lost.append(f"{request}: no other take was used")
    elif record.kind == RELEASE:
        _revise(place, changed, erasure)
    else:
        write_request(place, changed)


def _replacement(record: Record, gone: set[str]) -> Request | None:
    """The request to compute a result again; None for kinds that are not computed by themselves."""
    parameters = dict(record.provenance.get("parameters", {}))
    if record.kind == RELEASE:
        pins = [pin for pin in record.made_from if pin["seal"] not in gone]
        takes = {pin["take"] for pin in pins}
        lacking = [
            pin["take"]
            for pin in record.made_from
            if pin["seal"] in gone and pin["take"] in takes
        ]
        return Request(RELEASE, record.take, {TAKES: lacking, PINS: pins})
    if record.kind == REGISTRATION:
        return Request(REGISTRATION, "", {"reference": parameters.get("reference", "")})
    if record.kind in (STUDY, "edit"):
        return Request(record.kind, record.take, parameters)
    return None


def _revise(place: Place, request: Request, erasure: Erasure) -> None:
    """Commit the next revision of a release, and request the registrations that it
    lacks until they are made again.
    """
    parameters = request.parameters
    try:
        if parameters[TAKES]:
            write_request(
                place, Request(RELEASE, request.take, {TAKES: parameters[TAKES]})
            )
        commit_release(place, request.take, parameters[PINS])
        erasure.revised.append(request.take)
    except UnavailableError:
        raise
    except InputError:
        # a version that it names is damaged: `refresh` tries again when it was restored
        write_request(place, request)


def _with_space(place: Place, holdings: Holdings, step: Callable[[], T]) -> T:
    """The result of a step, repeated on a full disk after the data that are to be
    removed anyway were removed.
    """
    try:
        return step()
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
    for kind, take in holdings.takes:
        place.remove(f"data/{kind}/{take}")
    for record in holdings.versions:
        place.remove(record.path)
    return step()


def _rank(kind: str) -> int:
    return REMOVAL_ORDER.index(kind) if kind in REMOVAL_ORDER else len(REMOVAL_ORDER)
