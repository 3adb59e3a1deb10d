from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from skindb.export.bundle import export_bundle
from skindb.reflectance.tables import stored_brdf
from skindb.schema import FitStatus, ProbeStatus, dataset

SIDE = 24  # surfels along each side of the patch
SIZE = 64  # texels of the maps of bundles


def ggx(
    theta_h: np.ndarray, theta_d: np.ndarray, phi_d: np.ndarray, roughness: float
) -> np.ndarray:
    """Cook-Torrance D G F / (4 cos cos) with F0 = 0.04, Smith's G, written out from
    local directions.
    """
    d = np.stack(
        [
            np.sin(theta_d) * np.cos(phi_d),
            np.sin(theta_d) * np.sin(phi_d),
            np.cos(theta_d),
        ]
    )
    cos_i = -np.sin(theta_h) * d[0] + np.cos(theta_h) * d[2]
    cos_o = np.sin(theta_h) * d[0] + np.cos(theta_h) * d[2]
    a2 = roughness**4
    spread = a2 / (np.pi * ((a2 - 1) * np.cos(theta_h) ** 2 + 1) ** 2)
    up_i, up_o = (np.maximum(c, 1e-3) for c in (cos_i, cos_o))
    masking = np.ones_like(spread)
    for c in (up_i, up_o):
        masking = masking * 2 / (1 + np.sqrt(1 + a2 * (1 / c**2 - 1)))
    fresnel = 0.04 + 0.96 * (1 - np.cos(theta_d)) ** 5
    return np.where(
        (cos_i > 0) & (cos_o > 0), spread * masking * fresnel / (4 * up_i * up_o), 0
    )


def table(
    roughness: float,
    strength: float,
    diffuse: float,
    shape: tuple[int, int, int] = (90, 46, 36),
) -> np.ndarray:
    h = np.linspace(0, 1, shape[0]) ** 2 * np.pi / 2
    d = np.linspace(0, np.pi / 2, shape[1])
    p = np.arange(shape[2]) / shape[2] * np.pi
    return (
        strength * ggx(*np.meshgrid(h, d, p, indexing="ij"), roughness)
        + diffuse / np.pi
    )


@pytest.fixture(scope="session")
def tables() -> np.ndarray:
    """(nh, nd, np, 2): a broad and a narrow lobe, the broad one with a diffuse part."""
    return np.stack([table(0.55, 0.8, 0.02), table(0.35, 0.5, 0.0)], axis=-1).astype(
        np.float32
    )


def patch(tables: np.ndarray) -> xr.DataTree:
    """A bulged square patch with smooth reflectance; one corner was never seen."""
    u, v = (x.ravel() for x in np.meshgrid(*2 * [np.linspace(0.05, 0.95, SIDE)]))
    i = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([i, i + SIDE, i + 1], 1),
            np.stack([i + 1, i + SIDE, i + SIDE + 1], 1),
        ]
    )
    x = (u - 0.5) * 120
    y = (0.5 - v) * 120
    normal = np.stack([x / 150, y / 150, np.ones_like(x)], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    status = np.where(
        (u > 0.8) & (v > 0.8), int(FitStatus.UNSEEN), int(FitStatus.FITTED)
    )
    unseen = (status != 0)[:, None]
    values = {
        "surfel_position": np.stack([x, y, -(x**2 + y**2) / 300], axis=1),
        "surfel_normal": normal,
        "surfel_uv": np.stack([u, v], axis=1),
        "surfel_area": np.full(len(u), 25.0),
        "shading_normal": np.where(unseen, np.nan, normal),
        "diffuse_reflectance": np.where(
            unseen, np.nan, 0.2 + 0.5 * np.stack([u, v, u * v], axis=1)
        ),
        "diffuse_reflectance_error": np.full((len(u), 3), 0.01),
        "basis_weight": np.where(
            unseen, np.nan, np.stack([0.4 + 0.2 * u, 0.3 * v], axis=1)
        ),
        "sigma_tr": np.full((len(u), 3), [0.5, 0.8, 1.25]),
        "fit_status": status,
        "fit_residual": np.where(unseen[:, 0], np.nan, 0.04),
        "refractive_index": 1.3,
    }
    sites = {
        "site_sigma_tr": [[0.5, 0.8, np.nan]],
        "site_sigma_tr_error": [[0.1, 0.1, np.nan]],
        "site_sigma_tr_total_error": [[0.11, 0.12, np.nan]],
        "site_status": [
            [ProbeStatus.FITTED, ProbeStatus.POOR_FIT, ProbeStatus.TOO_FEW_FIBRES]
        ],
    }
    groups = {
        "/fitted": dataset(values),
        "/mesh": dataset({"triangle": faces}),
        "/basis": dataset(
            {
                "basis_brdf": stored_brdf(tables),
                "basis_mixture": np.eye(2),
                "disc_angular_radius": 0.0,
            },
            coords={"dictionary": ["a", "b"]},
        ),
        "/translucency": dataset(sites, coords={"site": ["cheek"]}),
    }
    attrs = {
        "consent_scope": ["fit", "export"],
        "subject": "S01",
        "parameters": {"k": np.int64(2)},
    }
    tree = xr.DataTree.from_dict(groups)
    tree.attrs.update(attrs)
    return tree


@pytest.fixture
def model(tables: np.ndarray) -> xr.DataTree:
    """The model of a patch, which the test may change."""
    return patch(tables)


@pytest.fixture(scope="session")
def bundle(tables: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Bundle of the patch without MERL files, which is only read."""
    return export_bundle(
        patch(tables), tmp_path_factory.mktemp("bundle") / "out", size=SIZE, merl=False
    ).parent


@pytest.fixture(scope="session")
def merl_bundle(tables: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Bundle of the patch with MERL files, which is only read."""
    return export_bundle(
        patch(tables), tmp_path_factory.mktemp("merl") / "out", size=SIZE, merl=True
    ).parent
