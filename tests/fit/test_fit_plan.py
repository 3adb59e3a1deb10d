"""Whatever a fit skips has no samples, or a bound on its cost; both are reported."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from planted_skin import capture_of

from skindb.errors import InputError
from skindb.fit import FitParameters, plan_fit
from skindb.fit.model import fit_model

EXACT = FitParameters(k=2, rank=6)


@pytest.fixture(scope="module")
def partly_dark(skin):
    """Surfels 0 and 5 without a sample; light 7 reaches only them."""
    capture = capture_of(skin, unseen=[0, 5])
    surfels = capture["surfels"].to_dataset()
    fraction = surfels["light_visible_fraction"].values.copy()
    fraction[:, 7] = np.isin(np.arange(len(fraction)), [0, 5])
    surfels["light_visible_fraction"] = (
        surfels["light_visible_fraction"].dims,
        fraction,
    )
    capture["surfels"] = xr.DataTree(surfels)
    samples = capture["samples"].to_dataset()
    samples["reflectance_sample"].values[:, 7] = np.nan
    return capture


@pytest.mark.slow
def test_plan_fit__skips_what_has_no_sample(partly_dark, small_dictionary):
    plan = plan_fit(partly_dark, EXACT, dictionary=small_dictionary)
    assert np.flatnonzero(~plan.surfels).tolist() == [0, 5]
    assert np.flatnonzero(~plan.lights).tolist() == [7]
    assert plan.translucency
    lines = plan.explain()
    assert len(lines) == 2
    assert lines[0].startswith("surfels: 2 of 40")
    assert all("results stay the same" in line for line in lines)


def test_plan_fit__what_is_skipped_changes_no_result(partly_dark, small_dictionary):
    """A fit of only the surfels and lights of the plan gives the same result as a fit of all."""
    plan = plan_fit(partly_dark, EXACT, dictionary=small_dictionary)
    kept = {
        "surfel": np.flatnonzero(plan.surfels),
        "light": np.flatnonzero(plan.lights),
    }
    part = partly_dark.map_over_datasets(
        lambda ds: ds.isel({dim: i for dim, i in kept.items() if dim in ds.dims})
    )
    part.attrs = partly_dark.attrs
    whole, alone = (
        fit_model(one, EXACT, dictionary=small_dictionary)
        for one in (partly_dark, part)
    )
    there = whole["fitted"].to_dataset().isel(surfel=kept["surfel"])
    for name in ("shading_normal", "diffuse_reflectance", "fit_residual", "fit_status"):
        np.testing.assert_allclose(
            there[name].values, alone["fitted"][name].values, rtol=1e-4, atol=1e-5
        )


@pytest.mark.parametrize("probe", [True, False])
def test_plan_fit__no_probe_no_translucency(skin, small_dictionary, probe):
    plan = plan_fit(capture_of(skin, probe=probe), EXACT, dictionary=small_dictionary)
    assert plan.translucency is probe
    assert any("translucency" in line for line in plan.explain()) is not probe


@pytest.mark.parametrize(
    ("probe", "found"),
    [(True, "only the probe was measured"), (False, "neither dome nor probe")],
)
def test_plan_fit__a_capture_without_dome_is_reported(skin, probe, found):
    capture = capture_of(skin, probe=probe)
    del capture["samples"]
    with pytest.raises(
        InputError,
        match=f"^S1: a fit needs photographs of a dome; found {found}; photograph ",
    ):
        plan_fit(capture)


def test_plan_fit__reports_what_the_rank_costs(skin, small_dictionary):
    capture = capture_of(skin, probe=False)

    def omissions(**options):
        return plan_fit(
            capture, FitParameters(**options), dictionary=small_dictionary
        ).omissions

    said = {rank: omissions(rank=rank) for rank in (3, 5, 6)}
    assert [one.what for one in said[6]] == ["translucency"]
    for rank in (3, 5):
        last = said[rank][-1]
        assert (last.skipped, last.of) == (6 - rank, 6)
        assert f"differ by at most {100 * last.bound:.3g} %" in str(last)
    assert 0 < said[5][-1].bound < said[3][-1].bound < 1
