"""Every quantity of the studies of a simulated cohort, compared with the truth of its
subjects.

    skindb simulate captures --cohort 87 --workers 2
    skindb ingest db captures/*/ --workers 2 && skindb fit db --workers 2
    python -m benchmarks cohort captures db [--group-by gender] [--adjust age]

The first table has for every quantity, over its regions or sites and channels, in takes of
the condition normal: the bias;
the standard deviation of its errors over takes, beside the one that is stated; how often
the stated 95 % intervals contain the truth, with the errors that takes have in common and
without these and the bias; the correlation with the truth; the true reliability, 1 less
the variance of the errors over that of the values, beside the stated one; and how often
`analyze groups` has p < 0.05 for a factor that is drawn at random. The next tables have
the regions of quantities of the surface. The last ones have the differences of groups,
their truth (the same regression of the true values), and whether their 95 % intervals
contain it: nearly always, as they also cover the variation between subjects, which the
true values share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr

import skindb
from skindb.analysis import group_effects
from skindb.analysis.quantities import (
    NORMAL_95,
    QUANTITIES,
    SURFACE,
    Measurement,
    measurements,
    quantities_of,
)
from skindb.analysis.subjects import NORMAL
from skindb.analysis.summary import region_tables
from skindb.geometry.mesh import vertex_areas
from skindb.reflectance.tables import NARROW_ANGLE, directional_albedo
from skindb.schema import dataset
from skindb.schema.label import CHANNELS
from skindb.virtual.capture import _materials

NAMES = tuple(QUANTITIES)
BY_REGION = (SURFACE, "glossiness", "albedo contrast", "RMS slope")
ROUGH = ("region_albedo_contrast", "region_normal_slope")
HEADER = (
    "bias | deviation | stated | covered | without bias | correlation | reliability | "
    "stated |"
)


def truth_of(path: Path, cohort: xr.Dataset) -> xr.Dataset:
    """True means of regions and sites of a take, in the layout of the cohort."""
    held = np.load(path)
    names = held["region_names"].tolist()
    sites = held["site_names"].tolist()
    materials, albedo = _materials()
    narrow = directional_albedo(materials.table, 1.0, NARROW_ANGLE)[0]
    # the even part of the materials is diffuse light for every fit
    even = np.outer(held["surface_lambertian"], [1.0, np.sin(2 * NARROW_ANGLE) ** 2])
    surface = held["surface_weights"] @ np.column_stack([albedo, narrow]) - even
    skin = np.column_stack([held["diffuse_reflectance"], surface])
    label = cohort["region"].values.tolist()
    member = np.zeros((len(label), len(skin)), bool)
    for mask, name in zip(member, label, strict=True):
        mask[:] = name == "face"
        if name in names:
            mask[:] = held["region_membership"][:, names.index(name)] > 0.5
    regions = np.array(
        [
            skin[mask].mean(axis=0) if mask.any() else 0 * skin[0] + np.nan
            for mask in member
        ]
    )
    rough = region_tables(true_surface(held), dict(zip(label, member, strict=True)))
    probed = np.full((cohort.sizes["site"], 3), np.nan)
    for i, name in enumerate(cohort["site"].values.tolist()):
        if name in sites:
            probed[i] = held["site_sigma_tr"][sites.index(name)]
    return xr.Dataset(
        {
            "region_diffuse_reflectance": (("region", "channel"), regions[:, :3]),
            "region_surface_reflectance": (("region",), regions[:, 3]),
            "region_glossiness": (("region",), regions[:, 4] / regions[:, 3]),
            "site_sigma_tr": (("site", "channel"), probed),
        }
        | {name: rough[name].reset_coords(drop=True) for name in ROUGH}
    )


def true_surface(held: Mapping[str, np.ndarray]) -> xr.Dataset:
    """The vertices of the true surface as surfels without errors."""
    count = len(held["vertices"])
    albedo = held["diffuse_reflectance"]
    return dataset(
        {
            "surfel_position": held["vertices"],
            "surfel_area": vertex_areas(held["vertices"], held["faces"].astype(int)),
            "shading_normal": held["normals"],
            "normal_error": np.zeros(count),
            "diffuse_reflectance": albedo,
            "diffuse_reflectance_error": 0 * albedo,
            "fit_status": np.zeros(count),
        },
        coords={"channel": CHANNELS},
    )


def compared(estimated: Measurement, true: Measurement, places: np.ndarray) -> str:
    """Columns of `HEADER` for the values of some places (mask)."""

    def chosen(values: np.ndarray) -> np.ndarray:
        return values.reshape(len(values), -1)[:, places.ravel()]

    value, truth = chosen(estimated.values), chosen(true.values)
    stated, common = chosen(estimated.errors), chosen(estimated.common)
    if estimated.quantity.is_log:
        stated = stated / value
        common = common / value
        value, truth = np.log(value), np.log(truth)
    error = np.where(np.isfinite(stated), value - truth, np.nan)
    bias = np.nanmean(error, axis=0)
    scatter = np.nanvar(error, axis=0, ddof=1)
    variance = np.nanvar(np.where(np.isfinite(error), value, np.nan), axis=0, ddof=1)
    squares = np.nanmean(stated**2, axis=0)

    def covered(difference: np.ndarray, deviation: np.ndarray) -> str:
        inside = np.abs(difference) < NORMAL_95 * deviation
        return f"{100 * inside[np.isfinite(difference)].mean():.0f} %"

    correlation = [
        np.corrcoef(*pair[:, np.isfinite(pair).all(axis=0)])[0, 1]
        for pair in np.stack([value, truth], axis=1).transpose(2, 1, 0)
    ]
    numbers = (
        f"{np.nanmean(bias):.4f}",
        f"{np.sqrt(np.nanmean(scatter)):.4f}",
        f"{np.sqrt(np.nanmean(squares)):.4f}",
        covered(error, np.hypot(stated, np.nan_to_num(common))),
        covered(error - bias, stated),
        f"{np.nanmedian(correlation):.2f}",
        f"{np.nanmedian(np.maximum(1 - scatter / variance, 0)):.2f}",
        f"{np.nanmedian(np.maximum(1 - squares / variance, 0)):.2f}",
    )
    return " | ".join(numbers)


def false_positives(cohort: xr.Dataset, draws: int) -> dict[str, str]:
    """Quantity -> fraction of p < 0.05 for groups that are drawn, of those with a p."""
    rng = np.random.default_rng(3)
    subjects, index = np.unique(cohort["subject"].values, return_inverse=True)
    found: dict[str, list[np.ndarray]] = {name: [] for name in NAMES}
    for _ in range(draws):
        half = rng.permutation(np.arange(len(subjects)) % 2)[index]
        drawn = cohort.assign_coords(drawn=("take", np.array(["a", "b"])[half]))
        effects = group_effects(
            drawn, group_by="drawn", quantities=NAMES, permutations=199, rng=rng
        ).isel(contrast=0)
        labels = np.array(effects["quantity"].values.tolist())
        for name, p in found.items():
            p.append(effects["effect_p"].values[np.char.startswith(labels, f"{name} ")])
    return {
        name: f"{100 * np.nanmean(np.less(p, 0.05)[np.isfinite(p)]):.1f} %"
        for name, p in found.items()
    }


def main(
    captures: Path,
    db: str,
    *,
    group_by: str = "gender",
    adjust: Sequence[str] = (),
    draws: int = 100,
) -> None:
    """Compare and print."""
    cohort = skindb.open(db).cohort("tables").load()
    true = [
        truth_of(captures / f"{take}.truth.npz", cohort)
        for take in cohort["take"].values.tolist()
    ]
    planted = xr.concat(true, "take").assign_coords(cohort.coords)
    # restrict the truth to where estimates exist
    planted = cohort.assign(
        {name: 0 * cohort[name] for name in cohort if str(name).endswith("_error")}
        | {
            name: planted[name].where(np.isfinite(cohort[name]))
            for name in planted
            if name in cohort
        }
    )
    normal = np.flatnonzero(cohort["condition"] == NORMAL)
    false = false_positives(cohort.isel(take=normal), draws)
    print(f"| quantity | {HEADER} p < 0.05 |")
    both = [measurements(part.isel(take=normal)) for part in (cohort, planted)]
    for estimated, truth in zip(*both, strict=True):
        name = estimated.quantity.name
        known = np.isfinite(estimated.values).any(axis=0)
        print(f"| {name} | {compared(estimated, truth, known)} | {false[name]} |")
    for estimated, truth in zip(*both, strict=True):
        if estimated.quantity.name in BY_REGION:
            print(f"\n| {estimated.quantity.name} | {HEADER}")
            known = np.isfinite(estimated.values).any(axis=0)
            for i in np.flatnonzero(known.reshape(len(known), -1).any(axis=1)):
                places = np.zeros_like(known)
                places[i] = known[i]
                region = estimated.labels[0][i]
                print(f"| {region} | {compared(estimated, truth, places)} |")
    options = {"group_by": group_by, "adjust": adjust, "quantities": NAMES}
    estimated, want = (
        group_effects(part, permutations=1000, rng=np.random.default_rng(0), **options)
        for part in (cohort, planted)
    )
    print_differences(estimated, want, quantities_of(cohort, NAMES).names)


def print_differences(
    estimated: xr.Dataset, want: xr.Dataset, quantities: Sequence[str]
) -> None:
    """Differences of groups, and which intervals contain the true ones."""
    for contrast in estimated["contrast"].values.tolist():
        inside = []
        print(
            f"\n| {contrast} | true difference | difference | 95 % interval | holds it |"
        )
        for quantity in quantities:
            est = estimated.sel(contrast=contrast, quantity=quantity)
            truth = float(want["effect"].sel(contrast=contrast, quantity=quantity))
            low = float(est["effect_low"])
            high = float(est["effect_high"])
            inside.append(low <= truth <= high)
            print(
                f"| {quantity} | {truth:.4f} | {float(est['effect']):.4f} | {low:.4f} to "
                f"{high:.4f} | {'yes' if inside[-1] else 'no'} |"
            )
        print(f"{sum(inside)} of {len(inside)} intervals contain the truth")
