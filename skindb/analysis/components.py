"""The study of components: the modes of a model of faces, as a table and as pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from xarray import DataArray, Dataset

from skindb.analysis.face_models import ALBEDO, POSITION, face_at, face_model
from skindb.analysis.study import Study, Table, of_cohort, table_of
from skindb.analysis.subjects import compared_conditions
from skindb.render.image import tone_map
from skindb.schema import variables
from skindb.study_parameters import DECLARED
from skindb.types import unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FEW = 20  # subjects, below which modes follow individuals
MIN_DISTANCE = 0.5  # of samples from the nearest subject, over that of subjects
MAX_FRACTION = 0.5  # of the variance of a mode that is of one subject
SHOWN_DEVIATIONS = (-2.0, 0.0, 2.0)  # of the faces of a plot from the mean
EXPOSURE = 1.5  # of a plot: albedo of 0.6 is white


def plot_face_model(model: Dataset, *, max_modes: int = 3) -> Figure:
    """Plot the first modes as faces from the front, lit from there: the mean, and two
    standard deviations to both sides.
    """
    from matplotlib import pyplot

    count = min(max_modes, model.sizes["mode"])
    figure: Figure
    figure, axes = pyplot.subplots(
        count, 3, figsize=(6, 2.4 * count), squeeze=False, sharex=True, sharey=True
    )
    for i, line in enumerate(axes):
        for ax, amount in zip(line, SHOWN_DEVIATIONS, strict=True):
            _draw(face_at(model, np.eye(count)[i] * amount), ax)
            ax.set_title(f"{amount:+g} SD" if amount else "mean", fontsize=8)
        ratio = float(model[variables.MODE_VARIANCE_RATIO][i].mean())
        line[0].set_ylabel(f"mode {i + 1}\n{ratio:.0%} of the variance", fontsize=8)
    figure.suptitle(f"faces of {model.sizes['subject']} subjects", fontsize=9)
    figure.tight_layout()
    return figure


def _draw(face: Dataset, ax: Axes) -> None:
    """Draw a face by Lambert's law, the points at the front last."""
    position = face[POSITION].values
    facing = unit(np.cross(*np.gradient(position, axis=(0, 1))))[..., 2:]
    picture = tone_map(face[ALBEDO].values * facing, exposure=EXPOSURE)
    seen = facing[..., 0] > 0
    x, y, z = position[seen].T
    order = np.argsort(z)
    colour = picture[seen][order] / 255
    ax.scatter(x[order], y[order], 4, colour, linewidths=0, rasterized=True)
    ax.set(aspect="equal", facecolor="black", xticks=[], yticks=[])


def tabulate_face_model(model: Dataset) -> Table:
    """Header and one row per mode: fraction of the variance, largest part of one subject,
    and errors of subjects held out with as many modes.
    """
    columns = {
        variables.MODE_LARGEST_SUBJECT: model[variables.MODE_LARGEST_SUBJECT],
        "variance_ratio": model[variables.MODE_VARIANCE_RATIO].mean("block"),
    }
    errors = model[variables.RECONSTRUCTION_ERROR].values[1:].T
    for block, values in zip(model["block"].values, errors, strict=True):
        columns[f"{block}_error"] = DataArray(values, dims="mode")
    return table_of(model.assign(columns), list(columns))


def describe_face_model(model: Dataset) -> list[str]:
    """Notes on the table, one line each."""
    n = model.sizes["subject"]
    errors = model[variables.RECONSTRUCTION_ERROR][0].to_series().round(3).to_dict()
    listed = ", ".join(f"{name} {error:g}" for name, error in errors.items())
    nearest = model.attrs["nearest_subject"]
    lines = [
        f"{n} subjects, each with the mean of its takes in the condition normal; "
        f"{model.attrs['used_fraction']:.0%} of the texels",
        "errors are of subjects held out: shape in mm, gloss absolute, others relative; "
        f"without modes {listed}",
        f"samples are {nearest:.2f} times as far from the nearest subject as subjects are",
    ]
    if n < FEW:
        lines.append(f"fewer than {FEW} subjects: modes follow individuals")
    return lines + privacy_notes(model)


def privacy_notes(model: Dataset) -> list[str]:
    """A line if a mode or the samples disclose a subject."""
    largest = model[variables.MODE_LARGEST_SUBJECT].values
    if model.attrs["nearest_subject"] < MIN_DISTANCE or (largest > MAX_FRACTION).any():
        return ["privacy: a mode or the samples show one subject; do not publish them"]
    return []


STUDY = Study(
    *DECLARED["components"],
    layout="maps",
    compute=of_cohort("face_model", face_model),
    shown=("face_model",),
    tabulate=tabulate_face_model,
    plot=plot_face_model,
    describe=describe_face_model,
    conditions=compared_conditions,
)
