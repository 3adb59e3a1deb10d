"""Verification of a database: all records and files are read and compared, and all
faults are reported together.
"""

import re
from functools import partial

from xarray import open_datatree

from skindb.errors import Fault, InputError, UnavailableError
from skindb.store.audit import BLOCK_NAME, ENTRY_NAME, read_audit
from skindb.store.entries import CATALOGUE, CATALOGUE_BLOCK
from skindb.store.erasure import holdings_of
from skindb.store.gathered import BLOCK_NAME as GATHERED_NAME
from skindb.store.gathered import GATHERED
from skindb.store.lease import NUMBER, abandoned_holder
from skindb.store.log import GENERATION, RESTORE, Log, committed_logs
from skindb.store.markers import SECRET, WITHDRAWN, marker_faults, read_markers
from skindb.store.place import (
    AUDIT,
    KIND,
    KINDS_OF_ONE_SUBJECT,
    STAGING,
    TAKE,
    TIME_HEX,
    Place,
    in_parallel,
)
from skindb.store.record import AS_RECORDED, Record, json_object
from skindb.store.stage import TABLES, describe, read_names, tables_from_json
from skindb.store.stale import REQUEST_NAME, REQUESTS, read_requests
from skindb.store.verified import (
    AS_COMMITTED,
    CHANGED,
    CURE,
    Committed,
    Manifest,
    VerifiedStore,
    read_beside,
    read_manifest,
    size_difference,
)

# patterns of the names in a database, by level; versions are folders, everything else files
LAYOUT = {
    "log": (KIND, TAKE, GENERATION.pattern),
    "heads": (KIND, rf"{TAKE}\.json"),
    "tombstones": (r"[0-9a-f]{64}\.json",),
    "data": (KIND, TAKE, rf"{TIME_HEX}\.(zarr|(manifest|tables|names)\.json)"),
    "leases": (KIND, TAKE, NUMBER.pattern),
    STAGING: (r"\.[0-9a-f]{32}\.tmp",),
    WITHDRAWN: (r"[0-9a-f]{64}\.json",),
    AUDIT: (BLOCK_NAME, ENTRY_NAME),
    REQUESTS: (REQUEST_NAME,),
    GATHERED: (GATHERED_NAME,),
    CATALOGUE: (CATALOGUE_BLOCK,),
}
FILE_BESIDE = re.compile(r"\.(manifest|tables)\.json")


def database_faults(place: Place) -> list[Fault]:
    """All faults of a database."""
    # files beside versions, listed before the log because a commit writes its record
    # last
    beside: list[str] = []
    layout = [
        fault
        for name, levels in LAYOUT.items()
        for fault in _layout_faults(place, name, levels, beside)
    ]
    faults = []
    records = []
    damaged = set()  # logs with a missing or unreadable record
    for log in committed_logs(place):
        try:
            readable, broken = log.faults()
        except InputError as error:  # a link in place of the folder of a take
            readable = []
            broken = list(error.faults)
        records += readable
        faults += broken
        damaged |= {log.what} if broken else set()
        for record in readable:
            if log.is_removed(record.seal):
                rule = "its removal must be completed"
                finding = "both a record and a tombstone"
                faults.append(Fault(record.title, rule, finding, "run skindb clean"))
            else:
                faults += version_faults(place, record)
    faults += _input_faults(place, records, damaged)
    faults += _unrecorded_faults(place, beside, records, damaged)
    faults += [
        *marker_faults(place),
        *read_requests(place)[1],
        *_withdrawn_faults(place),
        *read_audit(place)[1],
    ]
    reported = {fault.where for fault in faults}
    return [
        *dict.fromkeys(faults),
        *(fault for fault in layout if fault.where not in reported),
    ]


def _withdrawn_faults(place: Place) -> list[Fault]:
    """Faults of what is left of withdrawn subjects."""
    try:
        holdings = holdings_of(place, read_markers(place))
    except UnavailableError:
        raise
    except InputError as error:  # of the secret, which `marker_faults` reports
        return [fault for fault in error.faults if fault.where != place.where(SECRET)]
    rule = "nothing of a withdrawn subject must remain"
    cure = "run skindb clean --yes"
    finding = "data that the withdrawal did not remove, or that came later"
    return [Fault(place.where(key), rule, finding, cure) for key in holdings.keys]


def _layout_faults(
    place: Place, key: str, levels: tuple[str, ...], beside: list[str]
) -> list[Fault]:
    """Faults of unknown names in the folders of the database, and of links or pipes in
    place of files.
    """
    finding = place.file_type(key)
    if finding != "folder":
        return [_type_fault(place, key, "folder", finding)] if finding else []
    faults = []
    for name in place.children(key, links=True):
        child = f"{key}/{name}"
        if not re.fullmatch(levels[0], name):
            faults.append(
                Fault(
                    place.where(child),
                    "a database must contain only files of skindb",
                    "an unknown name",
                    "remove it",
                )
            )
        elif len(levels) > 1:
            faults += _layout_faults(place, child, levels[1:], beside)
        else:
            expected = "folder" if name.endswith(".zarr") else "file"
            if (finding := place.file_type(child)) != expected:
                faults.append(_type_fault(place, child, expected, finding))
            elif key.startswith("data/") and FILE_BESIDE.search(name):
                beside.append(child)
    return faults


def _type_fault(place: Place, key: str, expected: str, finding: str) -> Fault:
    names = {"link": "a symbolic link", "file": "a file", "folder": "a folder"}
    rule = "must be a folder" if expected == "folder" else "must be a regular file"
    return Fault(
        place.where(key), rule, names.get(finding, "a pipe, socket or device"), RESTORE
    )


def _input_faults(
    place: Place, records: list[Record], damaged: set[str]
) -> list[Fault]:
    """Faults of inputs of other versions that are missing or were replaced, without a tombstone."""
    seals = {record.key: record.seal for record in records}
    faults = []
    for record in records:
        for reference in record.made_from:
            log = Log(place, reference["kind"], reference["take"])
            generation = reference["generation"]
            if log.what in damaged or log.is_removed(reference["seal"]):
                continue
            if seals.get((log.kind, log.take, generation)) != reference["seal"]:
                rule = f"generation {generation}, from which {record.title} was made, must exist"
                finding = "no record, or a different one"
                faults.append(Fault(log.what, rule, finding, RESTORE))
    return faults


def _unrecorded_faults(
    place: Place, beside: list[str], records: list[Record], damaged: set[str]
) -> list[Fault]:
    """Faults of versions that were written completely, but whose records were lost."""
    named = {
        record.beside(suffix) for record in records for suffix in ("manifest", TABLES)
    }
    faults = []
    for key in beside:
        _, kind, take, _ = key.split("/")
        is_known = key in named or f"{kind} of {take}" in damaged
        log = Log(place, kind, take)
        # it never had a record if the head names the newest record and the log has it, and
        # may never have had one if there are none, or if the last run under a lease was killed
        if not is_known and log.generations() and may_have_had_record(log):
            faults.append(
                Fault(
                    place.where(key),
                    "a record of the log must name every version that was written completely",
                    "no such record",
                    "restore its record from a backup; if its run was killed, remove this file and "
                    "the version beside it",
                )
            )
    return faults


def may_have_had_record(log: Log) -> bool:
    """Whether a version without a record may have had a record."""
    return not log.head() and not abandoned_holder(log.place, log.kind, log.take)


def version_faults(place: Place, record: Record) -> list[Fault]:
    """All faults of one version."""
    try:
        manifest = read_manifest(place, record)
        tables = (
            read_beside(place, record, TABLES, record.tables) if record.tables else b""
        )
        sizes = place.sizes(record.path)
        check = partial(_file_fault, place, record, manifest, sizes)
        finding = in_parallel(check, sorted(sizes.keys() | manifest.keys()))
        faults = [fault for fault in finding if fault is not None]
        return faults or _record_faults(place, record, tables)
    except InputError as error:
        return list(error.faults)


def _file_fault(
    place: Place, record: Record, manifest: Manifest, sizes: dict[str, int], name: str
) -> Fault | None:
    key = f"{record.path}/{name}"
    location = place.where(key)
    if name not in manifest:
        return Fault(location, AS_COMMITTED, "an unknown file or folder", "remove it")
    file = manifest[name]
    finding = size_difference(sizes.get(name), file) or _difference(place, key, file)
    return Fault(location, AS_COMMITTED, finding, CURE) if finding else None


def _difference(place: Place, key: str, file: Committed) -> str:
    try:
        return "" if place.digests(key) == file.digests else CHANGED
    except OSError as error:  # reported, so that other damage is still found
        return f"a file that cannot be read ({error.strerror})"


def _record_faults(place: Place, record: Record, tables: bytes) -> list[Fault]:
    """Faults of a record that does not agree with the attributes of its version."""
    store = VerifiedStore(place, record)
    tree = open_datatree(store, engine="zarr", consolidated=True, chunks=None)  # type: ignore[arg-type]
    root = json_object(place.read_small(f"{record.path}/zarr.json"))
    wrong = [] if root.get("attributes") == record.provenance else ["provenance"]
    if record.kind not in KINDS_OF_ONE_SUBJECT:
        wrong += [] if read_names(place, record.path) == [*record.names] else ["names"]
    contents = {
        str(name): describe(node.to_dataset()) for name, node in tree.children.items()
    }
    contents |= (
        {TABLES: describe(tables_from_json(json_object(tables)))} if tables else {}
    )
    wrong += [] if contents == record.contents else ["contents"]
    wrong += [] if sum(place.sizes(record.path).values()) == record.bytes else ["bytes"]
    finding = f"different {', '.join(wrong)}"
    return [Fault(record.title, AS_RECORDED, finding, RESTORE)] if wrong else []
