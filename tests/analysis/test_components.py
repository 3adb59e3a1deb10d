"""Principal components of cohorts."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr

from skindb.analysis import (
    face_components,
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
