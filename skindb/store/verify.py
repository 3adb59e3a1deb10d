"""Every record and every file read again and compared; all damage at once."""

from __future__ import annotations

from skindb.errors import Fault, InputError
from skindb.store.folder import Folder
from skindb.store.log import Log, Record
from skindb.store.stage import TABLES
from skindb.store.verified import AS_COMMITTED, CURE, read_beside, read_manifest


def log_faults(place: Folder, log: Log) -> list[Fault]:
    """Damage of the records of one kind and take, and of the versions they name."""
    faults = log.faults()
    for generation in log.generations():
        try:
            record = log.read(generation)
        except InputError:
            continue  # `Log.faults` has told it
        faults += version_faults(place, record)
    return faults


def version_faults(place: Folder, record: Record) -> list[Fault]:
    """Damage of one version."""
    try:
        manifest = read_manifest(place, record)
        if record.tables:
            read_beside(place, record, TABLES, record.tables)
    except InputError as error:
        return list(error.faults)
    there, faults = place.sizes(record.path), []
    for name in sorted(there.keys() | manifest.keys()):
        key = f"{record.path}/{name}"
        if name not in there:
            faults.append(Fault(key, AS_COMMITTED, "nothing", CURE))
        elif name not in manifest:
            faults.append(Fault(key, AS_COMMITTED, "an unknown file", "remove it"))
        elif there[name] < 0:
            faults.append(Fault(key, AS_COMMITTED, "no regular file", CURE))
        elif found := _difference(place, key, manifest[name][0]):
            faults.append(Fault(key, AS_COMMITTED, found, CURE))
    return faults


def _difference(place: Folder, key: str, digest: str) -> str:
    try:
        return "" if place.digest(key) == digest else "other bytes"
    except OSError as error:  # a dying disk hides no other damage
        return f"a file that cannot be read ({error.strerror})"
