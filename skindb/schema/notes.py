"""Notes on takes, such as the reason why a take was skipped; they become text only
where they are printed.
"""

from __future__ import annotations

from collections.abc import Iterable
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
