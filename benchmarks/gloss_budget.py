"""Errors of surface reflectance and glossiness of regions by cause: parts of the fits are
replaced by true ones.

    skindb simulate captures --cohort 10 --cameras 6 --lights 32 --seed 57 --width 140 --height 176
    skindb ingest db captures/*/ --spacing 2.5 && skindb fit db
    python -m benchmarks gloss_budget captures db P001 P002 P004 P006

Means over the takes of the ratios to the true values of the same surfels.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr

import skindb
from skindb.analysis.regions import own_masks
from skindb.analysis.summary import MAX_HALF_ANGLE, trusted_surfels
from skindb.fit.albedo import estimate_in_sequence
from skindb.fit.joint import refine_jointly
from skindb.fit.lumitexels import lumitexels, scan_error
from skindb.fit.plan import surface_of
from skindb.fit.surface import fit_surface, refit
from skindb.parameters import FitParameters
from skindb.reflectance.block import gloss_of
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.model import Lamp, Points
from skindb.reflectance.tables import NARROW_ANGLE
from skindb.schema import label
from skindb.types import lengths, unit
from skindb.virtual.capture import _materials, at_foot_points, foot_points

EXACT = 0.05  # degree, error of a scan of true normals
GLOSS = ("surface_reflectance", "glossiness")


class Take:
    """The surfels of some regions of a take that tables use, and their truth."""

    def __init__(self, captures: Path, db: str, take: str, regions: Sequence[str]):
        database = skindb.open(db)
        model = database.read("model", take)
        fitted = model["fitted"].to_dataset().load()
        truth = np.load(captures / f"{take}.truth.npz")
        face, corner = foot_points(fitted, truth)
        masks = own_masks(fitted)
        seen = fitted["smallest_half_angle"].values <= MAX_HALF_ANGLE
        used = np.any([masks[region] for region in regions], axis=0) & (face >= 0)
        chosen = np.flatnonzero(used & seen & trusted_surfels(fitted))
        corners = truth["faces"][face[chosen]]

        def true(name: str) -> np.ndarray:
            values = truth[name][corners]
            return at_foot_points(values.reshape(*corners.shape, -1), corner[chosen])

        self.basis = model["basis"].to_dataset().load()
        self.samples = lumitexels(database.read("capture", take)).isel(surfel=chosen)
        self.samples = self.samples.compute()
        self.masks = {region: masks[region][chosen] for region in regions}
        self.area = fitted["surfel_area"].values[chosen].astype(float)
        self.normal = unit(true("normals"))
        self.position = true("vertices")
        self.weights = true("surface_weights")
        self.albedo = true("diffuse_reflectance")
        self.materials = Mixture(
            _materials()[0].table, disc_angular_radius=self.basis["disc_angular_radius"]
        )
        even = true("surface_lambertian")
        self.diffuse = self.albedo + even  # no fit can distinguish them
        whole, narrow = self.materials.normal_reflectance(self.weights)
        narrow = narrow - even[:, 0] * np.sin(2 * NARROW_ANGLE) ** 2
        self.truth = gloss_of(np.stack([whole - even[:, 0], narrow]))

    def exact_samples(self) -> np.ndarray:
        """Samples at the surfels instead of pixels, without noise."""
        out = np.full(self.samples["reflectance_sample"].shape, np.nan, np.float16)
        count = len(self.position)
        for c, camera in enumerate(self.samples["camera_position"].values):
            view = unit(camera - self.position)
            points = Points(self.position, self.normal, view, self.albedo, self.weights)
            for i, light in enumerate(self.samples["light_position"].values):
                place = np.broadcast_to(light.astype(float), (count, 1, 3))
                lamp = Lamp(place, np.ones((count, 1), np.float32), np.eye(3)[2], 0.0)
                square = lengths(self.position - light)[:, None] ** 2
                out[:, i, c] = square * self.materials.shade(points, lamp, eta=1.3)
        return np.where(np.isfinite(self.samples["reflectance_sample"]), out, np.nan)

    def fit(
        self, *, exact: bool = False, normal: bool = False, diffuse: bool = False
    ) -> tuple[xr.Dataset, xr.Dataset]:
        """Samples with estimates, and gloss by all BRDFs, with some parts replaced."""
        samples = self.samples
        error = scan_error(samples)
        if exact:
            value = label("reflectance_sample", self.exact_samples())
            samples = samples.assign(reflectance_sample=value)
        if normal:
            true = label("surfel_normal", self.normal)
            samples = samples.assign(surfel_normal=true)
            error = EXACT
        estimates = estimate_in_sequence(samples, eta=1.3, scan_error=error)
        refined = refine_jointly(samples.merge(estimates), eta=1.3, scan_error=error)
        estimates = estimates.assign(refined).compute()
        if diffuse:
            true = label("diffuse_reflectance", self.diffuse)
            estimates = estimates.assign(diffuse_reflectance=true)
        samples = samples.merge(estimates)
        surface = surface_of(samples, FitParameters(), None)
        fitted = fit_surface(samples, surface=surface).compute()
        gloss = gloss_of(surface.normal_reflectance(surface.parameters_of(fitted)))
        return samples, xr.Dataset({name: ("surfel", x) for name, x in gloss.items()})

    def ratios(self, gloss: xr.Dataset) -> list[list[float]]:
        """Ratios to the truth of the means of the regions."""
        out = []
        whole, narrow = (gloss[name].values.astype(float) for name in GLOSS)
        true_whole, true_narrow = self.truth.values()
        known = np.isfinite(whole * narrow)
        for mask in self.masks.values():
            area = self.area * (mask & known)
            found, true = np.nansum([whole * area, true_whole * area], axis=1)
            inner = np.nansum(whole * narrow * area) / found
            true_inner = np.nansum(true_whole * true_narrow * area) / true
            out.append([found / true, inner / true_inner])
        return out


def main(
    captures: Path,
    db: str,
    takes: Sequence[str],
    *,
    regions: Sequence[str] = ("nose", "lips", "forehead"),
) -> None:
    """Print the table."""
    rows: dict[str, list[list[list[float]]]] = {}
    for take in takes:
        part = Take(captures, db, take, regions)
        samples, gloss = part.fit()
        reduced = refit(samples, basis=part.basis)
        found = {
            "by the reduced basis": reduced,
            "by all BRDFs": gloss,
            "and true R_d": part.fit(diffuse=True)[1],
            "and true normals": part.fit(normal=True)[1],
            "and both": part.fit(normal=True, diffuse=True)[1],
            "and exact samples": part.fit(exact=True)[1],
            "and all of these": part.fit(exact=True, normal=True, diffuse=True)[1],
        }
        for name, values in found.items():
            rows.setdefault(name, []).append(part.ratios(values))
    print(f"| | {' | '.join(regions)} |\n|---|{'---|' * len(regions)}")
    for name, takes_ratios in rows.items():
        cells = [f"{a:.2f}, {b:.2f}" for a, b in np.mean(takes_ratios, axis=0)]
        print(f"| {name} | {' | '.join(cells)} |")
