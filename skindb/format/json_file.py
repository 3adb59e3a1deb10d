"""Reading JSON files of a capture within limits and without repeated keys, and their
values in messages.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from skindb.errors import Fault, InputError, printable
from skindb.files import json_depth, read_regular
from skindb.limits import MAX_JSON_BYTES, MAX_JSON_DEPTH, MAX_OBJECT_KEYS

MAX_MAGNITUDE = 1e30  # squares of larger numbers exceed the range of single precision
MAX_SHOWN_CHARACTERS = 100  # of a key or value in a message
CURE = "correct it, see docs/capture_format.md"


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
) -> dict[str, Any]:
    """The object of these pairs; repeated keys, and more than `MAX_OBJECT_KEYS`, are faults."""
    if len(pairs) > MAX_OBJECT_KEYS:
        rule = f"a JSON object must have at most {MAX_OBJECT_KEYS} keys"
        cure = "remove those that are not needed"
        faults.append(Fault(where, rule, f"{len(pairs)}", cure))
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
