"""Planted results of a demo: small models, errors and tables."""

from __future__ import annotations

import numpy as np
import xarray as xr
from small_face import SIDE, small_face

from skindb.analysis.translucency import COLUMNS
from skindb.demo.report import Results
from skindb.render.photographs import Comparison
from skindb.schema import FitStatus, label
from skindb.virtual.capture import Recovery

TAKES = ("V001", "V001.lotion", "V001.powder", "V002", "V003", "V004", "V005", "V006")
PLANTED = {
    FitStatus.UNSEEN: 700,
    FitStatus.TOO_FEW_SAMPLES: 1,
    FitStatus.NO_DIFFUSE_ESTIMATE: 40,
    FitStatus.OBSTRUCTED: 90,
}
SURFELS = SIDE**2
SCALE = 0.25
# deg, relative, relative
NORMAL_ERROR = 2.0
DIFFUSE_ERROR = 0.05
HELD_OUT_ERROR = 0.034


def planted_results(takes: tuple[str, ...] = TAKES) -> Results:
    results = Results()
    for take in takes:
        results.models[take] = _model(take)
        results.fits[take] = {"held_out_error": {"median": HELD_OUT_ERROR}}
        results.recovered[take] = _recovery(results.models[take])
        results.compared[take] = [
            comparison("l0", held_out=False),
            comparison("l1", held_out=True),
        ]
    results.studies = _studies(takes)
    results.edited_take = takes[0]
    results.target_take = takes[1]
    for amount, distance in ((0.0, 0.0), (1.0, 0.4)):
        edited = small_face((0.6 + 0.2 * amount, 0.4, 0.3))
        _shrink(edited)
        edited.attrs |= {"edit": {"lotion": amount}, "edit_distance": distance}
        results.edits[amount] = edited
    return results


def _model(take: str) -> xr.DataTree:
    albedo = (
        (0.25, 0.15, 0.1)
        if take == "V003"
        else (0.8, 0.4, 0.3)
        if take == "V001.lotion"
        else (0.6, 0.4, 0.3)
    )
    model = small_face(albedo)
    status = np.repeat(
        [FitStatus.FITTED, *PLANTED],
        [SURFELS - sum(PLANTED.values()), *PLANTED.values()],
    )
    fitted = model["fitted"].to_dataset()
    model["fitted"] = xr.DataTree(fitted.assign(fit_status=label("fit_status", status)))
    _shrink(model)
    traits = {"age": 67, "gender": "female", "ancestry": "south_asian"}
    model.attrs |= {"traits": traits, "condition": take.partition(".")[2] or "normal"}
    return model


def _shrink(model: xr.DataTree) -> None:
    """Reduce the size of the pictures of the camera, so that rendering is fast."""
    dome = model["dome"].to_dataset()
    matrix = dome["camera_matrix"]
    size = dome["camera_size"]
    smaller = {
        "camera_matrix": matrix * np.array([[SCALE], [SCALE], [1.0]]),
        "camera_size": (size * SCALE).astype(size.dtype),
    }
    kept = {
        name: values.assign_attrs(dome[name].attrs) for name, values in smaller.items()
    }
    model["dome"] = xr.DataTree(dome.assign(kept))


def _recovery(model: xr.DataTree) -> Recovery:
    fitted = model["fitted"].to_dataset()
    found = fitted["fit_status"].values == FitStatus.FITTED
    site = {"cheek": np.array([0.1, 0.0, -0.2])}
    diffuse = fitted["diffuse_reflectance"].values
    error = np.full((SURFELS, 3), DIFFUSE_ERROR)
    return Recovery(np.full(SURFELS, NORMAL_ERROR), error, diffuse, found, site)


def comparison(light: str, *, held_out: bool, exposure: float = 1.0) -> Comparison:
    image = np.full((40, 30, 3), 0.5, np.float32)
    mask = np.zeros((40, 30), bool)
    mask[5:35, 5:25] = True
    error = {
        "relative_rmse": 0.11,
        "relative_median": 0.015,
        "psnr": 30.0,
        "ssim": 0.9,
        "delta_e_median": 1.2,
        "exposure": exposure,
    }
    return Comparison(light, "c0", held_out, image, image, mask, 0.0, error, image)


def _studies(takes: tuple[str, ...]) -> dict[str, xr.DataTree]:
    channel = list("RGB")
    region = ["face"]
    by_site = ("group", "site", "channel")
    sizes = np.arange(1, 7)
    stated = {"sigma_tr_count": 6, "sigma_tr_mean_low": 0.8, "sigma_tr_mean_high": 1.2}
    translucency = {
        name: (by_site, np.full((1, 2, 3), stated.get(name, 1.0))) for name in COLUMNS
    }
    curve = {
        **{
            f"relative_error{end}": ("k", 1 + 0.3 / sizes)
            for end in ("", "_low", "_high")
        },
        "smallest_size": 3,
        "sufficient_size": 4,
        "plateau_tolerance": 0.01,
    }
    albedo = {
        "histogram_edge": (("axis", "edge"), np.tile(np.linspace(-2, 2, 257), (3, 1))),
        "albedo_mean": (
            ("take", "region", "channel"),
            np.full((len(takes), 1, 3), 0.4),
        ),
        "albedo_histogram": (
            ("take", "region", "axis", "bin"),
            np.full((len(takes), 1, 3, 256), 1 / 256),
        ),
    }
    traits = {
        "trait_count": (("trait", "side"), np.ones((1, 2), int)),
        "trait_brdf_shift": (("trait", "component"), np.full((1, 4), 0.0786)),
        "trait_quantile_shift": (
            ("trait", "region", "axis", "level"),
            np.full((1, 1, 3, 5), 0.615),
        ),
        "trait_log_sigma_tr_shift": (("trait", "channel"), np.full((1, 3), 0.01)),
    }
    where = {"channel": channel, "region": region}
    grouped = xr.Dataset(attrs={"group_by": ""})
    planted = {
        "translucency": {
            "translucency_table": xr.Dataset(
                translucency,
                {"channel": channel, "site": ["cheek", "forehead"], "group": ["all"]},
            )
        },
        "brdf": {"basis_size": xr.Dataset(curve, {"k": sizes}, {"surfels": 400})},
        "albedo": {
            "albedo": xr.Dataset(albedo, where | {"take": list(takes)}),
            "albedo_table": grouped,
        },
        "traits": {
            "traits": xr.Dataset(
                traits,
                where
                | {"trait": ["ancestry:south_asian"], "side": ["with", "without"]},
                {"flags": []},
            )
        },
    }
    return {name: xr.DataTree.from_dict(groups) for name, groups in planted.items()}
