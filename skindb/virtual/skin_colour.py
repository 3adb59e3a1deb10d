"""Measured mean colours of facial skin by group and site, and the two axes along which skin varies.

Numbers: International Skin Spectra Archive (Lu et al. 2025), reflectance spectra of
faces converted to scene-linear Rec. 709 under D65, means over people.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SITES = ("forehead", "cheek", "nose", "chin", "neck")
MEAN: dict[tuple[str, str], tuple[tuple[float, float, float], ...]] = {
    ("european", "female"): (
        (0.4567, 0.2712, 0.2042),
        (0.4668, 0.2730, 0.2124),
        (0.4187, 0.2380, 0.1730),
        (0.4607, 0.2508, 0.1960),
        (0.4718, 0.3185, 0.2268),
    ),
    ("european", "male"): (
        (0.4189, 0.2306, 0.1721),
        (0.4308, 0.2352, 0.1817),
        (0.4033, 0.2163, 0.1637),
        (0.3590, 0.1991, 0.1507),
        (0.4781, 0.2874, 0.2094),
    ),
    ("east_asian", "female"): (
        (0.4240, 0.2521, 0.1737),
        (0.4644, 0.2883, 0.2155),
        (0.4205, 0.2583, 0.1719),
        (0.4537, 0.2617, 0.1846),
        (0.4345, 0.2841, 0.1788),
    ),
    ("east_asian", "male"): (
        (0.3803, 0.2092, 0.1417),
        (0.4083, 0.2316, 0.1691),
        (0.3906, 0.2219, 0.1518),
        (0.3738, 0.2079, 0.1444),
        (0.4376, 0.2515, 0.1602),
    ),
    ("african", "female"): (
        (0.2186, 0.1149, 0.0718),
        (0.2176, 0.1153, 0.0697),
        (0.2517, 0.1259, 0.0781),
        (0.1935, 0.0992, 0.0659),
        (0.1721, 0.0920, 0.0554),
    ),
    ("african", "male"): (
        (0.1361, 0.0732, 0.0526),
        (0.1516, 0.0809, 0.0556),
        (0.1864, 0.0899, 0.0600),
        (0.1474, 0.0795, 0.0581),
        (0.1373, 0.0726, 0.0483),
    ),
    ("south_asian", "female"): (
        (0.3552, 0.2046, 0.1327),
        (0.3898, 0.2364, 0.1554),
        (0.3849, 0.2200, 0.1455),
        (0.3828, 0.2092, 0.1413),
        (0.3301, 0.2001, 0.1144),
    ),
    ("south_asian", "male"): (
        (0.3053, 0.1630, 0.1037),
        (0.2764, 0.1619, 0.1023),
        (0.3598, 0.1866, 0.1246),
        (0.2639, 0.1536, 0.1032),
        (0.2790, 0.1511, 0.0875),
    ),
}
# relative standard deviation between people, green, cheek
SPREAD: dict[tuple[str, str], float] = {
    ("european", "female"): 0.155,
    ("european", "male"): 0.189,
    ("east_asian", "female"): 0.142,
    ("east_asian", "male"): 0.132,
    ("african", "female"): 0.310,
    ("african", "male"): 0.279,
    ("south_asian", "female"): 0.169,
    ("south_asian", "male"): 0.301,
}
BLOOD_SPREAD = 0.06  # log green, between people of equal melanin


def _axis(light: Array, dark: Array) -> Array:
    """Direction from a lighter to a darker colour in log reflectance, 1 in green."""
    step = np.log(light) - np.log(dark)
    return np.asarray(step / step[1])


_CHEEK, _CHIN, _NECK = (SITES.index(site) for site in ("cheek", "chin", "neck"))
# melanin: difference between the cheeks of two groups; haemoglobin: difference between
# the ruddy chin and pale neck
MELANIN = _axis(
    np.array(MEAN["european", "female"][_CHEEK]),
    np.array(MEAN["african", "female"][_CHEEK]),
)
HAEMOGLOBIN = _axis(
    np.array(MEAN["european", "female"][_NECK]),
    np.array(MEAN["european", "female"][_CHIN]),
)
