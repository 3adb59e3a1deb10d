"""plan: what is left out carries no sample, and is said."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from skindb.errors import InputError
from skindb.plan import plan_fit
from skindb.schema import dataset


def _capture(*, probe: bool) -> xr.DataTree:
    fraction = np.ones((5, 3))
    fraction[[0, 2, 4], 1] = 0  # what reaches surfels 1 and 3 gives no sample
    groups = {
        "samples": dataset({"sample_count": [4, 0, 2, 0, 9]}),
        "surfels": dataset({"light_visible_fraction": fraction}),
    }
    if probe:
        groups["probe"] = dataset({"fibre_distance": [1.0, 2.0]})
    return xr.DataTree.from_dict(groups)


def test_plan_fit__leaves_out_what_has_no_sample():
    plan = plan_fit(_capture(probe=True))
    np.testing.assert_array_equal(plan.surfels, [True, False, True, False, True])
    np.testing.assert_array_equal(plan.lights, [True, False, True])
    assert plan.translucency
    lines = plan.explain()
    assert len(lines) == 2
    assert lines[0].startswith("surfels: 2 of 5")
    assert all("results stay the same" in line for line in lines)


@pytest.mark.parametrize("probe", [True, False])
def test_plan_fit__no_probe_no_translucency(probe):
    plan = plan_fit(_capture(probe=probe))
    assert plan.translucency is probe
    assert any("translucency" in line for line in plan.explain()) is not probe


@pytest.mark.parametrize(("probe", "found"), [(True, "only the probe was measured"), (False, "neither dome nor probe")])
def test_plan_fit__a_capture_without_dome_is_said(probe, found):
    capture = _capture(probe=probe)
    del capture["samples"]
    capture.attrs["subject"] = "S1"
    with pytest.raises(InputError, match=f"^S1: a fit needs photographs of a dome; found {found}; photograph "):
        plan_fit(capture)
