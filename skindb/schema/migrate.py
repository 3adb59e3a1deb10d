"""Versions that were written with schema version 1, as version 2 has them; nothing is rewritten on disk."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from skindb.optics.dictionary import EMBEDDED
from skindb.schema.brdf import ANGLES
from skindb.schema.label import dataset, label, text_labels

Attrs = Mapping[Any, Any]
# variable of version 1 -> of version 2; the order does not matter, all are renamed at once
RENAMED = {
    "basis_weight": "dictionary_weight",
    "reduced_weight": "basis_weight",
    "reduced_weight_error": "basis_weight_error",
    "component_weight": "basis_mixture",
    "mean_basis_weight": "mean_dictionary_weight",
    "effective_transport": "sigma_tr",
    "site_effective_transport": "site_sigma_tr",
    "site_effective_transport_error": "site_sigma_tr_error",
    "site_effective_transport_model_error": "site_sigma_tr_model_error",
    "full_basis_residual": "dictionary_residual",
    "full_basis_residual_perceptual": "dictionary_residual_perceptual",
    "outlier_share": "outlier_fraction",
    "light_outlier_share": "light_outlier_fraction",
    "camera_outlier_share": "camera_outlier_fraction",
    "prediction_share": "prediction_fraction",
    "prediction_outlier_share": "prediction_outlier_fraction",
    "hole_share": "hole_fraction",
    "population_weight": "population_mixture",
    "left_out": "skipped",
}
OLD_DIM, NEW_DIM = "basis", "dictionary"
FLAGS = ("region_mask", "landmark_used")  # were bool
EXPONENTS = re.compile(r"sigma_tr\^(-?[\d.]+) sigma_s'\^(-?[\d.]+)")
CHANNELS = 3
EMBEDDED_1 = "ABC parameters of Loew et al. 2012"  # how version 1 called the embedded dictionary


def migrate_version_1(tree: xr.DataTree) -> xr.DataTree:
    """A version of schema 1 as schema 2 has it.

    Variables are renamed, and what version 1 kept in attributes although results depend on it becomes variables.

    Parameters
    ----------
    tree
        As it was read, lazy.

    Returns
    -------
    DataTree
        As lazy as `tree`, except for `basis_brdf`, whose period is closed.
    """
    groups = {}
    for name, node in tree.children.items():
        ds = node.to_dataset()
        groups[name] = STEPS.get(name, _unchanged)(_renamed(ds), tree.attrs)
    if any(name in tree.attrs for name in ("held_out_lights", "held_out_cameras")) and "dome" in groups:
        groups["held_out"] = _held_out(groups["dome"], tree.attrs)
    migrated = xr.DataTree.from_dict(groups)
    migrated.attrs = migrate_provenance_1(tree.attrs)
    return migrated


def migrate_provenance_1(attrs: Attrs) -> dict[str, Any]:
    """Attributes of the root of a version 1, which are its provenance: figures of merit under their new names."""
    migrated = {RENAMED.get(str(name), str(name)): value for name, value in attrs.items()}
    if migrated.get("dictionary") == EMBEDDED_1:
        migrated["dictionary"] = EMBEDDED
    return migrated


def _renamed(ds: xr.Dataset) -> xr.Dataset:
    names = {old: new for old, new in RENAMED.items() if old in ds.variables}
    dims = {OLD_DIM: NEW_DIM} if OLD_DIM in ds.dims else {}
    flags = {name: ds[name].astype(np.int8) for name in FLAGS if name in ds.variables and ds[name].dtype == bool}
    return ds.assign(flags).rename(names | dims)


def _unchanged(ds: xr.Dataset, _: Attrs) -> xr.Dataset:
    return ds


def _scalar(ds: xr.Dataset, name: str, value: Any) -> xr.Dataset:
    """The Dataset with a scalar variable instead of the attribute of that name."""
    return _with_attrs(ds.assign({name: label(name, value)}), lambda key: key != name)


def _with_attrs(ds: xr.Dataset, keep: Callable[[str], bool]) -> xr.Dataset:
    """The Dataset with those of its attributes that are to be kept."""
    kept = {key: value for key, value in ds.attrs.items() if keep(str(key))}
    return ds.drop_attrs(deep=False).assign_attrs(kept)


def _samples(ds: xr.Dataset, _: Attrs) -> xr.Dataset:
    return _scalar(ds, "noise_floor", ds.attrs.get("noise_floor", 0.0))


def _probe(ds: xr.Dataset, _: Attrs) -> xr.Dataset:
    known = ds.attrs.get("gain_known", ds["fibre_profile"].attrs.get("gain_known", 1))
    sites = [str(site) for site in ds["site"].values]
    pressure = [float(ds.attrs.get(f"pressure_{site}", "nan")) for site in sites]
    ds = _scalar(_scalar(ds, "gain_known", int(known)), "fibre_radius", float(ds.attrs.get("fibre_radius", 0.0)))
    ds = ds.assign(site_pressure=label("site_pressure", pressure))
    return _with_attrs(ds, lambda key: not key.startswith("pressure_"))


def _fitted(ds: xr.Dataset, attrs: Attrs) -> xr.Dataset:
    return ds.assign(refractive_index=label("refractive_index", attrs["eta"])) if "eta" in attrs else ds


def _basis(ds: xr.Dataset, _: Attrs) -> xr.Dataset:
    ds = _scalar(ds, "disc_angular_radius", ds.attrs.get("disc_angular_radius", 0.0))
    brdf = ds["basis_brdf"].transpose("component", *ANGLES)
    closed = np.concatenate([brdf.values, brdf.values[..., :1]], axis=-1)
    coords = {name: ds[name].values for name in (*ANGLES, "component") if name in ds.coords}
    coords |= {"phi_d": np.append(coords["phi_d"], np.pi)} if "phi_d" in coords else {}
    return ds.drop_dims("phi_d").merge(dataset({"basis_brdf": closed}, coords=coords), combine_attrs="override")


def _translucency(ds: xr.Dataset, _: Attrs) -> xr.Dataset:
    shape = tuple(ds.sizes[dim] for dim in ("site", "channel"))
    new: dict[str, Any] = {}
    if "site_sigma_tr_error" in ds:
        new["site_sigma_tr_total_error"] = np.hypot(
            ds["site_sigma_tr_error"].values, ds["site_sigma_tr_model_error"].values
        )
    if "correlation" in ds.attrs:
        new["site_correlation"] = np.array(ds.attrs["correlation"], np.float64).reshape(shape)
        words = [[_exponents(text) for text in row] for row in ds.attrs["best_determined"]]
        new["site_best_exponent"] = np.array(words).reshape(*shape, 2)
    ds = ds.assign({name: label(name, value) for name, value in new.items()})
    return _with_attrs(ds, lambda key: key not in ("correlation", "best_determined"))


def _exponents(text: str) -> tuple[float, float]:
    found = EXPONENTS.fullmatch(text)
    return (float(found[1]), float(found[2])) if found else (np.nan, np.nan)


def _basis_size(ds: xr.Dataset, _: Attrs) -> xr.Dataset:
    values = {
        "smallest_size": ds.attrs.get("fewest_k", 0),
        "sufficient_size": ds.attrs.get("most_k", 0),
        "plateau_tolerance": ds.attrs.get("tolerance", 0.01),
        "dictionary_error": ds.attrs.get("full_basis_error", np.nan),
    }
    return ds.assign({name: label(name, value) for name, value in values.items()})


def _dictionary_report(ds: xr.Dataset, _: Attrs) -> xr.Dataset:
    return _scalar(ds, "disc_angular_radius", ds.attrs.get("disc_angular_radius", 0.0))


def _registration(ds: xr.Dataset, _: Attrs) -> xr.Dataset:
    scale = ds.attrs.get("mm_per_uv")
    return _scalar(ds, "mm_per_uv", np.nan if scale is None else scale)


def _held_out(dome: xr.Dataset, attrs: Attrs) -> xr.Dataset:
    variables, coords = {}, {}
    for dim in ("light", "camera"):
        names = [str(name) for name in dome[dim].values]
        held = set(map(str, attrs.get(f"held_out_{dim}s", [])))
        variables[f"{dim}_held_out"] = [int(name in held) for name in names]
        coords[dim] = text_labels(names)
    return dataset(variables, coords=coords)


# group -> what it needs beyond new names
STEPS: dict[str, Callable[[xr.Dataset, Attrs], xr.Dataset]] = {
    "samples": _samples,
    "probe": _probe,
    "fitted": _fitted,
    "basis": _basis,
    "translucency": _translucency,
    "basis_size": _basis_size,
    "dictionary_report": _dictionary_report,
    "registration": _registration,
}
