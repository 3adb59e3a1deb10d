"""A self-contained HTML page with tables, which can be downloaded as CSV files, pictures of all
subjects at one exposure and one scale, and plots for light and dark pages.
"""

from __future__ import annotations

import base64
import html
import importlib.resources
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import imagecodecs
import numpy as np
import xarray as xr

from skindb import plots
from skindb.analysis import plot_albedo, plot_basis_size, plot_translucency
from skindb.files import csv_text
from skindb.geometry.rays import RayScene
from skindb.render.image import auto_exposure, encode_srgb, tone_map
from skindb.render.photographs import Comparison, side_by_side
from skindb.render.rendering import frontal_camera
from skindb.render.scene import (
    Lights,
    Surface,
    cameras_from_dome,
    from_model,
    lights_from_dome,
)
from skindb.render.shading import View, shade_view, trace_view
from skindb.schema import variables
from skindb.types import Array, Bytes, Mask, lengths, unit

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from skindb.virtual.capture import Recovery

Image = Array
Picture = Bytes
ERRORS = (  # maps of residuals, black where they are unknown
    (variables.HELD_OUT_ERROR, 0.2, "error under lights the fit did not see"),
    (variables.OUTLIER_FRACTION, 0.1, "samples the model does not explain"),
)
# directions of the two lights of a portrait
KEY_LIGHTS = ((-0.5, 0.35, 0.8), (0.55, 0.25, 0.8))
MARGIN = 6  # pixels around a face
SIZE = (4.4, 3.3)  # inches; text is still readable at 360 px, the width of a phone
DOTS = 160  # per inch, twice the resolution of a page of 360 px
INK = "#8a847c"  # of text and lines, readable on light and on dark pages
MAX_NORMAL_ANGLE = 15  # degrees, end of the axis


@dataclass(frozen=True)
class Table:
    """A table of the report; its name is that of the file that a reader downloads."""

    name: str
    header: Sequence[str]
    rows: Sequence[Sequence[Any]]

    def columns(self, names: Sequence[str]) -> Table:
        """The table with only these columns."""
        indices = [list(self.header).index(name) for name in names]
        return Table(
            self.name, list(names), [[row[i] for i in indices] for row in self.rows]
        )

    def renamed(self, header: Sequence[str]) -> Table:
        """The table with another header."""
        return Table(self.name, header, self.rows)


def picture(image: Bytes, alt: str, *, caption: str = "") -> str:
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


@dataclass(frozen=True)
class Portraits:
    """Linear portraits of all takes, and their common exposure on the page."""

    images: Mapping[str, Image]
    exposure: float

    def cut(self, images: Mapping[str, Image]) -> dict[str, Picture]:
        """Portraits at the exposure of the page, cropped to one scale."""
        drawn = [tone_map(image, exposure=self.exposure) for image in images.values()]
        cut = crop_alike(drawn, [image.sum(axis=2) > 0 for image in images.values()])
        return dict(zip(images, cut, strict=True))


def draw_portraits(models: Mapping[str, xr.DataTree]) -> Portraits:
    """Portraits with a common exposure that does not clip the brightest skin, so that
    skin tones are comparable.
    """
    images = {take: portrait(model) for take, model in models.items()}
    return Portraits(images, min(auto_exposure(image) for image in images.values()))


def _frontal(
    model: xr.DataTree, *, scale: float
) -> tuple[Surface, View, RayScene, xr.Dataset]:
    dome = model["dome"].to_dataset().load()
    surface = from_model(model, fill=True)
    scene = RayScene(surface.vertices, surface.faces)
    camera = cameras_from_dome(dome)[frontal_camera(dome)].scaled(scale)
    return surface, trace_view(surface, camera, samples=2, scene=scene), scene, dome


def _key(dome: xr.Dataset) -> Lights:
    """Two lights of the dome, one from each side."""
    place = dome[variables.LIGHT_POSITION].values
    place = unit(place)
    directions = np.array(KEY_LIGHTS) / lengths(KEY_LIGHTS)[..., None]
    return lights_from_dome(dome).select(np.argmax(directions @ place.T, axis=1))


def portrait(model: xr.DataTree) -> Image:
    """Linear radiance (h, w, 3) of the model from the front under two lights."""
    surface, view, scene, dome = _frontal(model, scale=1.6)
    return np.asarray(
        shade_view(view, surface, _key(dome), scene, terms=("diffuse", "surface")).sum(
            axis=0
        )
    )


def map_pictures(
    models: Mapping[str, xr.DataTree],
) -> dict[str, list[tuple[Picture, str]]]:
    """Maps of each model from the front, at one scale.

    Returns
    -------
    dict
        For each take normal, albedo, surface reflection, translucency and errors, each
        with its caption.
    """
    drawn = {take: _maps(model) for take, model in models.items()}
    flat = [image for maps in drawn.values() for image in maps]
    cut = iter(
        crop_alike([image for image, _, _ in flat], [mask for _, mask, _ in flat])
    )
    return {
        take: [(next(cut), text) for _, _, text in maps] for take, maps in drawn.items()
    }


def _maps(model: xr.DataTree) -> list[tuple[Picture, Mask, str]]:
    surface, view, _, _ = _frontal(model, scale=1.2)
    shine = surface.model.normal_reflectance(view.interpolate(surface.parameters))
    pictures = [
        ((view.interpolate(surface.normals) + 1) / 2, "normal"),
        (encode_srgb(view.interpolate(surface.diffuse)), "diffuse albedo"),
        (_scaled(shine, 0.12), "surface reflection at normal incidence, 0 to 0.12"),
    ]
    if surface.sigma_tr is not None:
        depth = np.clip(1 / view.interpolate(surface.sigma_tr) / 3, 0, 1)
        pictures.append((encode_srgb(depth), "translucency 1/sigma_tr, 0 to 3 mm"))
    fitted = model["fitted"].to_dataset()
    for name, top, text in ERRORS:
        if name in fitted:
            values = view.interpolate(np.nan_to_num(fitted[name].values)[:, None])[:, 0]
            pictures.append((_scaled(values, top), f"{text}, 0 to {100 * top:g} %"))
    return [
        (_byte(view.image(values)), view.coverage > 0.5, text)
        for values, text in pictures
    ]


def crop_alike(pictures: Sequence[Picture], masks: Sequence[Mask]) -> list[Picture]:
    """Pictures (h, w, 3) cropped to the pixels that show a face in any of the `masks`
    (h, w), so that equal widths on the page correspond to equal scale. Without any face,
    pictures are not cropped.
    """
    rows, cols = np.nonzero(np.any(masks, axis=0))
    if not rows.size:
        return list(pictures)
    top = max(rows.min() - MARGIN, 0)
    left = max(cols.min() - MARGIN, 0)
    end = (slice(top, rows.max() + MARGIN + 1), slice(left, cols.max() + MARGIN + 1))
    return [image[end] for image in pictures]


def predictions(comparisons: Sequence[Comparison], exposure: float) -> list[Picture]:
    """Photograph, prediction and difference of each comparison side by side, all at one
    exposure and one scale.
    """
    drawn = list[Picture]()
    masks = list[Mask]()
    for comparison in comparisons:
        width = comparison.mask.shape[1]
        strip = side_by_side(comparison, exposure=exposure)
        drawn += [strip[:, i * width : (i + 1) * width] for i in range(3)]
        masks += [comparison.mask] * 3
    cut = crop_alike(drawn, masks)
    return [np.concatenate(cut[i : i + 3], axis=1) for i in range(0, len(cut), 3)]


def _scaled(values: Image, top: float) -> Image:
    return np.repeat(np.clip(values / top, 0, 1)[:, None], 3, axis=1)


def _byte(image: Image) -> Picture:
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def _plot(ax: Axes, alt: str) -> str:
    """A plot with its legend below and without a background; the figure is closed."""
    from matplotlib import pyplot

    handles, _ = ax.get_legend_handles_labels()
    if handles:
        ax.legend(
            fontsize=8,
            loc="upper center",
            bbox_to_anchor=(0.5, -0.18),
            ncol=2 if len(handles) < 5 else 3,
            frameon=False,
            labelcolor=INK,
        )
    ax.tick_params(colors=INK, which="both")
    figure = ax.get_figure(root=True)
    assert figure is not None
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=DOTS, bbox_inches="tight", transparent=True)
    pyplot.close(figure)
    return (
        f'<img class="plot" alt="{html.escape(alt)}" src="{_png(buffer.getvalue())}">'
    )


def _axes() -> Axes:
    from matplotlib import pyplot, rc_context

    names = ("axes.edgecolor", "axes.labelcolor", "text.color")
    with rc_context(dict.fromkeys(names, INK)):
        ax: Axes = pyplot.figure(figsize=SIZE).add_subplot()
    return ax


def reflectance_plot(recovered: Mapping[str, Recovery]) -> str:
    """Plot of recovered against true diffuse reflectance, for every fortieth fitted
    surfel of all takes.
    """
    ax = _axes()
    for channel, (name, colour) in enumerate(zip("RGB", plots.CHANNELS, strict=True)):
        true = []
        recovered_values = []
        for recovery in recovered.values():
            pick = np.flatnonzero(recovery.fitted)[::40]
            true.append(recovery.true_diffuse[pick, channel])
            recovered_values.append(
                true[-1] * (1 + recovery.diffuse_error[pick, channel])
            )
        ax.plot(
            np.concatenate(true),
            np.concatenate(recovered_values),
            ".",
            ms=2,
            color=colour,
            alpha=0.5,
        )
        # the points are too small for a legend
        ax.plot([], [], "o", ms=4, color=colour, label=name)
    top = ax.get_xlim()[1]
    ax.plot([0, top], [0, top], color=INK, lw=0.7, label="equal")
    ax.set_xlabel("true diffuse reflectance R_d [1]")
    ax.set_ylabel("recovered R_d [1]")
    return _plot(
        ax, "Recovered against true diffuse reflectance, with the line of equality."
    )


def normal_plot(recovered: Mapping[str, Recovery]) -> str:
    """Plot of the cumulative distribution of the error of normals, one line for each take."""
    ax = _axes()
    ax.set_prop_cycle(color=plots.CYCLE)
    for i, (take, recovery) in enumerate(recovered.items()):
        angle = recovery.normal_angle[recovery.fitted]
        angle = np.sort(angle[np.isfinite(angle)])
        dashes = "-" if i < len(plots.CYCLE) else "--"
        ax.plot(angle, np.linspace(0, 100, len(angle)), dashes, label=take)
    ax.set_xlim(0, MAX_NORMAL_ANGLE)
    ax.set_xlabel("angle between recovered and true normal [deg]")
    ax.set_ylabel("fitted surfels below [%]")
    return _plot(
        ax,
        "Cumulative distribution of the angle between the recovered and the true normal, by take.",
    )


def translucency_plot(table: xr.Dataset) -> str:
    """Plot of mean sigma_tr by site and channel."""
    alt = "Mean sigma_tr with its 95 % interval, by site and channel."
    return _plot(plot_translucency(table, ax=_axes()), alt)


def basis_size_plot(curve: xr.Dataset) -> str:
    """Plot of the error against the number of basis BRDFs."""
    alt = (
        "Relative error of the reflectance against the number of basis BRDFs, with its "
        "95 % interval."
    )
    return _plot(plot_basis_size(curve, ax=_axes()), alt)


def albedo_plot(histograms: xr.Dataset) -> str:
    """Plot of histograms of the first decorrelated axis of the albedo."""
    alt = "Histograms of the albedo along its first decorrelated axis, one line for each take."
    return _plot(plot_albedo(histograms, ax=_axes()), alt)
