"""Garbage: finding and removing files to which no record refers; docs/store_format.md has the rules."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from typing import cast

from skindb._limits import RESUMABLE_SECONDS
from skindb.errors import Fault, InputError
from skindb.schema.consent import CONSENT
from skindb.store.kinds import CALIBRATION, RELEASE
from skindb.store.lease import NUMBER, Lease, abandoned_by, holder_of, storage_time
from skindb.store.log import Log
from skindb.store.paths import KIND, TAKE, TIME_HEX, TRANSIENT, WORKED_ON
from skindb.store.place import Place
from skindb.store.record import Record
from skindb.store.stage import remove_version
from skindb.store.verify import (
    LAYOUT,
    SCRATCH,
    committed_logs,
    half_removed_of,
    may_have_had_record,
    names_below,
    tombstones,
)

STILL_WRITING_SECONDS = 3600.0  # what was written later may be that of a run without a lease
HISTORY = (CONSENT, RELEASE, CALIBRATION)  # kinds of which every generation stays
SAME_FIT = ("inputs", "requested", "dictionary_digest", "method_digest")  # as a first pass and its model say them
STEM = re.compile(rf"({TIME_HEX})\.(zarr|manifest\.json|tables\.json)")
Clock = Callable[[], float]
SPOOL = re.compile(rf"({TAKE})-[0-9a-f]+")


@dataclass(frozen=True)
class Garbage:
    """Something that no record refers to, or an old generation."""

    key: str
    what: str
    bytes: int
    kept: str = ""  # why it is not removed now
    generation: int = 0  # of a record that is dropped

    @property
    def of(self) -> tuple[str, str]:
        """Kind and take; empty for what belongs to none."""
        parts = self.key.split("/")
        if parts[0] == "tmp":
            return ("capture", match[1]) if (match := SPOOL.fullmatch(parts[1])) else ("", "")
        return (parts[1], parts[2]) if len(parts) > 3 else ("", "")


def find_garbage(place: Place, generations: int | None = None) -> list[Garbage]:
    """Files to which no record refers and, if a number is given, unused generations beyond it.

    Where the database is damaged, nothing is found: `database_faults` reports it.
    """
    now = cache(partial(storage_time, place))  # it is written for this: only if there is anything
    found = [*_scratch(place, now), *_spools(place, now)]
    unnamed = partial(_unnamed, stones=tombstones(place))
    for key, of_take in (("data", unnamed), ("leases", _leases)):
        for kind, take in names_below(place, key):
            if re.fullmatch(KIND, kind) and re.fullmatch(TAKE, take):
                with suppress(InputError):
                    found += of_take(place, kind, take, now)
    return found if generations is None else [*found, *_old(place, generations, now)]


def remove_garbage(place: Place, generations: int | None = None) -> list[Garbage]:
    """Remove what `find_garbage` finds and does not keep, each take under its leases; returns what was removed."""
    groups = defaultdict[tuple[tuple[str, ...], str], list[Garbage]](list)
    for one in find_garbage(place, generations):
        if not one.kept:
            groups[_leased(*one.of)].append(one)
    removed: list[Garbage] = []
    for (kinds, take), those in groups.items():
        if not kinds:
            removed += [one for one in those if _remove(place, one)]
            continue
        lease = Lease(place, take, kinds, command="skindb clean")
        try:
            lease.__enter__()
        except InputError:  # a run has begun its work on this take
            continue
        try:
            removed += [one for one in those if _remove(place, one)]
        finally:
            lease.__exit__(None, None, None)
    return removed


def _leased(kind: str, take: str) -> tuple[tuple[str, ...], str]:
    """The leases that a writer of files of a take may hold."""
    if kind in ("capture", "model", *WORKED_ON):
        return ("capture", "model"), take
    return ((kind,) if kind else ()), take


def _remove(place: Place, one: Garbage) -> bool:
    kind, take = one.of
    if one.key.startswith("leases/") and NUMBER.search(one.key):  # our own lease took its place
        return True
    if one.generation:
        Log(place, kind, take).remove(one.generation)
    elif kind in TRANSIENT and one.key.startswith("log/") and one.key.endswith(".json"):
        Log(place, kind, take).forget()
    elif one.key.endswith(".zarr"):
        records, faults = Log(place, kind, take).faults()
        if faults or one.key in {record.path for record in records}:  # committed since we looked
            return False
        remove_version(place, one.key)
    else:
        place.remove(one.key)
    return True


def _unnamed(place: Place, kind: str, take: str, now: Clock, *, stones: set[str]) -> Iterator[Garbage]:
    """Versions, and files beside them, that no record names, and records whose removal was interrupted."""
    key = f"data/{kind}/{take}"
    names = place.children(key)  # before the log, in which a running commit ends
    log = Log(place, kind, take)
    records, faults = log.faults()
    if kind in TRANSIENT:
        yield _transient(place, log, records, now)
        return
    for record in half_removed_of(log, records, stones):
        what = f"generation {record.generation}, whose removal was interrupted"
        kept = _in_use(place, kind, take)
        yield Garbage(f"{log.key}/{record.generation:08d}.json", what, record.bytes, kept, record.generation)
    named = {record.path for record in records}
    stems = {match[1] for name in names if (match := STEM.fullmatch(name))}
    stems = {stem for stem in stems if f"{key}/{stem}.zarr" not in named}
    sizes = place.sizes(key) if stems else {}
    for stem in sorted(stems):
        size = sum(max(count, 0) for name, count in sizes.items() if name.startswith(stem))
        if faults:
            kept = "its log is damaged: see skindb verify"
        elif f"{stem}.manifest.json" in names and may_have_had_record(log):
            kept = "its record may have been lost; remove it by hand if a run was killed there"
        elif abandoned_by(place, kind, take):
            kept = ""  # its writer cannot commit any more
        else:
            kept = _in_use(place, kind, take) or _too_young(
                place, [f"{key}/{name}" for name in names if stem in name], now
            )
        yield Garbage(f"{key}/{stem}.zarr", "a version without a record, left by a killed run", size, kept)


def _transient(place: Place, log: Log, records: list[Record], now: Clock) -> Garbage:
    """The first pass of a fit that was committed, or of one that was killed and can continue."""
    data = f"data/{log.kind}/{log.take}"
    what, kept = "the first pass of a killed fit", _in_use(place, log.kind, log.take)
    if records and _has_model(place, records[-1]):
        what = "the first pass of a fit that was committed"
    elif records:
        kept = kept or _too_young(place, [data], now, RESUMABLE_SECONDS)
    elif not abandoned_by(place, WORKED_ON[log.kind], log.take):
        kept = kept or _too_young(place, [data], now)
    size = sum(max(count, 0) for count in place.sizes(data).values())
    return Garbage(f"{log.key}/00000001.json", what, size, kept)


def _has_model(place: Place, first: Record) -> bool:
    fit = Log(place, WORKED_ON[first.kind], first.take)
    model = {} if fit.is_empty() else fit.read().about
    return all(name in model and model[name] == first.about.get(name) for name in SAME_FIT)


def _in_use(place: Place, kind: str, take: str) -> str:
    holder = holder_of(place, WORKED_ON.get(kind, kind), take)
    return f"in use by {holder}" if holder else ""


def _too_young(place: Place, keys: Iterable[str], now: Clock, seconds: float = STILL_WRITING_SECONDS) -> str:
    """Why a file that was written within this many seconds is not removed yet; empty otherwise."""
    try:
        age = now() - max(place.modified(key) for key in keys)
    except FileNotFoundError:  # removed or written at this moment
        age = 0.0
    if age >= seconds:
        return ""
    why = ", the same run continues there" if seconds == RESUMABLE_SECONDS else ""
    return f"written {max(age, 0.0) / 60:.0f} minutes ago, kept for {seconds / 3600:.0f} h{why}"


def _scratch(place: Place, now: Clock) -> Iterator[Garbage]:
    """Temporary files of killed writers."""
    for top, levels in LAYOUT.items():
        folders = [top] if place.file_type(top) == "folder" else []
        for _ in levels:
            below = [f"{folder}/{name}" for folder in folders for name in place.children(folder)]
            for key in below:
                if SCRATCH.fullmatch(key.rpartition("/")[2]):
                    with suppress(FileNotFoundError):  # its writer is running
                        size, kept = cast(int, place.identity(key)[0]), _too_young(place, [key], now)
                        yield Garbage(key, "a temporary file of a killed writer", size, kept)
            folders = below


def _spools(place: Place, now: Clock) -> Iterator[Garbage]:
    """Scratch folders of killed ingests."""
    for name in place.children("tmp") if place.file_type("tmp") == "folder" else []:
        key = f"tmp/{name}"
        size = sum(max(count, 0) for count in place.sizes(key).values())
        if match := SPOOL.fullmatch(name):
            kept = _in_use(place, "capture", match[1]) or _too_young(place, [key], now, RESUMABLE_SECONDS)
        else:
            kept = _too_young(place, [key], now)
        yield Garbage(key, "scratch of a killed ingest", size, kept)


def _leases(place: Place, kind: str, take: str, _: Clock) -> Iterator[Garbage]:
    if by := abandoned_by(place, kind, take):
        key = f"leases/{kind}/{take}"
        name, size = max(item for item in place.sizes(key).items() if NUMBER.fullmatch(item[0]))
        yield Garbage(f"{key}/{name}", f"the lease of a killed run: {by}", size)


def _old(place: Place, generations: int, now: Clock) -> Iterator[Garbage]:
    """Generations that are neither among the newest ones nor named by a version that stays."""
    if generations < 1:
        raise InputError(Fault("generations", "at least the newest one stays", str(generations), "give 1 or more"))
    every: dict[tuple[str, str, int], Record] = {}
    waiting: list[Record] = []
    for log in committed_logs(place):
        records, faults = log.faults()
        if faults:  # what it names is not known
            raise InputError(faults)
        every |= {(log.kind, log.take, record.generation): record for record in records}
        waiting += records if log.kind in HISTORY else records[-generations:]
    stays: set[tuple[str, str, int]] = set()
    while waiting:
        record = waiting.pop()
        own = (record.kind, record.take, record.generation)
        if own not in stays:
            stays.add(own)
            named = [(one["kind"], one["take"], one["generation"]) for one in record.made_from]
            waiting += [every[one] for one in named if one in every]
    for (kind, take, generation), record in every.items():
        if (kind, take, generation) not in stays:
            what = f"generation {generation}, which no version that stays was made from"
            kept = _in_use(place, kind, take) or _too_young(place, [record.path], now)
            yield Garbage(f"log/{kind}/{take}/{generation:08d}.json", what, record.bytes, kept, generation)
