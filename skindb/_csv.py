"""Tables as comma-separated values, whose text no spreadsheet evaluates as a formula."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
# first characters of formulas, also in full width
FORMULA = frozenset("=+-@\t\r\n\uff1d\uff0b\uff0d\uff20")


def csv_text(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table as CSV (RFC 4180), in which missing values are empty.

    Text that a spreadsheet would evaluate begins with an apostrophe (OWASP, "CSV Injection").
    """
    buffer = io.StringIO()
    csv.writer(buffer).writerows(
        [_cell(value) for value in row] for row in (header, *rows)
    )
    return buffer.getvalue()


def _cell(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()  # whose digits do not depend on the print options of NumPy
    if value is None or value != value:
        return ""
    if not isinstance(value, str) or NUMBER.fullmatch(value):
        return value
    first = {value[:1], value.lstrip()[:1]}
    return f"'{value}" if first & FORMULA else value
