"""A variable of the surfels as colours on the face."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.geometry.rays import RayScene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from skindb.store import Database

Float = NDArray[np.floating[Any]]
TURNS = (0.0, 55.0)  # degrees to the subject's left
RANGE = (1, 99)  # per cent of the values shown that the colours span: a stray surfel must not take them all
UNKNOWN = (0.72, 0.72, 0.72)
MARGIN = 0.03  # of the longer side, beside the head
FLATTEST = 0.05  # shorter side over the longer one: a patch may be seen edge on
DPI = 90
BEYOND = 10.0  # mm in front of the head, where rays start


def field_figure(
    take: xr.DataTree, variable: str, *, at: Mapping[str, str] | None = None, turns: Sequence[float] = TURNS
) -> Figure:
    """Draw a variable of the surfels on the face, with a scale of its values; statuses and masks by name.

    Parameters
    ----------
    take
        A capture or a model, with its group "mesh".
    variable
        Name of a variable with the dimension "surfel".
    at
        Label for each other dimension of the variable, such as ``{"channel": "G"}``.
    turns
        Degrees by which the views are turned to the subject's left; 0 is the front.

    Raises
    ------
    InputError
        If there is no such variable, or it has other dimensions than `at` says.
    """
    from matplotlib import pyplot

    group, found = _find(take, variable)
    chosen = _chosen(found, dict(at or {}))
    values, names = _shades(chosen)
    position, triangle = group["surfel_position"].values, take["mesh"].to_dataset()["triangle"].values
    views = [trace_front(position, triangle, turn) for turn in turns]
    pictures = [_field(view, values, nearest=bool(names)) for view in views]
    shown = np.concatenate([picture[np.isfinite(picture)] for picture in pictures])
    low, high = (-0.5, len(names) - 0.5) if names else _span(shown)
    colours = pyplot.get_cmap("tab10" if names else "viridis", len(names) or None)
    figure: Figure
    figure, axes = pyplot.subplots(
        1, len(views), figsize=(4 * len(views) + 1, 4.6), squeeze=False, layout="constrained"
    )
    for axis, (_, _, shade), picture in zip(axes[0], views, pictures, strict=True):
        image = colours(np.clip((picture - low) / (high - low), 0, 1))[..., :3]
        image[np.isnan(picture)] = UNKNOWN
        image *= (0.45 + 0.55 * shade)[..., None]
        image[np.isnan(shade)] = 1
        axis.imshow(image)
        axis.axis("off")
    scale = pyplot.cm.ScalarMappable(pyplot.Normalize(low, high), colours)
    bar = figure.colorbar(scale, ax=axes[0], shrink=0.7, extend="neither" if names else "both")
    if names:
        bar.set_ticks(range(len(names)), labels=names)
    who = (
        [] if not take.attrs.get("subject") else [f"{take.attrs['subject']} {take.attrs.get('condition', '')}".strip()]
    )
    figure.suptitle(
        ", ".join([*who, variable, *(f"{k} {v}" for k, v in (at or {}).items())]) + _units(found), fontsize=10
    )
    return figure


def write_field(
    db: Database, take: str, variable: str, out: Path, *, at: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Draw a variable of the newest model of a take, or of its newest capture, to a picture; says which it was."""
    from matplotlib import pyplot

    trees = {kind: db.read(kind, take) for kind in ("model", "capture") if take in db.takes(kind)}
    if not trees:
        known = ", ".join(db.takes("capture")) or "there is none"
        raise InputError(Fault("take", "a take of the database is drawn", take, f"choose {known}"))
    having = [kind for kind, tree in trees.items() if variable in _drawable(tree)]
    if not having:
        known = ", ".join(sorted(set().union(*map(_drawable, trees.values()))))
        raise InputError(Fault("variable", "a variable of the surfels is drawn", variable, f"choose {known}"))
    tree = trees[having[0]]
    figure = field_figure(tree, variable, at=at)
    figure.savefig(out, dpi=DPI)
    pyplot.close(figure)
    return {"path": str(out), "kind": having[0], "generation": tree.attrs["generation"]}


def trace_front(
    position: Float, triangle: NDArray[np.integer[Any]], turn: float = 0.0, *, size: int = 480
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """What parallel rays from the front meet first.

    Parameters
    ----------
    position, triangle
        (n, 3) mm and (f, 3).
    turn
        Degrees the view is turned to the subject's left (+x).
    size
        Pixels along the longer side of the picture.

    Returns
    -------
    corner : ndarray
        (rows, columns, 3) vertices of the triangle; -1 where nothing is met.
    weight : ndarray
        (rows, columns, 3) barycentric weights of the corners.
    shade : ndarray
        (rows, columns) cosine of the triangle's normal towards the viewer; NaN where nothing is met.
    """
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    right, back = np.array([c, 0, -s]), np.array([s, 0, c])  # of the picture; towards the viewer
    used = position[np.unique(triangle)].astype(np.float64)
    place = np.column_stack([used @ right, used[:, 1], used @ back])
    (left, bottom, _), (end, top, front) = place.min(axis=0), place.max(axis=0)
    width, height = (max(extent, FLATTEST * max(end - left, top - bottom)) for extent in (end - left, top - bottom))
    edge = MARGIN * max(width, height)
    step = (max(width, height) + 2 * edge) / size
    x = (left + end - width) / 2 - edge + (np.arange(np.ceil((width + 2 * edge) / step)) + 0.5) * step
    y = (top + bottom + height) / 2 + edge - (np.arange(np.ceil((height + 2 * edge) / step)) + 0.5) * step
    origin = x[None, :, None] * right + y[:, None, None] * np.array([0.0, 1, 0]) + (front + BEYOND) * back
    face, weight, _ = RayScene(position, triangle).first_hit(origin.reshape(-1, 3), -back[None])
    corner = np.where(face[:, None] >= 0, triangle[face], -1)
    p, q, r = (position[corner[:, k]] for k in range(3))
    normal = np.cross(q - p, r - p)
    shade = np.abs(normal @ back) / np.maximum(np.linalg.norm(normal, axis=1), 1e-30)
    shape = (len(y), len(x))
    return corner.reshape(*shape, 3), weight.reshape(*shape, 3), np.where(face < 0, np.nan, shade).reshape(shape)


def _field(view: tuple[Any, Any, Any], values: Float, *, nearest: bool) -> NDArray[np.float64]:
    """Values (n,) in a view; NaN beside the face, and where a corner that counts has none."""
    corner, weight, shade = view
    if nearest:
        corner, weight = np.take_along_axis(corner, weight.argmax(axis=-1)[..., None], -1), np.ones((1, 1, 1))
    with np.errstate(invalid="ignore"):
        picture = np.where(weight > 0, weight * values[corner], 0).sum(axis=-1)
    return np.where(np.isnan(shade), np.nan, picture)


def _groups(take: xr.DataTree) -> Iterator[xr.Dataset]:
    for name in ("surfels", "fitted", "samples"):
        if name in take:
            yield take[name].to_dataset()


def _find(take: xr.DataTree, variable: str) -> tuple[xr.Dataset, xr.DataArray]:
    """The group with the positions, and the variable."""
    groups = list(_groups(take))
    for group in groups:
        if variable in group and "surfel" in group[variable].dims:
            return next(g for g in groups if "surfel_position" in g), group[variable]
    cure = "choose " + ", ".join(sorted(_drawable(take)))
    raise InputError(Fault("variable", "a variable of the surfels is drawn", variable, cure))


def _drawable(take: xr.DataTree) -> set[str]:
    return {str(name) for group in _groups(take) for name, one in group.items() if "surfel" in one.dims}


def _chosen(found: xr.DataArray, at: dict[str, str]) -> xr.DataArray:
    """The variable at one label of every other dimension."""
    for dim in (str(d) for d in found.dims if d != "surfel"):
        labels = (
            [str(x) for x in found[dim].values] if dim in found.coords else [str(i) for i in range(found.sizes[dim])]
        )
        if at.get(dim) not in labels:
            said = f"{dim}={at[dim]}" if dim in at else f"no {dim}"
            cure = f"choose {dim}=" + ", ".join(labels[:12]) + (", ..." if len(labels) > 12 else "")
            raise InputError(Fault("at", f"{found.name} has one value for each {dim}", said, cure))
        found = found.isel({dim: labels.index(at.pop(dim))})
    if at:
        rule, cure = f"{found.name} has the dimensions {', '.join(map(str, found.dims))}", "leave it out"
        raise InputError(Fault("at", rule, ", ".join(at), cure))
    return found


def _shades(chosen: xr.DataArray) -> tuple[NDArray[np.float64], list[str]]:
    """Numbers (n,) to colour, and names if they stand for something."""
    values = chosen.values
    if "flag_values" in chosen.attrs:
        codes, names = np.atleast_1d(chosen.attrs["flag_values"]), str(chosen.attrs["flag_meanings"]).split()
        met = [i for i, code in enumerate(codes) if (values == code).any()]
        shade = np.full(len(values), np.nan)
        for place, i in enumerate(met):
            shade[values == codes[i]] = place
        return shade, [names[i] for i in met]
    if values.dtype == bool:
        return values.astype(np.float64), ["no", "yes"]
    return values.astype(np.float64), []


def _span(shown: NDArray[np.float64]) -> tuple[float, float]:
    low, high = (float(v) for v in np.percentile(shown, RANGE)) if len(shown) else (0.0, 1.0)
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def _units(found: xr.DataArray) -> str:
    units = str(found.attrs.get("units", "1"))
    return "" if units in ("1", "") else f" [{units}]"
