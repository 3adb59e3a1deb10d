"""Leases, which allow only one run at a time to work on a kind of versions of a take,
on all machines of a storage.

A lease is the file with the highest number below `leases/<kind>/<take>/`. If that file
is free, a process acquires the lease by creating the file with the next number, which
succeeds only if the file does not exist yet. Numbers are never reused, so that a holder
that was suspended can always detect another holder. The holder rewrites its file
regularly. A file that was not rewritten within the duration that it states is free;
ages are measured by the clock of the storage, because the clocks of the machines may
differ. Leases only prevent wasted work: the log alone decides what is committed.
"""

import json
import os
import re
import socket
import threading
import time
import uuid
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from skindb.clock import SYSTEM_CLOCK, Clock, utc_time
from skindb.errors import Fault, InputError, input_error
from skindb.files import Attributes, Json
from skindb.store.markers import WithdrawalGuard, WithdrawnError
from skindb.store.place import (
    KIND,
    KINDS_WITHOUT_SUBJECT,
    TAKE,
    Place,
    require_text,
    subject_of,
)
from skindb.store.record import json_object

# without a renewal; a compilation can delay the renewing thread for some of them
LEASE_SECONDS = 60.0
RENEWALS = 4  # within the duration of a lease
MAX_LEASE_SECONDS = 3600.0  # limit for the durations in files, which may be damaged
POLL_SECONDS = 0.5  # between two attempts to acquire a lease
PROC = Path("/proc")
# equal for processes that can find each other by their ids
MACHINE_KEYS = ("boot", "namespace")
NUMBER = re.compile(r"([0-9]{8})\.json")
ONE_RUN = "only one run at a time may work on it"


class LeaseLost(InputError):  # noqa: N818  an event, not an error of the program
    """Another run took over the lease, because this one did not renew it; nothing was committed."""


@dataclass(frozen=True)
class Claim:
    """File of a lease."""

    key: str
    number: int
    body: Json = field(repr=False)

    @property
    def seconds(self) -> float:
        """Duration of the lease after the file was written."""
        value = self.body.get("seconds")
        if isinstance(value, bool) or not isinstance(value, int | float):
            return LEASE_SECONDS
        if 0 < value <= MAX_LEASE_SECONDS:
            return float(value)
        return LEASE_SECONDS

    @property
    def is_released(self) -> bool:
        """Whether the holder released the lease."""
        return "released" in self.body

    def __str__(self) -> str:
        """Holder and start of the lease, as shown in messages."""
        holder = self.body.get("holder")
        if not isinstance(holder, dict):
            return "a lease that cannot be read"
        command, host = (
            str(holder.get(name, "unknown")) for name in ("command", "host")
        )
        process = holder.get("process")
        return f"{command} on {host} (process {process}) since {self.body.get('since')}"


class Lease:
    """Exclusive right to work on some kinds of versions of a take, as a context manager.

    Parameters
    ----------
    place, take, kinds
        Location of the database, take, and kinds of versions.
    wait
        Seconds to wait for another run; 0 raises an error immediately.
    seconds
        Seconds without a renewal after which the lease expires.
    command
        Name of the command, shown in messages of other runs; it must not contain personal data.
    clock
        Clock by which this process waits for another run.

    Raises
    ------
    InputError
        On entering, if another run holds one of the leases; the message names the
        holder and the start of its lease.
    """

    def __init__(
        self,
        place: Place,
        take: str,
        kinds: tuple[str, ...],
        *,
        wait: float = 0.0,
        seconds: float = LEASE_SECONDS,
        command: str = "python",
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        require_text(take, TAKE, "take")
        if not 0 < seconds <= MAX_LEASE_SECONDS:
            rule = f"the seconds of a lease must be above 0 and at most {MAX_LEASE_SECONDS:.0f}"
            raise ValueError(f"{rule}; found {seconds}")
        self.place = place
        self.wait = wait
        self.seconds = seconds
        self.keys = [
            f"leases/{require_text(kind, KIND, 'kind')}/{take}"
            for kind in sorted(set(kinds))
        ]
        self.token = uuid.uuid4().hex
        self.command = command
        self._clock = clock
        self._held: dict[str, int] = {}  # key -> number of its file
        self._content = b""
        self._lost: Fault | None = None
        self._ended = threading.Event()
        self._turn = threading.Lock()
        of_subject = {*kinds} - {*KINDS_WITHOUT_SUBJECT}
        subjects = {subject_of(take)} if of_subject else set()
        self._guard = WithdrawalGuard(place, frozenset(subjects))

    def __enter__(self) -> Self:
        end = self._clock.monotonic() + self.wait
        self._ended.clear()
        self._guard()
        try:
            while (holder := self._claim_all()) is not None:
                if (remaining := end - self._clock.monotonic()) <= 0:
                    raise input_error(
                        _lease_name(holder.key),
                        ONE_RUN,
                        str(holder),
                        "wait for it (--wait SECONDS) or end it; its lease expires "
                        f"{holder.seconds:.0f} s after its last renewal",
                    )
                self._clock.sleep(min(POLL_SECONDS, remaining))
        except BaseException:  # for example an interrupt or a full disk
            self._release()
            raise
        threading.Thread(
            target=self._renew_until_end, name="skindb lease", daemon=True
        ).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        with self._turn:
            self._release()

    def require(self) -> None:
        """Check in the storage that this run still holds the leases.

        Raises
        ------
        LeaseLost
            If another run took over, because this process was suspended for longer than
            the duration of its lease. A process that was suspended keeps the lease if
            no other run requested it.
        """
        if not self._held:
            raise ValueError("a lease must be used inside its with statement")
        self._renew()
        # again, because another run may have found the lease free just before the
        # renewal
        self.check()

    def _renew_until_end(self) -> None:
        while not self._ended.wait(self.seconds / RENEWALS):
            try:
                self._renew()
            except (LeaseLost, WithdrawnError):
                return  # `require` raises it again
            except (OSError, InputError):
                # a full disk or no connection: the next attempt may succeed
                continue

    def _renew(self) -> None:
        with self._turn:
            if self._ended.is_set():
                return
            self.check()
            for key, number in self._held.items():
                self.place.replace(
                    _file_key(key, number), self._content, guard=self._guard
                )

    def check(self) -> None:
        """Raise `LeaseLost` unless the newest file of every lease is that of this run;
        nothing is renewed.
        """
        for key in self._held:
            newest = _newest(self.place, key)
            if self._lost or (newest and newest.body.get("token") == self.token):
                continue
            finding = "another run took over, because this one did not renew its lease"
            if newest is None:
                finding = "the lease was removed"
            elif not newest.is_released:
                finding += f": {newest}"
            cure = "nothing was committed; run the command again"
            self._lost = Fault(_lease_name(key), ONE_RUN, finding, cure)
        if self._lost:
            raise LeaseLost(self._lost)

    def _claim_all(self) -> Claim | None:
        """Acquire all leases and return None, or acquire none and return the claim of
        another holder.
        """
        body = {
            "token": self.token,
            "holder": this_process() | {"command": self.command},
            "seconds": self.seconds,
            "since": utc_time(),
        }
        self._content = json.dumps(body).encode()
        for key in self.keys:  # sorted, so that two runs never wait for each other
            holder = self._claim(key)
            if holder is not None:
                self._release()
                return holder
        return None

    def _claim(self, key: str) -> Claim | None:
        before = _newest(self.place, key)
        if before is not None and not _has_ended(self.place, before):
            return before
        number = 1 + (before.number if before else 0)
        file = _file_key(key, number)
        try:
            created = self.place.create(file, self._content, guard=self._guard)
        except WithdrawnError:
            self.place.remove(file)
            raise
        now = _newest(self.place, key)
        if now is None or now.body.get("token") != self.token:
            if created:  # others have created higher numbers meanwhile
                self.place.remove(file)
            return now or Claim(key, number, {})
        self._held[key] = number
        for older in _numbers(self.place, key):
            if older < number:
                self.place.remove(_file_key(key, older))
        return None

    def _release(self) -> None:
        """Mark the leases as free, without the holder; their numbers are not reused."""
        content = json.dumps({"released": utc_time()}).encode()
        with suppress(OSError, InputError):  # otherwise the lease expires
            for key, number in self._held.items():
                newest = _newest(self.place, key)
                if newest is None or newest.body.get("token") != self.token:
                    continue
                file = _file_key(key, number)
                try:
                    self.place.replace(file, content, guard=self._guard)
                except OSError:
                    # the disk may be full; without its file the lease is free, even
                    # while this process continues
                    self.place.remove(file)
        self._held.clear()


def holder_of(place: Place, kind: str, take: str) -> str:
    """The process that holds the lease of a kind of versions of a take; empty if there is none."""
    newest = _newest(place, f"leases/{kind}/{take}")
    return "" if newest is None or _has_ended(place, newest) else str(newest)


def abandoned_holder(place: Place, kind: str, take: str) -> str:
    """The last holder of a lease, if it was killed or lost; empty if it released the
    lease or still holds it.
    """
    newest = _newest(place, f"leases/{kind}/{take}")
    if newest is None or newest.is_released or not _has_ended(place, newest):
        return ""
    return str(newest)


def _has_ended(place: Place, claim: Claim) -> bool:
    """Whether the holder of a claim released it, has ended, or has not renewed it in time.

    A file from the future is that of a holder that has not renewed it since the clock of
    the storage was set back; on this machine, a holder that has not ended will do so.
    """
    holder = claim.body.get("holder")
    holder = holder if isinstance(holder, dict) else {}
    if claim.is_released or has_ended(holder):
        return True
    try:
        written = place.modified(_file_key(claim.key, claim.number))
    except FileNotFoundError:  # removed meanwhile
        return False
    age = storage_time(place) - written
    return age > claim.seconds or (age < -claim.seconds and not _is_here(holder))


def storage_time(place: Place) -> float:
    """Time of the clock of the storage, or of this machine if the storage is read-only."""
    try:
        return place.now()
    except OSError:
        return time.time()


def _newest(place: Place, key: str) -> Claim | None:
    while numbers := _numbers(place, key):
        try:
            body = json_object(place.read_small(_file_key(key, numbers[-1])))
        except FileNotFoundError:  # taken over since the numbers were listed
            continue
        except (OSError, ValueError, RecursionError):
            body = {}
        return Claim(key, numbers[-1], body)
    return None


def _numbers(place: Place, key: str) -> list[int]:
    return sorted(
        int(match[1])
        for name in place.children(key)
        if (match := NUMBER.fullmatch(name))
    )


def _file_key(key: str, number: int) -> str:
    return f"{key}/{number:08d}.json"


def _lease_name(key: str) -> str:
    _, kind, take = key.split("/")
    return f"{kind} of {take}"


def this_process() -> Json:
    """Host name, process id and, on Linux, the boot id, the namespace of process ids
    and the start time.
    """
    number = os.getpid()
    names = {"host": socket.gethostname(), "process": number, "started": _start(number)}
    return names | _machine()


def has_ended(holder: Attributes) -> bool:
    """Whether a process described by `this_process` has certainly ended; False for a
    process of another machine.
    """
    number = holder.get("process")
    started = holder.get("started")
    if not _is_here(holder) or not started:
        return False
    if not isinstance(number, int) or not 0 < number < 1 << 31:
        return False
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return True
    except OSError:  # a process of another user
        pass
    now = _start(number)
    return now not in (started, None)


def _is_here(holder: Attributes) -> bool:
    here = _machine()
    return all(here[name] and here[name] == holder.get(name) for name in MACHINE_KEYS)


def _machine() -> dict[str, str]:
    try:
        boot = (PROC / "sys/kernel/random/boot_id").read_text().strip()
        return {"boot": boot, "namespace": str((PROC / "self/ns/pid").readlink())}
    except OSError:
        return dict.fromkeys(MACHINE_KEYS, "")


def _start(number: int) -> str | None:
    """Start of a process in clock ticks since the boot; "ended" for a zombie process;
    None if unknown.
    """
    try:
        status = (PROC / f"{number}/stat").read_text()
        state, *rest = status.rpartition(")")[2].split()
    except (OSError, ValueError):
        return None
    return "ended" if state in "ZX" else rest[18]
