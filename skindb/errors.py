"""Faults of user input as data: place, rule, what was found and cure, reported
together, one line each.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from concurrent.futures import Executor

T = TypeVar("T")
Item = TypeVar("Item")
CURE_FULL = "free some space there, then run the command again"
CURE_READ_ONLY = "make its file system writable, or copy it to one that is"
CURE_PERMISSIONS = "check its owner and permissions"
CURES = {
    errno.ENOSPC: CURE_FULL,
    errno.EDQUOT: CURE_FULL,
    errno.EFBIG: "raise the limit of file sizes (ulimit -f), then run the command again",
    errno.EROFS: CURE_READ_ONLY,
    errno.EACCES: CURE_PERMISSIONS,
    errno.EPERM: CURE_PERMISSIONS,
}
# faults with the same place and rule that are listed individually
MAX_SIMILAR_FAULTS = 3
MAX_PART_CHARACTERS = 300  # of each of place, rule, finding and cure


@dataclass(frozen=True)
class Fault:
    """One fault: where it is (file, key), the rule that it breaks, what was found, and the cure."""

    where: str
    rule: str
    found: str
    cure: str = ""

    def __str__(self) -> str:
        line = f"{printable(self.where)}: {printable(self.rule)}; found {printable(self.found)}"
        return f"{line}; {printable(self.cure)}" if self.cure else line


def printable(text: str, length: int = MAX_PART_CHARACTERS) -> str:
    """Text on one line for a terminal: white space is folded, control characters are
    escaped, the middle is cut.
    """
    if len(text) > length:
        head = length * 2 // 3
        text = f"{text[:head]}...{text[len(text) - (length - head - 3) :]}"
    return " ".join(escaped(text.replace("\n", " ").replace("\t", " ")).split())


def few_names(names: Sequence[str], count: int = 3, separator: str = ", ") -> str:
    """Names for a message: the first ones, and how many more there are."""
    rest = len(names) - count
    return separator.join(names[:count]) + (f" and {rest} more" if rest > 0 else "")


def counted(count: int, noun: str) -> str:
    """A number of things, such as "1 take" or "2 takes"."""
    return f"{count:,} {noun}" + ("" if count == 1 else "s")


def choices(name: str, known: Iterable[str], verb: str = "choose") -> str:
    """The cure for an unknown name: the known names, behind the most similar one."""
    known = sorted(known)
    lowered = {one.lower(): one for one in known}
    near = get_close_matches(name.lower(), lowered, n=1)
    hint = f"did you mean {lowered[near[0]]}? " if near else ""
    return f"{hint}{verb} {', '.join(known) or 'none'}"


def escaped(text: str) -> str:
    """Text with escapes in place of all characters that cannot be printed, such as
    control characters.
    """
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def grouped(faults: Iterable[Fault]) -> list[Fault]:
    """The faults, with many of the same place and rule replaced by one that gives the
    first finding and the number.
    """
    groups = dict[tuple[str, str], list[Fault]]()
    for fault in dict.fromkeys(faults):
        groups.setdefault((fault.where, fault.rule), []).append(fault)
    out = list[Fault]()
    for similar in groups.values():
        if len(similar) > MAX_SIMILAR_FAULTS:
            found = f"{similar[0].found}, and {len(similar) - 1} more"
            similar = [replace(similar[0], found=found)]
        out += similar
    return out


def system_fault(error: OSError, where: str) -> Fault:
    """Fault for an error of the operating system; `where` is used if the error names no file."""
    cure = CURES.get(
        error.errno or 0,
        "check that it is a file of the right kind, its permissions and the disk",
    )
    found = error.strerror or str(error)
    return Fault(
        str(error.filename or where), "must be readable and writable", found, cure
    )


@contextmanager
def add_filename(where: str) -> Iterator[None]:
    """Context that adds a file name to errors of the operating system that have none,
    such as those of writing.
    """
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = where
        raise


class SkindbWarning(UserWarning):
    """Warning for users, which the command line prints without its place in the code."""


class InputError(ValueError):
    """Invalid input, with all faults that were found, so that the user can correct them
    together.
    """

    def __init__(self, faults: Fault | Iterable[Fault]) -> None:
        self.faults = (faults,) if isinstance(faults, Fault) else tuple(faults)
        super().__init__("\n".join(str(fault) for fault in self.faults))

    def __reduce__(self) -> tuple[type[InputError], tuple[tuple[Fault, ...]]]:
        """Pickle the faults instead of their text."""
        return InputError, (self.faults,)


class UnavailableError(InputError):
    """A database does not answer or refuses access, so that its contents are unknown but
    not known to be damaged.
    """


def input_error(where: str, rule: str, found: str, cure: str = "") -> InputError:
    """An `InputError` with one fault."""
    return InputError(Fault(where, rule, found, cure))


def require(
    satisfied: object, where: str, rule: str, found: str, cure: str = ""
) -> None:
    """Raise an `InputError` with one fault unless a condition is satisfied."""
    if not satisfied:
        raise input_error(where, rule, found, cure)


def require_none(faults: Sequence[Fault]) -> None:
    """Raise an `InputError` with these faults if there are any."""
    if faults:
        raise InputError(faults)


def attempt(
    faults: list[Fault], call: Callable[[], T], *, where: str = "{}"
) -> T | None:
    """Result of a call; None if it raises an `InputError`, whose faults are then recorded,
    except for an `UnavailableError`.

    In `where`, the place of each fault, {} stands for the place that the fault names.
    """
    try:
        return call()
    except UnavailableError:
        raise
    except InputError as error:
        faults += [replace(f, where=where.replace("{}", f.where)) for f in error.faults]
        return None


def attempt_all(
    faults: list[Fault],
    call: Callable[[Item], T],
    items: Iterable[Item],
    *,
    pool: Executor,
    where: Callable[[Item], str] = lambda _: "{}",
) -> list[T]:
    """Results of a call for all items in threads; `InputError` with all faults, sorted."""
    results = pool.map(
        lambda item: attempt(faults, lambda: call(item), where=where(item)), items
    )
    completed = [result for result in results if result is not None]
    require_none(sorted(faults, key=str))
    return completed
