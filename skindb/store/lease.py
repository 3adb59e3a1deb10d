"""Leases: only one run at a time works on a kind of versions of a take, on all machines that share the storage.

A lease is the file with the highest number below `leases/<kind>/<take>/`. A process that needs it creates the next
number, if the highest one is free and no other process was faster: a file is created only if it is absent. Numbers are
never used again, so that a holder that was suspended can always detect whether there was another one. The holder
rewrites its file regularly; a file that was not rewritten for as long as it says is free, by the clock of the storage:
those of the machines may differ. A lease keeps runs from working in vain; what is committed is decided by the log
alone.
"""

from __future__ import annotations

import json
import re
import threading
import time
import uuid
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from types import TracebackType
from typing import Any, Self

from skindb.errors import Fault, InputError
from skindb.store.paths import KIND, TAKE, require_text
from skindb.store.place import Place
from skindb.store.process import has_ended, this_process
from skindb.store.record import json_object

LEASE_SECONDS = 60.0  # without a sign of life; a compilation keeps the renewing thread waiting for some of them
RENEWALS = 4  # in the time of a lease
MAX_LEASE_SECONDS = 3600.0  # no damaged file keeps a take for longer
POLL_SECONDS = 0.5  # between two looks at a lease that is waited for
NUMBER = re.compile(r"([0-9]{8})\.json")


class LeaseLost(InputError):  # noqa: N818  what happened, not an error of the program
    """Another run took over because this one did not renew its lease; nothing was committed."""


@dataclass(frozen=True)
class Claim:
    """A file of a lease."""

    key: str
    number: int
    body: dict[str, Any] = field(repr=False)

    @property
    def seconds(self) -> float:
        """Seconds for which it is valid after it was written."""
        value = self.body.get("seconds")
        usable = isinstance(value, int | float) and not isinstance(value, bool) and 0 < value <= MAX_LEASE_SECONDS
        return float(value) if usable else LEASE_SECONDS  # type: ignore[arg-type]

    @property
    def is_released(self) -> bool:
        """Whether its holder has finished."""
        return "released" in self.body

    def __str__(self) -> str:
        """Holder and start, as messages show them."""
        holder = self.body.get("holder")
        if not isinstance(holder, dict):
            return "a lease that cannot be read"
        by, where = (str(holder.get(name, "unknown")) for name in ("command", "host"))
        return f"{by} on {where} (process {holder.get('process')}) since {self.body.get('since')}"


class Lease:
    """Exclusive right to work on kinds of versions of a take; a context manager.

    Parameters
    ----------
    place, take, kinds
        What is worked on.
    wait
        Seconds to wait for another run; 0 refuses at once.
    seconds
        After which a holder that gave no sign of life loses the lease.
    command
        What messages to others name; nothing personal.

    Raises
    ------
    InputError
        On entering, if another run holds one of the leases; its line says who and since when.
    """

    def __init__(
        self, place: Place, take: str, kinds: tuple[str, ...], *,
        wait: float = 0.0, seconds: float = LEASE_SECONDS, command: str = "python",
    ) -> None:  # fmt: skip
        require_text(take, TAKE, "take")
        if not 0 < seconds <= MAX_LEASE_SECONDS:
            raise ValueError(f"a lease holds for up to {MAX_LEASE_SECONDS:.0f} s, not {seconds}")
        self.place, self.wait, self.seconds = place, wait, seconds
        self.keys = [f"leases/{require_text(kind, KIND, 'kind')}/{take}" for kind in sorted(set(kinds))]
        self.token, self.command = uuid.uuid4().hex, command
        self._held: dict[str, int] = {}  # key -> number of its file
        self._seen: dict[str, tuple[tuple[int, float], float]] = {}  # what others wrote, and since when we know it
        self._content = b""
        self._lost: Fault | None = None
        self._ended, self._turn = threading.Event(), threading.Lock()

    def __enter__(self) -> Self:
        end = time.monotonic() + self.wait
        self._ended.clear()
        try:
            while (holder := self._claim_all()) is not None:
                if (left := end - time.monotonic()) <= 0:
                    raise InputError(_held_by(holder))
                time.sleep(min(POLL_SECONDS, left))
        except BaseException:  # an interrupt, a full disk
            self._release()
            raise
        threading.Thread(target=self._renew_until_end, name="skindb lease", daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        with self._turn:
            self._release()

    def require(self) -> None:
        """Check with the storage that no other process took over.

        Raises
        ------
        LeaseLost
            If another run did, because this process slept for longer than its lease. A process that slept while
            no other process asked for the take keeps it.
        """
        if not self._held:
            raise ValueError("a lease holds inside its with statement only")
        self._renew()
        self._check()  # again: another run may have found the lease free just before it was renewed

    def _renew_until_end(self) -> None:
        while not self._ended.wait(self.seconds / RENEWALS):
            try:
                self._renew()
            except LeaseLost:
                return  # `require` says it again
            except (OSError, InputError):  # a full disk, or no connection: the next time may be better
                continue

    def _renew(self) -> None:
        with self._turn:
            if self._ended.is_set():
                return
            self._check()
            for key, number in self._held.items():
                self.place.replace(_file(key, number), self._content)

    def _check(self) -> None:
        """`LeaseLost` unless the newest file of every lease is that of this run."""
        for key in self._held:
            newest = _newest(self.place, key)
            if newest is None or newest.body.get("token") != self.token:
                self._lost = self._lost or _lost_to(key, newest)
        if self._lost:
            raise LeaseLost(self._lost)

    def _claim_all(self) -> Claim | None:
        """Take every lease and return None, or none of them and return who holds one."""
        body = {"token": self.token, "holder": this_process() | {"command": self.command}, "seconds": self.seconds}
        body["since"] = datetime.now(UTC).isoformat(timespec="seconds")
        self._content = json.dumps(body).encode()
        for key in self.keys:  # sorted: two runs never wait for each other
            holder = self._claim(key)
            if holder is not None:
                self._release()
                return holder
        return None

    def _claim(self, key: str) -> Claim | None:
        before = _newest(self.place, key)
        if before is not None and not self._is_free(before):
            return before
        number = 1 + (before.number if before else 0)
        created = self.place.create(_file(key, number), self._content)
        now = _newest(self.place, key)
        if now is None or now.body.get("token") != self.token:
            if created:  # the others went on to higher numbers since we looked
                self.place.remove(_file(key, number))
            return now or Claim(key, number, {})
        self._held[key] = number
        for older in (one for one in _numbers(self.place, key) if one < number):
            self.place.remove(_file(key, older))
        return None

    def _is_free(self, claim: Claim) -> bool:
        """Whether a claim has ended, or was seen unchanged for so long that it has, whatever the clocks say."""
        if _has_ended(self.place, claim):
            return True
        try:
            mark, now = (claim.number, self.place.modified(_file(claim.key, claim.number))), _uptime()
        except FileNotFoundError:  # removed at this moment: look again
            return False
        if self._seen.get(claim.key, (None, 0.0))[0] != mark:
            self._seen[claim.key] = (mark, now)
        return now - self._seen[claim.key][1] > claim.seconds

    def _release(self) -> None:
        """Mark what is held as free, without naming its holder; the number stays used."""
        content = json.dumps({"released": datetime.now(UTC).isoformat(timespec="seconds")}).encode()
        with suppress(OSError, InputError):  # it ends by itself
            for key, number in self._held.items():
                newest = _newest(self.place, key)
                if newest is not None and newest.body.get("token") == self.token:
                    self._free(_file(key, number), content)
        self._held.clear()

    def _free(self, key: str, content: bytes) -> None:
        try:
            self.place.replace(key, content)
        except OSError:  # a full disk: without the file the lease is free as well, also while this process lives on
            self.place.remove(key)


def holder_of(place: Place, kind: str, take: str) -> str:
    """The process that works on a kind of versions of a take; empty if there is none."""
    newest = _newest(place, f"leases/{kind}/{take}")
    return "" if newest is None or _has_ended(place, newest) else str(newest)


def abandoned_by(place: Place, kind: str, take: str) -> str:
    """The last process that worked on it, if it was killed or lost; empty if the last run finished or is running."""
    newest = _newest(place, f"leases/{kind}/{take}")
    left = newest is not None and not newest.is_released and _has_ended(place, newest)
    return str(newest) if left else ""


def _has_ended(place: Place, claim: Claim) -> bool:
    """Whether the holder of a claim released it, has ended, or has not renewed it for too long."""
    holder = claim.body.get("holder")
    if claim.is_released or (isinstance(holder, dict) and has_ended(holder)):
        return True
    try:
        return storage_time(place) - place.modified(_file(claim.key, claim.number)) > claim.seconds
    except FileNotFoundError:  # removed at this moment
        return False


def storage_time(place: Place) -> float:
    """Time of the clock of the storage, or of this machine if the storage is read-only."""
    try:
        return place.now()
    except OSError:
        return time.time()


def _newest(place: Place, key: str) -> Claim | None:
    while numbers := _numbers(place, key):
        try:
            body = json_object(place.read_small(_file(key, numbers[-1])))
        except FileNotFoundError:  # taken over between the two looks
            continue
        except (OSError, ValueError, RecursionError):
            body = {}
        return Claim(key, numbers[-1], body)
    return None


def _numbers(place: Place, key: str) -> list[int]:
    return sorted(int(match[1]) for name in place.children(key) if (match := NUMBER.fullmatch(name)))


def _file(key: str, number: int) -> str:
    return f"{key}/{number:08d}.json"


def _what(key: str) -> str:
    _, kind, take = key.split("/")
    return f"{kind} of {take}"


def _held_by(claim: Claim) -> Fault:
    cure = f"wait for it (--wait SECONDS) or end it; its lease ends {claim.seconds:.0f} s after its last sign of life"
    return Fault(_what(claim.key), "one run at a time", str(claim), cure)


def _lost_to(key: str, newest: Claim | None) -> Fault:
    found = "another run took over while this one gave no sign of life"
    if newest is None:
        found = "the lease was removed"
    elif not newest.is_released:
        found += f": {newest}"
    return Fault(_what(key), "one run at a time", found, "nothing was committed; run the command again")


def _uptime() -> float:
    """Seconds that count also while the machine is suspended."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))
