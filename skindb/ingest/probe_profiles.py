"""Fibre profiles of the contact probe from its bracketed photographs (Weyrich et al.
2005, section 8).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb.calibration.fibres import placement_signal
from skindb.calibration.isotropy import MIN_SIGNAL_TO_NOISE
from skindb.errors import Fault, InputError
from skindb.format.device_checks import energy_fault
from skindb.format.devices import ProbeRecord
from skindb.format.frames import Digests
from skindb.format.json_file import MAX_MAGNITUDE

Array = NDArray[np.float64]
MIN_LIT_FIBRES = 3  # of a site: a decay and a level, and one fibre that confirms them


@dataclass(frozen=True)
class Profiles:
    """R(r) of every site, in mm^-2 if `scale_known`, otherwise up to a factor."""

    value: Array  # (site, fibre, 3) mean over placements
    error: Array  # (site, fibre, 3) standard error
    scale_known: bool
    placements: tuple[Array, ...]  # for each site (placement, fibre, 3)
    # (site, 3) relative standard deviation between placements; NaN of a single one
    repeatability: Array


def fibre_profiles(probe: ProbeRecord, digests: Digests | None = None) -> Profiles:
    """Mean signal of each fibre's pixels over all brackets, times scale, divided by gain.

    The error combines photons, read noise and quantisation, a few 1e-4 near the source,
    with the gains: about 4e-3, independent between fibres but the same at every site.

    Raises
    ------
    InputError
        With every frame that cannot be decoded, and fibres that lie outside the picture.
    """
    found = list[list[tuple[Array, Array]]]()
    faults = list[Fault]()
    for site in probe.sites:
        try:
            found.append(
                [
                    placement_signal(probe, site, placement, digests)
                    for placement in probe.placements[site]
                ]
            )
        except InputError as problem:
            faults += problem.faults
    if faults:
        # the faults of the fibres repeat at every site
        raise InputError(dict.fromkeys(faults))
    if faults := _light_faults(probe, found):
        raise InputError(faults)
    factor = (probe.scale or 1.0) / probe.gain
    each = [
        (np.stack([v for v, _ in one]), np.stack([e for _, e in one])) for one in found
    ]
    together = [combine_placements(value, error) for value, error in each]
    value, error, spread = (np.array(column) for column in zip(*together, strict=True))
    value, error = value * factor, np.hypot(error, probe.gain_error * value) * factor
    if (np.fmax(np.abs(value), error) > MAX_MAGNITUDE).any():
        rule = f"scale * signal / gain must be at most {MAX_MAGNITUDE:g}"
        cure = "correct scale, gain and seconds"
        raise InputError(
            Fault(f"{probe.file}[gain]", rule, f"{np.nanmax(np.abs(value)):.3g}", cure)
        )
    known = probe.scale is not None
    fault = (
        energy_fault(str(probe.file), probe.sites, probe.distance, value, error)
        if known
        else None
    )
    if fault is not None:
        raise InputError(fault)
    return Profiles(value, error, known, tuple(one * factor for one, _ in each), spread)


def _light_faults(
    probe: ProbeRecord, signals: list[list[tuple[Array, Array]]]
) -> list[Fault]:
    """Faults of placements whose frames are black or white: nearly no fibre shows light
    that is clear of noise.
    """
    faults = list[Fault]()
    least = min(MIN_LIT_FIBRES, len(probe.fibres))
    rule = f"at least {least} fibres must show light, and not be saturated in every bracket"
    cure = "place the probe and take its frames again, or remove the site"
    for site, placements in zip(probe.sites, signals, strict=True):
        for placement, (value, error) in zip(
            probe.placements[site], placements, strict=True
        ):
            lit = int((value > MIN_SIGNAL_TO_NOISE * error).any(axis=1).sum())
            if lit < least:
                at = (
                    f"site {site}, placement {placement}"
                    if placement
                    else f"site {site}"
                )
                saturated = int(np.isnan(value).all(axis=1).sum())
                found = f"{at}: {lit} of {len(value)}, {saturated} saturated"
                faults.append(Fault(f"{probe.file}[frames]", rule, found, cure))
    return faults


def combine_placements(value: Array, error: Array) -> tuple[Array, Array, Array]:
    """Mean of repeated placements of the probe at one site, its standard error, and
    their repeatability.

    Each placement changes the coupling of the fibres to the skin. Its relative standard
    deviation is estimated from all fibres of a channel together, after the variance of
    photons and read noise is subtracted, and is part of the error of the mean. For a
    single placement it is unknown, and the error contains noise alone.

    Parameters
    ----------
    value, error
        (placement, fibre, 3) signals and their standard errors due to noise.

    Returns
    -------
    mean, error : ndarray
        (fibre, 3); NaN where a placement lacks the fibre.
    repeatability : ndarray
        (3,) relative standard deviation between placements; NaN of a single one.
    """
    count = len(value)
    mean = value.mean(axis=0)
    noise = np.sqrt((error**2).sum(axis=0)) / count
    if count == 1:
        return mean, noise, np.full(3, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = (value.var(axis=0, ddof=1) - (error**2).mean(axis=0)) / mean**2
        # far fibres carry little information
        weight = np.where(np.isfinite(relative), (mean / noise) ** 2, 0.0)
        spread = np.sqrt(
            np.maximum(np.nansum(weight * relative, axis=0) / weight.sum(axis=0), 0.0)
        )
    return mean, np.hypot(noise, spread * np.abs(mean) / np.sqrt(count)), spread
