"""A user's mistake as data: what, rule, found, cure, one line each, all of them together."""

from __future__ import annotations

import errno
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

CURE_FULL = "free some space there, then run the command again"
CURE_READ_ONLY = "make its file system writable, or copy it to one that is"
CURE_PERMISSIONS = "check its owner and permissions"
CURES = {
    errno.ENOSPC: CURE_FULL,
    errno.EDQUOT: CURE_FULL,
    errno.EFBIG: "raise the limit of the size of files (ulimit -f), then run the command again",
    errno.EROFS: CURE_READ_ONLY,
    errno.EACCES: CURE_PERMISSIONS,
    errno.EPERM: CURE_PERMISSIONS,
}
MAX_SIMILAR_FAULTS = 3  # faults of one place and rule that are listed one by one
MAX_PART_CHARACTERS = 300  # of the place, the rule, what was found and the cure, each


@dataclass(frozen=True)
class Fault:
    """One mistake: where it is (file, key), the rule it breaks, what was found, and the cure."""

    where: str
    rule: str
    found: str
    cure: str = ""

    def __str__(self) -> str:
        line = f"{printable(self.where)}: {printable(self.rule)}; found {printable(self.found)}"
        return f"{line}; {printable(self.cure)}" if self.cure else line


def printable(text: str, most: int = MAX_PART_CHARACTERS) -> str:
    """A text on one line that a terminal can show: white space folded, control characters escaped, its middle cut."""
    if len(text) > most:
        head = most * 2 // 3
        text = f"{text[:head]}...{text[len(text) - (most - head - 3) :]}"
    folded = text.replace("\n", " ").replace("\t", " ")
    return " ".join("".join(c if c.isprintable() else ascii(c)[1:-1] for c in folded).split())


def grouped(faults: Iterable[Fault]) -> list[Fault]:
    """The faults, with many of one place and rule merged into one, which gives the first finding and their number."""
    alike = dict[tuple[str, str], list[Fault]]()
    for fault in dict.fromkeys(faults):
        alike.setdefault((fault.where, fault.rule), []).append(fault)
    out = list[Fault]()
    for same in alike.values():
        found = f"{same[0].found}, and {len(same) - 1} more"
        out += same if len(same) <= MAX_SIMILAR_FAULTS else [replace(same[0], found=found)]
    return out


def system_fault(error: OSError, where: str) -> Fault:
    """What the operating system refused, and the cure for it; `where` counts if the error names no file."""
    cure = CURES.get(error.errno or 0, "check that it is no other kind of file, its permissions and its disk")
    found = error.strerror or str(error)
    return Fault(str(error.filename or where), "it must be possible to read and write it", found, cure)


@contextmanager
def named(where: str) -> Iterator[None]:
    """Errors of the operating system in the block that name no file, as those of writing do, name this one."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = where
        raise


class InputError(ValueError):
    """Input that breaks a rule; carries every fault found, so that the user repairs them in one go."""

    def __init__(self, faults: Fault | Iterable[Fault]) -> None:
        self.faults = (faults,) if isinstance(faults, Fault) else tuple(faults)
        super().__init__("\n".join(str(fault) for fault in self.faults))

    def __reduce__(self) -> tuple[type[InputError], tuple[tuple[Fault, ...]]]:
        """From one process to another with its faults, not with their text."""
        return InputError, (self.faults,)
