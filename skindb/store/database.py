"""A database: a folder of versions and their log."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import xarray as xr

from skindb.errors import Fault, InputError
from skindb.schema import SCHEMA_VERSION
from skindb.store.folder import Folder
from skindb.store.log import Log, Record
from skindb.store.stage import SHARD, Stage, require_text

TAKE = r"[A-Za-z0-9_-]{1,64}(\.[A-Za-z0-9_-]{1,64})?"
KIND = r"[a-z]{1,32}"
CURE = "restore this file from a backup, or make the version anew"


class Database:
    """Reads and stages versions; holds no state but its place.

    Parameters
    ----------
    url
        Folder; it is made by the first commit.
    """

    def __init__(self, url: str | os.PathLike[str]) -> None:
        text = os.fspath(url)
        if "://" in text:
            raise InputError(Fault(text, "a database is a local folder", "a URL", "buckets are not supported yet"))
        self.root = Path(text)
        if self.root.exists() and not self.root.is_dir():
            raise InputError(Fault(text, "a database is a folder", "a file", "name another folder"))
        self._place = Folder(self.root)

    def __repr__(self) -> str:
        return f"<skindb.Database {str(self.root)!r}: {len(self.takes())} takes>"

    def kinds(self, take: str | None = None) -> list[str]:
        """Kinds of versions there are, of one take or of any."""
        names = [kind for kind in self._place.children("log") if re.fullmatch(KIND, kind)]
        return [kind for kind in names if (take in self.takes(kind) if take else self.takes(kind))]

    def takes(self, kind: str = "capture") -> list[str]:
        """Takes with a committed version of this kind."""
        names = self._place.children(f"log/{require_text(kind, KIND, 'kind')}")
        return [take for take in names if re.fullmatch(TAKE, take) and Log(self._place, kind, take).generations()]

    def subjects(self) -> list[str]:
        """Subjects with at least one capture."""
        return sorted({take.partition(".")[0] for take in self.takes("capture")})

    def record(self, kind: str, take: str, generation: int | None = None) -> Record:
        """The record of a version, default the current one."""
        return self._log(kind, take).read(generation)

    def history(self, kind: str, take: str) -> list[Record]:
        """Every record, oldest first."""
        log = self._log(kind, take)
        return [log.read(generation) for generation in log.generations()]

    def read(self, kind: str, take: str, *, generation: int | None = None) -> xr.DataTree:
        """A version as a lazy DataTree, 4,096 surfels a block; the root's attributes are its provenance.

        `generation` is which version it is, and `consent_scope` what the subject's newest capture of the take says: who
        narrows a consent narrows what may be done with everything made before.
        """
        record = self.record(kind, take, generation)
        if record.provenance.get("schema_version", 0) > SCHEMA_VERSION:
            found = f"schema version {record.provenance['schema_version']}"
            raise InputError(Fault(record.path, f"this skindb reads up to {SCHEMA_VERSION}", found, "update skindb"))
        if "zarr.json" not in self._place.children(record.path):
            where = self._place.url(record.path)
            raise InputError(Fault(where, "the version of the log must exist", "nothing", "run skindb verify"))
        # chunks={} would pick the inner chunk: sixteen times the tasks
        store = self._place.zarr(record.path, read_only=True)
        tree = xr.open_datatree(store, engine="zarr", consolidated=False, chunks=None)  # type: ignore[arg-type]
        blocked = tree.map_over_datasets(_in_blocks)
        blocked.attrs = tree.attrs | {"generation": record.generation}
        if kind not in ("capture", "population") and Log(self._place, "capture", take).generations():
            blocked.attrs["consent_scope"] = self.record("capture", take).provenance.get("consent_scope", [])
        return blocked

    def source(self, version: xr.DataTree, kind: str = "capture") -> xr.DataTree:
        """The version of this kind that another was made from, as its provenance names it; not a newer one."""
        for made_from in version.attrs.get("inputs", []):
            if made_from["kind"] == kind:
                return self.read(kind, made_from["take"], generation=made_from["generation"])
        where = str(version.attrs.get("take", "version"))
        raise InputError(Fault(where, f"its provenance must name a {kind}", "none", "make the version anew"))

    def stage(self, kind: str, take: str) -> Stage:
        """A version to write; see `Stage`."""
        require_text(kind, KIND, "kind")
        require_text(take, TAKE, "take")
        return Stage(self._place, kind, take)

    def info(self) -> dict[str, Any]:
        """{"takes": {take: {kind: {generation, path, created, bytes}}}}; a damaged record shows as its fault.

        Studies of a population are no takes: they are below "studies", where there are any, in the same form.
        """
        takes: dict[str, Any] = {}
        studies: dict[str, Any] = {}
        for kind in self.kinds():
            for take in self.takes(kind):
                found = studies if kind == "population" else takes
                found.setdefault(take, {})[kind] = self._summary(kind, take)
        return {"takes": dict(sorted(takes.items()))} | ({"studies": dict(sorted(studies.items()))} if studies else {})

    def verify(self) -> list[Fault]:
        """Re-read every record and every file of every version and compare; all damage at once."""
        faults: list[Fault] = []
        for kind in self.kinds():
            for take in self.takes(kind):
                log = self._log(kind, take)
                known = log.generations()
                for generation in range(1, known[-1] + 1):
                    try:
                        faults += _damage(self._place, log.read(generation))
                    except InputError as error:
                        faults += error.faults
        return faults

    def _log(self, kind: str, take: str) -> Log:
        require_text(kind, KIND, "kind")
        require_text(take, TAKE, "take")
        log = Log(self._place, kind, take)
        if not log.generations():
            takes, kinds = self.takes(kind), self.kinds()
            there = f"takes: {', '.join(takes)}" if takes else f"no {kind}; kinds: {', '.join(kinds) or 'none'}"
            raise InputError(
                Fault(f"{self.root}: {kind} of {take}", "the database must hold it", there, "see skindb info")
            )
        return log

    def _summary(self, kind: str, take: str) -> dict[str, Any]:
        try:
            record = self.record(kind, take)
        except InputError as error:
            return {"fault": str(error)}
        path, created = self._place.url(record.path), record.created
        summary = {"generation": record.generation, "path": path, "created": created, "bytes": record.bytes}
        return summary | {"status": record.provenance.get("status", {})}


def _in_blocks(ds: xr.Dataset) -> xr.Dataset:
    return ds.chunk(surfel=SHARD) if "surfel" in ds.dims else ds


def _damage(place: Folder, record: Record) -> list[Fault]:
    there = set(place.files(record.path))
    faults = []
    for name in sorted(there | record.files.keys()):
        key = f"{record.path}/{name}"
        if name not in there:
            faults.append(Fault(key, "every file of a version must exist", "nothing", CURE))
        elif name not in record.files:
            faults.append(Fault(key, "a version is never changed", "an unknown file", "remove it"))
        elif wrong := _unlike(place, key, record.files[name]):
            faults.append(Fault(key, "a version is never changed", wrong, CURE))
    return faults


def _unlike(place: Folder, key: str, digest: str) -> str:
    try:
        return "" if place.digest(key) == digest else "other bytes than committed"
    except OSError as error:  # a dying disk hides no other damage
        return f"a file that cannot be read ({error.strerror})"
