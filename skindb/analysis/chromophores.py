"""Maps of melanin and haemoglobin by unmixing log albedo into two independent pigments
(Tsumura et al. 2003).

The model is -ln R_d = melanin * m + haemoglobin * h + offset. If two pigments vary
independently over skin, the independent components in the plane of the two largest
principal components of -ln R_d are their absorption vectors m and h (Tsumura et al.
2003, Image-based skin color and texture analysis/synthesis by extracting hemoglobin and
melanin information in the skin, ACM Transactions on Graphics 22, 770-779). Unlike the
photographs of the paper, R_d contains no shading.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.random import Generator
from xarray import Dataset

from skindb import plots
from skindb.analysis.regions import map_regions
from skindb.analysis.study import (
    Population,
    Results,
    Study,
    each_take,
    skipped_takes,
    table_of,
)
from skindb.analysis.subjects import compared_conditions, grouped
from skindb.analysis.texture import (
    COVERED,
    DARKEST,
    LEAST_COVERED,
    MAPPED,
    covered_fractions,
)
from skindb.errors import require
from skindb.numerics.statistics import SUMMARY
from skindb.schema import dataset, variables
from skindb.schema.cohort import require_comparable
from skindb.schema.label import CHANNELS, FACE
from skindb.study_parameters import DECLARED, ChromophoreParameters
from skindb.types import Array, Mask, finite_rows, lengths

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CHROMOPHORES = ("melanin", "haemoglobin")
COLUMNS = tuple(f"group_chromophore_{name}" for name in SUMMARY)
# absorption in Gaussian bands (standard deviation 30 nm) at 600, 540 and 450 nm
# relative to that at 540 nm: eumelanin (Sarna and Swartz 1988), haemoglobin with 75 %
# oxygenation (Prahl 1999); a test computes them from the tables
TABLE_AXES = np.array([[0.687, 1.0, 1.683], [0.490, 1.0, 4.210]])
# maximum angles [deg] between components and these. That of haemoglobin is wide because
# blue light hardly reaches the blood: the peak at 420 nm is far weaker in reflectance
# than in the transmission of a cuvette
MAX_TABLE_ANGLE = np.array([30.0, 60.0])
# [deg] RMS over bootstrap samples; it is about 30 for normally distributed pigments
MAX_AXIS_SPREAD = 10.0
# of the second to the third principal variance, below which noise hides a second
# pigment
MIN_PLANE_RATIO = 1.5
# of the red and green rows of the plane, above which they do not determine a vector in
# it
MAX_PLANE_CONDITION = 1e3
# relative to green: no pigment brightens skin, but noise rotates an axis slightly
MAX_NEGATIVE = 0.1
# [deg] between both axes: the noise of the amounts is inversely proportional to it
MIN_SEPARATION = 5.0
SAMPLES = 24_000  # texels of all takes together from which the axes are computed
# along each side; the bootstrap draws whole tiles because neighbouring texels are
# correlated
TILES = 4
DRAWS = 20  # bootstrap samples
CONSTANT = 1e-12  # variance of -ln R_d up to which maps count as constant
INDEPENDENT = "independent components"
PROJECTED = (
    "published absorption of red and green, in the plane of the two largest principal "
    "components"
)
PUBLISHED = "published absorption"


class _Sampled(NamedTuple):
    """Texels of a take."""

    density: Array  # (n, 3) -ln R_d minus its mean
    mean: Array  # (3,)
    tile: Array  # (n,) of each texel


@dataclass(frozen=True)
class _Plane:
    """The two largest principal components (3, 2), scaled by their standard deviations,
    and all three variances.
    """

    axes: Array
    variance: Array


def chromophore_axes(
    cohort: Dataset,
    *,
    landmarks: Mapping[str, Array] | None = None,
    rng: Generator,
) -> Dataset:
    """Absorption vectors of melanin and haemoglobin, from the variation of albedo within takes.

    Differences between takes are excluded, because a chance correlation of melanin and
    blood among a few people would rotate the axes. Every take has the same weight.
    Melanin is the component that absorbs more red relative to green. If independent
    components cannot be identified, or are not plausible absorption vectors, published
    absorption is used instead, and "flags" gives the reason. Amounts are then
    approximate, because the absorption of blue light by blood is weaker in skin than in
    a cuvette.

    Parameters
    ----------
    cohort
        ``db.cohort("maps", variables=skindb.analysis.texture.MAPPED)``.
    landmarks
        Name -> (2,) position in the common (u, v), to restrict the texels to skin
        without beard, brows and lips. By default all measured texels are used.
    rng
        Random generator of the initial components and of the bootstrap.

    Returns
    -------
    Dataset
        `chromophore_axis` (chromophore, channel), 1 in green; `chromophore_offset`, the
        mean -ln R_d, at which amounts are 0; `chromophore_table_angle` to published
        absorption; `chromophore_axis_spread` by bootstrap over tiles of maps.
        Attributes: `axes_origin`, `flags`, `skipped`.

    Raises
    ------
    InputError
        If no texel of skin was measured, or if albedo does not vary within any take.
    """
    require_comparable(cohort, "maps")
    size = cohort.sizes["v"]
    drawn = map_regions(landmarks or {}, size)
    flags = []
    inside = drawn.get("no_beard", drawn[FACE])
    if "no_beard" not in drawn:
        flags.append(
            "no landmarks: beards, brows and lips are used as skin and may rotate the axes"
        )
    count = max(SAMPLES // max(cohort.sizes["take"], 1), 64)
    samples = _skin_samples(cohort, inside, count)
    density = np.concatenate([sample.density for sample in samples])
    plane = _principal_plane(density)
    mixing, spread = _components(samples, plane, rng)
    reasons = _rejection_reasons(mixing, spread, plane)
    axes = np.maximum(mixing, 0.0)
    origin = INDEPENDENT
    if reasons:
        axes, origin = _published_axes(plane)
        flags.append(
            f"independent components are not used ({'; '.join(reasons)}): "
            f"the axes are {origin}, and amounts are approximate"
        )
    return dataset(
        {
            variables.CHROMOPHORE_AXIS: axes,
            variables.CHROMOPHORE_OFFSET: np.mean(
                [sample.mean for sample in samples], axis=0
            ),
            variables.CHROMOPHORE_TABLE_ANGLE: _angle(axes, TABLE_AXES),
            variables.CHROMOPHORE_AXIS_SPREAD: spread,
        },
        coords={"chromophore": CHROMOPHORES, "channel": CHANNELS},
        attrs={
            "axes_origin": origin,
            "flags": flags,
            "skipped": skipped_takes(cohort),
        },
    )


def _skin_samples(cohort: Dataset, inside: Mask, count: int) -> list[_Sampled]:
    """Samples of the skin of all takes that have any.

    Raises
    ------
    InputError
        If no texel was measured, or if albedo does not vary within any take.
    """
    samples = [
        sample
        for sample in each_take(_sampled, cohort, MAPPED, inside, count)
        if sample is not None
    ]
    require(
        samples,
        "chromophores",
        "some texels of skin must be measured",
        "none",
        "fit or register more takes",
    )
    require(
        np.concatenate([sample.density for sample in samples]).var(axis=0).sum()
        > CONSTANT,
        "chromophores",
        "albedo must vary over the skin of a take",
        "constant maps",
        "use maps of measured faces",
    )
    return samples


def chromophore_maps(maps: Dataset, axes: Dataset) -> Dataset:
    """Maps of melanin and haemoglobin of one take.

    Parameters
    ----------
    maps
        Of one take: `texel_diffuse_reflectance` (v, u, channel) and `texel_coverage` (v, u).
    axes
        From `chromophore_axes`.

    Returns
    -------
    Dataset
        `texel_chromophore` (v, u, chromophore): optical density (-ln R_d) at green due
        to the pigment, relative to the mean of the cohort (amounts may be negative). NaN
        where nothing was measured.
    """
    density, measured = _density(maps)
    amounts = _unmixed(
        density,
        axes[variables.CHROMOPHORE_AXIS].values,
        axes[variables.CHROMOPHORE_OFFSET].values,
    )
    measured_amounts = np.where(measured[..., None], amounts, np.nan)
    return dataset(
        {variables.TEXEL_CHROMOPHORE: measured_amounts},
        coords={"chromophore": CHROMOPHORES},
    )


def chromophore_statistics(
    cohort: Dataset,
    *,
    axes: Dataset,
    landmarks: Mapping[str, Array] | None = None,
) -> Dataset:
    """Mean and standard deviation of melanin and haemoglobin over the texels of every
    take and region.

    Parameters
    ----------
    cohort, landmarks
        As in `chromophore_axes`.
    axes
        From `chromophore_axes`.

    Returns
    -------
    Dataset
        `take_chromophore` and `take_chromophore_deviation` (take, region, chromophore).
        NaN for regions of which less than half was measured.
    """
    drawn = map_regions(landmarks or {}, cohort.sizes["v"])
    masks = np.stack(list(drawn.values()))
    vectors = axes[variables.CHROMOPHORE_AXIS].values
    offset = axes[variables.CHROMOPHORE_OFFSET].values
    rows = each_take(_statistics, cohort, MAPPED, masks, vectors, offset)
    mean, deviation = (np.stack(column) for column in zip(*rows, strict=True))
    return dataset(
        {
            variables.TAKE_CHROMOPHORE: mean,
            variables.TAKE_CHROMOPHORE_DEVIATION: deviation,
        },
        coords={
            "take": cohort["take"].values.tolist(),
            "region": list(drawn),
            "chromophore": CHROMOPHORES,
        },
        attrs={"skipped": skipped_takes(cohort)},
    )


def chromophore_table(
    cohort: Dataset, *, statistics: Dataset, group_by: str | None = None
) -> Dataset:
    """Mean melanin and haemoglobin of groups of subjects, with Student's 95 % interval.

    Parameters
    ----------
    cohort
        Any cohort of the takes; only its coordinates are used.
    statistics
        From `chromophore_statistics` of these takes.
    group_by
        Attribute or trait; None puts all takes into the group "all". Takes in other
        conditions than normal are used only if it is "condition" or a trait of it. The
        takes of a subject in a group are averaged first.

    Returns
    -------
    Dataset
        (group, region, chromophore), see the variables of the group "chromophore_table".
    """
    groups = grouped(cohort, group_by)
    values = statistics[variables.TAKE_CHROMOPHORE]
    takes = groups.takes["take"].values.tolist()
    moments = groups.moments(values.sel(take=takes).values)
    return dataset(
        moments.summary("group_chromophore"),
        coords={
            "group": [*groups.members],
            "region": statistics["region"].values,
            "chromophore": CHROMOPHORES,
        },
        attrs=groups.attrs,
    )


def _density(maps: Dataset) -> tuple[Array, Mask]:
    """-ln R_d (v, u, 3), 0 where nothing was measured, and the mask (v, u) of measured texels."""
    albedo = maps[variables.TEXEL_DIFFUSE_REFLECTANCE].values.astype(float)
    measured = (maps[variables.TEXEL_COVERAGE].values > COVERED) & finite_rows(albedo)
    known = np.where(measured[..., None], albedo, 1.0)
    return -np.log(np.maximum(known, DARKEST)), measured


def _sampled(maps: Dataset, inside: Mask, count: int) -> _Sampled | None:
    """Evenly spaced texels of the skin of one take; `count` texels, so that each take
    has the same weight.
    """
    density, measured = _density(maps)
    rows, columns = np.nonzero(measured & inside)
    if not len(rows):
        return None
    chosen = np.linspace(0, len(rows) - 1, count).round().astype(int)
    rows = rows[chosen]
    columns = columns[chosen]
    height, width = measured.shape
    tile = rows * TILES // height * TILES + columns * TILES // width
    values = density[rows, columns]
    return _Sampled(
        values - values.mean(axis=0), density[measured & inside].mean(axis=0), tile
    )


def _principal_plane(density: Array) -> _Plane:
    """Principal components of densities (n, 3)."""
    values, vectors = np.linalg.eigh(density.T @ density / len(density))
    values = np.maximum(values[::-1], 0.0)
    return _Plane(vectors[:, :0:-1] * np.sqrt(values[:2]), values)


def _components(
    samples: list[_Sampled], plane: _Plane, rng: Generator
) -> tuple[Array, Array]:
    """Independent components (2, 3), melanin first, and their RMS rotation [deg] in
    bootstrap samples.

    Both are NaN if the density varies in one direction only.
    """
    nothing = np.full((2, 3), np.nan), np.full(2, np.nan)
    if plane.variance[1] <= 1e-9 * plane.variance[0]:
        return nothing
    blocks = [
        sample.density[sample.tile == tile]
        for sample in samples
        for tile in np.unique(sample.tile)
    ]
    best = _independent(np.concatenate(blocks), rng)
    draws = [
        [blocks[i] for i in rng.integers(len(blocks), size=len(blocks))]
        for _ in range(DRAWS)
    ]
    turned = [_angle(_independent(np.concatenate(draw), rng), best) for draw in draws]
    return best, np.sqrt(np.mean(np.square(turned), axis=0))


def _independent(density: Array, rng: Generator) -> Array:
    """Independent components (2, 3) in the principal plane, 1 in green; the one that
    absorbs more red is the first.
    """
    # take longer to import than most commands run
    from sklearn.decomposition import FastICA
    from sklearn.exceptions import ConvergenceWarning

    axes = _principal_plane(density).axes
    white = density @ np.linalg.pinv(axes).T
    white -= white.mean(axis=0)
    # no warning is needed: a component that has not converged rotates in the bootstrap
    # and is then rejected
    ica = FastICA(
        whiten=False,
        fun="logcosh",
        max_iter=500,
        tol=1e-5,
        random_state=int(rng.integers(2**31)),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        mixing = (axes @ ica.fit(white).mixing_).T
    green = mixing[:, 1:2]
    mixing = mixing / np.where(np.abs(green) > 1e-6, green, 1e-6)
    return np.asarray(mixing[np.argsort(-mixing[:, 0])])


def _rejection_reasons(mixing: Array, spread: Array, plane: _Plane) -> list[str]:
    """Reasons why components cannot be the absorption of two pigments; empty if there are none."""
    if not np.isfinite(mixing).all():
        return ["albedo varies in one direction only, as with one pigment"]
    ratio = plane.variance[1] / max(plane.variance[2], 1e-300)
    negative = CHANNELS[int(np.argmin(mixing.min(axis=0)))]
    apart = float(_angle(mixing[:1], mixing[1:])[0])
    reasons = {
        f"the second principal variance is {ratio:.2f} times the third, as with one "
        "pigment and noise": ratio < MIN_PLANE_RATIO,
        f"they rotate by {spread.max():.0f} degrees between samples, as with normally "
        "distributed pigments": spread.max() > MAX_AXIS_SPREAD,
        f"one of them would brighten {negative}, which no pigment does": (
            mixing.min() < -MAX_NEGATIVE
        ),
    }
    angles = _angle(mixing, TABLE_AXES)
    for name, angle, limit in zip(CHROMOPHORES, angles, MAX_TABLE_ANGLE, strict=True):
        text = f"the axis of {name} is {angle:.0f} degrees from published absorption"
        reasons[text] = angle > limit
    reasons[f"they are {apart:.1f} degrees apart"] = apart < MIN_SEPARATION
    return [text for text, applies in reasons.items() if applies]


def _published_axes(plane: _Plane) -> tuple[Array, str]:
    """Axes with the published absorption of red and green; that of blue follows from
    the plane if this is possible.

    An orthogonal projection to the plane would exchange the pigments: haemoglobin
    absorbs blue more than melanin in a cuvette, but less in skin.
    """
    red_green = plane.axes[:2]
    if (
        plane.variance[1] > MIN_PLANE_RATIO * plane.variance[2]
        and np.linalg.cond(red_green) < MAX_PLANE_CONDITION
    ):
        within = (plane.axes @ np.linalg.solve(red_green, TABLE_AXES[:, :2].T)).T
        if (within > 0).all() and _angle(within[:1], within[1:])[0] >= MIN_SEPARATION:
            return within / within[:, 1:2], PROJECTED
    return TABLE_AXES.copy(), PUBLISHED


def _unmixed(density: Array, axes: Array, offset: Array) -> Array:
    """Amounts (..., 2) by least squares."""
    return (density - offset) @ np.linalg.pinv(axes)


def _statistics(
    maps: Dataset, masks: Mask, axes: Array, offset: Array
) -> tuple[Array, Array]:
    """Mean and standard deviation (region, chromophore)."""
    density, measured = _density(maps)
    covered = covered_fractions(measured, masks)
    mean, deviation = np.full((2, len(masks), len(CHROMOPHORES)), np.nan)
    for r, mask in enumerate(masks):
        # the first region is the face, which needs no minimum coverage
        if covered[r] >= LEAST_COVERED or (r == 0 and measured.any()):
            amounts = _unmixed(density[measured & mask], axes, offset)
            mean[r] = amounts.mean(axis=0)
            deviation[r] = amounts.std(axis=0)
    return mean, deviation


def _angle(a: Array, b: Array) -> Array:
    """Angles [deg] between the rows (n, 3) of two arrays."""
    cosine = (a * b).sum(axis=-1) / lengths(a) / lengths(b)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def describe_chromophores(axes: Dataset) -> list[str]:
    """Origin of the axes and their angles to published absorption, one line each."""
    lines = [f"axes: {axes.attrs['axes_origin']}"]
    for name in CHROMOPHORES:
        axis = axes.sel(chromophore=name)
        absorbed = axis[variables.CHROMOPHORE_AXIS].values.tolist()
        lines.append(
            f"{name}: absorbs R, G, B as {', '.join(f'{x:.2f}' for x in absorbed)}; "
            f"{float(axis[variables.CHROMOPHORE_TABLE_ANGLE]):.0f} degrees from "
            f"published absorption; independent components rotate by "
            f"{float(axis[variables.CHROMOPHORE_AXIS_SPREAD]):.1f} degrees between samples"
        )
    amounts = "amounts are optical densities (-ln R_d) of a pigment at green, relative "
    return [*lines, f"{amounts}to the mean of all takes", *axes.attrs["flags"]]


def plot_chromophores(table: Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot mean melanin and haemoglobin of the groups in every region, with 95 % intervals."""
    regions = [name for name in table["region"].values.tolist() if name != "neck"]
    groups = enumerate(table["group"].values.tolist())
    colours = {"melanin": plots.BLUE, "haemoglobin": plots.RED}
    lines = list(itertools.product(groups, colours.items()))
    height = max(0.55, 0.11 * len(lines))
    ax = ax or plots.new_axes(6.5, 1.4 + height * len(regions))
    ax.axvline(0, color="0.6", linewidth=1)
    for i, ((g, group), (name, colour)) in enumerate(lines):
        part = table.sel(group=group, chromophore=name, region=regions)
        count = int(part[variables.GROUP_CHROMOPHORE_COUNT].max())
        plots.intervals(
            ax,
            part,
            variables.GROUP_CHROMOPHORE_MEAN,
            np.arange(len(regions)) + 0.7 * ((i + 0.5) / len(lines) - 0.5),
            fmt="osD^v"[g % 5],
            color=colour,
            mfc="white" if name == CHROMOPHORES[0] else colour,
            label=f"{name}, {group} (n = {count})",
        )
    ax.set_yticks(range(len(regions)), regions)
    ax.invert_yaxis()
    ax.set_xlabel(
        "amount relative to the mean of all takes, with 95 % CI [-ln R_d at green]"
    )
    plots.legend_above(ax)
    return ax


def compute(population: Population, parameters: ChromophoreParameters) -> Results:
    """The results of the study."""
    cohort = population.cohort
    landmarks = population.landmarks
    rng = np.random.default_rng(parameters.seed)
    axes = chromophore_axes(cohort, landmarks=landmarks, rng=rng)
    statistics = chromophore_statistics(cohort, axes=axes, landmarks=landmarks)
    table = chromophore_table(
        cohort, statistics=statistics, group_by=parameters.group_by
    )
    return {
        "chromophores": axes.merge(statistics, combine_attrs="override"),
        "chromophore_table": table,
    }


STUDY = Study(
    *DECLARED["chromophores"],
    layout="maps",
    absolute=True,
    compute=compute,
    shown=("chromophores", "chromophore_table"),
    tabulate=lambda _, table: table_of(table, COLUMNS),
    plot=lambda _, table: plot_chromophores(table),
    describe=lambda axes, _: describe_chromophores(axes),
    conditions=compared_conditions,
)
