"""Figures: a variable of the surfels as colours on the face, and grids of pictures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from skindb.errors import InputError, choices, input_error
from skindb.files import private_file
from skindb.geometry.mesh import face_crosses
from skindb.geometry.rays import RayScene
from skindb.render.image import encode_srgb, shown_part
from skindb.schema import variables
from skindb.schema.consent import honour_consent
from skindb.types import Array, Faces, Float64, Index, lengths

if TYPE_CHECKING:
    from matplotlib.figure import Figure
from skindb.plots import plain_text
from skindb.render.image import auto_exposure, tone_map

View = tuple[Index, Float64, Float64]
TURNS = (0.0, 55.0)  # degrees to the subject's left
# percentiles of the visible values at the ends of the colour scale, so that outliers do
# not set it
RANGE = (1, 99)
UNKNOWN = (0.72, 0.72, 0.72)  # colour of surfels without a value
MARGIN = 0.03  # border around the head, as a fraction of the longer side
DPI = 90
RAY_START_MM = 10.0  # in front of the head
CELL = 2.0  # inches, the longer side of a picture
GAP = 0.04  # inches between pictures
GRID_MARGIN_PX = 4  # pixels around the lit part


def field_figure(
    take: xr.DataTree,
    variable: str,
    *,
    at: Mapping[str, str] | None = None,
    turns: Sequence[float] = TURNS,
) -> Figure:
    """Draw a variable of the surfels on the face, with a colour bar; statuses and masks
    are labelled by their names.

    A variable with the dimension "channel" is drawn as an sRGB picture without shading.
    Its white is the 99 % quantile of the largest channel, which the title states. Unit
    vectors n are drawn as the colours (n + 1) / 2.

    Parameters
    ----------
    take
        A capture or a model with the group "mesh".
    variable
        Name of a variable with the dimension "surfel".
    at
        Label for each other dimension of the variable, such as ``{"channel": "G"}``;
        "channel" and the "xyz" of unit vectors may be omitted.
    turns
        Angles [degrees] by which the views are rotated to the subject's left; 0 is the front.

    Raises
    ------
    InputError
        If there is no such variable, or `at` does not have a valid label for each of
        its other dimensions.
    """
    group, values = _find(take, variable)
    at = dict(at or {})
    colour = _colour_dim(values, at)
    chosen = _chosen(values, dict(at), keep=colour)
    position = group[variables.SURFEL_POSITION].values
    triangle = take["mesh"].dataset[variables.TRIANGLE].values
    views = [trace_front(position, triangle, turn) for turn in turns]
    who = f"{take.attrs.get('subject') or ''} {take.attrs.get('condition', '')}".strip()
    title = ", ".join(
        [
            *([who] if take.attrs.get("subject") else []),
            variable,
            *(f"{k} {v}" for k, v in at.items()),
        ]
    )
    if colour:
        images, scale = _colour_images(chosen, views)
        return _figure(images, f"{title} ({scale})")
    return _scalar_figure(chosen, views, title + _units(values))


def _figure(images: Sequence[Float64], title: str) -> Figure:
    """Pictures (rows, columns, 3) in [0, 1] side by side."""
    from matplotlib import pyplot

    figure: Figure
    figure, axes = pyplot.subplots(
        1,
        len(images),
        figsize=(4 * len(images) + 1, 4.6),
        squeeze=False,
        layout="constrained",
    )
    for axis, image in zip(axes[0], images, strict=True):
        axis.imshow(image)
        axis.axis("off")
    figure.suptitle(title, fontsize=10)
    return figure


def _scalar_figure(chosen: xr.DataArray, views: Sequence[View], title: str) -> Figure:
    """Figure of values or categories as shaded colours, with a colour bar."""
    from matplotlib import pyplot

    values, names = _shades(chosen)
    pictures = [_field(view, values, nearest=bool(names)) for view in views]
    finite = np.concatenate([picture[np.isfinite(picture)] for picture in pictures])
    low, high = (-0.5, len(names) - 0.5) if names else _span(finite)
    colours = pyplot.get_cmap("tab10" if names else "viridis", len(names) or None)
    images = []
    for (_, _, shade), picture in zip(views, pictures, strict=True):
        image = colours(np.clip((picture - low) / (high - low), 0, 1))[..., :3]
        image[np.isnan(picture)] = UNKNOWN
        image *= (0.45 + 0.55 * shade)[..., None]
        image[np.isnan(shade)] = 1
        images.append(image)
    figure = _figure(images, title)
    scale = pyplot.cm.ScalarMappable(pyplot.Normalize(low, high), colours)
    bar = figure.colorbar(
        scale, ax=figure.axes, shrink=0.7, extend="neither" if names else "both"
    )
    if names:
        bar.set_ticks(range(len(names)), labels=names)
    return figure


def _colour_images(
    chosen: xr.DataArray, views: Sequence[View]
) -> tuple[list[Float64], str]:
    """Pictures of a variable (surfel, 3) of colours or unit vectors, and a description
    of their scale.
    """
    values = chosen.transpose("surfel", ...).values.astype(np.float64)
    pictures = [
        np.stack([_field(view, value, nearest=False) for value in values.T], axis=-1)
        for view in views
    ]
    if "xyz" in chosen.dims:
        images = [np.clip((picture + 1) / 2, 0, 1) for picture in pictures]
        scale = "red, green, blue = (x + 1, y + 1, z + 1) / 2"
    else:
        exposure = 1 / _white(
            np.concatenate([picture.reshape(-1, 3) for picture in pictures])
        )
        images = [encode_srgb(exposure * picture) for picture in pictures]
        scale = f"sRGB, white is {1 / exposure:.3g}{_plain_units(chosen)}"
    for image, picture, (_, _, shade) in zip(images, pictures, views, strict=True):
        image[np.isnan(picture).any(axis=-1)] = UNKNOWN
        image[np.isnan(shade)] = 1
    return images, scale


def _white(values: Array) -> float:
    """The value of the largest channel that is drawn white, of values (n, 3); 1 if none
    is above zero.
    """
    peak = values.max(axis=-1)
    peak = peak[np.isfinite(peak) & (peak > 0)]
    return float(np.percentile(peak, RANGE[1])) if len(peak) else 1.0


def _colour_dim(values: xr.DataArray, at: Mapping[str, str]) -> str | None:
    """The dimension that is drawn as a colour: the only one besides "surfel" that is
    not in `at`, if it fits.
    """
    free = [str(dim) for dim in values.dims if dim != "surfel" and dim not in at]
    if len(free) != 1 or values.sizes[free[0]] != 3 or "flag_values" in values.attrs:
        return None
    unit_vectors = free[0] == "xyz" and str(values.attrs.get("units", "1")) in ("1", "")
    return free[0] if free[0] == "channel" or unit_vectors else None


def write_field(
    trees: Mapping[str, xr.DataTree],
    variable: str,
    out: Path,
    *,
    at: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Write a plot of a variable, from the first version that has it.

    Parameters
    ----------
    trees
        Versions by kind, such as a model and the capture it was made from.
    variable, at
        See `field_figure`.
    out
        Picture to write (.png, .pdf, .svg).

    Returns
    -------
    dict
        Path of the picture, and kind and generation of the version drawn.
    """
    from matplotlib import pyplot

    for version in trees.values():
        honour_consent(version.attrs, "export")
    having = [kind for kind, tree in trees.items() if variable in _drawable(tree)]
    if not having:
        raise _not_drawable(variable, trees.values())
    tree = trees[having[0]]
    figure = field_figure(tree, variable, at=at)
    figure.savefig(private_file(out), dpi=DPI)
    pyplot.close(figure)
    return {"path": str(out), "kind": having[0], "generation": tree.attrs["generation"]}


def trace_front(
    position: Array,
    triangle: Faces,
    turn: float = 0.0,
    *,
    size: int = 480,
) -> View:
    """Intersect a mesh with parallel rays from the front.

    Parameters
    ----------
    position, triangle
        (n, 3) mm and (f, 3).
    turn
        Angle [degrees] by which the view is rotated to the subject's left (+x).
    size
        Pixels along each side of the picture.

    Returns
    -------
    corner : ndarray
        (size, size, 3) vertices of the triangle hit; -1 where there is none.
    weight : ndarray
        (size, size, 3) barycentric weights of the corners.
    shade : ndarray
        (size, size) cosine between the triangle's normal and the direction to the
        viewer; NaN where there is no hit.
    """
    c = np.cos(np.radians(turn))
    s = np.sin(np.radians(turn))
    # rightwards in the picture, upwards, and towards the viewer
    axes = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    place = position[np.unique(triangle)].astype(np.float64) @ axes.T
    low = place.min(axis=0)
    high = place.max(axis=0)
    side = (1 + 2 * MARGIN) * (high - low)[:2].max()
    along = ((np.arange(size) + 0.5) / size - 0.5) * side
    x, y = np.meshgrid(along, -along)
    middle = (low + high) / 2
    depth = np.full(x.shape, high[2] + RAY_START_MM - middle[2])
    origin = (middle + np.stack([x, y, depth], axis=-1)) @ axes
    back = axes[2]
    face, weight, _ = RayScene(position, triangle).first_hit(
        origin.reshape(-1, 3), -back[None]
    )
    corner = np.where(face[:, None] >= 0, triangle[face], -1)
    normal = face_crosses(position, corner)
    shade = np.abs(normal @ back) / np.maximum(lengths(normal), 1e-30)
    shape = (size, size)
    return (
        corner.reshape(*shape, 3),
        weight.reshape(*shape, 3),
        np.where(face < 0, np.nan, shade).reshape(shape),
    )


def _field(view: View, values: Array, *, nearest: bool) -> Float64:
    """Values (n,) interpolated in a view; NaN beside the face, and where a corner with
    a weight has no value.
    """
    corner, weight, shade = view
    if nearest:
        corner = np.take_along_axis(corner, weight.argmax(axis=-1)[..., None], -1)
        weight = np.ones((1, 1, 1))
    with np.errstate(invalid="ignore"):
        picture = np.where(weight > 0, weight * values[corner], 0).sum(axis=-1)
    return np.where(np.isnan(shade), np.nan, picture)


def _groups(take: xr.DataTree) -> Iterator[xr.Dataset]:
    for name in ("surfels", "fitted", "samples"):
        if name in take:
            yield take[name].to_dataset()


def _find(take: xr.DataTree, variable: str) -> tuple[xr.Dataset, xr.DataArray]:
    """The group with the positions of the surfels, and the variable."""
    groups = list(_groups(take))
    for group in groups:
        if variable in group and "surfel" in group[variable].dims:
            return next(g for g in groups if variables.SURFEL_POSITION in g), group[
                variable
            ]
    raise _not_drawable(variable, [take])


def _not_drawable(variable: str, takes: Iterable[xr.DataTree]) -> InputError:
    cure = choices(variable, set().union(*map(_drawable, takes)))
    return input_error("variable", "must be a variable of the surfels", variable, cure)


def _drawable(take: xr.DataTree) -> set[str]:
    return {
        str(name)
        for group in _groups(take)
        for name, values in group.items()
        if "surfel" in values.dims
    }


def _chosen(
    values: xr.DataArray, at: dict[str, str], *, keep: str | None = None
) -> xr.DataArray:
    """The variable at one label of each dimension other than "surfel" and the one to keep."""
    for dim in (str(d) for d in values.dims if d not in ("surfel", keep)):
        labels = (
            [str(x) for x in values[dim].values]
            if dim in values.coords
            else [str(i) for i in range(values.sizes[dim])]
        )
        if at.get(dim) not in labels:
            choice = f"{dim}={at[dim]}" if dim in at else f"no {dim}"
            cure = (
                f"choose {dim}="
                + ", ".join(labels[:12])
                + (", ..." if len(labels) > 12 else "")
            )
            raise input_error(
                "at", f"must select one {dim} of {values.name}", choice, cure
            )
        values = values.isel({dim: labels.index(at.pop(dim))})
    if at:
        dims = ", ".join(map(str, values.dims))
        cure = "remove the others"
        raise input_error(
            "at",
            f"must name dimensions of {values.name}, which has {dims}",
            ", ".join(at),
            cure,
        )
    return values


def _shades(chosen: xr.DataArray) -> tuple[Float64, list[str]]:
    """Numbers (n,) to colour, and for categories their names."""
    values = chosen.values
    if "flag_values" in chosen.attrs:
        codes = np.atleast_1d(chosen.attrs["flag_values"])
        names = str(chosen.attrs["flag_meanings"]).split()
        met = [i for i, code in enumerate(codes) if (values == code).any()]
        shade = np.full(len(values), np.nan)
        for place, i in enumerate(met):
            shade[values == codes[i]] = place
        return shade, [names[i] for i in met]
    if values.dtype == bool:
        return values.astype(np.float64), ["no", "yes"]
    return values.astype(np.float64), []


def _span(values: Float64) -> tuple[float, float]:
    low, high = (
        (float(v) for v in np.percentile(values, RANGE)) if len(values) else (0.0, 1.0)
    )
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def _units(values: xr.DataArray) -> str:
    units = _plain_units(values).strip()
    return f" [{units}]" if units else ""


def _plain_units(values: xr.DataArray) -> str:
    units = str(values.attrs.get("units", "1"))
    return "" if units in ("1", "") else f" {units}"


@plain_text()
def write_grid(
    path: Path,
    rows: Mapping[str, Sequence[Array]],
    titles: Sequence[str],
    *,
    exposure: float | None = None,
) -> None:
    """Write pictures as a grid with labels (.png, .pdf, .svg).

    Parameters
    ----------
    path
        File to write.
    rows
        Linear pictures (h, w, 3) of one size, one per column, by the label of the row.
    titles
        Titles of the columns.
    exposure
        Factor on every picture before encoding; default `auto_exposure` of the first picture.
    """
    from matplotlib import pyplot

    pictures = [image for row in rows.values() for image in row]
    gain = auto_exposure(pictures[0]) if exposure is None else exposure
    lit = [np.nan_to_num(image).max(axis=2) > 0 for image in pictures]
    crop = shown_part(lit, GRID_MARGIN_PX)
    height, width = pictures[0][crop].shape[:2]
    size = np.array([width, height]) * (CELL + GAP) / max(height, width)
    figure, axes = pyplot.subplots(
        len(rows),
        len(titles),
        figsize=size * [len(titles), len(rows)],
        squeeze=False,
    )
    for line, (label, row) in zip(axes, rows.items(), strict=True):
        for ax, image in zip(line, row, strict=True):
            ax.imshow(tone_map(image[crop], exposure=gain), interpolation="none")
            ax.set(xticks=[], yticks=[])
            ax.set_frame_on(False)
        line[0].set_ylabel(label, rotation=0, ha="right", va="center", fontsize=8)
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title, fontsize=8)
    # labels lie outside, and are included by "tight"
    figure.subplots_adjust(0, 0, 1, 1, wspace=GAP / CELL, hspace=GAP / CELL)
    figure.savefig(
        private_file(path),
        dpi=max(150.0, max(height, width) / CELL),
        bbox_inches="tight",
    )
    pyplot.close(figure)
