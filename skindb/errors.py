"""A user's mistake as data: what, rule, found, cure, one line each, all of them together."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Fault:
    """One mistake: where it is (file, key), the rule it breaks, what was found, and the cure."""

    where: str
    rule: str
    found: str
    cure: str = ""

    def __str__(self) -> str:
        line = f"{self.where}: {self.rule}; found {self.found}"
        return " ".join((f"{line}; {self.cure}" if self.cure else line).split())


class InputError(ValueError):
    """Input that breaks a rule; carries every fault found, so that the user repairs them in one go."""

    def __init__(self, faults: Fault | Iterable[Fault]) -> None:
        self.faults = (faults,) if isinstance(faults, Fault) else tuple(faults)
        super().__init__("\n".join(str(fault) for fault in self.faults))

    def __reduce__(self) -> tuple[type[InputError], tuple[tuple[Fault, ...]]]:
        """From one process to another with its faults, not with their text."""
        return InputError, (self.faults,)
