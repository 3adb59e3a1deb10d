"""Random walk of photons below a smooth boundary, as a reference that is independent of
diffusion theory.

The medium is semi-infinite, with Henyey-Greenstein scattering and exact Fresnel
reflection at its surface (Prahl et al. 1989, "A Monte Carlo model of light propagation
in tissue"). The walk is simulated once without absorption, in units of 1/sigma_s'.
Absorption is applied afterwards as exp(-sigma_a path), which is exact, so that one walk
is valid for every wavelength and site.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb.optics import _walk_kernels

Array = NDArray[np.float64]
EVENTS_PER_PACKET = 6  # memory reserved; two to three are used
BATCHES = 16


@dataclass(frozen=True)
class Walk:
    """Escapes of photons in a walk without absorption; lengths in units of 1/sigma_s'."""

    radius: NDArray[np.float32]  # (m,) distance between entry and escape
    path: NDArray[np.float32]  # (m,) length of the path before the escape
    weight: NDArray[np.float32]  # (m,) fraction of the packet that escapes
    batch: NDArray[np.uint8]  # (m,) index of the independent batch of packets
    packets: int
    longest: float  # length of the path after which packets are discarded


def random_walk(
    packets: int,
    *,
    eta: float,
    anisotropy: float = 0.8,
    longest: float = 240.0,
    rng: np.random.Generator,
) -> Walk:
    """Simulate the random walk of photon packets that enter along the normal.

    Parameters
    ----------
    packets
        Number of packets.
    eta
        Index of refraction of the medium relative to air.
    anisotropy
        Mean cosine g of the Henyey-Greenstein phase function; 0 is isotropic.
    longest
        Length of the path, in units of 1/sigma_s', after which a packet is discarded.
        The error is below exp(-longest sigma_a/sigma_s').
    rng
        Random generator. Each batch has its own stream, so that the result does not
        depend on the number of threads.

    Returns
    -------
    Walk
        Escapes in the order of the batches.
    """
    per_batch = max(packets // BATCHES, 1)

    def run(stream: np.random.Generator) -> NDArray[np.float32]:
        events = np.empty((per_batch * EVENTS_PER_PACKET + 64, 3), np.float32)
        count = _walk_kernels.walk(stream, per_batch, anisotropy, eta, longest, events)
        if count == len(events):
            raise ValueError(
                "eta must be an index of refraction with at most "
                f"{EVENTS_PER_PACKET} escapes per packet, found {eta}"
            )
        return events[:count]

    with ThreadPoolExecutor(2) as pool:
        parts = list(pool.map(run, rng.spawn(BATCHES)))
    batch = np.repeat(np.arange(BATCHES, dtype=np.uint8), [len(part) for part in parts])
    radius, path, weight = np.concatenate(parts).T
    return Walk(
        radius.copy(), path.copy(), weight.copy(), batch, per_batch * BATCHES, longest
    )


def total_reflectance(
    walk: Walk, sigma_a: float, sigma_s_prime: float
) -> tuple[float, float]:
    """Diffuse reflectance per photon that enters, and its standard error from the batches."""
    escaped = walk.weight * np.exp(
        -(sigma_a / sigma_s_prime) * walk.path.astype(np.float64)
    )
    batch = np.bincount(walk.batch, escaped, BATCHES) * BATCHES / walk.packets
    return float(batch.mean()), float(batch.std(ddof=1) / np.sqrt(BATCHES))


def radial_profile(
    walk: Walk, sigma_a: float, sigma_s_prime: float, edges: Array
) -> tuple[Array, Array]:
    """R(r) in mm^-2 per photon that enters, as mean over rings between `edges` (k + 1,)
    mm, and its standard error.
    """
    escaped = walk.weight * np.exp(
        -(sigma_a / sigma_s_prime) * walk.path.astype(np.float64)
    )
    ring = np.searchsorted(edges, walk.radius / sigma_s_prime, side="right") - 1
    count = len(edges) - 1
    inside = (ring >= 0) & (ring < count)
    index = walk.batch[inside].astype(np.int64) * count + ring[inside]
    energy = np.bincount(index, escaped[inside], BATCHES * count).reshape(
        BATCHES, count
    )
    density = energy * (BATCHES / walk.packets) / (np.pi * np.diff(edges**2))
    return density.mean(axis=0), density.std(axis=0, ddof=1) / np.sqrt(BATCHES)
