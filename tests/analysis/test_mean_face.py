"""The mean face compared with NumPy: subjects, conditions, holes and limits."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr

from skindb.analysis import mean_face, plot_mean_face
from skindb.errors import InputError

mpl.use("Agg")
SUBJECTS = ["A", "A", "B", "C", "D", "D"]  # A has two takes, D one with lotion
CONDITIONS = ["normal"] * 5 + ["lotion"]
SIZE = 8


@pytest.fixture
def cohort():
    rng = np.random.default_rng(2)
    n = len(SUBJECTS)
    dims = ("take", "v", "u")
    albedo = rng.uniform(0.1, 0.5, (n, SIZE, SIZE, 3)).astype(np.float32)
    albedo[3, 0, 0, 1] = np.nan  # C lacks one channel there
    coverage = np.ones((n, SIZE, SIZE), np.float32)
    coverage[2, 1] = 0.0  # row 1 of B was never measured
    coverage[3, 1] = 0.3
    coverage[0, 2] = 0.0  # the other take of A has row 2
    coverage[:, 7] = 0.0
    return xr.Dataset(
        {
            "texel_diffuse_reflectance": ((*dims, "channel"), albedo),
            "texel_sigma_tr": (
                (*dims, "channel"),
                rng.uniform(0.5, 2.0, albedo.shape).astype(np.float32),
            ),
            "texel_surface_reflectance": (
                dims,
                rng.uniform(0.0, 0.06, coverage.shape).astype(np.float32),
            ),
            "texel_coverage": (dims, coverage),
        },
        coords={
            "take": [f"T{i}" for i in range(n)],
            "subject": ("take", np.array(SUBJECTS, object)),
            "condition": ("take", np.array(CONDITIONS, object)),
            "channel": ["R", "G", "B"],
        },
    )


def by_numpy(values, coverage):
    """Values (subject, ...) of A, B, C and D without lotion; NaN where they were not measured."""
    covered = coverage.reshape(coverage.shape + (1,) * (values.ndim - 3)) > 0.5
    known = np.where(covered, values.astype(np.float64), np.nan)
    with np.errstate(invalid="ignore"):
        both = np.where(
            np.isnan(known[0]),
            known[1],
            np.where(np.isnan(known[1]), known[0], known[:2].mean(axis=0)),
        )
    return np.stack([both, known[2], known[3], known[4]])


@pytest.mark.parametrize(
    ("name", "is_log"),
    [("diffuse_reflectance", True), ("sigma_tr", True), ("surface_reflectance", False)],
)
@pytest.mark.parametrize("chunks", [None, {"take": 1}, {"take": 2, "v": 3}])
def test_mean_face__as_numpy(cohort, name, is_log, chunks):
    values = cohort[f"texel_{name}"].values
    coverage = cohort["texel_coverage"].values
    people = by_numpy(np.log(values) if is_log else values, coverage)
    count = np.isfinite(people).sum(axis=0)
    centre = np.where(
        count, np.nan_to_num(people).sum(axis=0) / np.maximum(count, 1), np.nan
    )
    spread = np.sqrt(
        np.nansum((people - centre) ** 2, axis=0) / np.maximum(count - 1, 1)
    )
    enough = count >= 3
    found = mean_face(cohort if chunks is None else cohort.chunk(chunks))
    mean = np.where(enough, np.exp(centre) if is_log else centre, np.nan)
    # stored in single precision
    np.testing.assert_allclose(found[f"face_{name}"], mean, rtol=1e-5)
    deviation = found[f"face_{name}{'_log' if is_log else ''}_deviation"]
    np.testing.assert_allclose(deviation, np.where(enough, spread, np.nan), rtol=1e-5)
    least = count.min(axis=-1) if count.ndim == 3 else count
    np.testing.assert_array_equal(found[f"face_{name}_count"], least)


def test_mean_face__texels_of_few_are_nan(cohort):
    found = mean_face(cohort)
    count = found["face_diffuse_reflectance_count"].values
    assert (count[1].tolist(), count[2].tolist(), count[7].tolist()) == (
        [2] * SIZE,
        [4] * SIZE,
        [0] * SIZE,
    )
    assert np.isnan(found["face_diffuse_reflectance"].values[[1, 7]]).all()
    assert np.isfinite(
        mean_face(cohort, min_subjects=2)["face_diffuse_reflectance"].values[1]
    ).all()
    assert found.attrs["subjects"] == 4
    assert found.attrs["takes"] == ["T0", "T1", "T2", "T3", "T4"]


def test_mean_face__without_sigma_tr(cohort):
    found = mean_face(cohort.drop_vars(["texel_sigma_tr", "texel_surface_reflectance"]))
    assert set(found.data_vars) == {
        f"face_diffuse_reflectance{end}" for end in ("", "_log_deviation", "_count")
    }


def test_mean_face__refuses_too_few(cohort):
    with pytest.raises(
        InputError,
        match="one texel must be measured in 3 subjects; found none among 1 subj",
    ):
        mean_face(cohort.isel(take=[0, 1]))
    with pytest.raises(InputError, match="one texel must be measured in 3 subjects"):
        mean_face(cohort.assign(texel_coverage=0 * cohort["texel_coverage"]))
    with pytest.raises(InputError, match="condition normal"):
        mean_face(cohort.isel(take=[5]))


def test_plot_mean_face__names_the_subjects(cohort):
    ax = plot_mean_face(mean_face(cohort))
    assert "n = 4" in ax.get_title()
    assert ax.images[0].get_array().shape == (SIZE, SIZE, 3)
    mpl.pyplot.close(ax.figure)
