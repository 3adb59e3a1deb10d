"""Tables and figures of the paper (Weyrich et al. 2005) from the takes of a database."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from xarray import Dataset, DataTree

from skindb import plots
from skindb.analysis.brdf import describe_basis_size, plot_basis_size
from skindb.analysis.brdf_plots import plot_group_spheres
from skindb.analysis.studies import write_plot
from skindb.errors import InputError, counted, require
from skindb.files import make_private, private_file
from skindb.render.figures import write_grid
from skindb.render.photographs import Comparison, compare_photographs
from skindb.schema import variables
from skindb.schema.label import CHANNELS
from skindb.store import Database
from skindb.types import Array, Progress, silent, unit
from skindb.workflow.audit import logged_action
from skindb.workflow.cohorts import require_fitted
from skindb.workflow.edits import basis_grid, edit_grid
from skindb.workflow.pictures import show_take, translucency_grid
from skindb.workflow.studies import study

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PAGE = "figures.md"
MAX_FACES = 5  # of figure 11
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
PARTS = ("upper", "lower")  # of the face, in figure 5
MAX_ROWS = 4  # of figure 19
# of figure 19
TRAITS = ("beard_density", "ancestry:european", "condition:tan", "condition:lotion")
GROUPS = ["ancestry", "gender"]  # of figure 16
HISTOGRAM_SURFELS = 2000  # of each take, in figure 16
PEOPLE = ["condition", *GROUPS]  # rows of table 1
# table 2: mean and variance of red, green and blue [mm^-1, mm^-2]
SIGMA_TR = {
    "cheek": ((0.5572, 0.1727), (0.9751, 0.2089), (1.5494, 0.1881)),
    "forehead": ((0.5443, 0.0756), (0.9831, 0.1696), (1.5499, 0.2607)),
    "neck": ((0.6911, 0.2351), (1.2488, 0.3686), (1.9159, 0.4230)),
}


@dataclass(frozen=True)
class Source:
    """What the tables and figures are made from; dictionary is that of the fits."""

    db: Database
    table: pd.DataFrame  # the catalogue of the takes with a model
    take: str  # of the figures of one face
    dictionary: Path | None
    progress: Progress

    def study(self, what: str, **options: Any) -> DataTree:
        """A study; `InputError` if the takes do not allow it."""
        if what in ("brdf", "surface", "traits"):
            options["dictionary"] = self.dictionary
        return study(self.db, what, **options)

    def compared(self, take: str) -> Comparison:
        """The first kept photograph of a take with its prediction."""
        self.db.require_consent(take, "export")
        versions = (self.db.read(kind, take) for kind in ("model", "capture"))
        return compare_photographs(*versions)[0]


@dataclass(frozen=True)
class Item:
    """A table or a figure; `make` writes a picture to a path, if it has one, and returns
    lines of the page.
    """

    title: str
    make: Callable[[Source, Path], list[str]]
    paper: str  # what the paper has

    def written(self, source: Source, out: Path) -> tuple[list[str], str]:
        """Lines of the page, and why the item could not be made, or ""."""
        name = self.title.partition(":")[0].lower().replace(" ", "_")
        picture = out / f"{name}.png"
        picture.unlink(missing_ok=True)
        reason = ""
        try:
            lines = self.make(source, picture)
        except InputError as error:
            reason = str(error)
            lines = [f"Not made: {reason}"]
        if picture.exists():
            lines.append(f"![{self.title}]({picture.name})")
        return [f"## {self.title}", *lines, f"The paper: {self.paper}"], reason


@plots.plain_text()
def reproduce(
    db: Database,
    out: Path,
    *,
    take: str | None = None,
    dictionary: Path | None = None,
    progress: Progress = silent,
) -> dict[str, str]:
    """Write the tables and figures of the paper as a page with pictures.

    Parameters
    ----------
    db
        Database with models.
    out
        Folder for figures.md and its pictures, which are replaced.
    take
        Of the figures of one face; default one of the subject with the most conditions.
    dictionary
        Path of the dictionary of the fits; default the embedded one.
    progress
        Called with the stage, the number of finished steps and the total number of steps.

    Returns
    -------
    dict
        Title of each table and figure -> why it could not be made, or "".

    Raises
    ------
    InputError
        If the database has no models, or no model of `take`.

    References
    ----------
    Weyrich et al. 2005, tables 1 and 2 and figures 5 to 7, 10 to 12 and 14 to 19.
    """
    models = db.takes("model")
    require_fitted(db, models)
    table = db.table()
    table = table[table.index.isin(models)]
    source = Source(db, table, take or _most_conditions(table), dictionary, progress)
    db.record("model", source.take)
    make_private(out)
    reasons = {}
    page = [
        "# Tables and figures of Weyrich et al. 2005",
        f"{counted(len(table), 'take')} of {counted(table['subject'].nunique(), 'subject')}; "
        f"figures of one face are of {source.take}.",
    ]
    with logged_action(db, "reproduce", models):
        for number, item in enumerate(ITEMS):
            progress("tables and figures", number, len(ITEMS))
            lines, reasons[item.title] = item.written(source, out)
            page += lines
    progress("tables and figures", len(ITEMS), len(ITEMS))
    text = "\n\n".join(page) + "\n"
    private_file(out / PAGE).write_text(text, encoding="utf-8")
    return reasons


def _most_conditions(table: pd.DataFrame) -> str:
    """The first take of the subject with the most conditions."""
    conditions = table.groupby("subject")["condition"].nunique()
    return str(table.index[table["subject"] == conditions.idxmax()][0])


def _people(source: Source, _: Path) -> list[str]:
    table = source.table.reindex(columns=["subject", "age", *PEOPLE])
    # laboratories may have words in place of ages
    table["age"] = pd.to_numeric(table["age"], errors="coerce")
    groups = table.groupby(PEOPLE, dropna=False, sort=False)
    rows = groups.agg(
        subjects=("subject", "nunique"), youngest=("age", "min"), oldest=("age", "max")
    )
    return [_markdown(rows.reset_index())]


def _sigma_tr(source: Source, _: Path) -> list[str]:
    table = source.study("translucency")["translucency_table"].to_dataset()
    names = ["sigma_tr_count", "sigma_tr_mean", variables.SIGMA_TR_VARIANCE]
    rows = table[names].isel(group=0, drop=True).to_dataframe().reset_index()
    rows.columns = ["site", "channel", "n", "mean [mm⁻¹]", "variance [mm⁻²]"]
    known = {
        (site, channel): values
        for site, channels in SIGMA_TR.items()
        for channel, values in zip("RGB", channels, strict=True)
    }
    pairs = [
        known.get(key, ("-", "-"))
        for key in zip(rows["site"], rows["channel"], strict=True)
    ]
    rows["mean, paper"], rows["variance, paper"] = zip(*pairs, strict=True)
    return [_markdown(rows)]


def _lumitexels(source: Source, picture: Path) -> list[str]:
    from matplotlib import pyplot

    source.db.require_consent(source.take, "export")
    capture = source.db.read("capture", source.take)
    samples, dome = (capture[name].dataset for name in ("samples", "dome"))
    counts = samples[variables.SAMPLE_COUNT].values
    _, axes = pyplot.subplots(1, 2, figsize=(7, 3.4))
    # the best seen surfels on both sides of the median height of the seen ones
    surfels = capture["surfels"].dataset
    height = surfels[variables.SURFEL_POSITION].values[:, 1]
    upper = height > np.median(height[counts > 0])
    for ax, is_part, part in zip(axes, (upper, ~upper), PARTS, strict=True):
        at = int(np.argmax(np.where(is_part, counts, -1)))
        camera = _draw_lumitexel(
            ax, samples.isel(surfel=at).load(), surfels.isel(surfel=at).load(), dome
        )
        ax.set_title(f"a surfel of the {part} half, {camera}", fontsize=8)
    write_plot(axes[0], picture)
    seen = counts[counts > 0]
    return [
        f"On average {seen.mean():.0f}, at most {seen.max()} samples of each of "
        f"{len(seen):,} surfels."
    ]


def _draw_lumitexel(ax: Axes, samples: Dataset, surfel: Dataset, dome: Dataset) -> str:
    """Draw the samples of one surfel in the camera that has most of them over the
    hemisphere of light directions, and return its name with their number.
    """
    values = samples[variables.REFLECTANCE_SAMPLE].mean("channel").values
    camera = int(np.argmax(np.isfinite(values).sum(axis=0)))
    place = surfel[variables.SURFEL_POSITION].values
    normal = surfel[variables.SURFEL_NORMAL].values
    across = unit(np.cross([0.0, 1.0, 0.0], normal))
    frame = np.stack([across, np.cross(normal, across)])
    to_light = unit(dome[variables.LIGHT_POSITION].values - place)
    to_camera = unit(dome[variables.CAMERA_POSITION].values[camera] - place)
    mirrored = 2 * (normal @ to_camera) * normal - to_camera
    is_known = np.isfinite(values[:, camera])
    x, y = frame @ to_light[is_known].T
    shown = ax.scatter(x, y, c=values[is_known, camera], s=22, cmap="viridis")
    ax.plot(*(frame @ to_camera), "s", color=plots.RED, label="camera")
    ax.plot(*(frame @ mirrored), "*", color=plots.RED, label="mirror direction")
    turn = np.linspace(0, 2 * np.pi, 100)
    ax.plot(np.cos(turn), np.sin(turn), color="0.7", linewidth=0.8)
    ax.set(xlim=(-1.05, 1.05), ylim=(-1.05, 1.05), xticks=[], yticks=[], aspect="equal")
    ax.figure.colorbar(shown, ax=ax, shrink=0.7, label="sample [sr⁻¹]")
    ax.legend(fontsize=6, loc="upper center", bbox_to_anchor=(0.5, 0), ncols=2)
    return f"camera {dome['camera'].values[camera]} (n = {is_known.sum()})"


def _normals(source: Source, picture: Path) -> list[str]:
    show_take(source.db, source.take, variables.SHADING_NORMAL, picture)
    return ["Shading normals n of the model as colours (n + 1) / 2."]


def _bases(source: Source, picture: Path) -> list[str]:
    errors = basis_grid(source.db, source.take, picture, dictionary=source.dictionary)
    words = [f"{name} {100 * error:.2g} %" for name, error in errors.items()]
    return [f"Relative RMS difference from all bases: {', '.join(words)}."]


def _profiles(source: Source, picture: Path) -> list[str]:
    from matplotlib import pyplot

    source.db.require_consent(source.take, "export")
    capture = source.db.read("capture", source.take)
    require("probe" in capture, source.take, "must have profiles of the probe", "none")
    probe = capture["probe"].dataset
    distance = probe[variables.FIBRE_DISTANCE].values
    order = np.argsort(distance)
    sites = probe["site"].values.tolist()
    _, axes = pyplot.subplots(
        1, len(sites), figsize=(2.6 * len(sites), 2.8), sharey=True, squeeze=False
    )
    for ax, site in zip(axes[0], sites, strict=True):
        values, errors = (
            probe[name].sel(site=site).values[order]
            for name in (variables.FIBRE_PROFILE, variables.FIBRE_PROFILE_ERROR)
        )
        # beyond the first value that noise reaches, others are above it by chance
        is_noise = np.logical_or.accumulate(values < 3 * errors, axis=0)
        values = np.where(is_noise, np.nan, values)
        for name, colour, line in zip(CHANNELS, plots.CHANNELS, values.T, strict=True):
            ax.semilogy(
                distance[order], line, "o-", color=colour, markersize=3, label=name
            )
        ax.set_title(f"{site} (n = {len(distance)} fibres)", fontsize=8)
        ax.set_xlabel("distance [mm]")
    axes[0, 0].yaxis.set_major_formatter(
        lambda x, _: "10" + f"{np.log10(x):.0f}".translate(SUPERSCRIPT)
    )
    axes[0, 0].set_ylabel("reflectance [mm⁻²]")
    axes[0, 0].legend(fontsize=7)
    write_plot(axes[0, 0], picture)
    return [
        "Means over the azimuths of the fibres, up to where they are below three standard "
        "errors."
    ]


def _photographs(source: Source, picture: Path) -> list[str]:
    normal = source.table[source.table["condition"] == "normal"]
    takes = normal.groupby("subject").head(1).index.tolist()
    compared = dict[str, Comparison]()
    refused = []
    for take in takes:
        try:
            comparison = source.compared(str(take))
        except InputError as error:
            refused.append(f"Not shown: {error}")
            continue
        first = next(iter(compared.values()), comparison)
        if comparison.mask.shape == first.mask.shape:
            compared[str(take)] = comparison
        else:
            refused.append(f"Not shown: {take}, whose pictures have another size")
        if len(compared) == MAX_FACES:
            break
    require(compared, "photographs", "some take must have some", "\n".join(refused))
    each = compared.values()
    rows = {
        "photographs": [one.photographed for one in each],
        "model": [one.rendered for one in each],
    }
    write_grid(picture, rows, [*compared])
    errors = [
        f"{take} {100 * one.error['relative_rmse']:.1f} %"
        for take, one in compared.items()
    ]
    return [f"Relative RMS error of the pictures: {', '.join(errors)}.", *refused]


def _components(source: Source, picture: Path) -> list[str]:
    one = source.compared(source.take)
    parts = {
        "photograph": one.photographed,
        "diffuse part": one.diffuse,
        "photograph less diffuse part": one.photographed - one.diffuse,
        "model": one.rendered,
        "surface part": one.rendered - one.diffuse,
    }
    write_grid(picture, {source.take: [*parts.values()]}, [*parts])
    return [f"Light {one.light}, camera {one.camera}."]


def _spheres(source: Source, picture: Path) -> list[str]:
    space = source.study("surface", group_by="condition")
    write_plot(plot_group_spheres(space["brdf_space"].dataset.load()), picture)
    return ["Mean surface BRDFs over subjects; those of the paper are of one."]


def _basis_sizes(source: Source, picture: Path) -> list[str]:
    own = _of_subject(source)
    groups = {"one take": [source.take]}
    others = source.table.index.difference(own).tolist()
    if len(own) > 1:
        groups[f"{len(own)} takes of one subject"] = own
    if others:
        groups[f"{len(others)} takes of others"] = others
    curves = {
        name: source.study("brdf", takes=takes)["basis_size"].to_dataset().load()
        for name, takes in groups.items()
    }
    write_plot(plot_basis_size(curves), picture)
    lines = [f"- {name}: {describe_basis_size(curves[name])}" for name in curves]
    return ["\n".join(lines)]


def _histograms(source: Source, picture: Path) -> list[str]:
    from matplotlib import pyplot

    names = [variables.DIFFUSE_REFLECTANCE, variables.SURFEL_AREA]
    cohort = source.db.cohort("surfels", surfels=HISTOGRAM_SURFELS, variables=names)
    cohort = cohort.isel(take=cohort["condition"].values == "normal").load()
    words = {name: cohort[name].values for name in GROUPS if name in cohort.coords}
    require(words, "takes", f"must have {' or '.join(GROUPS)}", "neither")
    group = pd.DataFrame(words).astype(str).agg(", ".join, axis=1).to_numpy()
    groups = sorted(set(group))
    columns = min(len(groups), 4)
    rows = -(-len(groups) // columns)
    figure, axes = pyplot.subplots(
        rows, columns, figsize=(2.3 * columns, 2 * rows), squeeze=False, sharey=True
    )
    edges = np.linspace(0, np.nanquantile(cohort[names[0]], 0.999), 41)
    for ax, name in zip(axes.flat, groups, strict=False):
        members = cohort.isel(take=group == name)
        takes = [members.isel(take=i) for i in range(members.sizes["take"])]
        for c, colour in enumerate(plots.CHANNELS):
            means = [_histogram(take.isel(channel=c), edges) for take in takes]
            ax.stairs(np.mean(means, axis=0), edges, color=colour, label=CHANNELS[c])
        ax.set_title(f"{name} (n = {len(takes)})", fontsize=8)
    for ax in axes.flat[len(groups) :]:
        ax.set_axis_off()
    axes[0, 0].set_ylabel("fraction of the area")
    axes[-1, 0].set_xlabel(plots.typeset("albedo R_d"), parse_math=True)
    axes[0, 0].legend(fontsize=7)
    figure.tight_layout()
    write_plot(figure, picture)
    return ["Mean histograms over takes in the condition normal."]


def _histogram(take: Dataset, edges: Array) -> Array:
    """Fractions of the area of a take with R_d between these edges, in one channel."""
    colour, area = (
        take[name].values.astype(float)
        for name in (variables.DIFFUSE_REFLECTANCE, variables.SURFEL_AREA)
    )
    is_known = np.isfinite(colour)
    counts, _ = np.histogram(colour[is_known], edges, weights=area[is_known])
    return np.asarray(counts / area[is_known].sum())


def _translucent(source: Source, picture: Path) -> list[str]:
    shown = translucency_grid(source.db, picture, progress=source.progress)
    words = [f"{take} {length:.2f} mm" for take, length in shown.items()]
    return [f"Mean of 1 / σₜᵣ over the channels, cheek: {', '.join(words)}."]


def _edits(source: Source, picture: Path) -> list[str]:
    traits = source.study("traits")["traits"].to_dataset()["trait"].values.tolist()
    chosen = [name for name in TRAITS if name in traits] or traits[:MAX_ROWS]
    edited = edit_grid(
        source.db,
        source.take,
        {name: {name: 1.0} for name in chosen},
        picture,
        dictionary=source.dictionary,
    )
    words = [
        f"{name} {float(model.attrs['edit_distance']):.2g}"
        for name, model in edited.items()
    ]
    return [
        "Each trait is added with the strengths 0.5 and 1, also to a face that has it.",
        f"Distance from the nearest take, above 1 outside the data: {', '.join(words)}.",
        *(f"The takes have no {name}." for name in TRAITS if name not in chosen),
    ]


def _of_subject(source: Source) -> list[str]:
    """Takes of the subject of the figures of one face."""
    of_subject = source.table["subject"] == source.table["subject"][source.take]
    return [str(take) for take in source.table.index[of_subject]]


def _markdown(rows: pd.DataFrame) -> str:
    """A table; numbers have five significant digits, and a dash stands for none."""
    cells = [[_cell(value) for value in row] for row in rows.to_numpy(object)]
    lines = [[*map(str, rows.columns)], ["---"] * rows.shape[1], *cells]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "-" if np.isnan(value) else f"{value:.5g}"
    return str(value).replace("|", "\\|")


ITEMS = (
    Item(
        "Table 1: subjects",
        _people,
        "87 subjects, 70 male and 17 female, aged 13 to 74; one more in seven conditions.",
    ),
    Item(
        "Table 2: sigma_tr",
        _sigma_tr,
        "the last two columns; figure 17 shows that its variances are no variances.",
    ),
    Item(
        "Figure 5: lumitexels",
        _lumitexels,
        "about 900 samples of a point on average, up to 1,200.",
    ),
    Item("Figure 6: normals", _normals, "no numbers."),
    Item("Figure 7: basis BRDFs", _bases, "four of them are enough for one person."),
    Item(
        "Figure 10: profiles of the probe",
        _profiles,
        "16 profiles along azimuths, which agree.",
    ),
    Item("Figure 11: photographs and model", _photographs, "no numbers."),
    Item("Figure 12: components", _components, "no numbers."),
    Item(
        "Figure 14: surface by condition",
        _spheres,
        "lotion and heat differ most from cold and powder.",
    ),
    Item(
        "Figure 15: number of basis BRDFs",
        _basis_sizes,
        "4 for one person, 6 for its conditions, at least 8 for all.",
    ),
    Item(
        "Figure 16: albedo by group", _histograms, "RGB histograms by race and gender."
    ),
    Item(
        "Figures 17 and 18: least and most translucent",
        _translucent,
        "σₜᵣ of (0.9171, 1.5682, 1.6569) and (0.3558, 0.7932, 1.5173) mm⁻¹.",
    ),
    Item("Figure 19: edits", _edits, "beard, Caucasian, tan and lotion."),
)
