"""Reading JSON files within limits, and their keys one by one; every fault is recorded with
file and key, and reading continues.
"""

from __future__ import annotations

import difflib
import json
import re
from collections import Counter
from collections.abc import Collection, Iterator
from datetime import datetime
from pathlib import Path
from string import Formatter
from typing import Any, NamedTuple

import numpy as np

from skindb.errors import Fault, InputError, printable
from skindb.files import Json, json_depth, read_regular
from skindb.limits import (
    MAX_FRAME_SIDE_PX,
    MAX_JSON_BYTES,
    MAX_JSON_DEPTH,
    MAX_NAME_CHARACTERS,
    MAX_NAMED_UNKNOWN_KEYS,
    MAX_OBJECT_KEYS,
    MAX_TEXT_CHARACTERS,
)
from skindb.types import Float64

REQUIRED: Any = object()
FEWER = "remove those that are not needed"
MAX_MAGNITUDE = 1e30  # squares of larger numbers exceed the range of single precision
MAX_SHOWN_CHARACTERS = 100  # of a key or value in a message
PAGE = "docs/capture_format.md"
CURE = f"correct it, see {PAGE}"


class TextRule(NamedTuple):
    """A pattern that a text must match completely, and the wording of the rule in a message."""

    pattern: str
    text: str


NON_EMPTY = TextRule(r"(?s).+", "must be text, and not empty")
NAME = TextRule(r"[A-Za-z0-9_-]{1,64}", "must be 1 to 64 letters, digits, '-' or '_'")
IDENTIFIER = TextRule(
    r"(?!\.)[A-Za-z0-9_.-]{1,64}",  # "." and ".." are folders
    "must be 1 to 64 letters, digits, '-', '_' or '.', which is not the first",
)


class Fields:
    """The keys of one JSON object; a faulty value is recorded in `faults` and replaced
    by a valid default. `page` describes the file.
    """

    def __init__(
        self, data: Any, where: str, faults: list[Fault], page: str = PAGE
    ) -> None:
        self.where = where
        self.faults = faults
        self.page = page
        self.used = set[str]()
        # otherwise missing keys are not reported in addition
        self.is_object = isinstance(data, dict)
        if not self.is_object:
            faults.append(
                Fault(
                    where,
                    "must be a JSON object {...}",
                    shown(data),
                    f"correct it, see {page}",
                )
            )
        self.data: Json = data if self.is_object else {}

    def place(self, key: str) -> str:
        """Location of `key` in a message."""
        return f"{self.where}[{short(key)}]"

    def fault(self, key: str, rule: str, found: str, cure: str = "") -> None:
        """Record a fault of `key`; `found` is a phrase, for a value the result of `shown`."""
        cure = cure or f"correct it, see {self.page}"
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
            cure = f"add it, see {self.page}"
            self.fault(key, "this key is required", "nothing", cure)
        return None

    def object(self, key: str, default: Any = REQUIRED) -> Fields:
        """The JSON object under a key."""
        return Fields(self.get(key, default), self.place(key), self.faults, self.page)

    def rest(self) -> Json:
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
        self.fault(
            key,
            f"a text must be at most {MAX_TEXT_CHARACTERS} characters that can be printed",
            f"{len(value)} characters, {hidden} of which cannot be printed",
            "shorten or correct it",
        )
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
        return np.full(shape, fallback, float) if array is None else array

    def _array(self, key: str, value: Any, *shapes: tuple[int, ...]) -> Float64 | None:
        if not any(_has_shape(value, shape) for shape in shapes):
            sizes = " or ".join(" x ".join(map(str, shape)) for shape in shapes)
            self.fault(key, f"must be {sizes} numbers", shown(value))
            return None
        try:
            array = np.array(value, float)
        except OverflowError:  # integers of hundreds of digits
            array = np.full(shapes[0], np.inf)
        if (np.abs(array) <= MAX_MAGNITUDE).all():
            return array
        self.fault(
            key, f"must be finite numbers, at most {MAX_MAGNITUDE:g}", shown(value)
        )
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
                self.fault(
                    key, f"must be a list of names: each {IDENTIFIER.text}", shown(name)
                )
                return ()
        if len(value) < minimum:
            self.fault(
                key,
                "must be a list of at least one name",
                shown(value),
                "give at least one name, or remove the enclosing part",
            )
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
            Fields(item, f"{self.where}[{key}][{i}]", self.faults, self.page)
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
            self.fault(
                key,
                "ids must differ",
                f"{short(', '.join(repeated))} more than once",
                "rename them",
            )

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
            self.fault(
                key, "must be a path with placeholders", f"{short(value)}: {error}"
            )
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


def read_json(path: Path, faults: list[Fault]) -> Any:
    """Content of a JSON file; None and a fault if it is absent, invalid, null, or
    beyond a limit.
    """
    where = str(path)
    earlier = len(faults)
    finding = ""
    content = None
    try:
        text = read_regular(path, MAX_JSON_BYTES).decode("utf-8")
        if (depth := json_depth(text)) > MAX_JSON_DEPTH:
            rule = f"must have at most {MAX_JSON_DEPTH} levels of nested brackets"
            faults.append(Fault(where, rule, f"{depth}", CURE))
            return None
        content = json.loads(
            text, object_pairs_hook=lambda pairs: _unique_pairs(pairs, where, faults)
        )
    except InputError as error:
        faults += error.faults
        return None
    except UnicodeDecodeError as error:
        finding = f"byte {error.start} is not UTF-8"
    except (ValueError, RecursionError) as error:
        # ValueError: also of numbers with thousands of digits
        finding = str(error)
    if finding:
        cure = "correct the file at that place, or write it again"
        faults.append(Fault(where, "must be JSON in UTF-8", finding, cure))
        return None
    if content is None:
        faults.append(Fault(where, "must be a JSON object {...}", "null", CURE))
    if re.search(r"\\u[dD][89a-fA-F]", text):
        rule = "must be text that UTF-8 can represent"
        cure = "write the complete character"
        faults += [
            Fault(f"{where}{place}", rule, "half a surrogate pair", cure)
            for place in _broken_texts(content)
        ]
    return content if len(faults) == earlier else None


def _unique_pairs(
    pairs: list[tuple[str, Any]], where: str, faults: list[Fault]
) -> Json:
    """The object of these pairs; repeated keys, and more than `MAX_OBJECT_KEYS`, are faults."""
    if len(pairs) > MAX_OBJECT_KEYS:
        rule = f"a JSON object must have at most {MAX_OBJECT_KEYS} keys"
        faults.append(
            Fault(where, rule, f"{len(pairs)}", "remove those that are not needed")
        )
        return dict(pairs)
    count = Counter(key for key, _ in pairs)
    rule = "an object must have each key once"
    faults += [
        Fault(
            f"{where}[{short(key)}]",
            rule,
            "the key more than once",
            "remove all but one",
        )
        for key in sorted(key for key, times in count.items() if times > 1)
    ]
    return dict(pairs)


def _broken_texts(value: Any, place: str = "") -> Iterator[str]:
    """Places of the keys and texts with half a surrogate pair."""
    if isinstance(value, str):
        if any("\ud800" <= c <= "\udfff" for c in value):
            yield place
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from _broken_texts(item, f"{place}[{i}]")
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _broken_texts(key, f"{place}[{short(key)}]")
            yield from _broken_texts(item, f"{place}[{short(key)}]")


def is_number(value: Any) -> bool:
    """Whether a JSON value is a number: `true` and "1.0" are not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def shown(value: Any) -> str:
    """A JSON value as it appears in a message; text is marked as such, to distinguish
    "1" from 1.
    """
    if isinstance(value, str):
        return f'the text "{short(value)}"' if value else "an empty text"
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if is_number(value) and isinstance(value, int) and abs(value) > MAX_MAGNITUDE:
        return "a number of more than 30 digits"
    if isinstance(value, list) and len(value) > MAX_SHOWN_CHARACTERS:
        return (
            f"a list of {len(value)}, [{', '.join(shown(v) for v in value[:3])}, ...]"
        )
    if isinstance(value, dict) and len(value) > MAX_SHOWN_CHARACTERS:
        return f"an object of {len(value)} keys"
    return short(json.dumps(value, default=str))


def short(text: str) -> str:
    """A text as it appears in a message, shortened if necessary."""
    return printable(text, MAX_SHOWN_CHARACTERS)
