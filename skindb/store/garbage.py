"""Finding and removing files to which no record refers; docs/store_format.md describes
the rules.
"""

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cache, partial

from skindb.errors import InputError, require
from skindb.limits import RESUMABLE_SECONDS
from skindb.schema.consent import CONSENT
from skindb.store.erasure import SCRATCH_NAME, erase_withdrawn, holdings_of
from skindb.store.gathered import BLOCK_KEY, GATHERED
from skindb.store.lease import Lease, abandoned_holder, holder_of, storage_time
from skindb.store.log import Log, committed_logs, remove_version, takes_below
from skindb.store.markers import Markers, read_markers
from skindb.store.place import (
    CALIBRATION,
    RELEASE,
    STAGING,
    TIME_HEX,
    Place,
)
from skindb.store.record import Key, Record
from skindb.store.verify import may_have_had_record

STILL_WRITING_SECONDS = 3600.0  # newer files may belong to a run without a lease
KEPT_BLOCK_SECONDS = 30 * 24 * 3600.0
KEPT_KINDS = (CONSENT, RELEASE, CALIBRATION)  # kinds of which all generations are kept
VERSION_FILE = re.compile(rf"({TIME_HEX})\.(zarr|(manifest|tables|names)\.json)")
OF_WITHDRAWN = "it is of a withdrawn subject, or refers to one"
Clock = Callable[[], float]


@dataclass(frozen=True)
class Garbage:
    """A file, folder or version to which no record refers, or an old generation."""

    key: str
    what: str
    bytes: int
    kept: str = ""  # reason why it is not removed now
    generation: int = 0  # of a record that is to be removed

    @property
    def of(self) -> tuple[str, str]:
        """Kind and take; empty if it does not belong to a take."""
        parts = self.key.split("/")
        if parts[0] == "tmp":
            match = SCRATCH_NAME.fullmatch(parts[1])
            return ("capture", match[1]) if match else ("", "")
        return (parts[1], parts[2]) if len(parts) > 3 else ("", "")


def find_garbage(place: Place, generations: int | None = None) -> list[Garbage]:
    """Files to which no record refers and, if `generations` is given, unused
    generations older than that number.

    Damaged parts of a database are skipped, as `database_faults` reports them; with
    `generations`, a damaged record raises an `InputError`.
    """
    # needs a file to be written, so it is only called if there is garbage
    now = cache(partial(storage_time, place))
    markers = read_markers(place)
    garbage = [
        *_of_withdrawn_subjects(place, markers),
        *_loose_files(place, STAGING, "a temporary file of a killed writer", now),
        *_old_blocks(place, now),
        *_scratch_folders(place, now),
    ]
    for kind, take in takes_below(place, "data"):
        if not markers.hides(kind, take):
            with suppress(InputError):
                garbage += _unrecorded(place, kind, take, now)
    if generations is not None:
        garbage += _old_generations(place, generations, now)
    return garbage


def remove_garbage(place: Place, generations: int | None = None) -> list[Garbage]:
    """Remove and return what `find_garbage` lists without a reason for keeping it,
    under the leases of each take.

    What is left of withdrawn subjects is removed first, without leases: nobody may work on it.
    """
    removed = list(_of_withdrawn_subjects(place, read_markers(place)))
    erase_withdrawn(place)
    groups = defaultdict[tuple[tuple[str, ...], str], list[Garbage]](list)
    for item in find_garbage(place, generations):
        if not item.kept:
            groups[_required_leases(*item.of)].append(item)
    for (kinds, take), those in groups.items():
        with ExitStack() as leases:
            if kinds:
                lease = Lease(place, take, kinds, command="skindb clean")
                try:
                    leases.enter_context(lease)
                except InputError:  # a run has started to work on this take
                    continue
            removed += [item for item in those if _remove_one(place, item)]
    return removed


def _required_leases(kind: str, take: str) -> tuple[tuple[str, ...], str]:
    """Kinds and take of the leases that a writer of these files may hold."""
    if kind in ("capture", "model"):
        return ("capture", "model"), take
    return ((kind,) if kind else ()), take


def _remove_one(place: Place, item: Garbage) -> bool:
    kind, take = item.of
    if item.generation:
        Log(place, kind, take).remove(item.generation)
    elif item.key.endswith(".zarr"):
        records, faults = Log(place, kind, take).faults()
        # committed meanwhile
        if faults or item.key in {record.path for record in records}:
            return False
        remove_version(place, item.key)
    else:
        place.remove(item.key)
    return True


def _unrecorded(place: Place, kind: str, take: str, now: Clock) -> Iterator[Garbage]:
    """Versions and files beside them that no record names, and records whose removal
    was interrupted.
    """
    key = f"data/{kind}/{take}"
    # listed before the log, because a commit writes its record last
    names = place.children(key)
    log = Log(place, kind, take)
    records, faults = log.faults()
    for record in (one for one in records if log.is_removed(one.seal)):
        description = f"generation {record.generation}, whose removal was interrupted"
        reason = _in_use_reason(place, kind, take)
        number = record.generation
        yield Garbage(log.record_key(number), description, record.bytes, reason, number)
    named = {record.path for record in records}
    stems = {match[1] for name in names if (match := VERSION_FILE.fullmatch(name))}
    stems = {stem for stem in stems if f"{key}/{stem}.zarr" not in named}
    sizes = place.sizes(key) if stems else {}
    for stem in sorted(stems):
        size = sum(
            max(count, 0) for name, count in sizes.items() if name.startswith(stem)
        )
        if faults:
            reason = "its log is damaged, see skindb verify"
        elif f"{stem}.manifest.json" in names and may_have_had_record(log):
            reason = (
                "its record may have been lost; remove it by hand if its run was killed"
            )
        elif abandoned_holder(place, kind, take):
            reason = ""  # its writer can no longer commit
        else:
            files = [f"{key}/{name}" for name in names if stem in name]
            reason = _in_use_reason(place, kind, take)
            reason = reason or _recent_reason(place, files, now)
        what = "a version without a record, left by a killed run"
        yield Garbage(f"{key}/{stem}.zarr", what, size, reason)


def _in_use_reason(place: Place, kind: str, take: str) -> str:
    holder = holder_of(place, kind, take)
    return f"in use by {holder}" if holder else ""


def _recent_reason(
    place: Place,
    keys: Iterable[str],
    now: Clock,
    seconds: float = STILL_WRITING_SECONDS,
) -> str:
    """Reason to keep files that were written within this many seconds; empty if they are older."""
    try:
        age = now() - max(place.modified(key) for key in keys)
    except FileNotFoundError:  # removed or replaced meanwhile
        age = 0.0
    if age >= seconds:
        return ""
    purpose = " so that the same run can resume" if seconds == RESUMABLE_SECONDS else ""
    return f"written {max(age, 0.0) / 60:.0f} minutes ago, kept for {seconds / 3600:.0f} h{purpose}"


def _of_withdrawn_subjects(place: Place, markers: Markers) -> Iterator[Garbage]:
    """What interrupted withdrawals, and writers that were suspended during one, left of
    withdrawn subjects.
    """
    for key in holdings_of(place, markers).keys:
        yield Garbage(key, OF_WITHDRAWN, _bytes_below(place, key))


def _bytes_below(place: Place, key: str) -> int:
    return sum(max(count, 0) for count in place.sizes(key).values())


def _loose_files(
    place: Place,
    folder: str,
    what: str,
    now: Clock,
    seconds: float = STILL_WRITING_SECONDS,
) -> Iterator[Garbage]:
    """Files of a folder, which are kept for some seconds."""
    sizes = place.sizes(folder) if place.file_type(folder) == "folder" else {}
    for name, size in sizes.items():
        key = f"{folder}/{name}"
        if size >= 0:
            yield Garbage(key, what, size, _recent_reason(place, [key], now, seconds))


def _old_blocks(place: Place, now: Clock) -> list[Garbage]:
    """Gathered tables of which nobody knows whether a study will read them again; it
    gathers those again that are gone.
    """
    what = "tables that studies gathered a month ago"
    blocks = _loose_files(place, GATHERED, what, now, KEPT_BLOCK_SECONDS)
    return [one for one in blocks if not one.kept and re.fullmatch(BLOCK_KEY, one.key)]


def _scratch_folders(place: Place, now: Clock) -> Iterator[Garbage]:
    """First passes of killed fits, and temporary files."""
    for name in place.children("tmp") if place.file_type("tmp") == "folder" else []:
        key = f"tmp/{name}"
        size = _bytes_below(place, key)
        if match := SCRATCH_NAME.fullmatch(name):
            reason = _in_use_reason(place, "model", match[1]) or _recent_reason(
                place, [key], now, RESUMABLE_SECONDS
            )
        else:
            reason = _recent_reason(place, [key], now)
        yield Garbage(key, "scratch files of a killed run", size, reason)


def _old_generations(place: Place, generations: int, now: Clock) -> Iterator[Garbage]:
    """Generations that are neither among the newest ones nor inputs of a version that is kept."""
    rule = "must be at least 1, because the newest generation is kept"
    require(
        generations >= 1, "generations", rule, str(generations), "choose a larger one"
    )
    listed: dict[Key, Record] = {}
    waiting = []
    for log in committed_logs(place):
        records, faults = log.faults()
        if faults:  # the inputs that a damaged record names are unknown
            raise InputError(faults)
        listed |= {record.key: record for record in records}
        waiting += records if log.kind in KEPT_KINDS else records[-generations:]
    stays = set()
    while waiting:
        record = waiting.pop()
        if record.key not in stays:
            stays.add(record.key)
            waiting += [listed[key] for key in record.input_keys if key in listed]
    for (kind, take, generation), record in listed.items():
        if (kind, take, generation) not in stays:
            what = f"generation {generation}, which is not an input of a kept version"
            reason = _in_use_reason(place, kind, take)
            reason = reason or _recent_reason(place, [record.path], now)
            key = Log(place, kind, take).record_key(generation)
            yield Garbage(key, what, record.bytes, reason, generation)
