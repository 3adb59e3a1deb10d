"""Principal components of cohorts, and the mean face compared with NumPy."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr

from skindb.analysis import (
    face_components,
    mean_face,
    principal_components,
)
from skindb.analysis.components import (
    describe_components,
    plot_components,
    tabulate_components,
)
from skindb.errors import InputError


def _planted(takes=12, seed=3):
    """Maps that differ along two patterns, with some noise."""
    rng = np.random.default_rng(seed)
    patterns = rng.normal(size=(2, 5, 4, 3))
    amounts = rng.normal(size=(takes, 2)) * [3.0, 1.0]
    values = (
        10
        + np.einsum("tp,pvuc->tvuc", amounts, patterns)
        + 1e-3 * rng.normal(size=(takes, 5, 4, 3))
    )
    names = [f"T{i}" for i in range(takes)]
    coords = {"take": names, "channel": ["R", "G", "B"]}
    return xr.DataArray(
        values, dims=("take", "v", "u", "channel"), coords=coords, attrs={"units": "1"}
    )


def test_principal_components__find_planted_patterns_and_rebuild_the_takes():
    values = _planted()
    found = principal_components(values.chunk(take=1), max_components=2)
    assert found["explained_variance_ratio"].sum() > 0.99999
    rebuilt = found["mean"] + (found["score"] * found["axis"]).sum("component")
    # ten times the noise
    np.testing.assert_allclose(rebuilt.transpose(*values.dims), values, atol=0.01)
    np.testing.assert_allclose(
        found["score"].var("take", ddof=1), found["explained_variance"], rtol=1e-9
    )
    assert float(found["residual"].max()) < 3e-3
    assert found.attrs == {"skipped": [], "used_fraction": 1.0}
    assert list(found["channel"].values) == ["R", "G", "B"]


def test_principal_components__use_what_every_take_has():
    values = _planted()
    values[0, 0] = np.nan  # a take that lacks a fifth of the map
    values[5] = np.nan
    values[5, 0, 0] = 1.0  # a take with hardly any measured texels
    found = principal_components(values, max_components=3)
    assert found.attrs["skipped"] == [
        {"take": "T5", "reason": "only 5% of its entries are known"}
    ]
    assert found.attrs["used_fraction"] == pytest.approx(0.8)
    assert np.isnan(found["mean"][0]).all()
    assert np.isfinite(found["axis"][:, 1:]).all()
    assert "T5" not in found["take"].values


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v[:1], "at least two takes must have enough values; found 1 of 1"),
        (
            lambda v: v.where(False),
            "at least two takes must have enough values; found 0 of 12",
        ),
        (
            lambda v: v[:2].where(
                xr.DataArray(np.arange(5) % 2, dims="v")
                == xr.DataArray([0, 1], dims="take")
            ),
            "none",
        ),
    ],
)
def test_principal_components__of_too_little_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        principal_components(change(_planted()), least_known=0.3)


def test_face_components__of_a_cohort_with_table_and_plot(tmp_path):
    """The scores rebuild the takes, and the faces of the first axis are the mean and a
    step to either side.
    """
    values = 0.4 + 0.02 * (_planted() - 10)
    cohort = (
        values.rename("texel_diffuse_reflectance")
        .to_dataset()
        .assign_attrs(skipped=["X: no consent"])
    )
    found = face_components(cohort, max_components=2)
    rebuilt = found["principal_mean"].values + np.einsum(
        "tc,cvuk->tvuk", found["principal_score"].values, found["principal_axis"].values
    )
    np.testing.assert_allclose(
        rebuilt, values.transpose("take", "v", "u", "channel"), atol=1e-3
    )
    header, rows = tabulate_components(found)
    assert header == ["take", "score_1", "score_2", "principal_residual"]
    assert len(rows) == 12
    assert (
        "of the variance between 12 takes (100% of the texels"
        in describe_components(found)[0]
    )
    assert found.attrs["skipped"] == ["X: no consent"]
    figure = plot_components(found)
    figure.savefig(tmp_path / "axes.png")
    assert [ax.get_title() for ax in figure.axes[:3]] == [
        "mean - 1 sd",
        "mean",
        "mean + 1 sd",
    ]


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
