"""A self-contained HTML page with pictures, plots and tables, which can be downloaded
as CSV files.
"""

from __future__ import annotations

import base64
import html
import importlib.resources
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from skindb.files import csv_text


@dataclass(frozen=True)
class Table:
    """A table of the report; its name is that of the file that a reader downloads."""

    name: str
    header: Sequence[str]
    rows: Sequence[Sequence[Any]]

    def columns(self, names: Sequence[str]) -> Table:
        """The table with only these columns."""
        at = [list(self.header).index(name) for name in names]
        return Table(
            self.name, list(names), [[row[i] for i in at] for row in self.rows]
        )

    def renamed(self, header: Sequence[str]) -> Table:
        """The table with another header."""
        return Table(self.name, header, self.rows)


def picture(image: NDArray[np.uint8], alt: str, *, caption: str = "") -> str:
    """An sRGB picture (rows, cols, 3) with an alternative text and, if there is one, a
    visible caption.
    """
    image_tag = (
        f'<img alt="{html.escape(alt)}" '
        f'src="{_png(imagecodecs.png_encode(np.ascontiguousarray(image)))}">'
    )
    text = f"<figcaption>{html.escape(caption)}</figcaption>" if caption else ""
    return f"<figure>{image_tag}{text}</figure>"


def row(pictures: Iterable[str], *, kind: str = "row") -> str:
    """Pictures side by side; `kind` is a class of the style sheet: "row", "wide" or "plots"."""
    return f'<div class="{kind}">{"".join(pictures)}</div>'


def themed(light: bytes, dark: bytes, alt: str) -> str:
    """A plot as two PNG images, of which the browser shows the one for its theme."""
    source = f'<source media="(prefers-color-scheme: dark)" srcset="{_png(dark)}">'
    return (
        f'<picture>{source}<img class="plot" alt="{html.escape(alt)}" '
        f'src="{_png(light)}"></picture>'
    )


def _png(data: bytes | bytearray) -> str:
    return f"data:image/png;base64,{base64.b64encode(data).decode()}"


def table(content: Table) -> str:
    """A table; numbers are printed to three significant digits."""
    head = "".join(
        f'<th scope="col">{html.escape(name)}</th>' for name in content.header
    )
    body = "".join(
        "<tr>" + "".join(map(_entry, values)) + "</tr>" for values in content.rows
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _entry(value: Any) -> str:
    kind = "" if isinstance(value, str) else ' class="number"'
    return f"<td{kind}>{html.escape(cell(value))}</td>"


def cell(value: Any) -> str:
    """The text of a value: floats with three significant digits, NaN as a dash, counts
    with commas.
    """
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool):
        return f"{value:,}"
    if not isinstance(value, (float, np.floating)):
        return str(value)
    number = float(value)
    return (
        "-"
        if np.isnan(number)
        else f"{number:.3g}"
        if abs(number) < 1000
        else f"{number:,.0f}"
    )


def downloads(tables: Iterable[Table]) -> str:
    """Links for downloading tables as CSV files with all columns and digits; the page
    contains the files.
    """
    links = []
    for content in tables:
        data = base64.b64encode(
            csv_text(content.header, content.rows).encode()
        ).decode()
        name = html.escape(f"{content.name}.csv")
        links.append(
            f'<a download="{name}" href="data:text/csv;charset=utf-8;base64,{data}">{name}</a>'
        )
    return f'<p class="downloads">Download: {", ".join(links)}</p>'


def details(summary: str, blocks: Iterable[str]) -> str:
    """Blocks that are hidden until the reader opens them."""
    return (
        f"<details><summary>{html.escape(summary)}</summary>{''.join(blocks)}</details>"
    )


def paragraph(text: str) -> str:
    """A paragraph of plain text."""
    return f"<p>{html.escape(text)}</p>"


def page(title: str, lead: str, sections: Iterable[tuple[str, Sequence[str]]]) -> str:
    """The page: title, lead, and sections of (heading, parts of HTML)."""
    parts = list(sections)
    links = "".join(
        f'<a href="#s{i}">{html.escape(name)}</a>' for i, (name, _) in enumerate(parts)
    )
    body = "".join(
        f'<section><h2 id="s{i}">{html.escape(name)}</h2>{"".join(blocks)}</section>'
        for i, (name, blocks) in enumerate(parts)
    )
    style = (
        importlib.resources.files("skindb.demo")
        .joinpath("report.css")
        .read_text(encoding="utf-8")
    )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{html.escape(title)}</title><style>{style}</style></head><body><main><h1>{html.escape(title)}</h1>"
        f'<p class="lead">{html.escape(lead)}</p><nav>{links}</nav>{body}</main></body></html>\n'
    )
