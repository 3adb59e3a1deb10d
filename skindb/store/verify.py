"""Every record and every file read again and compared; all damage at once."""

from __future__ import annotations

import re
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

import xarray as xr

from skindb.errors import Fault, InputError
from skindb.schema import SCHEMA_VERSION
from skindb.store.lease import NUMBER, abandoned_by
from skindb.store.log import GENERATION, RESTORE, Log, tombstone_of
from skindb.store.paths import KIND, TAKE, TIME_HEX, TRANSIENT, WORKED_ON
from skindb.store.place import Place
from skindb.store.record import AS_RECORDED, Record, json_object
from skindb.store.stage import TABLES, describe, tables_from_json
from skindb.store.verified import AS_COMMITTED, CURE, Manifest, VerifiedStore, read_beside, read_manifest

# what is in the folders of a database, level by level; a version is a folder, everything else a file
LAYOUT = {
    "log": (KIND, TAKE, GENERATION.pattern),
    "heads": (KIND, rf"{TAKE}\.json"),
    "tombstones": (r"[0-9a-f]{64}\.json",),
    "data": (KIND, TAKE, rf"{TIME_HEX}\.(zarr|manifest\.json|tables\.json)"),
    "leases": (KIND, TAKE, NUMBER.pattern),
}
SCRATCH = re.compile(r"\.[0-9a-f]{32}\.tmp")  # of a writer that is running or was killed
THREADS = 8  # that read files: a server answers many requests at a time, and each takes its time
BESIDE = re.compile(r"\.(manifest|tables)\.json")


def database_faults(place: Place) -> list[Fault]:
    """All damage of a database."""
    beside: list[str] = []  # files beside versions; listed before the log, in which a running commit ends
    layout = [fault for name, levels in LAYOUT.items() for fault in _layout_faults(place, name, levels, beside)]
    faults: list[Fault] = []
    records: list[Record] = []
    stones = tombstones(place)
    damaged: set[str] = set()  # logs of which a record is missing or cannot be read
    for log in committed_logs(place):
        try:
            readable, broken = log.faults()
        except InputError as error:  # a link in place of the folder of a take
            readable, broken = [], list(error.faults)
        half_removed = half_removed_of(log, readable, stones)
        records += readable
        faults += broken
        damaged |= {log.what} if broken else set()
        for record in readable:
            faults += [_half_removed(record)] if record in half_removed else version_faults(place, record)
    faults += _input_faults(place, records, damaged)
    faults += _unnamed(place, beside, records, damaged)
    reported = {fault.where for fault in faults}
    return [*faults, *(fault for fault in layout if fault.where not in reported)]


def committed_logs(place: Place) -> Iterable[Log]:
    """The log of every kind and take, also of those that only a head remembers."""
    heads = {(kind, name.removesuffix(".json")) for kind, name in names_below(place, "heads")}
    for kind, take in sorted({*names_below(place, "log"), *heads}):
        if re.fullmatch(KIND, kind) and re.fullmatch(TAKE, take) and kind not in TRANSIENT:
            yield Log(place, kind, take)


def names_below(place: Place, key: str) -> Iterable[tuple[str, str]]:
    """Names on the first two levels below a key; `_layout_faults` reports links."""
    if place.file_type(key) == "folder":
        for kind in place.children(key):
            for name in place.children(f"{key}/{kind}"):
                yield kind, name


def _layout_faults(place: Place, key: str, levels: tuple[str, ...], beside: list[str]) -> list[Fault]:
    """What does not belong into a folder of the database, and links or pipes in place of its files."""
    found = place.file_type(key)
    if found != "folder":
        return [_of_type(place, key, "folder", found)] if found else []
    faults: list[Fault] = []
    for name in place.children(key, links=True):
        child = f"{key}/{name}"
        if not re.fullmatch(levels[0], name):
            if not SCRATCH.fullmatch(name):
                faults.append(Fault(place.where(child), "a database holds its own files only", "another", "remove it"))
        elif len(levels) > 1:
            faults += _layout_faults(place, child, levels[1:], beside)
        else:
            expected = "folder" if name.endswith(".zarr") else "file"
            if (found := place.file_type(child)) != expected:
                faults.append(_of_type(place, child, expected, found))
            elif BESIDE.search(name):
                beside.append(child)
    return faults


def _of_type(place: Place, key: str, expected: str, found: str) -> Fault:
    names = {"link": "a symbolic link", "file": "a file", "folder": "a folder"}
    rule = "must be a folder" if expected == "folder" else "must be a regular file"
    return Fault(place.where(key), rule, names.get(found, "a pipe, socket or device"), RESTORE)


def _input_faults(place: Place, records: list[Record], damaged: set[str]) -> list[Fault]:
    """Versions that others were made from, and that vanished or were replaced without a note of their removal."""
    seals = {(record.kind, record.take, record.generation): record.seal for record in records}
    faults = []
    for record in records:
        for one in record.made_from:
            log, generation = Log(place, one["kind"], one["take"]), one["generation"]
            if log.what in damaged or not one.get("seal") or log.is_removed(one["seal"]):
                continue
            if seals.get((log.kind, log.take, generation)) != one["seal"]:
                by = f"{record.kind} {record.generation} of {record.take}"
                rule = f"generation {generation}, from which {by} was made, must be there"
                faults.append(Fault(log.what, rule, "nothing, or another record", RESTORE))
    return faults


def _unnamed(place: Place, beside: list[str], records: list[Record], damaged: set[str]) -> list[Fault]:
    """Versions that were written to the end, and whose record was lost."""
    named = {record.beside(what) for record in records if record.files is None for what in ("manifest", TABLES)}
    rule = "a record of the log must name every version that was written to the end"
    cure = "restore its record from a backup; if a run was killed there, remove this file and the version beside it"
    faults = []
    for key in beside:
        _, kind, take, _ = key.split("/")
        known = key in named or kind in TRANSIENT or f"{kind} of {take}" in damaged
        if not known and _lost_record(place, kind, take):
            faults.append(Fault(place.where(key), rule, "none that does", cure))
    return faults


def _lost_record(place: Place, kind: str, take: str) -> bool:
    """Whether a version that was written to the end must have lost its record.

    Not where a head remembers the newest record, and the log has it: then the version never had one. Nor where there
    is no record at all, or the last run under a lease was killed.
    """
    log = Log(place, kind, take)
    return bool(log.generations()) and may_have_had_record(log)


def may_have_had_record(log: Log) -> bool:
    """Whether a version without a record may have had one."""
    return not log.head() and not abandoned_by(log.place, WORKED_ON.get(log.kind, log.kind), log.take)


def version_faults(place: Place, record: Record) -> list[Fault]:
    """Damage of one version."""
    try:
        manifest = read_manifest(place, record)
        tables = read_beside(place, record, TABLES, record.tables) if record.tables else b""
        faults = _file_faults(place, record, manifest)
        return faults or _record_faults(place, record, tables)
    except InputError as error:
        return list(error.faults)


def tombstones(place: Place) -> set[str]:
    """Names of all tombstones."""
    return set(place.children("tombstones")) if place.file_type("tombstones") == "folder" else set()


def half_removed_of(log: Log, records: Iterable[Record], stones: set[str]) -> list[Record]:
    """Records whose tombstone exists already, because their removal was killed."""
    there = [record for record in records if tombstone_of(record.seal).rpartition("/")[2] in stones]
    return [record for record in there if log.is_removed(record.seal)]


def _half_removed(record: Record) -> Fault:
    what = f"{record.kind} {record.generation} of {record.take}"
    return Fault(what, "its removal must be completed", "its record, and the note of its removal", "run skindb clean")


def _file_faults(place: Place, record: Record, manifest: Manifest) -> list[Fault]:
    there = place.sizes(record.path)
    names = sorted(there.keys() | manifest.keys())
    with ThreadPoolExecutor(THREADS) as threads:
        found = list(threads.map(lambda name: _file_fault(place, record, manifest, there, name), names))
    return [fault for fault in found if fault is not None]


def _file_fault(place: Place, record: Record, manifest: Manifest, there: dict[str, int], name: str) -> Fault | None:
    key = f"{record.path}/{name}"
    where = place.where(key)
    if name not in there:
        return Fault(where, AS_COMMITTED, "nothing", CURE)
    if name not in manifest:
        return Fault(where, AS_COMMITTED, "an unknown file or folder", "remove it")
    if there[name] < 0:
        return Fault(where, AS_COMMITTED, "no regular file", CURE)
    found = _difference(place, key, there[name], manifest[name], record.bytes)
    return Fault(where, AS_COMMITTED, found, CURE) if found else None


def _difference(place: Place, key: str, size: int, committed: tuple[str, int], most: int) -> str:
    digest, expected = committed
    if size != expected >= 0:
        return f"{size} bytes, committed were {expected}"
    if expected < 0 and size > most:  # a record of format 1 names no sizes
        return f"{size} bytes, the whole version had {most}"
    try:
        return "" if place.digest(key) == digest else "other bytes"
    except OSError as error:  # a dying disk hides no other damage
        return f"a file that cannot be read ({error.strerror})"


def _record_faults(place: Place, record: Record, tables: bytes) -> list[Fault]:
    """Whether a record agrees with the attributes of its version."""
    root = json_object(place.read_small(f"{record.path}/zarr.json"))
    wrong = [] if root.get("attributes") == record.provenance else ["provenance"]
    if record.files is None and record.provenance["schema_version"] == SCHEMA_VERSION:
        store = VerifiedStore(place, record)
        tree = xr.open_datatree(store, engine="zarr", consolidated=False, chunks=None)  # type: ignore[arg-type]
        contents = {str(name): describe(node.to_dataset()) for name, node in tree.children.items()}
        contents |= {TABLES: describe(tables_from_json(json_object(tables)))} if tables else {}
        wrong += [] if contents == record.contents else ["contents"]
        wrong += [] if sum(place.sizes(record.path).values()) == record.bytes else ["bytes"]
    where = f"{record.kind} {record.generation} of {record.take}"
    return [Fault(where, AS_RECORDED, f"other {', '.join(wrong)}", RESTORE)] if wrong else []
