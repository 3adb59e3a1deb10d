"""The studies of a population, and what is shown of a stored one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from xarray import Dataset, DataTree

from skindb import plots
from skindb.analysis.albedo import STUDY as ALBEDO
from skindb.analysis.brdf import STUDY as BRDF
from skindb.analysis.chromophores import STUDY as CHROMOPHORES
from skindb.analysis.components import STUDY as COMPONENTS
from skindb.analysis.correlations import STUDY as CORRELATIONS
from skindb.analysis.coverage import STUDY as COVERAGE
from skindb.analysis.formula_models import STUDY as MODEL
from skindb.analysis.groups import STUDY as GROUPS
from skindb.analysis.maps import STUDY as MAPS
from skindb.analysis.planning import STUDY as PLAN
from skindb.analysis.repeats import STUDY as REPEATABILITY
from skindb.analysis.study import Study, Table
from skindb.analysis.surface import STUDY as SURFACE
from skindb.analysis.traits import STUDY as TRAITS
from skindb.analysis.translucency import STUDY as TRANSLUCENCY
from skindb.files import private_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STUDIES: dict[str, Study] = {
    study.name: study
    for study in (
        BRDF,
        ALBEDO,
        TRANSLUCENCY,
        TRAITS,
        GROUPS,
        COMPONENTS,
        CORRELATIONS,
        MAPS,
        CHROMOPHORES,
        COVERAGE,
        SURFACE,
        REPEATABILITY,
        MODEL,
        PLAN,
    )
}


def study_of(results: DataTree) -> Study:
    """The study to which stored results belong."""
    return next(
        study for study in STUDIES.values() if study.shown[0] in results.children
    )


def tabulate_study(results: DataTree) -> Table:
    """Header and rows of the table of a study."""
    return study_of(results).tabulate(*_shown(results))


def describe_study(results: DataTree) -> list[str]:
    """Notes on a study that accompany its table, one line each."""
    return study_of(results).describe(*_shown(results))


@plots.plain_text()
def plot_study(results: DataTree, path: Path) -> None:
    """Plot a study and write the figure to a file."""
    write_plot(study_of(results).plot(*_shown(results)), path)


def write_plot(ax: Axes | Figure, path: Path) -> None:
    """Write a figure, or that of axes, to a file, and close it."""
    from matplotlib import pyplot

    figure = ax.get_figure(root=True)
    assert figure is not None
    figure.savefig(private_file(path), dpi=150, bbox_inches="tight")
    pyplot.close(figure)


def _shown(results: DataTree) -> list[Dataset]:
    names = study_of(results).shown
    return [results[name].dataset.load() for name in names]
