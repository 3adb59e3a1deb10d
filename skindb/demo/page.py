"""One self-contained HTML page from pictures, plots and tables."""

from __future__ import annotations

import base64
import html
import importlib.resources
import io
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import imagecodecs
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure


def picture(image: NDArray[np.uint8], caption: str = "", *, width: int | None = None) -> str:
    """An sRGB picture (rows, cols, 3) with a caption."""
    data = base64.b64encode(imagecodecs.png_encode(np.ascontiguousarray(image))).decode()
    size = f' style="width: {width}px"' if width else ""
    text = f"<figcaption>{html.escape(caption)}</figcaption>" if caption else ""
    return f'<figure{size}><img alt="{html.escape(caption)}" src="data:image/png;base64,{data}">{text}</figure>'


def row(pictures: Iterable[str]) -> str:
    """Pictures side by side."""
    return f'<div class="row">{"".join(pictures)}</div>'


def plot(figure: Figure | SubFigure, alt: str) -> str:
    """A matplotlib figure as inline PNG; closes it."""
    from matplotlib import pyplot
    from matplotlib.figure import SubFigure

    figure = figure.figure if isinstance(figure, SubFigure) else figure
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, bbox_inches="tight")
    pyplot.close(figure)
    data = base64.b64encode(buffer.getvalue()).decode()
    return f'<img class="plot" alt="{html.escape(alt)}" src="data:image/png;base64,{data}">'


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table; numbers are printed to three significant digits."""
    head = "".join(f"<th>{html.escape(h)}</th>" for h in header)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(_cell(c))}</td>" for c in r) + "</tr>" for r in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _cell(value: Any) -> str:
    if not isinstance(value, (float, np.floating)):
        return str(value)
    number = float(value)
    return "-" if np.isnan(number) else f"{number:.3g}" if abs(number) < 1000 else f"{number:.0f}"


def paragraph(text: str) -> str:
    """A paragraph of plain text."""
    return f"<p>{html.escape(text)}</p>"


def page(title: str, lead: str, sections: Iterable[tuple[str, Sequence[str]]]) -> str:
    """The page: title, lead, and sections of (heading, parts of HTML)."""
    parts = list(sections)
    links = "".join(f'<a href="#s{i}">{html.escape(name)}</a>' for i, (name, _) in enumerate(parts))
    body = "".join(f'<h2 id="s{i}">{html.escape(name)}</h2>{"".join(blocks)}' for i, (name, blocks) in enumerate(parts))
    style = importlib.resources.files("skindb.demo").joinpath("report.css").read_text(encoding="utf-8")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{html.escape(title)}</title><style>{style}</style></head><body><main><h1>{html.escape(title)}</h1>"
        f'<p class="lead">{html.escape(lead)}</p><nav>{links}</nav>{body}</main></body></html>\n'
    )
