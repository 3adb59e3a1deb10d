"""What the store asks of the place where a database is: a local folder or a bucket."""

from __future__ import annotations

from collections.abc import Hashable
from pathlib import Path
from typing import Protocol

from zarr.abc.store import Store

from skindb.errors import InputError


class UnavailableError(InputError):
    """A place that gives no answer, or refuses access: what it holds is unknown, and nothing is known to be damaged."""


class Place(Protocol):
    """A place that keeps bytes under keys, which are relative, with "/" between their parts.

    A key that would leave the place is an `InputError`. A missing file is a `FileNotFoundError`, any other that cannot
    be read an `OSError`; both have a `strerror` for people.
    """

    @property
    def name(self) -> str:
        """How messages name the place; two of one name are the same."""

    def writable(self, key: str) -> Store:
        """A zarr store at a key, to be written; versions are read through `VerifiedStore`."""

    def scratch(self) -> Path:
        """A local folder for temporary files; it need not exist yet."""

    def url(self, key: str) -> str:
        """Where a person finds a key."""

    def where(self, key: str) -> str:
        """How messages name a key, which may be anything."""

    def names(self) -> list[str] | None:
        """Names at the top of the place; None if there is no such place."""

    def children(self, key: str, *, links: bool = False) -> list[str]:
        """Names right below a key, sorted, without symbolic links unless asked for; empty if there is nothing."""

    def file_type(self, key: str) -> str:
        """What is at a key: "folder", "file", "link" or "other"; empty if there is nothing."""

    def sizes(self, key: str) -> dict[str, int]:
        """Bytes of every file below a key, by its path relative to it; -1 for what is no regular file."""

    def read(self, key: str, begin: int = 0, end: int | None = None) -> bytes:
        """Contents of a file from byte `begin`, counted from its end if negative, up to `end`."""

    def read_small(self, key: str) -> bytes:
        """Contents of a JSON file, whose size is limited."""

    def digest(self, key: str) -> str:
        """Digest sha256 of a file."""

    def identity(self, key: str) -> tuple[Hashable, ...]:
        """What changes whenever the file at a key is written or replaced."""

    def identities(self, key: str) -> dict[str, tuple[Hashable, ...]]:
        """The identity of every file below a key, by its path relative to it; (-1,) for what is no regular file."""

    def proves(self, identity: tuple[Hashable, ...], content: bytes) -> bool:
        """Whether an identity from `identities` shows, without reading the file, that it holds exactly this."""

    def modified(self, key: str) -> float:
        """When a file, or the newest file below a key, was written, in seconds by the clock of the storage."""

    def now(self) -> float:
        """The clock of the storage: the same for all machines that share it, whatever their own clocks say."""

    def make_durable(self, key: str, *, flush: bool = True) -> None:
        """Return once everything below a key survives a loss of power; without `flush`, once other processes see it."""

    def create(self, key: str, data: bytes) -> bool:
        """Write a file that must not exist; False, and nothing written, if it does. Durable when this returns."""

    def replace(self, key: str, data: bytes) -> None:
        """Write a small file, whole or not at all; an older one is replaced. For caches only."""

    def remove(self, key: str) -> None:
        """Delete a file, or everything below a key; nothing if there is nothing."""
