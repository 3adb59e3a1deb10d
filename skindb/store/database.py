"""A database: a folder of versions and their log."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import xarray as xr

from skindb.errors import Fault, InputError
from skindb.schema import SCHEMA_VERSION
from skindb.store.log import Log, Record
from skindb.store.stage import SHARD, Stage, digest, files_of, require_text

TAKE = r"[A-Za-z0-9_-]{1,64}(\.[A-Za-z0-9_-]{1,64})?"
KIND = r"[a-z]{1,32}"


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

    def __repr__(self) -> str:
        return f"<skindb.Database {str(self.root)!r}: {len(self.takes())} takes>"

    def kinds(self, take: str | None = None) -> list[str]:
        """Kinds of versions there are, of one take or of any."""
        log = self.root / "log"
        names = sorted(p.name for p in log.iterdir() if p.is_dir()) if log.is_dir() else []
        return [kind for kind in names if (take in self.takes(kind) if take else self.takes(kind))]

    def takes(self, kind: str = "capture") -> list[str]:
        """Takes with a committed version of this kind."""
        folder = self.root / "log" / require_text(kind, KIND, "kind")
        names = sorted(p.name for p in folder.iterdir() if p.is_dir()) if folder.is_dir() else []
        return [take for take in names if Log(self.root, kind, take).generations()]

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
        """A version as a lazy DataTree, 4,096 surfels a block; the root's attributes are its provenance."""
        record = self.record(kind, take, generation)
        if record.provenance.get("schema_version", 0) > SCHEMA_VERSION:
            found = f"schema version {record.provenance['schema_version']}"
            raise InputError(Fault(record.path, f"this skindb reads up to {SCHEMA_VERSION}", found, "update skindb"))
        path = self.root / record.path
        if not path.is_dir():
            raise InputError(Fault(str(path), "the version of the log must exist", "nothing", "run skindb verify"))
        # chunks={} would pick the inner chunk: sixteen times the tasks
        tree = xr.open_datatree(path, engine="zarr", consolidated=False, chunks=None)
        blocked = tree.map_over_datasets(_in_blocks)
        blocked.attrs = tree.attrs
        return blocked

    def stage(self, kind: str, take: str) -> Stage:
        """A version to write; see `Stage`."""
        require_text(kind, KIND, "kind")
        require_text(take, TAKE, "take")
        return Stage(self.root, kind, take)

    def info(self) -> dict[str, Any]:
        """{"takes": {take: {kind: {generation, path, created, bytes}}}}; a damaged record shows as its fault."""
        takes: dict[str, Any] = {}
        for kind in self.kinds():
            for take in self.takes(kind):
                takes.setdefault(take, {})[kind] = self._summary(kind, take)
        return {"takes": dict(sorted(takes.items()))}

    def verify(self) -> list[Fault]:
        """Re-read every file of every version and compare with the log; all damage at once."""
        faults: list[Fault] = []
        for kind in self.kinds():
            for take in self.takes(kind):
                log = self._log(kind, take)
                for generation in log.generations():
                    try:
                        faults += _damage(self.root, log.read(generation))
                    except InputError as error:
                        faults += error.faults
        return faults

    def _log(self, kind: str, take: str) -> Log:
        require_text(kind, KIND, "kind")
        require_text(take, TAKE, "take")
        if take not in self.takes(kind):
            there = ", ".join(self.takes(kind)) or "none"
            raise InputError(
                Fault(
                    f"{self.root}: {kind} of {take}", "the database must hold it", f"takes: {there}", "see skindb info"
                )
            )
        return Log(self.root, kind, take)

    def _summary(self, kind: str, take: str) -> dict[str, Any]:
        try:
            record = self.record(kind, take)
        except InputError as error:
            return {"fault": str(error)}
        path = str((self.root / record.path).resolve())
        summary = {"generation": record.generation, "path": path, "created": record.created, "bytes": record.bytes}
        return summary | {"status": record.provenance.get("status", {})}


def _in_blocks(ds: xr.Dataset) -> xr.Dataset:
    return ds.chunk(surfel=SHARD) if "surfel" in ds.dims else ds


def _damage(root: Path, record: Record) -> list[Fault]:
    folder = root / record.path
    there = {file.relative_to(folder).as_posix() for file in files_of(folder)} if folder.is_dir() else set()
    where, cure = f"{record.path}/{{}}", "restore this file from a backup, or make the version anew"
    faults = [
        Fault(where.format(f), "every file of a version must exist", "nothing", cure)
        for f in sorted(record.files.keys() - there)
    ]
    faults += [
        Fault(where.format(f), "a version is never changed", "an unknown file", "remove it")
        for f in sorted(there - record.files.keys())
    ]
    for name in sorted(there & record.files.keys()):
        if digest(folder / name) != record.files[name]:
            faults.append(Fault(where.format(name), "a version is never changed", "other bytes than committed", cure))
    return faults
