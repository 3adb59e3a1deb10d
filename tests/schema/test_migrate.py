"""Versions of schema 1: their structure was written down by the software that made them (version_1.json)."""

from __future__ import annotations

import json
from pathlib import Path

import dask.array as da
import numpy as np
import pytest
import xarray as xr

from skindb.optics.brdf_table import TableGrid
from skindb.schema import GROUPS, VARIABLES, check
from skindb.schema.brdf import kernel_tables
from skindb.schema.migrate import migrate_version_1

VERSIONS = json.loads(Path(__file__).with_name("version_1.json").read_text(encoding="utf-8"))
SIZES = {"surfel": 5, "xyz": 3, "uv": 2, "channel": 3, "row": 3, "col": 3, "coefficient": 5, "corner": 3, "site": 3}
LENGTH = 4  # of every other dim
REPORTS = {"prediction"}  # groups that no version stores


def _labels(dim: str, size: int) -> np.ndarray:
    if dim in ("theta_h", "theta_d", "phi_d"):
        return getattr(TableGrid(size, size, size), dim)
    names = {"site": ["cheek", "forehead", "neck"], "channel": ["R", "G", "B"]}.get(dim)
    return np.array(names or [f"{dim}{i}" for i in range(size)], np.dtypes.StringDType())


def _group(described: dict) -> xr.Dataset:
    """A group with counted values, lazy along surfels."""
    attrs = dict(described["attrs"])
    variables = {}
    for name, (dims, dtype, units) in described["variables"].items():
        shape = [SIZES.get(dim, LENGTH) for dim in dims]
        values = (np.arange(np.prod(shape)).reshape(shape) % 2).astype(dtype)
        data = da.from_array(values, chunks=2) if dims[:1] == ["surfel"] else values
        variables[name] = (dims, data, {"units": units})
    coords = {dim: _labels(dim, SIZES.get(dim, LENGTH)) for dim in described["labelled"]}
    return xr.Dataset(variables, coords, attrs)


def _version_1(name: str) -> xr.DataTree:
    described = VERSIONS[name]
    tree = xr.DataTree.from_dict({group: _group(one) for group, one in described["groups"].items()})
    tree.attrs = dict(described["attrs"])
    return tree


@pytest.mark.parametrize("name", VERSIONS)
def test_migrate_version_1__every_group_fits_the_schema(name):
    migrated = migrate_version_1(_version_1(name))
    for group, node in migrated.children.items():
        ds = node.to_dataset()
        declared = {variable.name for variable in GROUPS.get(group, ())}
        assert set(ds.data_vars) <= set(VARIABLES), group
        check(ds, map(str, ds.data_vars), where=f"{name}/{group}")
        assert declared or group in ("fitted", "translucency"), group


def test_migrate_version_1__only_names_change_where_values_stay():
    old, new = _version_1("model/take"), migrate_version_1(_version_1("model/take"))
    pairs = {
        "fitted/basis_weight": "fitted/dictionary_weight",
        "fitted/reduced_weight": "fitted/basis_weight",
        "fitted/reduced_weight_error": "fitted/basis_weight_error",
        "fitted/effective_transport": "fitted/sigma_tr",
        "fitted/outlier_share": "fitted/outlier_fraction",
        "basis/component_weight": "basis/basis_mixture",
        "translucency/site_effective_transport": "translucency/site_sigma_tr",
        "outliers/light_outlier_share": "outliers/light_outlier_fraction",
    }
    for before, after in pairs.items():
        np.testing.assert_array_equal(new[after].values, old[before].values)
    assert new["fitted/dictionary_weight"].dims == ("surfel", "dictionary")
    assert list(new["basis"]["dictionary"].values) == list(old["basis"]["basis"].values)


def test_migrate_version_1__attributes_that_change_results_become_variables():
    capture, model = (migrate_version_1(_version_1(name)) for name in ("capture/take", "model/take"))
    assert capture["samples/noise_floor"] == VERSIONS["capture/take"]["groups"]["samples"]["attrs"]["noise_floor"]
    assert "noise_floor" not in capture["samples"].attrs
    assert (capture["probe/gain_known"], capture["probe/fibre_radius"]) == (1, 0.25)
    pressure = capture["probe/site_pressure"].sel(site=["cheek", "forehead", "neck"]).values
    np.testing.assert_array_equal(pressure, [-8.32, -7.97, -8.1])
    assert model["fitted/refractive_index"] == 1.3
    assert model["basis/disc_angular_radius"] == pytest.approx(0.0147, abs=0.002)  # 12.5 mm at 0.85 m
    assert not model["held_out/light_held_out"].any()  # the lights of this version are named otherwise
    table = VERSIONS["model/take"]["groups"]["translucency"]["attrs"]
    np.testing.assert_allclose(model["translucency/site_correlation"], table["correlation"], rtol=1e-6)
    words = table["best_determined"][0][0]  # "sigma_tr^a sigma_s'^b"
    a, b = (float(part.split("^")[1]) for part in words.split())
    np.testing.assert_allclose(model["translucency/site_best_exponent"].values[0, 0], [a, b], rtol=1e-6)


def test_migrate_version_1__held_out_lights_are_flagged():
    tree = _version_1("model/take")
    tree.attrs["held_out_lights"] = ["light1", "light3"]
    held = migrate_version_1(tree)["held_out"]
    np.testing.assert_array_equal(held["light_held_out"], [0, 1, 0, 1])
    np.testing.assert_array_equal(held["camera_held_out"], 0)


def test_migrate_version_1__total_error_is_both_in_quadrature():
    tree = _version_1("model/take")
    tree["translucency/site_effective_transport_error"][...] = 3.0
    tree["translucency/site_effective_transport_model_error"][...] = 4.0
    np.testing.assert_array_equal(migrate_version_1(tree)["translucency/site_sigma_tr_total_error"], 5.0)


def test_migrate_version_1__the_period_of_the_tables_is_closed():
    old, new = _version_1("model/take"), migrate_version_1(_version_1("model/take"))["basis"].to_dataset()
    np.testing.assert_array_equal(np.moveaxis(kernel_tables(new), -1, 0), old["basis/basis_brdf"].values)
    np.testing.assert_array_equal(new["basis_brdf"].isel(phi_d=-1), new["basis_brdf"].isel(phi_d=0))
    assert new["phi_d"].values[-1] == np.pi
    assert np.isfinite(new["basis_brdf"].interp(phi_d=np.pi - 1e-3)).all()


def test_migrate_version_1__stays_lazy_along_surfels():
    migrated = migrate_version_1(_version_1("model/take"))
    lazy = [name for name, one in migrated["fitted"].data_vars.items() if "surfel" in one.dims and one.chunks is None]
    assert lazy == []


def test_stored_version__two_generations_can_be_subtracted():
    """No variable of a model is boolean: xarray cannot subtract those."""
    one = migrate_version_1(_version_1("model/take"))["fitted"].to_dataset().load()
    difference = one - one
    assert set(difference.data_vars) == set(one.data_vars)
    assert float(abs(difference.to_array()).max()) == 0
    assert not [v.name for v in VARIABLES.values() if v.dtype == "bool"]
