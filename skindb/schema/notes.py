"""Notes on takes, such as the reason why a take was skipped, and things that a computation
skips, with the bound on the error this costs (MODEL.md, section 11). They become text only
where they are printed.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

Note = dict[str, Any]  # "take", which may be empty or a subject, and "reason"


def note(take: str, reason: str) -> Note:
    """A note on a take or subject; on all takes if the name is empty."""
    return {"take": take, "reason": reason}


def unique_notes(notes: Iterable[Note]) -> list[Note]:
    """The notes in order, each only once."""
    return list({(item["take"], item["reason"]): item for item in notes}.values())


def note_lines(notes: Iterable[Note]) -> list[str]:
    """One line for each note."""
    return [
        f"{item['take']}: {item['reason']}" if item["take"] else item["reason"]
        for item in notes
    ]


@dataclass(frozen=True)
class Omission:
    """One thing that is skipped: what, how many of how many, why, and what the results
    can differ by.
    """

    what: str
    skipped: int = 0
    of: int = 0  # 0 where they are not counted
    reason: str = ""
    bound: float = 0.0
    bounded: str = "results"  # what the bound is a fraction of

    def __str__(self) -> str:
        cost = (
            f"{self.bounded} differ by at most {100 * self.bound:.3g} %"
            if self.bound
            else "results stay the same"
        )
        count = f"{self.skipped} of {self.of}" if self.of else "some"
        return f"{self.what}: {count} are skipped ({self.reason}); {cost}"
