"""Keys of a JSON file, read one by one; every fault is recorded with file and key, and
reading continues.
"""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Collection
from datetime import datetime
from string import Formatter
from typing import Any, NamedTuple

import numpy as np

from skindb.errors import Fault
from skindb.format.json_file import CURE, MAX_MAGNITUDE, is_number, short, shown
from skindb.limits import (
    MAX_FRAME_SIDE_PX,
    MAX_NAME_CHARACTERS,
    MAX_NAMED_UNKNOWN_KEYS,
    MAX_TEXT_CHARACTERS,
)
from skindb.types import Float64

REQUIRED: Any = object()
FEWER = "remove those that are not needed"


class TextRule(NamedTuple):
    """A pattern that a text must match completely, and the wording of the rule in a message."""

    pattern: str
    text: str


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
        self.is_object = isinstance(data, dict)
        if not self.is_object:
            faults.append(
                Fault(where, "must be a JSON object {...}", shown(data), CURE)
            )
        self.data: dict[str, Any] = data if self.is_object else {}

    def place(self, key: str) -> str:
        """Location of `key` in a message."""
        return f"{self.where}[{short(key)}]"

    def fault(self, key: str, rule: str, found: str, cure: str = CURE) -> None:
        """Record a fault of `key`; `found` is a phrase, for a value the result of `shown`."""
        self.faults.append(Fault(self.place(key), rule, found, cure))

    def has(self, key: str) -> bool:
        """Whether the key is given; null counts as absent."""
        return self.get(key, None) is not None

    def get(self, key: str, default: Any = REQUIRED) -> Any:
        """The unchecked value; null counts as absent."""
        self.used.add(key)
        value = self.data.get(key)
        if value is not None:
            return value
        if default is not REQUIRED:
            return default
        if self.is_object:
            cure = "add it, see docs/capture_format.md"
            self.fault(key, "this key is required", "nothing", cure)
        return None

    def object(self, key: str, default: Any = REQUIRED) -> Fields:
        """The JSON object under a key."""
        return Fields(self.get(key, default), self.place(key), self.faults)

    def rest(self) -> dict[str, Any]:
        """Keys that were not read, with their values; they are kept as attributes."""
        return {key: value for key, value in self.data.items() if key not in self.used}

    def unknown(self, *, besides: Collection[str] = ()) -> tuple[str, ...]:
        """Keys that were not read, except `besides`, each with the maximum similar key
        that was read.
        """
        missing = self.used - self.data.keys()
        keys = sorted(self.rest().keys() - set(besides))
        names = []
        for key in keys[:MAX_NAMED_UNKNOWN_KEYS]:
            start = key[:MAX_NAME_CHARACTERS].lower()
            near = difflib.get_close_matches(start, missing, n=1)
            names.append(short(key) + (f" (did you mean {near[0]}?)" if near else ""))
        if len(keys) > len(names):
            names.append(f"and {len(keys) - len(names)} more")
        return tuple(names)

    def require_known(self, rule: str, cure: str = "") -> None:
        """Record keys that were not read as a fault."""
        if unknown := self.unknown():
            self.faults.append(Fault(self.where, rule, ", ".join(unknown), cure))

    def at_most(self, maximum: int, things: str) -> bool:
        """Whether the object has at most `maximum` keys, all of which are printable names."""
        if len(self.data) > maximum:
            rule = f"must name at most {maximum} {things}"
            self.faults.append(Fault(self.where, rule, f"{len(self.data)}", FEWER))
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
            self.fault(key, rule.text, shown(value))
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
        found = f"{len(value)} characters, {hidden} of which cannot be printed"
        self.fault(key, rule, found, "shorten or correct it")
        return False

    def number(
        self,
        key: str,
        *,
        default: Any = REQUIRED,
        minimum: float = -np.inf,
        above: float = -np.inf,
        maximum: float = np.inf,
    ) -> float:
        """A finite number from `minimum` to `maximum` and greater than `above`."""
        value = self.get(key, default)
        if value is None:
            return 1.0
        if not is_number(value) or not abs(value) <= MAX_MAGNITUDE:
            rule = f"must be a finite number, at most {MAX_MAGNITUDE:g}"
        elif value <= above:
            rule = f"must be greater than {above:g}"
        elif value < minimum:
            rule = f"must be at least {minimum:g}"
        elif value > maximum:
            rule = f"must be at most {maximum:,g}"
        else:
            return float(value)
        self.fault(key, rule, shown(value))
        return 1.0

    def integer(
        self,
        key: str,
        *,
        minimum: int,
        maximum: int = MAX_FRAME_SIDE_PX,
        default: Any = REQUIRED,
    ) -> int:
        """An integer from `minimum` to `maximum`; `minimum` if the value is faulty."""
        value = self.number(key, default=default, minimum=minimum)
        if value != int(value):
            self.fault(key, "must be a whole number", shown(value))
        elif value > maximum:
            self.fault(key, f"must be at most {maximum}", shown(value))
        # a faulty size or depth must not be used in a computation: 2 ** 1e300 takes all memory
        return int(value) if minimum <= value <= maximum else minimum

    def array(
        self,
        key: str,
        shape: tuple[int, ...],
        *,
        default: Any = REQUIRED,
        fallback: Any = 1.0,
    ) -> Float64:
        """Finite numbers of exactly this shape; `fallback` if they are faulty."""
        value = self.get(key, default)
        array = None if value is None else self._array(key, value, shape)
        return np.full(shape, fallback, np.float64) if array is None else array

    def _array(self, key: str, value: Any, *shapes: tuple[int, ...]) -> Float64 | None:
        if not any(_has_shape(value, shape) for shape in shapes):
            sizes = " or ".join(" x ".join(map(str, shape)) for shape in shapes)
            self.fault(key, f"must be {sizes} numbers", shown(value))
            return None
        try:
            array = np.array(value, np.float64)
        except OverflowError:  # integers of hundreds of digits
            array = np.full(shapes[0], np.inf)
        if (np.abs(array) <= MAX_MAGNITUDE).all():
            return array
        rule = f"must be finite numbers, at most {MAX_MAGNITUDE:g}"
        self.fault(key, rule, shown(value))
        return None

    def gains(self, key: str, count: int) -> Float64:
        """Positive factors, one per element or one per element and channel, as (count,
        3); default 1.
        """
        if not self.has(key) or not count:
            return np.ones((count, 3))
        gains = self._array(key, self.get(key), (count,), (count, 3))
        if gains is not None and (gains <= 0).any():
            self.fault(key, "gains must be positive", shown(gains.min()))
            gains = None
        if gains is None:
            return np.ones((count, 3))
        return np.broadcast_to(gains.reshape(count, -1), (count, 3))

    def names(self, key: str, *, maximum: int, minimum: int = 1) -> tuple[str, ...]:
        """A list of different names, `minimum` to `maximum`."""
        value = self.get(key)
        if value is None:
            return ()
        if not isinstance(value, list):
            self.fault(key, "must be a list of names", shown(value))
            return ()
        if not self._within(key, value, maximum):
            return ()
        for name in value:
            if not isinstance(name, str) or not re.fullmatch(IDENTIFIER.pattern, name):
                rule = f"must be a list of names: each {IDENTIFIER.text}"
                self.fault(key, rule, shown(name))
                return ()
        if len(value) < minimum:
            cure = "give at least one name, or remove the enclosing part"
            self.fault(key, "must be a list of at least one name", shown(value), cure)
        self._require_unique(key, value)
        return tuple(value)

    def items(self, key: str, *, maximum: int) -> list[Fields]:
        """The objects of a list, 1 to `maximum`, whose ids differ."""
        value = self.get(key)
        if value is None:
            return []
        if not isinstance(value, list) or not value:
            self.fault(key, "must be a list of at least one object", shown(value))
            return []
        if not self._within(key, value, maximum):
            return []
        items = [
            Fields(item, f"{self.where}[{key}][{i}]", self.faults)
            for i, item in enumerate(value)
        ]
        self._require_unique(key, [item.data.get("id") for item in items])
        return items

    def _within(self, key: str, value: list[Any], maximum: int) -> bool:
        if len(value) > maximum:
            self.fault(
                key, f"must be a list of at most {maximum}", f"{len(value)}", FEWER
            )
        return len(value) <= maximum

    def _require_unique(self, key: str, ids: list[Any]) -> None:
        count = Counter(i for i in ids if isinstance(i, str))
        if repeated := sorted(name for name, times in count.items() if times > 1):
            found = f"{short(', '.join(repeated))} more than once"
            self.fault(key, "ids must differ", found, "rename them")

    def template(
        self,
        key: str,
        needed: set[str],
        allowed: Collection[str] = (),
        *,
        default: Any = REQUIRED,
    ) -> str:
        """A path template with the placeholders `needed` and, optionally, `allowed`."""
        value = self.text(key, default=default)
        try:
            parts = [part for part in Formatter().parse(value) if part[1] is not None]
        except ValueError as error:
            rule = "must be a path with placeholders"
            self.fault(key, rule, f"{short(value)}: {error}")
            return ""
        names = {name for _, name, _, _ in parts}
        formatted = any(spec or conversion for _, _, spec, conversion in parts)
        if value and (formatted or not needed <= names <= needed.union(allowed)):
            placeholders = " and ".join(f"{{{name}}}" for name in sorted(needed))
            self.fault(key, f"must name {placeholders}", shown(value))
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


def zoned_time(text: str) -> datetime | None:
    """An ISO 8601 time with its zone; None if the text is not such a time."""
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        return None
    return None if time.tzinfo is None else time
