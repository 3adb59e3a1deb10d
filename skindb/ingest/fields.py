"""Keys of a JSON file read one by one; every fault is noted with file and key, and reading goes on."""

from __future__ import annotations

import difflib
import json
import re
import stat
from collections.abc import Collection, Sequence
from pathlib import Path
from string import Formatter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault

IDENTIFIER = r"[A-Za-z0-9_.-]{1,64}"
REQUIRED: Any = object()
LARGEST = 1 << 20  # of a width or height in pixels
EXTREME = 1e30  # beyond it squares leave what single precision stores


class Fields:
    """The keys of one JSON object; a faulty value is noted in `faults` and replaced by a harmless one."""

    def __init__(self, data: Any, where: str, faults: list[Fault]) -> None:
        self.where, self.faults, self.used = where, faults, set[str]()
        if not isinstance(data, dict):
            faults.append(Fault(where, "must be a JSON object", _short(data)))
        self.data: dict[str, Any] = data if isinstance(data, dict) else {}

    def fault(self, key: str, rule: str, found: Any, cure: str = "") -> None:
        """Note a fault of `key`."""
        self.faults.append(Fault(f"{self.where}[{key}]", rule, _short(found), cure))

    def get(self, key: str, default: Any = REQUIRED) -> Any:
        """The raw value; None counts as absent."""
        self.used.add(key)
        value = self.data.get(key)
        if value is None and default is REQUIRED and self.data:
            self.fault(key, "this key is required", "nothing", "add it, see docs of the capture format")
        return default if value is None and default is not REQUIRED else value

    def rest(self) -> dict[str, Any]:
        """Keys nobody asked for: they are kept as attributes."""
        return {key: value for key, value in self.data.items() if key not in self.used}

    def unknown(self, *, besides: Collection[str] = ()) -> tuple[str, ...]:
        """Of the keys nobody asked for each but those of `besides`, with the nearest one that somebody did."""
        found = []
        for key in self.rest().keys() - set(besides):
            near = difflib.get_close_matches(key.lower(), self.used - self.data.keys(), n=1)
            found.append(f"{_short(key)} ({near[0]} meant?)" if near else _short(key))
        return tuple(sorted(found))

    def text(self, key: str, *, pattern: str = r"(?s).+", default: Any = REQUIRED) -> str:
        """Text that fits a pattern in full."""
        value = self.get(key, default)
        if value is None:
            return ""
        if not isinstance(value, str) or not re.fullmatch(pattern, value):
            self.fault(key, f"must be text that fits {pattern}", value)
            return ""
        return value

    def number(self, key: str, *, default: Any = REQUIRED, least: float = -np.inf, above: float = -np.inf) -> float:
        """A finite number, at least `least` and greater than `above`."""
        value = self.get(key, default)
        if value is None:
            return 1.0
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= EXTREME:
            shown = repr(value) if isinstance(value, str) else value  # "0.04" is text, not a number
            self.fault(key, f"must be a finite number, at most {EXTREME:g}", shown)
            return 1.0
        if value < least or value <= above:
            self.fault(key, f"must be {f'greater than {above:g}' if value <= above else f'at least {least:g}'}", value)
            return 1.0
        return float(value)

    def integer(self, key: str, *, least: int, most: int = LARGEST, default: Any = REQUIRED) -> int:
        """A whole number from `least` to `most`; `least` where it is faulty."""
        value = self.number(key, default=default, least=least)
        if value != int(value):
            self.fault(key, "must be a whole number", value)
        elif value > most:
            self.fault(key, f"must be at most {most}", value)
        # a faulty size or depth must not be computed with: 2 ** 1e300 takes all memory
        return int(value) if least <= value <= most else least

    def array(
        self, key: str, shape: tuple[int, ...], *, default: Any = REQUIRED, fallback: Any = 1.0
    ) -> NDArray[np.float64]:
        """Finite numbers of exactly this shape; `fallback` where they are faulty."""
        value = self.get(key, default)
        found = None if value is None else self._array(key, value, (shape,))
        return np.broadcast_to(np.float64(fallback), shape).copy() if found is None else found

    def _array(self, key: str, value: Any, shapes: Sequence[tuple[int, ...]]) -> NDArray[np.float64] | None:
        rule = " or ".join(" x ".join(map(str, shape)) for shape in shapes)
        try:
            found = np.array(value, np.float64)
        except (ValueError, TypeError, OverflowError):
            self.fault(key, f"must be {rule} numbers", value)
            return None
        if found.shape not in shapes:
            self.fault(key, f"must be {rule} numbers", f"shape {found.shape}", "correct its length")
            return None
        if not (np.abs(found) <= EXTREME).all():
            self.fault(key, f"must be finite numbers, at most {EXTREME:g}", value)
            return None
        return found

    def gains(self, key: str, count: int) -> NDArray[np.float64]:
        """Positive factors, one per element or one per element and channel, as (count, 3); default 1."""
        value = self.get(key, None)
        if value is None:
            return np.ones((count, 3))
        found = self._array(key, value, ((count,), (count, 3)))
        if found is not None and (found <= 0).any():
            self.fault(key, "gains must be positive", found.min())
        if found is None or (found <= 0).any():
            return np.ones((count, 3))
        return np.asarray(np.broadcast_to(found.reshape(count, -1), (count, 3)))

    def names(self, key: str, *, least: int = 1) -> tuple[str, ...]:
        """A list of different names, `least` or more."""
        value = self.get(key)
        if value is None:
            return ()
        if not isinstance(value, list) or not all(isinstance(v, str) and re.fullmatch(IDENTIFIER, v) for v in value):
            self.fault(key, f"must be a list of names that fit {IDENTIFIER}", value)
            return ()
        if len(value) < least:
            self.fault(key, "must be a list of at least one name", value, "name one, or leave the whole part out")
        self._unique(key, value)
        return tuple(value)

    def items(self, key: str) -> list[Fields]:
        """The objects of a list, at least one, whose ids differ."""
        value = self.get(key)
        if value is None:
            return []
        if not isinstance(value, list) or not value:
            self.fault(key, "must be a list of at least one object", value)
            return []
        out = [Fields(item, f"{self.where}[{key}][{i}]", self.faults) for i, item in enumerate(value)]
        self._unique(key, [item.data.get("id") for item in out])
        return out

    def _unique(self, key: str, ids: list[Any]) -> None:
        known = [i for i in ids if i is not None]
        if twice := sorted({str(i) for i in known if known.count(i) > 1}):
            self.fault(key, "ids must differ", f"{', '.join(twice)} more than once", "rename them")

    def template(self, key: str, needed: set[str], allowed: set[str], *, default: Any = REQUIRED) -> str:
        """A path with the placeholders `needed` and perhaps those `allowed`."""
        value = self.text(key, default=default) if self.get(key, default) is not None else ""
        if not value:
            return ""
        try:
            parts = [
                (name, spec, conversion) for _, name, spec, conversion in Formatter().parse(value) if name is not None
            ]
        except ValueError as error:
            self.fault(key, "must be a path with placeholders", f"{value}: {error}")
            return ""
        found = {name for name, _, _ in parts}
        if any(spec or conversion for _, spec, conversion in parts) or not needed <= found <= needed | allowed:
            must = " and ".join(f"{{{name}}}" for name in sorted(needed))
            self.fault(key, f"must name {must}", value)
            return ""
        return value


def read_json(path: Path, faults: list[Fault]) -> Any:
    """Content of a JSON file; None and a note if it is not there, not JSON or nothing."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        faults.append(Fault(str(path), "the file must exist", error.strerror or str(error)))
    except (ValueError, RecursionError) as error:  # ValueError: of JSON, of UTF-8, of numbers with thousands of digits
        faults.append(Fault(str(path), "must be JSON in UTF-8", str(error)))
    else:
        if content is None:
            faults.append(Fault(str(path), "must be a JSON object", "null"))
        return content
    return None


def inside(
    folder: Path, name: str, where: str, faults: list[Fault], known: dict[Path, bool] | None = None
) -> Path | None:
    """The file `name` of the folder; None and a note if it lies outside, also by a link.

    `known` is which folders lie inside, of earlier calls; it is filled.
    """
    path = folder / name
    try:
        within = _within(path, folder, {} if known is None else known)
    except (OSError, ValueError, RuntimeError) as error:
        faults.append(Fault(where, "must be a path this system can follow", f"{_short(ascii(name))}: {error}"))
        return None
    given = Path(name)
    if given.is_absolute() or ".." in given.parts or not within:
        rule = "every path must stay inside the capture folder"
        found = name if within else f"{name}, which leads out of it"
        faults.append(Fault(where, rule, found, "copy the file into the folder"))
        return None
    return path


def _within(path: Path, folder: Path, known: dict[Path, bool]) -> bool:
    """Whether a path stays inside a folder with every link followed; the folders on the way are asked once."""
    try:
        link = stat.S_ISLNK(path.lstat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        link = False
    if link:
        path.exists()  # asks the system about every part, links in a circle and names too long among them
        return path.resolve().is_relative_to(folder.resolve())
    parent = path.parent
    if parent not in known:
        known[parent] = parent.resolve().is_relative_to(folder.resolve())
    return known[parent]


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= 100 else f"{text[:97]}..."
