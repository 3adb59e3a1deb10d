"""Description of this process, and whether another process of the same machine has ended."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Any

PROC = Path("/proc")
# equal for processes that can find each other by their ids
MACHINE_KEYS = ("boot", "namespace")


def this_process() -> dict[str, Any]:
    """Host name, process id and, on Linux, the boot id, the namespace of process ids
    and the start time.
    """
    number = os.getpid()
    return {
        "host": socket.gethostname(),
        "process": number,
        "started": _start(number),
        **_machine(),
    }


def has_ended(holder: Mapping[str, Any]) -> bool:
    """Whether a process described by `this_process` has certainly ended; False for a
    process of another machine.
    """
    here = _machine()
    number = holder.get("process")
    started = holder.get("started")
    if not all(here[name] and here[name] == holder.get(name) for name in MACHINE_KEYS):
        return False
    if not isinstance(number, int) or not 0 < number < 1 << 31 or not started:
        return False
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return True
    except OSError:  # a process of another user
        pass
    now = _start(number)
    return now not in (started, None)


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
        state, *rest = (
            (PROC / str(number) / "stat").read_text().rpartition(")")[2].split()
        )
    except (OSError, ValueError):
        return None
    return "ended" if state in "ZX" else rest[18]
