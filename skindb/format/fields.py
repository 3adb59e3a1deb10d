"""Keys of a JSON file, read one by one; every fault is recorded with file and key, and
reading continues.
"""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Collection, Sequence
from string import Formatter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault
from skindb.format.json_file import CURE, MAX_MAGNITUDE, is_number, short, shown
from skindb.limits import (
    MAX_FRAME_SIDE_PX,
    MAX_NAME_CHARACTERS,
    MAX_NAMED_UNKNOWN_KEYS,
    MAX_TEXT_CHARACTERS,
)

REQUIRED: Any = object()


class TextRule(NamedTuple):
    """A pattern that a text must match completely, and the wording of the rule in a message."""

    pattern: str
    said: str


NON_EMPTY = TextRule(r"(?s).+", "must be text, and not empty")
NAME = TextRule(r"[A-Za-z0-9_-]{1,64}", "must be 1 to 64 letters, digits, '-' or '_'")
IDENTIFIER = TextRule(
    r"[A-Za-z0-9_.-]{1,64}", "must be 1 to 64 letters, digits, '-', '_' or '.'"
)


class Fields:
    """The keys of one JSON object; a faulty value is recorded in `faults` and replaced
    by a valid default.
    """

    def __init__(self, data: Any, where: str, faults: list[Fault]) -> None:
        self.where = where
        self.faults = faults
        self.used = set[str]()
        # otherwise missing keys are not reported in addition
        self.whole = isinstance(data, dict)
        if not self.whole:
            faults.append(
                Fault(where, "must be a JSON object {...}", shown(data), CURE)
            )
        self.data: dict[str, Any] = data if self.whole else {}

    def place(self, key: str) -> str:
        """Location of `key` in a message."""
        return f"{self.where}[{short(key)}]"

    def fault(self, key: str, rule: str, found: str, cure: str = CURE) -> None:
        """Record a fault of `key`; `found` is a phrase, for a value the result of `shown`."""
        self.faults.append(Fault(self.place(key), rule, found, cure))

    def get(self, key: str, default: Any = REQUIRED) -> Any:
        """The unchecked value; null counts as absent."""
        self.used.add(key)
        value = self.data.get(key)
        if value is None and default is REQUIRED and self.whole:
            self.fault(
                key,
                "this key is required",
                "nothing",
                "add it, see docs/capture_format.md",
            )
        return default if value is None and default is not REQUIRED else value

    def rest(self) -> dict[str, Any]:
        """Keys that were not read, with their values; they are kept as attributes."""
        return {key: value for key, value in self.data.items() if key not in self.used}

    def unknown(self, *, besides: Collection[str] = ()) -> tuple[str, ...]:
        """Keys that were not read, except `besides`, each with the most similar key
        that was read.
        """
        found = []
        keys = sorted(self.rest().keys() - set(besides))
        for key in keys[:MAX_NAMED_UNKNOWN_KEYS]:
            near = difflib.get_close_matches(
                key[:MAX_NAME_CHARACTERS].lower(), self.used - self.data.keys(), n=1
            )
            name = short(key)
            found.append(f"{name} (did you mean {near[0]}?)" if near else name)
        left = len(keys) - len(found)
        return (*found, f"and {left} more") if left else tuple(found)

    def at_most(self, most: int, things: str) -> bool:
        """Whether the object has at most `most` keys, all of which are printable names."""
        if len(self.data) > most:
            cure = "remove those that are not needed"
            self.faults.append(
                Fault(
                    self.where,
                    f"must name at most {most} {things}",
                    f"{len(self.data)}",
                    cure,
                )
            )
            return False
        for name in self.data:
            if not 0 < len(name) <= MAX_NAME_CHARACTERS or not name.isprintable():
                rule = f"a name must be 1 to {MAX_NAME_CHARACTERS} characters that can be printed"
                self.fault(name, rule, f"{len(name)} characters", "rename it")
        return True

    def text(
        self, key: str, *, rule: TextRule = NON_EMPTY, default: Any = REQUIRED
    ) -> str:
        """Text that satisfies a rule."""
        value = self.get(key, default)
        if value is None:
            return ""
        if not isinstance(value, str) or not re.fullmatch(rule.pattern, value):
            self.fault(key, rule.said, shown(value))
            return ""
        return value if self.require_printable(key, value) else ""

    def require_printable(self, key: str, value: str) -> bool:
        """Whether a text is short and has only characters that can be printed, such as
        no control characters.
        """
        hidden = sum(not character.isprintable() for character in value)
        if len(value) <= MAX_TEXT_CHARACTERS and not hidden:
            return True
        rule = f"a text must be at most {MAX_TEXT_CHARACTERS} characters that can be printed"
        self.fault(
            key,
            rule,
            f"{len(value)} characters, {hidden} of which cannot be printed",
            "shorten or correct it",
        )
        return False

    def number(
        self,
        key: str,
        *,
        default: Any = REQUIRED,
        least: float = -np.inf,
        above: float = -np.inf,
        most: float = np.inf,
    ) -> float:
        """A finite number from `least` to `most` and greater than `above`."""
        value = self.get(key, default)
        if value is None:
            return 1.0
        if not is_number(value) or not abs(value) <= MAX_MAGNITUDE:
            self.fault(
                key, f"must be a finite number, at most {MAX_MAGNITUDE:g}", shown(value)
            )
            return 1.0
        if value < least or value <= above:
            rule = (
                "must be "
                f"{f'greater than {above:g}' if value <= above else f'at least {least:g}'}"
            )
            self.fault(key, rule, shown(value))
            return 1.0
        if value > most:
            self.fault(key, f"must be at most {most:,g}", shown(value))
            return 1.0
        return float(value)

    def integer(
        self,
        key: str,
        *,
        least: int,
        most: int = MAX_FRAME_SIDE_PX,
        default: Any = REQUIRED,
    ) -> int:
        """An integer from `least` to `most`; `least` if the value is faulty."""
        value = self.number(key, default=default, least=least)
        if value != int(value):
            self.fault(key, "must be a whole number", shown(value))
        elif value > most:
            self.fault(key, f"must be at most {most}", shown(value))
        # a faulty size or depth must not be used in a computation: 2 ** 1e300 takes all memory
        return int(value) if least <= value <= most else least

    def array(
        self,
        key: str,
        shape: tuple[int, ...],
        *,
        default: Any = REQUIRED,
        fallback: Any = 1.0,
    ) -> NDArray[np.float64]:
        """Finite numbers of exactly this shape; `fallback` if they are faulty."""
        value = self.get(key, default)
        found = None if value is None else self._array(key, value, (shape,))
        return (
            np.broadcast_to(np.float64(fallback), shape).copy()
            if found is None
            else found
        )

    def _array(
        self, key: str, value: Any, shapes: Sequence[tuple[int, ...]]
    ) -> NDArray[np.float64] | None:
        rule = " or ".join(" x ".join(map(str, shape)) for shape in shapes)
        if not any(_has_shape(value, shape) for shape in shapes):
            self.fault(key, f"must be {rule} numbers", shown(value))
            return None
        try:
            found = np.array(value, np.float64)
        except OverflowError:  # integers of hundreds of digits
            found = np.full(shapes[0], np.inf)
        if not (np.abs(found) <= MAX_MAGNITUDE).all():
            self.fault(
                key, f"must be finite numbers, at most {MAX_MAGNITUDE:g}", shown(value)
            )
            return None
        return found

    def gains(self, key: str, count: int) -> NDArray[np.float64]:
        """Positive factors, one per element or one per element and channel, as (count,
        3); default 1.
        """
        value = self.get(key, None)
        if value is None:
            return np.ones((count, 3))
        found = self._array(key, value, ((count,), (count, 3)))
        if found is not None and (found <= 0).any():
            self.fault(key, "gains must be positive", shown(found.min()))
        if found is None or (found <= 0).any():
            return np.ones((count, 3))
        return np.asarray(np.broadcast_to(found.reshape(count, -1), (count, 3)))

    def names(self, key: str, *, most: int, least: int = 1) -> tuple[str, ...]:
        """A list of different names, `least` to `most`."""
        value = self.get(key)
        if value is None:
            return ()
        if not isinstance(value, list):
            self.fault(key, "must be a list of names", shown(value))
            return ()
        if not self._within(key, value, most):
            return ()
        for name in value:
            if not isinstance(name, str) or not re.fullmatch(IDENTIFIER.pattern, name):
                self.fault(
                    key, f"must be a list of names: each {IDENTIFIER.said}", shown(name)
                )
                return ()
        if len(value) < least:
            cure = "give at least one name, or remove the enclosing part"
            self.fault(key, "must be a list of at least one name", shown(value), cure)
        self._unique(key, value)
        return tuple(value)

    def items(self, key: str, *, most: int) -> list[Fields]:
        """The objects of a list, 1 to `most`, whose ids differ."""
        value = self.get(key)
        if value is None:
            return []
        if not isinstance(value, list) or not value:
            self.fault(key, "must be a list of at least one object", shown(value))
            return []
        if not self._within(key, value, most):
            return []
        out = [
            Fields(item, f"{self.where}[{key}][{i}]", self.faults)
            for i, item in enumerate(value)
        ]
        self._unique(key, [item.data.get("id") for item in out])
        return out

    def _within(self, key: str, value: list[Any], most: int) -> bool:
        if len(value) > most:
            self.fault(
                key,
                f"must be a list of at most {most}",
                f"{len(value)}",
                "remove those that are not needed",
            )
        return len(value) <= most

    def _unique(self, key: str, ids: list[Any]) -> None:
        count = Counter(i for i in ids if isinstance(i, str))
        if twice := sorted(name for name, times in count.items() if times > 1):
            found = f"{short(', '.join(twice))} more than once"
            self.fault(key, "ids must differ", found, "rename them")

    def template(
        self, key: str, needed: set[str], allowed: set[str], *, default: Any = REQUIRED
    ) -> str:
        """A path template with the placeholders `needed` and, optionally, `allowed`."""
        value = (
            self.text(key, default=default)
            if self.get(key, default) is not None
            else ""
        )
        if not value:
            return ""
        try:
            parts = [
                (name, spec, conversion)
                for _, name, spec, conversion in Formatter().parse(value)
                if name is not None
            ]
        except ValueError as error:
            self.fault(
                key, "must be a path with placeholders", f"{short(value)}: {error}"
            )
            return ""
        found = {name for name, _, _ in parts}
        if (
            any(spec or conversion for _, spec, conversion in parts)
            or not needed <= found <= needed | allowed
        ):
            must = " and ".join(f"{{{name}}}" for name in sorted(needed))
            self.fault(key, f"must name {must}", shown(value))
            return ""
        return value


def _has_shape(value: Any, shape: tuple[int, ...]) -> bool:
    """Whether lists of lists of numbers have exactly this shape."""
    if not shape:
        return is_number(value)
    return (
        isinstance(value, list)
        and len(value) == shape[0]
        and all(_has_shape(v, shape[1:]) for v in value)
    )
