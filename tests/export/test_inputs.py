from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from skindb.errors import InputError
from skindb.export import export_bundle, export_gltf, texture_maps
from skindb.export.inputs import REQUIRED


@pytest.mark.parametrize("name", REQUIRED)
def test_export__missing_variables_are_named(
    model: xr.DataTree, tmp_path: Path, name: str
) -> None:
    model["fitted"] = model["fitted"].to_dataset().drop_vars(name)
    for export in (export_bundle, export_gltf):
        with pytest.raises(
            InputError, match=rf"fitted\[{name}\]: variable is required"
        ):
            export(model, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("values", "found"),
    [(np.nan, "values that are not finite"), (0.5, "no triangle with an area")],
)
def test_export__invalid_texture_coordinates_are_named(
    model: xr.DataTree, values: float, found: str
) -> None:
    model["fitted/surfel_uv"].values[:] = values
    with pytest.raises(
        InputError,
        match=rf"fitted\[surfel_uv\]: texture coordinates must be finite.*found {found}",
    ):
        texture_maps(model)


def test_export__maps_larger_than_the_memory_are_refused(
    model: xr.DataTree, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skindb.export.inputs._free_memory", lambda: 1e9)
    said = (
        r"maps of 8192 x 8192 texels need 14.8 GB of memory; found 1.0 GB; choose a "
        r"smaller size, for example 64"
    )
    for export in (export_bundle, export_gltf):
        with pytest.raises(InputError, match=said):
            export(model, tmp_path / "out", size=8192)
    assert texture_maps(model, size=64)["albedo"].values.shape == (64, 64, 3)
    with pytest.raises(InputError, match="size: must be positive; found 0"):
        texture_maps(model, size=0)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_export__few_fitted_surfels_are_enough(
    model: xr.DataTree, tmp_path: Path, count: int
) -> None:
    fitted = model["fitted"].to_dataset()
    others = np.flatnonzero(fitted["fit_status"].values == 0)[count:]
    fitted["fit_status"].values[others] = fitted["fit_status"].values.max()
    for name in ("shading_normal", "diffuse_reflectance", "basis_weight"):
        fitted[name].values[others] = np.nan
    model["fitted"] = fitted
    export_bundle(model, tmp_path / "out", merl=False)
    maps = texture_maps(model)
    assert (maps["confidence"].values > 0).sum() > 0
    assert all(np.isfinite(one.values).all() for one in maps.values())


def test_export__a_folder_that_cannot_be_created_is_named(
    model: xr.DataTree, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(
        InputError,
        match="file/out: must be a folder that can be created; found Not a directory",
    ):
        export_bundle(model, tmp_path / "file/out")
    with pytest.raises(InputError, match="must be a new or empty folder; found a file"):
        export_bundle(model, tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"


def test_export__zero_sigma_tr_is_unknown(model: xr.DataTree) -> None:
    """It would be a diffusion length of infinity, and spread over the map."""
    model["fitted/sigma_tr"].values[:300, 1] = 0
    maps = texture_maps(model)
    for name in ("translucency", "mean_free_path"):
        assert np.isfinite(maps[name].values).all()
    np.testing.assert_allclose(maps["translucency"].values[..., 1], 1 / 0.8, rtol=1e-5)
