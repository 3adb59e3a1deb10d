"""The file `unfinished.json` of an interrupted capture: its identity, and the steps
completed so far; and the lock of the folder of a session.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from skindb.errors import Fault, InputError
from skindb.files import make_private, private_file
from skindb.format.fields import read_json
from skindb.hw.sequence import Schedule, Step

UNFINISHED = "unfinished.json"  # removed when the capture is complete
STEP_KEYS = {"light", "exposure", "t_on", "t_off", "trigger_count"}
SITE_KEYS = {"site", "number", "pressure", "suffix", "drift_kpa", "lost_readings"}


@dataclass
class Unfinished:
    """State of an unfinished capture; call `save` after every change."""

    folder: Path
    # values that must not change between the sessions of a capture
    identity: dict[str, Any]
    # complete steps, as dome.json keeps them
    sequence: list[dict[str, Any]] = field(default_factory=list)
    # complete placements of the probe
    sites: list[dict[str, Any]] = field(default_factory=list)
    # the confirmation for the session with the most flashes per second
    override: dict[str, Any] | None = None
    flashes_per_second: int = 0  # of the session with the most
    # the steady lamp: stated and measured brightness, and responsible operator
    lamp: dict[str, Any] | None = None
    running: dict[str, Any] | None = None  # steps that are running, see `begin_run`

    @property
    def started(self) -> bool:
        """Whether the subject was photographed or measured; a session that was refused
        before has no subject.
        """
        recorded = self.sequence or self.sites or self.flashes_per_second
        return bool(recorded) or any(
            (self.folder / name).exists() for name in ("dome", "contact")
        )

    def save(self) -> None:
        """Replace the file atomically, so that a killed process leaves the old or the
        new content.
        """
        record = {name: value for name, value in vars(self).items() if name != "folder"}
        temporary = self.folder / f"{UNFINISHED}.new"
        with temporary.open("w", encoding="utf-8") as file:
            json.dump(record, file, indent=1)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(self.folder / UNFINISHED)

    def count(self, flashes: int, override: Mapping[str, Any] | None) -> None:
        """Record, before a session begins, its flashes per second and their confirmation."""
        if flashes > self.flashes_per_second:
            self.flashes_per_second = flashes
            self.override = dict(override) if override is not None else self.override
        self.save()

    def begin_run(self, part: Schedule, now: float) -> None:
        """Record the steps that run from now on [s since 1970], in case this process is killed."""
        steps = [
            [step.light, step.exposure, step.on_us, step.off_us] for step in part.steps
        ]
        self.running = {"steps": steps, "base": part.base, "started": now}
        self.save()

    def interrupted_run(self) -> tuple[Schedule, float] | None:
        """Steps that ran when the process was killed, and when they began [s since
        1970]; None without such a run.
        """
        if self.running is None:
            return None
        schedule = Schedule(
            tuple(Step(*step) for step in self.running["steps"]), self.running["base"]
        )
        return schedule, self.running["started"]


def open_unfinished(folder: Path, identity: Mapping[str, Any]) -> Unfinished:
    """Begin a capture in a new folder, or resume an unfinished one of the same subject.

    Parameters
    ----------
    folder
        Folder of the capture; created if it does not exist.
    identity
        Values of JSON types that must be the same in all sessions of a capture.

    Raises
    ------
    InputError
        If the folder has other contents, or a capture of another subject or under other conditions.
    """
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        folder.mkdir(parents=True, exist_ok=True)
        begun = Unfinished(folder, dict(identity))
        # also verifies that the folder is writable before any light is switched on
        begun.save()
        return begun
    path = folder / UNFINISHED
    faults = list[Fault]()
    note = read_json(path, faults) if path.is_file() else None
    if faults:
        raise InputError(faults)
    if note is None:
        text = (
            "a complete capture"
            if (folder / "capture.json").is_file()
            else "other files"
        )
        rule = "must be a new folder, or that of an unfinished capture"
        raise InputError(Fault(str(folder), rule, text, "choose another folder"))
    begun = _read(folder, path, note)
    if begun.started:
        _require_same(folder, begun.identity, identity)
    begun.identity = dict(identity)
    begun.save()
    return begun


def _read(folder: Path, path: Path, note: Any) -> Unfinished:
    record: dict[str, Any] = note if isinstance(note, dict) else {}
    identity = record.get("identity")
    override = record.get("override")
    sequence = _entries(record.get("sequence"), STEP_KEYS)
    sites = _entries(record.get("sites"), SITE_KEYS)
    flashes, lamp, running = (
        record.get(name) for name in ("flashes_per_second", "lamp", "running")
    )
    sound = all(
        isinstance(part, dict | None) for part in (override, lamp)
    ) and isinstance(flashes, int)
    sound = sound and (running is None or _is_run(running))
    if not isinstance(identity, dict) or sequence is None or sites is None or not sound:
        cure = "choose another folder; the existing frames are kept"
        raise InputError(
            Fault(
                str(path),
                "must be the record of an unfinished capture",
                "other content",
                cure,
            )
        )
    return Unfinished(
        folder,
        identity,
        sequence,
        sites,
        override,
        int(record["flashes_per_second"]),
        lamp,
        running,
    )


def _is_run(value: Any) -> bool:
    """Whether a value is a record of `Unfinished.begin_run`."""
    if not isinstance(value, dict) or not isinstance(value.get("base"), int):
        return False
    steps = value.get("steps")
    kinds = (str, str, int, int)
    if not isinstance(steps, list) or not isinstance(value.get("started"), int | float):
        return False
    return all(
        isinstance(step, list)
        and len(step) == len(kinds)
        and all(map(isinstance, step, kinds))
        for step in steps
    )


def _entries(value: Any, keys: set[str]) -> list[dict[str, Any]] | None:
    """The value if it is a list of objects with these keys, else None."""
    sound = isinstance(value, list) and all(
        isinstance(entry, dict) and keys <= entry.keys() for entry in value
    )
    return value if sound else None


def _require_same(
    folder: Path, before: Mapping[str, Any], now: Mapping[str, Any]
) -> None:
    """Refuse to mix subjects, or frames under different conditions."""
    faults = []
    for name in {**before, **now}:
        old, new = (
            json.dumps(record.get(name), sort_keys=True) for record in (before, now)
        )
        if old != new:
            rule = f"an unfinished capture must be resumed with the same {name}"
            cure = "give the earlier value, or choose another folder"
            faults.append(Fault(str(folder), rule, f"{new}, and {old} before", cure))
    if faults:
        raise InputError(faults)


def digest(*records: Any) -> str:
    """Short digest of the content of JSON records."""
    text = json.dumps(records, sort_keys=True)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()[:16]


@contextmanager
def one_session(out: Path) -> Iterator[None]:
    """Lock the folder of a capture; the system releases the lock however the session ends.

    Raises
    ------
    InputError
        If another session holds the lock, or the folder cannot be written to.
    """
    make_private(out.parent)
    path = out.parent / f".{out.name}.lock"
    with private_file(path).open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not os.path.samestat(os.fstat(lock.fileno()), path.stat()):
                # the other session ended between opening and locking
                raise FileNotFoundError
        except (BlockingIOError, FileNotFoundError):
            rule = "only one session at a time may write into a folder"
            cure = "wait until the other session has ended"
            raise InputError(Fault(str(out), rule, "another session", cure)) from None
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
