"""Which process this is, and whether another one of the same machine has ended."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Any

PROC = Path("/proc")
MACHINE = ("boot", "namespace")  # shared by processes that can see each other by their ids


def this_process() -> dict[str, Any]:
    """Host name and process id; where Linux provides them also the boot, the namespace of process ids and the start."""
    number = os.getpid()
    return {"host": socket.gethostname(), "process": number, "started": _start(number), **_machine()}


def has_ended(holder: Mapping[str, Any]) -> bool:
    """Whether a process that `this_process` described is certainly gone; False of one of another machine."""
    here, number, started = _machine(), holder.get("process"), holder.get("started")
    if not all(here[name] and here[name] == holder.get(name) for name in MACHINE):
        return False
    if not isinstance(number, int) or not 0 < number < 1 << 31 or not started:
        return False
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return True
    except OSError:  # the process of another user
        pass
    now = _start(number)
    return now not in (started, None)


def _machine() -> dict[str, str]:
    try:
        boot = (PROC / "sys/kernel/random/boot_id").read_text().strip()
        return {"boot": boot, "namespace": str((PROC / "self/ns/pid").readlink())}
    except OSError:
        return dict.fromkeys(MACHINE, "")


def _start(number: int) -> str | None:
    """Start of a process in ticks since the boot; "ended" of one whose parent has not noticed; None if unknown."""
    try:
        state, *rest = (PROC / str(number) / "stat").read_text().rpartition(")")[2].split()
    except (OSError, ValueError):
        return None
    return "ended" if state in "ZX" else rest[18]
