"""Plots of the report, each in versions for light and dark pages."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from skindb.analysis import colours, plot_albedo, plot_basis_size, plot_translucency
from skindb.demo.page import themed

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from skindb.virtual.truth import Recovery

SIZE = (4.4, 3.3)  # inches; text is still readable at 360 px, the width of a phone
DOTS = 160  # per inch, twice the resolution of a page of 360 px
# background and foreground, as in report.css
LIGHT, DARK = ("#ffffff", "#22211f"), ("#262422", "#e9e5df")
MAX_GREY_DIFFERENCE = 0.05  # between the channels of colours that count as grey
MAX_NORMAL_ANGLE = 15  # degrees, end of the axis


def themed_plot(ax: Axes, alt: str) -> str:
    """A plot for both themes with its legend below; the figure is closed."""
    from matplotlib import pyplot

    handles, _ = ax.get_legend_handles_labels()
    if handles:
        ax.legend(
            fontsize=8,
            loc="upper center",
            bbox_to_anchor=(0.5, -0.18),
            ncol=2 if len(handles) < 5 else 3,
            frameon=False,
        )
    figure = ax.get_figure(root=True)
    assert figure is not None
    light, dark = (_png(figure, *theme) for theme in (LIGHT, DARK))
    pyplot.close(figure)
    return themed(light, dark, alt)


def _png(figure: Figure, paper: str, ink: str) -> bytes:
    """The figure on a background, with everything grey or black in the foreground colour."""
    from matplotlib.colors import to_rgb

    figure.set_facecolor(paper)
    for ax in figure.axes:
        ax.set_facecolor(paper)
        ax.tick_params(colors=ink, which="both")
        for spine in ax.spines.values():
            spine.set_edgecolor(ink)
        for text in (
            ax.title,
            ax.xaxis.label,
            ax.yaxis.label,
            *(ax.legend_.get_texts() if ax.legend_ else ()),
        ):
            text.set_color(ink)
        for line in (*ax.lines, *(ax.legend_.get_lines() if ax.legend_ else ())):
            channels = to_rgb(line.get_color())
            if max(channels) - min(channels) < MAX_GREY_DIFFERENCE:
                line.set_color(ink)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DOTS, bbox_inches="tight", facecolor=paper)
    return buffer.getvalue()


def _axes() -> Axes:
    from matplotlib import pyplot

    ax: Axes = pyplot.figure(figsize=SIZE).add_subplot()
    return ax


def reflectance_plot(recovered: Mapping[str, Recovery]) -> str:
    """Plot of recovered against true diffuse reflectance, for every fortieth fitted
    surfel of all takes.
    """
    ax = _axes()
    for channel, (name, colour) in enumerate(zip("RGB", colours.CHANNELS, strict=True)):
        true = []
        found = []
        for one in recovered.values():
            pick = np.flatnonzero(one.fitted)[::40]
            true.append(one.true_diffuse[pick, channel])
            found.append(true[-1] * (1 + one.diffuse_error[pick, channel]))
        ax.plot(
            np.concatenate(true),
            np.concatenate(found),
            ".",
            ms=2,
            color=colour,
            alpha=0.5,
        )
        # the points are too small for a legend
        ax.plot([], [], "o", ms=4, color=colour, label=name)
    top = ax.get_xlim()[1]
    ax.plot([0, top], [0, top], "k-", lw=0.7, label="equal")
    ax.set_xlabel("true diffuse reflectance R_d [1]")
    ax.set_ylabel("recovered R_d [1]")
    return themed_plot(
        ax, "Recovered against true diffuse reflectance, with the line of equality."
    )


def normal_plot(recovered: Mapping[str, Recovery]) -> str:
    """Plot of the cumulative distribution of the error of normals, one line for each take."""
    ax = _axes()
    ax.set_prop_cycle(color=colours.CYCLE)
    for i, (take, one) in enumerate(recovered.items()):
        angle = one.normal_angle[one.fitted]
        angle = np.sort(angle[np.isfinite(angle)])
        dashes = "-" if i < len(colours.CYCLE) else "--"
        ax.plot(angle, np.linspace(0, 100, len(angle)), dashes, label=take)
    ax.set_xlim(0, MAX_NORMAL_ANGLE)
    ax.set_xlabel("angle between recovered and true normal [deg]")
    ax.set_ylabel("fitted surfels below [%]")
    return themed_plot(
        ax,
        "Cumulative distribution of the angle between the recovered and the true normal, by take.",
    )


def translucency_plot(table: xr.Dataset) -> str:
    """Plot of mean sigma_tr by site and channel."""
    alt = "Mean sigma_tr with its 95 % interval, by site and channel."
    return themed_plot(plot_translucency(table, ax=_axes()), alt)


def basis_size_plot(curve: xr.Dataset) -> str:
    """Plot of the error against the number of basis BRDFs."""
    alt = (
        "Relative error of the reflectance against the number of basis BRDFs, with its "
        "95 % interval."
    )
    return themed_plot(plot_basis_size(curve, ax=_axes()), alt)


def albedo_plot(histograms: xr.Dataset) -> str:
    """Plot of histograms of the first decorrelated axis of the albedo."""
    alt = "Histograms of the albedo along its first decorrelated axis, one line for each take."
    return themed_plot(plot_albedo(histograms, ax=_axes()), alt)
