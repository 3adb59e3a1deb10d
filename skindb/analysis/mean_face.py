"""Mean face of a cohort in the common (u, v), and the standard deviation between
subjects at every texel.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from skindb import plots
from skindb.analysis.subjects import takes_to_compare
from skindb.analysis.texture import COVERED
from skindb.errors import Fault, InputError
from skindb.numerics.statistics import Moments, known_mean
from skindb.schema import dataset
from skindb.schema.cohort import require_same_fit
from skindb.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# the spread of fewer is unknown, and their mean would show the face of a single subject
LEAST_SUBJECTS = 3
COVERAGE = "texel_coverage"
# map -> (name, whether it is averaged on the log scale)
AVERAGED = {
    "texel_diffuse_reflectance": ("face_diffuse_reflectance", True),
    "texel_sigma_tr": ("face_sigma_tr", True),
    "texel_surface_reflectance": ("face_surface_reflectance", False),
}


def mean_face(
    cohort: xr.Dataset, *, least: int = LEAST_SUBJECTS, mixed_fits: bool = False
) -> xr.Dataset:
    """Mean and standard deviation over subjects of albedo, sigma_tr and surface
    reflectance, texel by texel.

    Takes in another condition than normal are excluded, and the takes of a subject are
    averaged first. Albedo and sigma_tr are averaged on the log scale and transformed
    back: the mean is the geometric one, and the standard deviation is that of the
    natural logarithm (pigments multiply). Surface reflectance is averaged as it is.
    Only one subject is in memory at a time; its sums are merged with those of the
    others (Chan et al. 1979).

    Parameters
    ----------
    cohort
        ``db.cohort("maps")``; the result omits maps that the cohort lacks.
    least
        Minimum number of subjects of a texel; texels with fewer are NaN.
    mixed_fits
        Accept takes that were fitted with different parameters.

    Returns
    -------
    Dataset
        `face_diffuse_reflectance`, `face_sigma_tr` (v, u, channel),
        `face_surface_reflectance` (v, u), each with `_log_deviation` or `_deviation`
        and `_count`, the number of subjects.

    Raises
    ------
    InputError
        If no texel has enough subjects.
    """
    if not mixed_fits:
        require_same_fit(cohort)
    takes, subjects = takes_to_compare(cohort, None)
    names = [name for name in AVERAGED if name in takes]
    sums: dict[str, Moments] = {}
    for subject in subjects.names:
        rows = np.flatnonzero(subjects.rows_of(subject))
        for name, values in _subject_maps(takes.isel(take=rows), names).items():
            sums[name] = (
                sums[name] + Moments.of(values[None])
                if name in sums
                else Moments.of(values[None])
            )
    variables: dict[str, Array] = {}
    for name, moments in sums.items():
        short, is_log = AVERAGED[name]
        enough = moments.count >= max(least, 1)
        mean = np.exp(moments.mean) if is_log else moments.mean
        deviation = f"{short}_log_deviation" if is_log else f"{short}_deviation"
        variables[short] = np.where(enough, mean, np.nan).astype(np.float32)
        variables[deviation] = np.where(
            enough, moments.standard_deviation, np.nan
        ).astype(np.float32)
        count = moments.count.min(axis=-1) if moments.count.ndim == 3 else moments.count
        variables[f"{short}_count"] = count.astype(np.int32)
    if not any(np.isfinite(variables[AVERAGED[name][0]]).any() for name in names):
        rule = f"at least one texel must be measured in {least} subjects"
        cure = "fit or register more subjects"
        raise InputError(
            Fault("mean face", rule, f"none among {len(subjects.names)} subjects", cure)
        )
    return dataset(
        variables,
        coords={"channel": ["R", "G", "B"]},
        attrs={
            "subjects": len(subjects.names),
            "least_subjects": least,
            "takes": sorted(map(str, takes["take"].values)),
            "skipped": list(cohort.attrs.get("skipped", [])),
        },
    )


def _subject_maps(takes: xr.Dataset, names: list[str]) -> dict[str, Array]:
    """Means of the maps over the takes of a subject, on the scale of averaging; NaN
    where nothing was measured.
    """
    of_takes: dict[str, list[Array]] = {name: [] for name in names}
    for i in range(takes.sizes["take"]):
        take = takes[[*names, COVERAGE]].isel(take=i).load()
        measured = take[COVERAGE].values > COVERED
        for name in names:
            values = take[name].values.astype(np.float64)
            is_known = (
                measured if values.ndim == 2 else measured[..., None]
            ) & np.isfinite(values)
            if AVERAGED[name][1]:
                is_known &= values > 0
                values = np.log(np.where(is_known, values, 1.0))
            of_takes[name].append(np.where(is_known, values, np.nan))
    return {name: known_mean(np.stack(values)) for name, values in of_takes.items()}


def plot_mean_face(face: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the mean albedo in sRGB; texels with too few subjects are white."""
    ax = ax or plots.new_axes(4, 4)
    linear = face["face_diffuse_reflectance"].values
    clipped = np.clip(np.nan_to_num(linear, nan=1.0), 0.0, 1.0)
    encoded = np.where(
        clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055
    )
    ax.imshow(encoded, extent=(0, 1, 1, 0), interpolation="nearest")
    ax.set_xlabel("common u")
    ax.set_ylabel("common v")
    ax.set_title(f"geometric mean of R_d (n = {face.attrs['subjects']})", fontsize=9)
    return ax
