"""Stated noise of samples against that of simulated sensors, as standard deviations of z-scores.

    python -m benchmarks sample_noise CAPTURE --electrons 20000 500

CAPTURE has 16-bit PNG frames without noise and known intensities of the lights. Its
frames of the face are exposed again by sensors with a full well of so many electrons,
and both captures are ingested.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import imagecodecs
import numpy as np
import xarray as xr

import skindb
from skindb import workflow
from skindb.fit import lumitexels
from skindb.fit.lumitexels import sample_variance

READ_NOISE = 6.0  # electrons
PIXELS = ((1, 1.5), (1.5, 2.5), (2.5, 4.1))
VALUES = ((0, 0.01), (0.01, 0.05), (0.05, 0.2), (0.2, 0.5))  # sr^-1
MIN_SAMPLES = 200


def main(
    capture: Path, *, electrons: Sequence[float] = (20000, 500), seed: int = 1
) -> None:
    print(
        "| full well | samples | number | standard deviation of z |\n|---|---|---|---|"
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        clean = ingested(folder / "clean", capture)
        for full_well in electrons:
            noisy = folder / f"capture-{full_well:.0f}"
            expose_again(capture, noisy, full_well, np.random.default_rng(seed))
            for label, z in groups(
                clean, ingested(folder / f"db-{full_well:.0f}", noisy)
            ):
                print(
                    f"| {full_well:,.0f} | {label} | {len(z):,} | {z.std():.3f} |",
                    flush=True,
                )


def expose_again(
    source: Path, target: Path, full_well: float, rng: np.random.Generator
) -> None:
    """Copy a capture, and add photon and read noise to its frames of the face."""
    shutil.copytree(source, target)
    file = target / "dome/dome.json"
    dome = json.loads(file.read_text())
    for camera in dome["cameras"]:
        black = camera["black_level"]
        white = camera["white_level"]
        per_value = full_well / (white - black)
        camera |= {"electrons_per_dn": per_value, "read_noise_e": READ_NOISE}
        for path in sorted((target / "dome/frames").glob(f"*/*_{camera['id']}.png")):
            values = imagecodecs.png_decode(path.read_bytes())
            expected = per_value * np.maximum(values - float(black), 0)
            electrons_read = rng.poisson(expected) + READ_NOISE * rng.standard_normal(
                expected.shape
            )
            # where the frame is saturated, how much light there was is unknown: it
            # remains saturated
            values = np.where(
                values >= white,
                white,
                np.clip(np.rint(black + electrons_read / per_value), 0, white),
            )
            path.write_bytes(imagecodecs.png_encode(values.astype(np.uint16)))
    file.write_text(json.dumps(dome))


def ingested(database: Path, capture: Path) -> xr.Dataset:
    db = skindb.open(str(database), create=True)
    workflow.ingest_take(db, capture)
    return lumitexels(db.read("capture", db.takes("capture")[0]))


def groups(clean: xr.Dataset, noisy: xr.Dataset) -> Iterator[tuple[str, np.ndarray]]:
    """z-scores of all samples, by effective pixels, and by value."""
    true = clean["reflectance_sample"].values.astype(np.float64)
    variance = sample_variance(noisy, np.nan_to_num(true)).values
    z = (noisy["reflectance_sample"].values - true) / np.sqrt(variance)
    pixels = np.broadcast_to(
        noisy["effective_pixels"].values[:, None, :, None], z.shape
    )
    finite = np.isfinite(z)
    z = z[finite]
    true = true[finite]
    pixels = pixels[finite]
    yield "all", z
    for kind, values, bounds, unit in (
        ("effective pixels", pixels, PIXELS, ""),
        ("value", true, VALUES, " / sr"),
    ):
        for low, high in bounds:
            part = z[(values >= low) & (values < high)]
            if len(part) >= MIN_SAMPLES:
                yield f"{kind} {low:g} to {high:g}{unit}", part
