"""Coverage of the stated errors: fraction of true values within the 95 % interval, for
samples of the model.

    python -m benchmarks stated_errors [--surfels N] [--full]

Samples are diffuse light, surface lobes and noise (a fraction of the sample and a floor
in quadrature), made with the public functions of `skindb.optics`. Prints two Markdown
tables: normals and R_d by dome, noise and gloss; weights of two distinguishable lobes
and the surface reflectance, by mode and by known quantities. With N surfels, the
standard error of a coverage is sqrt(0.0475 / N).
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import xarray as xr

from benchmarks.curves_photometry import (
    ETA,
    SCAN_ERROR,
    Array,
    ModelSamples,
    model_samples,
)
from skindb.fit import estimate_diffuse_reflectance, estimate_normals, refit
from skindb.reflectance.separation import surface_lobes
from skindb.reflectance.tables import directional_albedo, stored_brdf
from skindb.schema import dataset, label

QUICK = ((32, 6), (60, 8))
FULL = (*QUICK, (150, 16))
# fraction of the sample, floor [sr^-1]
NOISES = ((0.01, 0.0), (0.05, 0.0), (0.01, 1e-3))
# 1.73: 95 % of the angles of two equal normal axes, over their RMS
ISOTROPIC_95 = float(np.sqrt(-np.log(0.05)))
BROAD_AND_NARROW = (2, 4)  # indices of the lobes used by the fit of R_d


def inside(values: Any, truth: Array, error: Any) -> str:
    """Percentage of values within 1.96 stated errors; mean and standard deviation of
    error over stated error.
    """
    z = (np.asarray(values, np.float64) - truth) / np.asarray(error, np.float64)
    z = z[np.isfinite(z)]
    return f"{100 * (np.abs(z) < 1.96).mean():.1f} ({np.mean(z):+.2f}, {np.std(z):.2f})"


def known_normals(skin: ModelSamples) -> dict[str, xr.Dataset]:
    """The samples with true normals, with estimated normals and their errors, and with
    estimated normals only.
    """
    turned = estimate_normals(skin.lumitexels, eta=ETA, scan_error=SCAN_ERROR)
    true = skin.lumitexels.assign(shading_normal=label("shading_normal", skin.normal))
    names = ["shading_normal", "normal_error"]
    return {
        "true": true,
        "found": skin.lumitexels.assign(turned[names]),
        "blind": skin.lumitexels.assign(turned[names[:1]]),
    }


def albedo_and_normals(
    rng: np.random.Generator, surfels: int, domes: tuple[tuple[int, int], ...]
) -> None:
    """Print the coverage of normals and of R_d, with true normals, and with estimated
    ones with and without errors.
    """
    print(
        "| dome | noise, floor | gloss | normal | R_d, true normal | R_d, "
        "estimated normal | without its error |"
    )
    print("|---|---|---|---|---|---|---|")
    for lights, cameras in domes:
        for noise, floor in NOISES:
            for gloss in (0.0, 0.3):
                skin = model_samples(
                    rng,
                    surfels=surfels,
                    lights=lights,
                    cameras=cameras,
                    noise=noise,
                    gloss=gloss,
                    floor=floor,
                )
                sets = known_normals(skin)
                shares = []
                cosine = (
                    (sets["found"]["shading_normal"].values * skin.normal)
                    .sum(1)
                    .clip(-1, 1)
                )
                angle = (
                    np.degrees(np.arccos(cosine))
                    < ISOTROPIC_95 * sets["found"]["normal_error"].values
                )
                for lumitexels in sets.values():
                    r = estimate_diffuse_reflectance(lumitexels, eta=ETA)
                    shares.append(
                        inside(
                            r["diffuse_reflectance"],
                            skin.diffuse,
                            r["diffuse_reflectance_error"],
                        )
                    )
                case = (
                    f"| {lights} x {cameras} | {noise:.0%}, {floor:g} | {gloss} | "
                    f"{100 * angle.mean():.1f} |"
                )
                print(case, " | ".join(shares), "|", flush=True)


def weights(
    rng: np.random.Generator, surfels: int, domes: tuple[tuple[int, int], ...]
) -> None:
    """Print the coverage of the active weights of two lobes and of the surface reflectance."""
    print(
        "\n| dome | noise, floor | mode | known | broad lobe | narrow lobe | "
        "surface reflectance | active |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for lights, cameras in domes:
        for noise, floor in ((0.002, 0.0), *NOISES):
            skin = model_samples(
                rng,
                surfels=surfels,
                lights=lights,
                cameras=cameras,
                noise=noise,
                gloss=0.2,
                floor=floor,
                lobes=BROAD_AND_NARROW,
            )
            case = f"| {lights} x {cameras} | {noise:.1%}, {floor:g}"
            cases = known_quantities(skin)
            for mode in ("linear", "perceptual"):
                for name, lumitexels in cases.items():
                    cells = weight_cells(skin, lumitexels, mode)
                    print(f"{case} | {mode} | {name} | {cells} |", flush=True)


def known_quantities(skin: ModelSamples) -> dict[str, xr.Dataset]:
    """The samples with true or estimated normals and diffuse reflectance."""
    sets = known_normals(skin)
    diffuse = label("diffuse_reflectance", skin.diffuse)
    cases = {"normal, R_d": sets["true"].assign(diffuse_reflectance=diffuse)}
    for name, key in (("normal", "true"), ("nothing", "found")):
        estimate = estimate_diffuse_reflectance(sets[key], eta=ETA)
        cases[name] = sets[key].merge(estimate)
    return cases


def weight_cells(skin: ModelSamples, lumitexels: xr.Dataset, mode: str) -> str:
    """Coverage of both weights and of the surface reflectance, and active weights."""
    table, _ = surface_lobes()
    table = np.ascontiguousarray(table[..., list(BROAD_AND_NARROW)])
    basis = dataset({"basis_brdf": stored_brdf(table)})
    strength = directional_albedo(table, [1.0])[0]
    truth = skin.weight[:, list(BROAD_AND_NARROW)]
    fit = refit(lumitexels, basis=basis, mode=mode, eta=ETA)
    weight = fit["basis_weight"].values
    error = fit["basis_weight_error"].values
    cells = [inside(weight[:, k], truth[:, k], error[:, k]) for k in range(2)]
    reflectance = fit["surface_reflectance"]
    reflectance_error = fit["surface_reflectance_error"]
    cells.append(inside(reflectance, truth @ strength, reflectance_error))
    return " | ".join([*cells, f"{100 * np.isfinite(error).mean():.0f} %"])


def main(
    *,
    surfels: int = 400,
    full: Annotated[bool, "Include the dome of 150 lights and 16 cameras."] = False,
) -> None:
    domes = FULL if full else QUICK
    print(
        "Percentage within 1.96 stated errors (mean, standard deviation of error "
        "over stated error)\n"
    )
    albedo_and_normals(np.random.default_rng(11), surfels, domes)
    weights(np.random.default_rng(12), surfels, domes[1:2])
