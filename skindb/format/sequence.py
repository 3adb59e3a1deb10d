"""Order and times of the frames of a dome, from `sequence` in dome.json (capture
format, version 2).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from skindb.format.fields import Fields
from skindb.format.json_file import shown
from skindb.limits import MAX_SEQUENCE_STEPS

Array = NDArray[np.float64]
MAX_SECONDS = 1e6  # of a session; more indicates inconsistent clocks
CURE = "write what the controller acknowledged, or remove the sequence"


@dataclass(frozen=True)
class SequenceRecord:
    """Steps in the order in which they were executed."""

    light: tuple[str, ...]  # id of the light of each step
    exposure: tuple[str, ...]
    on: Array  # (step,) s since the first light went on
    off: Array  # (step,) s
    triggers: NDArray[np.int64]  # (step,) number of trigger pulses


def read_sequence(
    fields: Fields, lights: Collection[str], exposures: Collection[str]
) -> SequenceRecord | None:
    """The sequence of dome.json, or None if it has none; faults are recorded in `fields`."""
    if fields.get("sequence", None) is None:
        return None
    noted = len(fields.faults)
    steps = fields.items("sequence", most=MAX_SEQUENCE_STEPS)
    light = tuple(step.text("light") for step in steps)
    exposure = tuple(step.text("exposure") for step in steps)
    on = np.array([_seconds(step, "t_on") for step in steps])
    off = np.array([_seconds(step, "t_off") for step in steps])
    triggers = np.array(
        [step.integer("trigger_count", least=0, default=1) for step in steps], np.int64
    )
    if len(fields.faults) > noted:
        return None
    for key, given, known in (
        ("light", light, lights),
        ("exposure", exposure, exposures),
    ):
        if unknown := sorted(set(given) - set(known)):
            fields.fault(
                "sequence",
                f"every {key} must be listed in dome.json",
                shown(unknown[0]),
                CURE,
            )
        if missing := sorted(set(known) - set(given)):
            fields.fault(
                "sequence",
                f"every {key} of dome.json must have a step",
                f"none of {missing[0]}",
                CURE,
            )
    if not (off > on).all():
        fields.fault(
            "sequence",
            "t_off must be after t_on",
            f"step {int((off <= on).argmax())}",
            CURE,
        )
    elif not (np.diff(on) >= 0).all():
        found = (
            f"step {int((np.diff(on) < 0).argmax()) + 1} is earlier than the one before"
        )
        fields.fault(
            "sequence",
            "steps must be in the order in which they were executed",
            found,
            CURE,
        )
    elif off.max() - on[0] > MAX_SECONDS:
        fields.fault(
            "sequence",
            f"a session must last at most {MAX_SECONDS:g} s",
            f"{off.max() - on[0]:.3g} s",
            CURE,
        )
    return SequenceRecord(light, exposure, on - on[0], off - on[0], triggers)


def _seconds(step: Fields, key: str) -> float:
    """A time in seconds, or an ISO 8601 time with its zone as seconds since 1970."""
    if isinstance(text := step.get(key), str):
        try:
            time = datetime.fromisoformat(text)
        except ValueError:
            time = datetime.min
        if time.tzinfo is None:
            step.fault(
                key,
                "must be a number of seconds, or an ISO 8601 time with its zone",
                shown(text),
                CURE,
            )
            return 0.0
        return time.timestamp()
    return step.number(key, least=-1e10, most=1e10)
