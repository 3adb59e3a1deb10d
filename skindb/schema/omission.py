"""Something that a computation skips, with the bound on the error this costs (MODEL.md,
section 11).
"""

from __future__ import annotations

from dataclasses import dataclass

NOTHING = "nothing is skipped"


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


def explain(omissions: tuple[Omission, ...]) -> list[str]:
    """One line per thing that is skipped, for `--explain`."""
    return [str(omission) for omission in omissions] or [NOTHING]
