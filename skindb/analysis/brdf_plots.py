"""Plots of the space of surface BRDFs: map of the takes, spheres and lobes (Weyrich et
al. 2005, figures 7 and 14).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from xarray import Dataset

from skindb import plots
from skindb.optics.angles import half_difference
from skindb.reflectance.sampling import tangents
from skindb.reflectance.tables import lookup
from skindb.schema import variables
from skindb.types import AnyArray, Array, Float32, Mask

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.projections.polar import PolarAxes

VIEW = np.array([0.0, 0.0, 1.0])  # direction to the camera
LINES = ("-", "--")
# angles of the lights from the viewing direction, upwards and to the right
FRONTAL = np.radians(15.0)
GRAZING = np.radians(100.0)
SPHERE = 256  # diameter of a sphere in pixels
SPHERES_PER_ROW = 6
WHITE_PERCENTILE = 99.5  # percentile of all pixels on spheres that is drawn white
INCIDENCES = (30.0, 60.0)  # degrees
MAX_EXITANCE = 80.0  # degrees; f rises towards the horizon and would hide the rest
GAMMA = 2.2


def plot_brdf_space(space: Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the map of the takes, coloured by group.

    Parameters
    ----------
    space
        From `brdf_space`.
    ax
        Axes to draw on; by default new ones.
    """
    ax = ax or plots.new_axes(5, 4.4)
    named = np.array(space.attrs["groups_of_takes"])
    for i, (group, count) in enumerate(_groups(space)):
        points = space[variables.TAKE_PLACE].values[named == group]
        takes = "" if len(points) == count else f", {len(points)} takes"
        ax.plot(
            *points.T,
            plots.MARKERS[i % len(plots.MARKERS)],
            color=_colour(i),
            markersize=4,
            alpha=0.75,
            label=plots.legend_entry(f"{group} (n = {count}{takes})"),
        )
    horizontal, second = (
        f"{fraction:.1%}" for fraction in space[variables.EXPLAINED_FRACTION].values
    )
    ax.set_xlabel(f"axis 1, {horizontal} of the scatter [length of the mean BRDF]")
    ax.set_ylabel(
        f"axis 2, {second}; relative error of the map {float(space[variables.MAP_ERROR]):.1%}"
    )
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_box_aspect(1)
    plots.legend_above(ax, fontsize=8)
    return ax


def plot_group_spheres(space: Dataset, *, ax: Axes | None = None) -> Axes:
    """Render a sphere with the mean surface BRDF of each group, under a frontal and a
    grazing light, at equal exposure.

    The lights are 15 degrees above the viewer and 100 degrees to the right, of equal
    irradiance; diffuse light is omitted. The brightest 0.5 % of the pixels are white.

    Parameters
    ----------
    space
        From `brdf_space`.
    ax
        Axes to draw on; by default new ones.
    """
    groups = _groups(space)
    columns = min(len(groups), SPHERES_PER_ROW)
    rows = -(-len(groups) // columns)
    ax = ax or plots.new_axes(1.6 * columns + 0.4, 1.9 * rows + 0.4)
    radiance, inside = sphere_radiance(_tables(space))
    white = float(np.percentile(radiance[inside], WHITE_PERCENTILE)) or 1.0
    step_x = 1.1
    step_y = 1.35
    for i, (name, count) in enumerate(groups):
        x = step_x * (i % columns)
        y = -step_y * (i // columns)
        shades = np.clip(radiance[..., i] / white, 0, 1) ** (1 / GAMMA)
        ax.imshow(
            np.where(inside, shades, 1.0),
            cmap="gray",
            vmin=0,
            vmax=1,
            extent=(x - 0.5, x + 0.5, y - 0.5, y + 0.5),
            interpolation="antialiased",
        )
        label = f"{name}\n(n = {count})"
        ax.text(x, y - 0.53, label, ha="center", va="top", fontsize=8)
    ax.set_xlim(-0.6, step_x * (columns - 1) + 0.6)
    ax.set_ylim(-step_y * (rows - 1) - 0.9, 0.6)
    ax.set_aspect("equal")
    ax.set_axis_off()
    ax.set_title(
        "surface BRDF under a frontal and a grazing light, equal exposure", fontsize=9
    )
    return ax


def plot_group_lobes(space: Dataset, *, ax: PolarAxes | None = None) -> PolarAxes:
    """Plot the lobes f cos(theta_i) [sr^-1] of the groups in the plane of incidence, at
    30 and 60 degrees of incidence.

    The lobes are drawn up to 80 degrees of exitance.

    Parameters
    ----------
    space
        From `brdf_space`.
    ax
        Polar axes to draw on; by default new ones.
    """
    from matplotlib import pyplot
    from matplotlib.ticker import MaxNLocator

    if ax is None:
        _, ax = pyplot.subplots(figsize=(6, 3.8), subplot_kw={"projection": "polar"})
    angle = np.radians(np.linspace(-MAX_EXITANCE, MAX_EXITANCE, 321))
    tables = _tables(space)
    for incidence, line in zip(INCIDENCES, LINES, strict=True):
        for i, (group, count) in enumerate(_groups(space)):
            values = lobe(tables[..., [i]], np.radians(incidence), angle)[:, 0]
            text = f"{group} (n = {count}), {incidence:.0f}°"
            label = plots.legend_entry(text)
            ax.plot(angle, values, line, color=_colour(i), linewidth=1.2, label=label)
    ax.set_theta_zero_location("N")
    ax.set_theta_direction(-1)
    ax.set_thetamin(-90)
    ax.set_thetamax(90)
    ax.set_rlabel_position(-90)
    ax.yaxis.set_major_locator(MaxNLocator(4))
    ax.tick_params(labelsize=7)
    ax.set_title(
        "f cos θᵢ [sr⁻¹] against the angle of exitance; light from the left", fontsize=9
    )
    ax.legend(
        fontsize=7,
        loc="upper center",
        bbox_to_anchor=(0.5, 0.08),
        ncols=2,
        frameon=False,
    )
    return ax


def plot_space(space: Dataset) -> Axes:
    """Plot map, spheres and lobes in one figure, and return the axes of the map."""
    from matplotlib import pyplot

    groups = space.sizes["group"]
    height = 5.6 + 0.2 * groups
    figure = pyplot.figure(figsize=(11, height), layout="constrained")
    map_part, right = figure.subfigures(1, 2, width_ratios=(1, 1.1))
    upper, lower = right.subfigures(2, 1, height_ratios=(1, 1.2 + 0.1 * groups))
    plot_group_spheres(space, ax=upper.subplots())
    plot_group_lobes(space, ax=lower.subplots(subplot_kw={"projection": "polar"}))
    return plot_brdf_space(space, ax=map_part.subplots())


def sphere_radiance(tables: AnyArray) -> tuple[Array, Mask]:
    """Radiance (pixels, pixels, groups) of spheres per irradiance of the lights
    [sr^-1], and the mask of their pixels.

    Parameters
    ----------
    tables
        (nh, nd, np, groups) [sr^-1].
    """
    pixel = (np.arange(SPHERE) + 0.5) / SPHERE * 2 - 1
    x, y = np.meshgrid(pixel, -pixel)
    inside = x**2 + y**2 < 1
    normal = np.stack([x, y, np.sqrt(np.clip(1 - x**2 - y**2, 0, None))], axis=-1)[
        inside
    ]
    lights = [
        np.array([0.0, np.sin(FRONTAL), np.cos(FRONTAL)]),
        np.array([np.sin(GRAZING), 0.0, np.cos(GRAZING)]),
    ]
    radiance = np.zeros((*inside.shape, tables.shape[-1]))
    radiance[inside] = sum(_shaded(tables, normal, light) for light in lights)
    return radiance, inside


def lobe(tables: AnyArray, incidence: float, angle: Array) -> Array:
    """Values f cos(theta_i) [sr^-1] (angles, groups) in the plane of incidence; the
    mirror is at +incidence [rad].
    """
    to_light = np.array([-np.sin(incidence), 0.0, np.cos(incidence)])
    to_camera = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=-1)
    values = lookup(
        tables, *half_difference(np.broadcast_to(to_light, to_camera.shape), to_camera)
    )
    return np.asarray(values * np.cos(incidence))


def _shaded(tables: AnyArray, normal: Array, light: Array) -> Array:
    """Values f cos(theta_i) (n, groups) for normals seen from the direction z; the BRDF
    is isotropic.
    """
    cosine = normal @ light
    lit = cosine > 0
    frame = (*tangents(normal[lit]), normal[lit])
    to_light, to_camera = (
        np.stack([axis @ direction for axis in frame], axis=-1)
        for direction in (light, VIEW)
    )
    out = np.zeros((len(normal), tables.shape[-1]))
    values = lookup(tables, *half_difference(to_light, to_camera))
    out[lit] = values * cosine[lit][:, None]
    return out


def _tables(space: Dataset) -> Float32:
    """Tables (nh, nd, np, group) of `group_brdf`, without the last azimuth, which
    repeats the first.
    """
    stored = (
        space[variables.GROUP_BRDF]
        .transpose("theta_h", "theta_d", "phi_d", "group")
        .values
    )
    return np.ascontiguousarray(stored[:, :, :-1])


def _groups(space: Dataset) -> list[tuple[str, int]]:
    """Names and numbers of subjects of the groups."""
    counts = space[variables.GROUP_SUBJECT_COUNT].values.tolist()
    return list(zip(space["group"].values.tolist(), counts, strict=True))


def _colour(i: int) -> str:
    return plots.CYCLE[i % len(plots.CYCLE)]
