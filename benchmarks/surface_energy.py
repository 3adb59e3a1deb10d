"""The fraction of light that the surface of skin reflects in total, from measured spectra
and from refractive indices (docs/howto/population.md).

    python -m benchmarks surface_energy SPECTRA.csv

SPECTRA.csv has one reading of a spectrophotometer with the specular component included in
each row: the columns origin (laboratory), ethnicity, body_location, and R400 to R700, the
reflectance by wavelength. The part that is white and independent of pigment is s in
R(blue) = s + c (R(red) - s)^p.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from skindb.optics.fresnel import fresnel_reflectance
from skindb.reflectance.ggx import GGX

FACE = ("cheek", "forehead", "chin", "neck", "cheek_bone")
ARM = ("inner_arm", "outer_arm")
HAND = ("back_of_hand",)
BLUE = ("R400", "R420", "R440")
SCATTER = 0.02  # of readings about the curve, beyond which they count less
MIN_READINGS = 500
INDICES = (1.40, 1.45, 1.51, 1.53)
ROUGHNESS = (0.1, 0.3, 0.5)


def white_part(red: NDArray[np.float64], blue: NDArray[np.float64]) -> float:
    """s by robust least squares."""
    good = np.isfinite(red + blue) & (blue > 0.005) & (red > 0.05)

    def misfit(x: NDArray[np.float64]) -> NDArray[np.float64]:
        coloured = np.maximum(red[good] - x[0], 1e-3)
        return np.asarray((x[0] + x[1] * coloured ** x[2] - blue[good]) / SCATTER)

    bounds = ([0, 0, 0.3], [0.2, 5, 8])
    return float(
        least_squares(misfit, [0.03, 0.5, 1.5], loss="soft_l1", bounds=bounds).x[0]
    )


def row(name: str, part: NDArray[np.void]) -> list[str]:
    """White part of some readings at each wavelength in blue."""
    values = [f"{white_part(part['R650'], part[blue]):.3f}" for blue in BLUE]
    return [name, str(len(part)), *values]


def spectrum_rows(spectra: Path) -> list[list[str]]:
    """White part of all readings and of parts of them."""
    table = np.genfromtxt(
        spectra, delimiter=",", names=True, dtype=None, encoding="utf-8"
    )
    sites = {"face": FACE, "arms": ARM, "back of the hand": HAND}
    table = table[np.isin(table["body_location"], sum(sites.values(), ()))]
    rows = [["skin spectra: white part", "readings", *BLUE], row("all", table)]
    for name, places in sites.items():
        rows.append(row(name, table[np.isin(table["body_location"], places)]))
    for column in ("origin", "ethnicity"):
        for value in np.unique(table[column]):
            part = table[table[column] == value]
            if len(part) > MIN_READINGS:
                rows.append(row(f"{column} {value}", part))
    return rows


def main(spectra: Path) -> None:
    """Print the white part of readings, and the reflection of dielectrics."""
    heading, *rows = spectrum_rows(spectra)
    for cells in (heading, ["---"] * len(heading), *rows):
        print(f"| {' | '.join(cells)} |")
    rough = " | ".join(f"GGX, alpha {alpha}" for alpha in ROUGHNESS)
    print(f"\n| refractive index | smooth | {rough} |\n|---|---|---|---|---|")
    for index in INDICES:
        lobes = np.array([[1.0, alpha] for alpha in ROUGHNESS])
        smooth = float(fresnel_reflectance(1.0, index))
        values = [smooth, *GGX(index).normal_reflectance(lobes)[0]]
        print(f"| {index} | {' | '.join(f'{value:.3f}' for value in values)} |")
