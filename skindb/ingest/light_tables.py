"""Tables of lights: CSV, and .lp files of reflectance transformation imaging."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import partial
from pathlib import Path

import numpy as np

from skindb.errors import Fault, InputError, attempt, input_error, require, require_none
from skindb.files import read_regular
from skindb.format.fields import short
from skindb.limits import MAX_LIGHTS
from skindb.types import Float64

MAX_TABLE_BYTES = 4 << 20
COLUMNS = ("x", "y", "z")
# of a file of lights; positions are in mm
POSITION_COLUMNS = ("x_mm", "y_mm", "z_mm")
INTENSITY = "intensity"
SYNONYMS = ("gain", "power", "brightness", "strength", "flux")  # of the intensity


@dataclass(frozen=True)
class Light:
    """A light of a table: the picture it belongs to, and where it is."""

    name: str
    vector: Float64  # (3,) direction, or position in mm
    distant: bool
    gain: float = 1.0  # relative intensity
    by_order: bool = False  # whether its line does not name the picture


def read_lights(path: Path, pictures: Sequence[str] = ()) -> list[Light]:
    """Lights of a CSV or RTI .lp file, in its order.

    Values are separated by commas, semicolons, tabs or spaces. Without a header, a line is a
    name and a direction, or a direction alone if every line is one of `pictures` in their
    order; a header names columns: the first one is the picture, `x, y, z` a direction or
    `x_mm, y_mm, z_mm` a position, `intensity` a relative intensity.

    Raises
    ------
    InputError
        With every line that is not a light, and names that are given twice.
    """
    try:
        text = read_regular(path, MAX_TABLE_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise _table_fault(path, "must be UTF-8 text", "another encoding") from None
    faults = []
    found = list[Light]()
    header = list[str]()
    lines = [_words(line) for line in text.splitlines()]
    by_order = _is_unnamed(lines)
    if by_order:
        lines = _named(lines, pictures, path)
    for number, words in enumerate(lines, 1):
        if not words or (not found and len(words) == 1 and words[0].isdigit()):
            continue  # .lp files begin with the number of pictures
        values = numbers(words[1:])
        if not found and not header and any(value is None for value in values[-3:]):
            header = [word.lower() for word in words]
            faults += _header_faults(header, path)
            continue
        place = f"{path}, line {number}"
        light = attempt(faults, partial(_table_light, words, header, place))
        if light is not None:
            found.append(replace(light, by_order=by_order))
    names = [light.name for light in found]
    for name in sorted({name for name in names if names.count(name) > 1}):
        faults.append(
            Fault(
                str(path),
                "a picture must have one light",
                f"{short(name)} twice",
                "remove the lines that do not apply",
            )
        )
    require_none(faults)
    if not 1 <= len(found) <= MAX_LIGHTS:
        raise _table_fault(
            path, f"must have 1 to {MAX_LIGHTS:,} lights", f"{len(found)} lights"
        )
    return found


def _header_faults(header: Sequence[str], path: Path) -> list[Fault]:
    """Faults of columns that are absent, or whose names are nearly those that are read;
    others are ignored.
    """
    known = (*COLUMNS, *POSITION_COLUMNS, INTENSITY)
    faults = [
        Fault(
            f"{path}, column {short(name)}",
            f"columns that are read are {', '.join(known)}",
            "another name",
            f"write {INTENSITY if name in SYNONYMS else near[0]}",
        )
        for name in header[1:]
        if name not in known
        and ((near := get_close_matches(name, known, 1, 0.8)) or name in SYNONYMS)
    ]
    if faults or any(set(c) <= set(header[1:]) for c in (COLUMNS, POSITION_COLUMNS)):
        return faults
    return [
        Fault(
            str(path),
            f"a header names the picture and {', '.join(COLUMNS)} of the direction to "
            f"its light, or {', '.join(POSITION_COLUMNS)} of its position",
            short(", ".join(header)),
            "name or compute these columns",
        )
    ]


def _is_unnamed(lines: list[list[str]]) -> bool:
    """Whether every line of a table is a direction without the name of a picture; a header
    of such lines, which names no pictures, is emptied.
    """
    used = [k for k, words in enumerate(lines) if words]
    if used and [word.lower() for word in lines[used[0]]] == list(COLUMNS):
        lines[used.pop(0)] = []
    return bool(used) and all(
        len(lines[k]) == len(COLUMNS) and None not in numbers(lines[k]) for k in used
    )


def _named(
    lines: Sequence[list[str]], pictures: Sequence[str], path: Path
) -> list[list[str]]:
    """Directions with the names of the pictures in front."""
    count = sum(map(bool, lines))
    require(
        count == len(pictures),
        str(path),
        "directions without names must be those of all pictures, in their order",
        f"{count} lines for {len(pictures)} pictures",
        "write the name of its picture in front of each direction",
    )
    names = iter(pictures)
    return [[next(names), *words] if words else words for words in lines]


def _words(line: str) -> list[str]:
    """Cells of a line of a table; a name in front may contain spaces."""
    # names may contain the sign: comments follow two numbers
    line = re.sub(r"^\s*#.*|([\d.]([\s,;]+[-+.\de]+){2})\s+#.*", r"\1", line).strip()
    for separator in (";", "\t", ","):
        # a name in quotes may contain it
        cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
        if len(cells) > 1:
            cells = [cell.strip() for cell in cells]
            if separator == ",":
                return cells
            # numbers with decimal commas
            return [cells[0], *(cell.replace(",", ".") for cell in cells[1:])]
    words = line.split()
    front = len(words)
    while front > 1 and numbers(words[front - 1 : front])[0] is not None:
        front -= 1
    if front == 1 or front == len(words):
        return words
    return [" ".join(words[:front]), *words[front:]]


def numbers(words: Sequence[str]) -> list[float | None]:
    """Numbers of cells; None for what is no number."""
    values: list[float | None] = []
    for word in words:
        try:
            values.append(float(word))
        except ValueError:
            values.append(None)
    return values


def _table_light(words: Sequence[str], header: Sequence[str], place: str) -> Light:
    """The light of a line."""
    columns = header or ("picture", *COLUMNS)
    require(
        not any(words[len(columns) :]),
        place,
        f"must have {len(columns)} cells: {', '.join(columns)}",
        short(", ".join(words)),
        "name further columns in a header; write decimal points, or separate by semicolons",
    )
    cells = dict(zip(columns, words, strict=False))
    name = re.split(r"[\\/]", words[0])[-1]
    distant = not set(POSITION_COLUMNS) <= set(cells)
    values = numbers(
        [cells.get(key, "") for key in (COLUMNS if distant else POSITION_COLUMNS)]
    )
    gain = numbers([cells.get(INTENSITY, "1")])[0] or 0.0
    vector = np.array([np.nan if value is None else value for value in values])
    usable = 0 < np.linalg.norm(vector) < np.inf
    require(
        name and usable and 0 < gain < np.inf,
        place,
        "must be a picture and the direction x, y, z to its light (or x_mm, y_mm, z_mm "
        "of a header); an intensity is positive",
        short(", ".join(words)),
        "correct the line",
    )
    return Light(name, vector, distant, gain)


def _table_fault(path: Path, rule: str, found: str) -> InputError:
    return input_error(str(path), f"a table of lights {rule}", found, "correct it")
