"""Sanity checks of lights, lenses, sensors, white targets and fibre probes: limits of
their parameters.

The limits are about ten times beyond any device known to us: they find wrong units and
slips, not unusual devices.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault

Array = NDArray[np.float64]
EXPOSURE_SECONDS = (1e-9, 1e5)  # s: from a laser pulse to a day
MAX_DISC_RADIUS_MM = 2_000.0  # mm: the largest soft boxes have a radius of 1 m
# exponent of the cosine: a narrow spot, half as bright at 1.5 degrees from the axis
MAX_FALLOFF = 2_000.0
# mm from the origin: 100 m; domes have a radius of 0.5 to 5 m
MAX_DEVICE_DISTANCE_MM = 100_000.0
TARGET_HALF_SIZES_MM = (1.0, 2_000.0)  # mm: from a patch of a colour chart to a wall
MIN_VIGNETTE_GAIN = 0.05  # at a corner: a lens that darkens by 4 stops has 0.06
# relative to the principal point; lenses darken towards the corners
MAX_VIGNETTE_GAIN = 4.0
# distortion at the farthest corner; fisheyes have 0.5 and 0.01
RADIAL_FACTORS = (0.1, 10.0)
MAX_TANGENTIAL = 0.5
# electrons at the white level; cameras of phones have thousands
MIN_FULL_ELECTRONS = 100.0
MAX_READ_NOISE_FRACTION = 0.1  # of the white level; cameras have at most 0.01
# mm, of the farthest fibre: light does not scatter within a tenth of a millimetre
FIBRE_DISTANCES_MM = (0.1, 300.0)
MAX_BALL_RADIUS_MM = 1_000.0  # mm; mirror balls have 5 to 200
MAX_FIBRE_RADIUS_MM = 10.0  # mm; fibres of probes have 0.02 to 1
# of the sum of the radii [px]: fibres may touch, and circles are approximate
MIN_CENTRE_DISTANCE_FRACTION = 0.9
# of a fibre's gain to the median one; fibres of a probe differ by tens of percent
MAX_GAIN_RATIO = 100.0
MAX_GAIN_ERROR = 1.0  # relative
# kPa: from a vacuum to the double of it; suction has no more than the air
GAUGE_PRESSURES_KPA = (-101.4, 101.4)
# kPa: suction that holds a probe has 5 to 10, and 40 leave a bruise
USUAL_PRESSURES_KPA = (-40.0, 1.0)
# of the incident light; 1 by energy conservation, doubled for errors of scale and gain
MAX_RETURNED_FRACTION = 2.0


def fibre_faults(
    where: str, distance: Array, centre: Array, radius: Array, face: float
) -> list[Fault]:
    """Faults of fibres that are at one distance, in another unit, or overlap.

    Parameters
    ----------
    where
        File of the probe.
    distance, centre, radius
        (n,) mm from the source, (n, 2) and (n,) px.
    face
        Radius of a fibre and of the source in mm; 0 if unknown.
    """
    if not len(distance):
        return []
    faults, (least, most) = [], FIBRE_DISTANCES_MM
    if not least <= distance.max() <= most:
        rule = (
            f"distances must be in mm, and the farthest fibre must be {least:g} to "
            f"{most:g} mm from the source"
        )
        faults.append(
            Fault(
                f"{where}[fibres]",
                rule,
                f"{distance.max():g} mm",
                "give the distances in mm",
            )
        )
    elif len(distance) > 1 and np.ptp(distance) == 0:
        rule = "a profile needs fibres at different distances"
        cure = "give each fibre its own distance"
        faults.append(
            Fault(
                f"{where}[fibres]",
                rule,
                f"all {len(distance)} at {distance[0]:g} mm",
                cure,
            )
        )
    if face > 0 and (distance < 2 * face).any():
        i = int(distance.argmin())
        rule = (
            "fibres must not overlap the source: distance must be at least twice "
            f"fibre_radius, {2 * face:g} mm"
        )
        cure = (
            "distance is measured between the centres; both are in mm, and "
            "fibre_radius is not the diameter"
        )
        faults.append(
            Fault(f"{where}[fibres][{i}][distance]", rule, f"{distance[i]:g} mm", cure)
        )
    faults += _overlap_faults(where, centre, radius)
    return faults


def _overlap_faults(where: str, centre: Array, radius: Array) -> list[Fault]:
    """Fault of fibres that overlap in the picture; it names the pair that overlaps most."""
    gap = np.linalg.norm(centre[:, None] - centre, axis=-1)
    closeness = gap / (MIN_CENTRE_DISTANCE_FRACTION * (radius[:, None] + radius))
    closeness[np.tril_indices(len(radius))] = np.inf
    count = int((closeness < 1).sum())
    if not count:
        return []
    i, j = np.unravel_index(closeness.argmin(), closeness.shape)
    rule = "fibres must not overlap in the picture"
    cure = "correct centre and radius, in pixels"
    found = (
        f"{count} pairs, such as {i} and {j}: {gap[i, j]:.3g} px apart, radii "
        f"{radius[i]:g} and {radius[j]:g} px"
    )
    return [Fault(f"{where}[fibres]", rule, found, cure)]


def gain_faults(where: str, gain: Array) -> list[Fault]:
    """Faults of gains (n, 3) that are far from the median of their channel."""
    ratio = gain / np.median(gain, axis=0)
    off = np.maximum(ratio, 1 / ratio).max(axis=1)
    rule = (
        f"the gain of a fibre must be at most {MAX_GAIN_RATIO:g} times as large or "
        "small as the median gain"
    )
    cure = "measure the flat field of the fibre again"
    return [
        Fault(f"{where}[gain]", rule, f"{x:.3g} times, of fibre {i}", cure)
        for i, x in enumerate(off)
        if x > MAX_GAIN_RATIO
    ]


def energy_fault(
    where: str, sites: Sequence[str], distance: Array, value: Array, error: Array
) -> Fault | None:
    """Fault of profiles (site, fibre, 3) in mm^-2 that return more light than is incident.

    A profile that falls with the distance returns at least pi r^2 R(r) of the light within r.
    """
    returned = np.pi * distance[:, None] ** 2 * (value - 3 * error)
    if not (returned > MAX_RETURNED_FRACTION).any():
        return None
    site, fibre = divmod(int(np.nanargmax(returned)) // value.shape[2], value.shape[1])
    rule = (
        f"R at r mm must be at most {MAX_RETURNED_FRACTION:g} / (pi r^2): skin cannot "
        "return more light"
    )
    found = f"{np.nanmax(returned):.3g} / (pi r^2) at fibre {fibre} of {sites[site]}"
    cure = (
        "correct scale, gain, seconds or distance; use a scale of null if it is unknown"
    )
    return Fault(f"{where}[scale]", rule, found, cure)


def distortion_fault(where: str, lens: Array, K: Array, size: Array) -> Fault | None:
    """Fault of a distortion k1 k2 p1 p2 k3 that is too large at the corners of the picture."""
    corners = (np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size - K[:2, 2]) / [
        K[0, 0],
        K[1, 1],
    ]
    k1, k2, p1, p2, k3 = lens
    r2 = float((corners**2).sum(axis=1).max())
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    tangential = 3 * np.hypot(p1, p2) * np.sqrt(r2)
    if (
        RADIAL_FACTORS[0] <= radial <= RADIAL_FACTORS[1]
        and tangential <= MAX_TANGENTIAL
    ):
        return None
    rule = (
        f"1 + k1 r^2 + k2 r^4 + k3 r^6 must be {RADIAL_FACTORS[0]:g} to "
        f"{RADIAL_FACTORS[1]:g}, and 3 |p| r at most "
        f"{MAX_TANGENTIAL:g}, at the corners of the picture"
    )
    found = f"{radial:.3g} and {tangential:.3g} at r = {np.sqrt(r2):.3g}"
    return Fault(
        f"{where}[distortion]",
        rule,
        found,
        "the order is k1, k2, p1, p2, k3, of distances over the focal length",
    )


def noise_fault(where: str, read_noise: float, full_electrons: float) -> Fault | None:
    """Fault of a sensor with too few electrons, or too much noise, for a picture."""
    if full_electrons < MIN_FULL_ELECTRONS:
        rule = (
            "electrons_per_dn * (white_level - black_level) must be at least "
            f"{MIN_FULL_ELECTRONS:g} electrons"
        )
        return Fault(
            f"{where}[electrons_per_dn]",
            rule,
            f"{full_electrons:.3g}",
            "measure it by a photon transfer curve",
        )
    if read_noise > MAX_READ_NOISE_FRACTION * full_electrons:
        rule = (
            f"read noise must be at most {MAX_READ_NOISE_FRACTION:g} of the electrons "
            "at the white level"
        )
        found = f"{read_noise:.3g} of {full_electrons:.3g} electrons"
        return Fault(
            f"{where}[read_noise_e]",
            rule,
            found,
            "give it in electrons: values times electrons_per_dn",
        )
    return None
