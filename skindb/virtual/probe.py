"""The virtual contact probe: profiles by a random walk of photons, and 23 bracketed
images of 28 fibres.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from skindb.cache import cached_arrays
from skindb.files import private_file
from skindb.optics.transport import Walk, radial_profile, random_walk
from skindb.types import AnyArray, Float64
from skindb.virtual.dome import Sensor, write_png
from skindb.virtual.skin import Site

# mm
FIBRES = 28
FIRST = 1.0
PITCH = 0.5
FIBRE_RADIUS = 0.25
# seconds; 2/3 stop apart
BRACKETS = 23
LONGEST = 24.0
SIGNAL = 1300.0  # full scales per second and mm^-2 at gain 1
# fibres a row of the image, pixels
COLUMNS = 7
CELL = 16
SPOT = 5.0
INSIDE = 4.0
GAIN_ERROR = 0.004
# mm, width of the rings of the profile: reproduces the variance of faces of 0.25 mm
# within 2 %
BIN = 0.025
PACKETS = 160_000
WALK_SEED = 20050701
SOURCES = (
    "skindb.optics._walk_kernels",
    "skindb.optics.transport",
    "skindb.virtual.probe",
)
# expected change of slope of log(r^2 R) from fibre to fibre, per mm of spacing over r
SMOOTH = 0.15
PROBE_SENSOR = Sensor(
    black=512, white=65535, step=1, full_well=90000.0, read_noise=8.0, pattern_noise=4.0
)


@dataclass(frozen=True)
class ProbeTruth:
    """True light at the fibres."""

    distance: Float64  # (fibre,) mm
    profile: Float64  # (site, fibre, channel) mm^-2
    error: Float64  # (site, fibre, channel) standard error of the random walk


@lru_cache(maxsize=4)
def shared_walk(eta: float, packets: int = PACKETS) -> Walk:
    """The absorption-free walk that every site of every take reweights: the same
    photons each time.
    """

    def make() -> dict[str, AnyArray]:
        return vars(random_walk(packets, eta=eta, rng=np.random.default_rng(WALK_SEED)))

    arrays = cached_arrays("probe-walk", (eta, packets), sources=SOURCES, make=make)
    radius, path, weight, batch = (
        arrays[name] for name in ("radius", "path", "weight", "batch")
    )
    return Walk(
        radius, path, weight, batch, int(arrays["packets"]), float(arrays["max_path"])
    )


def fibre_profiles(walk: Walk, sites: Sequence[Site]) -> ProbeTruth:
    """Diffuse reflectance R(r) averaged over the faces of the source and of each fibre,
    for every site and channel.
    """
    distance = FIRST + PITCH * np.arange(FIBRES, dtype=float)
    edges = BIN * np.arange(round((distance[-1] + 1.0) / BIN) + 1, dtype=np.float64)
    middle = (edges[:-1] + edges[1:]) / 2
    face = _disc_shares(middle, distance) @ _disc_shares(middle, middle)
    profile = np.empty((len(sites), FIBRES, 3))
    error = np.empty((len(sites), FIBRES, 3))
    for i, site in enumerate(sites):
        for c in range(3):
            mean, deviation = radial_profile(
                walk, site.sigma_a[c], site.sigma_s_prime[c], edges
            )
            value = face @ mean
            sigma = np.sqrt(face**2 @ deviation**2)
            profile[i, :, c], error[i, :, c] = _smooth(distance, value, sigma), sigma
    return ProbeTruth(distance, profile, error)


def _disc_shares(middle: Float64, distance: Float64) -> Float64:
    """Fraction (n, ring) of each ring around a point that lies inside a face at each of
    n distances.
    """
    r = middle[None, :]
    d = distance[:, None]
    arc = (
        2
        * r
        * np.arccos(np.clip((r * r + d * d - FIBRE_RADIUS**2) / (2 * r * d), -1, 1))
    )
    return arc / arc.sum(axis=1, keepdims=True)


def _smooth(distance: Float64, value: Float64, error: Float64) -> Float64:
    """Whittaker smoothing of log(r^2 R), which is linear far from the source by diffusion.

    Each fibre is weighted by the error of the walk: near ones hardly change, far ones
    (where few photons arrive) follow the straight line, so that the images contain the
    noise of the sensor and not that of the walk.
    """
    clear = (value > 0) & (error < 0.7 * value)
    target = np.where(clear, np.log(np.where(clear, value, 1) * distance**2), 0)
    weight = np.where(clear, (value / np.maximum(error, 1e-3 * value + 1e-300)) ** 2, 0)
    bend = (
        np.diff(np.eye(len(distance)), 2, axis=0)
        * (distance[1:-1] / (SMOOTH * PITCH))[:, None]
    )
    line = np.linalg.solve(np.diag(weight) + bend.T @ bend, weight * target)
    return np.exp(line) / distance**2


def write_probe(
    folder: Path, sites: Sequence[Site], *, eta: float, rng: np.random.Generator
) -> ProbeTruth:
    """Write contact/probe.json and the bracketed images of every site; returns the true
    light at the fibres.
    """
    truth = fibre_profiles(shared_walk(eta), sites)
    gain_true = rng.lognormal(0, 0.10, (FIBRES, 1)) * rng.lognormal(
        0, 0.015, (FIBRES, 3)
    )
    centre, spot = _layout(rng)
    # measured flat field, with errors
    gain = gain_true * (1 + GAIN_ERROR * rng.standard_normal((FIBRES, 3)))
    seconds = LONGEST * 2.0 ** (-2 / 3 * np.arange(BRACKETS))
    pattern = PROBE_SENSOR.pattern((*spot.shape[1:], 3), rng=rng)
    for site, received in zip(sites, truth.profile, strict=True):
        rate = np.einsum("fyx,fc->yxc", spot, received * gain_true).astype(
            np.float32
        ) * np.float32(SIGNAL)
        for k, time in enumerate(seconds):
            frame = PROBE_SENSOR.expose(rate * np.float32(time), pattern, rng=rng)
            write_png(folder / "contact" / site.name / f"b{k:02d}.png", frame)
    fibres = [
        {
            "id": f"f{i:02d}",
            "distance": float(d),
            "centre": c.tolist(),
            "radius": INSIDE,
        }
        for i, (d, c) in enumerate(zip(truth.distance, centre, strict=True))
    ]
    meta = {
        "sites": [site.name for site in sites],
        "fibres": fibres,
        "exposures": [
            {"id": f"b{k:02d}", "seconds": float(t)} for k, t in enumerate(seconds)
        ],
        "frames": "contact/{site}/{exposure}.png",
        "gain": gain.tolist(),
        "gain_error": GAIN_ERROR,
        "bit_depth": 16,
        "black_level": PROBE_SENSOR.black,
        "white_level": PROBE_SENSOR.white,
        "read_noise_e": PROBE_SENSOR.read_noise,
        "electrons_per_dn": PROBE_SENSOR.electrons_per_dn,
        "scale": 1 / SIGNAL,
        "pressure": {site.name: round(float(rng.normal(-8, 0.3)), 2) for site in sites},
        "fibre_radius": FIBRE_RADIUS,
    }
    private_file(folder / "contact" / "probe.json").write_text(
        json.dumps(meta, indent=1), encoding="utf-8"
    )
    return truth


def _layout(rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Centres (fibre, 2) px, and spots (fibre, y, x): 1 within INSIDE of the centre, a
    soft edge, 0 before the next.
    """
    index = np.arange(FIBRES)
    centre = (
        np.stack([index % COLUMNS, index // COLUMNS], axis=1) * CELL
        + CELL / 2
        + rng.normal(0, 0.3, (FIBRES, 2))
    )
    height = CELL * (FIBRES // COLUMNS)
    width = CELL * COLUMNS
    y, x = np.mgrid[:height, :width] + 0.5
    distance = np.hypot(x - centre[:, 0, None, None], y - centre[:, 1, None, None])
    # a compact edge, as a bright fibre must not leak into a neighbour that is five decades darker
    spot = np.clip((SPOT + 1.0 - distance) / 2.0, 0, 1)
    return centre, spot
