"""What exports need of a model; the mean free path by a random walk that is written out here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray

from skindb.errors import InputError
from skindb.export import export_bundle, export_gltf, texture_maps
from skindb.export.inputs import REQUIRED, mean_free_path
from skindb.optics.diffusion import dipole_profile, dipole_s, scattering_coefficients


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


ETA = 1.3
PHOTONS = 100_000
Float = NDArray[np.float64]


def single_albedo(multiple: float) -> float:
    """Single-scattering albedo of OpenPBR 1.1, from the fraction of light that returns
    (Kulla and Conty 2017).
    """
    s = (
        4.09712
        + 4.20863 * multiple
        - np.sqrt(9.59217 + 41.6808 * multiple + 17.7126 * multiple**2)
    )
    return 1 - s * s


def walk(albedo: float, rng: np.random.Generator) -> tuple[Float, Float]:
    """Distances along x, in mean free paths, between entry and exit of photons, and
    their weights.
    """
    rise = -np.sqrt(rng.random(PHOTONS))  # they enter in proportion to the cosine
    x = np.zeros(PHOTONS)
    z = np.zeros(PHOTONS)
    weight = np.ones(PHOTONS)
    turn = 2 * np.pi * rng.random(PHOTONS)
    found = []
    left = []
    while len(x):
        step = rng.exponential(size=len(x))
        along = np.sqrt(1 - rise**2) * np.cos(turn)
        out = z + step * rise > 0
        found.append((x - z / rise * along)[out])
        left.append(weight[out])
        x = (x + step * along)[~out]
        z = (z + step * rise)[~out]
        weight = weight[~out] * albedo
        weak = weight < 0.01
        alive = ~weak | (rng.random(len(x)) < 0.1)
        x = x[alive]
        z = z[alive]
        weight = np.where(weak, 10 * weight, weight)[alive]
        rise = 2 * rng.random(len(x)) - 1
        turn = 2 * np.pi * rng.random(len(x))
    return np.concatenate(found), np.concatenate(left)


def dipole_edge(diffuse: float, sigma_tr: float, across: Float) -> Float:
    """Light that leaves the skin at these distances [mm] from the edge of a shadow; 1
    is that of even light.
    """
    absorption, scattering = scattering_coefficients(
        dipole_s(np.array(diffuse), eta=ETA)[0], np.array(sigma_tr)
    )
    line = np.linspace(0, 30, 1201)
    along = np.concatenate([[0], np.geomspace(1e-4, 100, 1500)])
    distance = np.hypot(line[:, None], along)
    spread = np.trapezoid(
        dipole_profile(distance, float(absorption), float(scattering), eta=ETA),
        along,
        axis=1,
    )
    light = np.concatenate([[0], np.cumsum((spread[1:] + spread[:-1]) / 2)])
    return 0.5 + np.sign(across) * np.interp(
        np.abs(across), line, light / light[-1] / 2
    )


@pytest.mark.parametrize("diffuse", [0.2, 0.5, 0.8])
def test_mean_free_path__a_walk_spreads_light_as_the_dipole_does(
    diffuse: float,
) -> None:
    sigma_tr = 0.7
    across = np.linspace(-8, 8, 81)
    place, weight = walk(single_albedo(diffuse), np.random.default_rng(1))
    # the formula of the albedo, and noise
    assert weight.sum() / PHOTONS == pytest.approx(diffuse, rel=0.02)
    order = np.argsort(place)
    rising = np.cumsum(weight[order]) / weight.sum()
    true = dipole_edge(diffuse, sigma_tr, across)

    def gap(factor: float) -> float:
        path = factor * float(
            mean_free_path(np.array(diffuse), np.array(sigma_tr), eta=ETA)
        )
        return float(
            np.sqrt(
                np.mean((np.interp(across / path, place[order], rising) - true) ** 2)
            )
        )

    # of the light in the open; the shapes of the profiles differ by 0.001 to 0.017
    assert gap(1) < 0.02
    assert gap(1) < min(gap(0.8), gap(1.25))
