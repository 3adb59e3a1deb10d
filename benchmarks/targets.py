"""Measured BRDFs outside the dictionary, fitted with its 59 materials and with reduced
bases (docs/results).

    python -m benchmarks targets PATH... [--only WORD...] [--surfels N] [--noise FRACTION]

PATH is a file of Lafortune lobes (.csv with term, Cxy_*, Cz_*, n_* of r, g, b and a row
diffuse_albedo, as fitted to skin by Marschner et al. 1999) or of networks (.npz with
675 weights per material, Sztrajman et al. 2021); --only selects networks whose name
contains a word. Surfels with random normals are seen under 150 lights by 16 cameras;
the diffuse and the surface part are estimated with the public functions.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from benchmarks.curves_surface import spiral
from skindb.fit import estimate_diffuse_reflectance, fit_surface, reduce_basis, refit
from skindb.optics.angles import half_difference
from skindb.reflectance.dictionary import embedded_dictionary
from skindb.reflectance.mixture import Mixture
from skindb.schema import dataset

MODES = ("linear", "perceptual")
SIZES = range(1, 9)
LAYERS = ((6, 21), (21, 21), (21, 3))
# BRDF (..., 3) sr^-1 of local directions
Target = Callable[[np.ndarray, np.ndarray], np.ndarray]


def lafortune(path: Path) -> Target:
    """kd/pi + sum of (Cxy (x x' + y y') + Cz z z')^n (Lafortune et al. 1997)."""
    with path.open() as file:
        rows = {row["term"]: row for row in csv.DictReader(file)}
    values = {
        term: [[row[f"{key}_{c}"] for c in "rgb"] for key in ("Cxy", "Cz", "n")]
        for term, row in rows.items()
    }
    albedo = np.array(values.pop("diffuse_albedo")[0], float)
    lobes = np.array(list(values.values()), float)

    def evaluate(wi, wo):
        flat = (wi[..., :2] * wo[..., :2]).sum(-1, keepdims=True)
        high = wi[..., 2:] * wo[..., 2:]
        return albedo / np.pi + sum(
            np.maximum(xy * flat + z * high, 0) ** n for xy, z, n in lobes
        )

    return evaluate


def network(weights: np.ndarray) -> Target:
    """Network 6-21-21-3 on half and difference vector, with ReLU and at the end
    max(exp(x) - 1, 0).
    """
    parts = []
    start = 0
    for a, b in LAYERS:
        parts.append(
            (
                weights[start : start + a * b].reshape(a, b),
                weights[start + a * b : start + a * b + b],
            )
        )
        start += a * b + b

    def evaluate(wi, wo):
        h, d, phi = half_difference(wi, wo)
        x = np.stack(
            [
                np.sin(h),
                0 * h,
                np.cos(h),
                np.sin(d) * np.cos(phi),
                np.sin(d) * np.sin(phi),
                np.cos(d),
            ],
            axis=-1,
        )
        for matrix, bias in parts[:-1]:
            x = np.maximum(x @ matrix + bias, 0)
        return np.maximum(np.expm1(x @ parts[-1][0] + parts[-1][1]), 0)

    return evaluate


def read_targets(paths: list[Path], words: list[str]) -> dict[str, Target]:
    """Targets of all files by name; networks only if their name contains one of the words."""
    targets: dict[str, Target] = {}
    for path in paths:
        if path.suffix == ".csv":
            targets[path.stem] = lafortune(path)
            continue
        with np.load(path) as nets:
            targets |= {
                n: network(nets[n])
                for n in nets.files
                if not words or any(word in n for word in words)
            }
    return targets


def sampled(target: Target, *, surfels: int, noise: float, seed: int = 0) -> xr.Dataset:
    """Samples f cos(theta_i) of a ball in a dome, with true normals; every target has
    the same geometry.
    """
    rng = np.random.default_rng(seed)
    light = spiral(150, 1000.0, 1.0)
    camera = spiral(16, 1200.0, 0.8)
    normal = rng.normal(size=(surfels, 3)) * [0.5, 0.5, 0] + [0, 0, 1]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    sample = np.full((surfels, len(light), len(camera), 3), np.nan, np.float16)
    for n, out in zip(normal, sample, strict=True):
        frame = np.linalg.qr(np.c_[n, np.eye(3)[:, :2]])[0]
        frame[:, 0] = n
        wi, wo = (t - 90 * n for t in (light, camera))
        wi, wo = (
            (w / np.linalg.norm(w, axis=1, keepdims=True)) @ frame[:, [1, 2, 0]]
            for w in (wi, wo)
        )
        a, b = np.nonzero((wi[:, None, 2] > 0.1) & (wo[None, :, 2] > 0.1))
        value = target(wi[a], wo[b]) * wi[a, 2:]
        out[a, b] = value * (1 + noise * rng.normal(size=value.shape))
    ball = {
        "reflectance_sample": sample,
        "surfel_position": 90 * normal,
        "surfel_area": np.ones(surfels),
        "shading_normal": normal,
        "light_position": light,
        "camera_position": camera,
        "noise_floor": 0.0,
    }
    skin = dataset(ball)
    return skin.merge(estimate_diffuse_reflectance(skin)[["diffuse_reflectance"]])


def _cell(fitted, linear, perceptual):
    return (
        f"{100 * float(fitted[linear].median()):.1f} / "
        f"{100 * float(fitted[perceptual].median()):.1f}"
    )


def _table(heads, rows):
    print("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|")
    for row in rows:
        print("| " + " | ".join(row) + " |")


def print_modes(samples: dict[str, xr.Dataset]) -> dict[str, xr.Dataset]:
    """Print residuals of the full dictionary by mode; returns the perceptual fits."""
    surface = Mixture.of_dictionary(embedded_dictionary())
    rows = []
    perceptual = {}
    for name, ds in samples.items():
        fits = {mode: fit_surface(ds, surface=surface, mode=mode) for mode in MODES}
        perceptual[name] = fits["perceptual"]
        rd = ds["diffuse_reflectance"].median("surfel").values
        cells = [
            _cell(fit, "dictionary_residual", "dictionary_residual_perceptual")
            for fit in fits.values()
        ]
        rows.append([name, " ".join(f"{v:.2f}" for v in rd), *cells])
    print(
        "RMS residual over RMS of the samples with diffuse light, linear / in "
        "cube-root space [%]; median surfel\n"
    )
    _table(["target", "estimated R_d", *MODES], rows)
    return perceptual


def print_sizes(
    samples: dict[str, xr.Dataset], perceptual: dict[str, xr.Dataset]
) -> None:
    """Print residuals of bases that are common to all targets, by size."""
    fitted = xr.concat(
        [perceptual[name].merge(ds[["surfel_area"]]) for name, ds in samples.items()],
        "surfel",
        combine_attrs="override",
    )
    rows = {name: [name] for name in samples}
    for k in SIZES:
        basis = reduce_basis(
            fitted,
            dictionary=embedded_dictionary(),
            rng=np.random.default_rng(0),
            k=k,
            in_metric=True,
        )
        for name, ds in samples.items():
            fit = refit(ds, basis=basis)
            rows[name].append(_cell(fit, "fit_residual", "fit_residual_perceptual"))
    print("\nThe same with k components common to all targets, mode perceptual\n")
    _table(["target", *(f"k = {k}" for k in SIZES)], list(rows.values()))


def main(
    path: Sequence[Path],
    *,
    only: Sequence[str] = (),
    surfels: int = 60,
    noise: float = 0.0,
) -> None:
    """Print two tables: residuals of the full dictionary by mode, and of reduced bases by size."""
    samples = {
        name: sampled(target, surfels=surfels, noise=noise)
        for name, target in read_targets(path, only).items()
    }
    if not samples:
        sys.exit(
            f"no target of these files has a name that contains {' or '.join(only)}"
        )
    print_sizes(samples, print_modes(samples))
