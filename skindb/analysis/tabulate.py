"""Tables, notes and plots of studies."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xarray as xr

from skindb.analysis.albedo import plot_albedo
from skindb.analysis.basis_size import (
    describe_basis_size,
    plot_basis_size,
    tabulate_basis_size,
)
from skindb.analysis.brdf_plots import plot_space
from skindb.analysis.brdf_space import describe_brdf_space, tabulate_brdf_space
from skindb.analysis.chromophores import describe_chromophores, plot_chromophores
from skindb.analysis.components import (
    describe_components,
    plot_components,
    tabulate_components,
)
from skindb.analysis.correlations import describe_correlations, plot_correlations
from skindb.analysis.coverage import describe_coverage, plot_coverage
from skindb.analysis.effect_maps import (
    describe_effect_maps,
    plot_effect_maps,
    tabulate_effect_maps,
)
from skindb.analysis.group_effects import describe_group_effects, plot_group_effects
from skindb.analysis.traits import describe_traits, plot_traits
from skindb.analysis.translucency import describe_translucency, plot_translucency
from skindb.files import private_file
from skindb.plots import plain_text
from skindb.schema.regions import FACE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

EFFECT_COLUMNS = (
    "effect",
    "effect_low",
    "effect_high",
    "effect_percent",
    "effect_percent_low",
    "effect_percent_high",
    "effect_p",
    "effect_p_adjusted",
    "effect_p_false_discovery",
    "effect_detectable",
)

CORRELATION_COLUMNS = (
    "correlation_count",
    "component_correlation",
    "component_correlation_low",
    "component_correlation_high",
    "correlation_p",
    "correlation_p_false_discovery",
)


def tabulate_study(study: xr.DataTree) -> tuple[list[str], list[list[Any]]]:
    """Header and rows of the table of a study."""
    if "basis_size" in study.children:
        return tabulate_basis_size(study["basis_size"].to_dataset().load())
    if "components" in study.children:
        return tabulate_components(study["components"].to_dataset().load())
    if "effect_maps" in study.children:
        return tabulate_effect_maps(study["effect_maps"].to_dataset().load())
    if "brdf_space" in study.children:
        return tabulate_brdf_space(study["brdf_space"].to_dataset().load())
    if "translucency_table" in study.children:
        table = study["translucency_table"].to_dataset()
        names = [
            "sigma_tr_count",
            "sigma_tr_mean",
            "sigma_tr_mean_low",
            "sigma_tr_mean_high",
            "sigma_tr_standard_deviation",
            "sigma_tr_measurement_error",
            "sigma_tr_total_error",
            "sigma_tr_people_fraction",
            "sigma_tr_repeat_deviation",
        ]
        names = [name for name in names if name in table]
        dims = ["group", "site", "channel"]
    elif "correlations" in study.children:
        table = study["correlations"].to_dataset()
        names = list(CORRELATION_COLUMNS)
        dims = ["pair"]
    elif "effects" in study.children:
        table = study["effects"].to_dataset()
        table = table.assign(
            {
                f"subjects_{s}": table["effect_count"].sel(side=s, drop=True)
                for s in table["side"].values.tolist()
            }
        )
        names = ["subjects_with", "subjects_without", *EFFECT_COLUMNS]
        dims = ["contrast", "quantity"]
    elif "traits" in study.children:
        table = study["traits"].to_dataset()
        table = table.assign({**_side_counts(table), **_vector_lengths(table)})
        names = ["takes_with", "takes_without", *_vector_lengths(table)]
        dims = ["trait"]
    elif "chromophore_table" in study.children:
        table = study["chromophore_table"].to_dataset()
        columns = ("count", "mean", "mean_low", "mean_high", "standard_deviation")
        names = [f"group_chromophore_{column}" for column in columns]
        dims = ["group", "region", "chromophore"]
    elif "coverage" in study.children:
        table = study["coverage"].to_dataset()
        names = ["coverage_count"]
        dims = ["cell"]
    elif study["albedo_table"].attrs["group_by"]:
        table = study["albedo_table"].to_dataset()
        columns = ("count", "mean", "mean_low", "mean_high", "standard_deviation")
        names = [f"group_albedo_{column}" for column in columns]
        dims = ["group", "region", "channel"]
    else:
        table = study["albedo"].to_dataset()
        names = ["albedo_mean"]
        dims = ["take", "region", "channel"]
    stacked = table[names].stack(row=dims, create_index=False).load()
    keys = [
        list(key)
        for key in itertools.product(*(table[d].values.tolist() for d in dims))
    ]
    return [*dims, *names], [
        [*k, *(stacked[n].values[i].item() for n in names)] for i, k in enumerate(keys)
    ]


def describe_study(study: xr.DataTree) -> list[str]:
    """Notes on a study that accompany its table, one line each."""
    if "basis_size" in study.children:
        return [describe_basis_size(study["basis_size"].to_dataset().load())]
    if "components" in study.children:
        return describe_components(study["components"].to_dataset().load())
    if "correlations" in study.children:
        return describe_correlations(study["correlations"].to_dataset().load())
    if "effect_maps" in study.children:
        return describe_effect_maps(study["effect_maps"].to_dataset().load())
    if "brdf_space" in study.children:
        return describe_brdf_space(study["brdf_space"].to_dataset().load())
    if "effects" in study.children:
        return describe_group_effects(study["effects"].to_dataset().load())
    if "chromophores" in study.children:
        return describe_chromophores(study["chromophores"].to_dataset().load())
    if "coverage" in study.children:
        return describe_coverage(study["coverage"].to_dataset().load())
    if "traits" in study.children:
        return describe_traits(study["traits"].to_dataset().load())
    if "translucency_table" in study.children:
        return describe_translucency(study["translucency_table"].to_dataset().load())
    return []


def _side_counts(table: xr.Dataset) -> dict[str, xr.DataArray]:
    """Numbers of takes with and without each trait."""
    return {
        f"takes_{side}": table["trait_count"].sel(side=side, drop=True)
        for side in ("with", "without")
    }


def _vector_lengths(table: xr.Dataset) -> dict[str, xr.DataArray]:
    """RMS lengths of the parts of trait vectors, and the lengths that noise alone would
    give them.
    """
    face = (
        table.sel(region=FACE, drop=True)
        if FACE in table["region"].values
        else table.isel(region=0, drop=True)
    )
    parts = {
        "brdf": (table, "trait_brdf_shift", ["component"]),
        "colour": (face, "trait_quantile_shift", ["axis", "level"]),
        "log_sigma_tr": (table, "trait_log_sigma_tr_shift", ["channel"]),
    }
    found: dict[str, xr.DataArray] = {}
    for name, (ds, variable, dims) in parts.items():
        for suffix, part in (("shift", variable), ("noise", f"{variable}_error")):
            if part in ds:
                square = (ds[part] ** 2).mean(dims, skipna=False)
                found[f"{name}_{suffix}"] = square**0.5
    return found


@plain_text()
def plot_study(study: xr.DataTree, path: Path) -> None:
    """Plot a study and write the figure to a file."""
    from matplotlib import pyplot

    figures: dict[str, Callable[[xr.Dataset], Figure]] = {
        "effect_maps": plot_effect_maps,
        "components": plot_components,
    }
    for name in figures.keys() & set(study.children):
        whole = figures[name](study[name].to_dataset().load())
        whole.savefig(private_file(path), dpi=150, bbox_inches="tight")
        pyplot.close(whole)
        return
    drawn: dict[str, Callable[..., Axes]] = {
        "translucency_table": plot_translucency,
        "basis_size": plot_basis_size,
        "brdf_space": plot_space,
        "correlations": plot_correlations,
        "effects": plot_group_effects,
        "traits": plot_traits,  # before albedo, which this study also holds
        "albedo": plot_albedo,
        "chromophores": plot_chromophores,
        "coverage": plot_coverage,
    }
    names = [name for name in drawn if name in study.children]
    tables = {"albedo": "albedo_table", "chromophores": "chromophore_table"}
    options: dict[str, Any] = {}
    if names[0] in tables:
        options["table"] = study[tables[names[0]]].to_dataset().load()
    ax = drawn[names[0]](study[names[0]].to_dataset().load(), **options)
    figure = ax.get_figure(root=True)
    assert figure is not None
    figure.savefig(private_file(path), dpi=150, bbox_inches="tight")
    pyplot.close(figure)
