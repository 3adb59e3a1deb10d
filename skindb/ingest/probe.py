"""Fibre profiles of the contact probe from its bracketed photographs (Weyrich et al. 2005, section 8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.ingest.devices import ProbeRecord
from skindb.ingest.frames import Digests, Frame, read_frames
from skindb.ingest.radiance import merge_exposures

Array = NDArray[np.float64]
# share of a fibre's pixels that may be lost in a channel (stuck ones): a face half as bright again in its middle as on
# average then reads 0.5 % low, the default error of a gain; more would be read from the rim
LOST = 0.01


@dataclass(frozen=True)
class Profiles:
    """R(r) of every site; `scale_known`: in mm^-2, else up to a factor."""

    value: Array  # (site, fibre, 3)
    error: Array  # (site, fibre, 3) standard error
    scale_known: bool


def fibre_profiles(probe: ProbeRecord, digests: Digests | None = None) -> Profiles:
    """Mean signal of each fibre's pixels over all brackets, times scale, over gain.

    The error is that of photons, read noise and quantisation, a few 1e-4 near the source, and that of the gains: some
    4e-3, independent from fibre to fibre but the same at every site.

    Raises
    ------
    InputError
        Every frame that cannot be decoded, and fibres that lie outside the picture.
    """
    values, errors, faults = [], [], list[Fault]()
    for site in probe.sites:
        try:
            value, error = _site(probe, read_frames([probe.frame(site, e) for e in probe.exposures], None, digests))
        except InputError as problem:
            faults += problem.faults
            continue
        values.append(value)
        errors.append(error)
    if faults:
        raise InputError(faults)
    factor = (probe.scale or 1.0) / probe.gain
    value, error = np.array(values), np.array(errors)
    return Profiles(value * factor, np.hypot(error, probe.gain_error * value) * factor, probe.scale is not None)


def _site(probe: ProbeRecord, frames: list[Frame]) -> tuple[Array, Array]:
    """Signal per second (fibre, 3) and its standard error; NaN where pixels are saturated in every bracket."""
    masks = fibre_pixels(probe, frames[0].shape[:2])
    rows, columns = np.nonzero(np.any(masks, axis=0))
    # only the fibres' pixels are merged: a few per cent of the picture
    strips = [frame[rows, columns][None] for frame in frames]
    radiance, error, _ = merge_exposures(strips, tuple(probe.exposures.values()), probe.sensor)
    value, spread = np.full((len(masks), 3), np.nan), np.full((len(masks), 3), np.nan)
    for i, mask in enumerate(masks):
        own = mask[rows, columns]
        signal, noise = radiance[0, own].astype(np.float64), error[0, own].astype(np.float64)
        for c in range(3):
            usable = np.isfinite(signal[:, c])
            if 1 - usable.mean() <= LOST:
                value[i, c] = signal[usable, c].mean()
                spread[i, c] = np.sqrt((noise[usable, c] ** 2).sum()) / usable.sum()
    return value, spread


def fibre_pixels(probe: ProbeRecord, shape: tuple[int, ...]) -> list[NDArray[np.bool_]]:
    """Mask (h, w) of each fibre: pixels whose centre is within its radius."""
    y, x = np.arange(shape[0])[:, None] + 0.5, np.arange(shape[1]) + 0.5
    masks = [(x - c[0]) ** 2 + (y - c[1]) ** 2 <= r * r for c, r in zip(probe.centre, probe.radius, strict=True)]
    faults = [
        Fault(
            f"fibre {probe.fibres[i]} (centre)",
            "a fibre must lie in the picture",
            f"no pixel of {shape[1]} x {shape[0]}",
        )
        for i, mask in enumerate(masks)
        if not mask.any()
    ]
    if faults:
        raise InputError(faults)
    return masks
