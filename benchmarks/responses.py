"""Error of recovered responses by form of the response, number of exposures and noise,
on simulated stacks.

python -m benchmarks responses [--electrons N] [--read-noise E]

Prints the root mean square over three channels and two scenes of the relative error of
recovered exposures, by octaves below the white level, after the unit of each channel is
set by the brightest octaves.
"""

from __future__ import annotations

import numpy as np

from skindb.calibration.response import recover_response

BLACK = 1024.0
WHITE = 65520.0
OCTAVES = np.arange(9, -1, -1)
EXPOSURES = {
    2: (0.04, 0.005),
    4: (0.04, 0.02, 0.01, 0.005),
    8: tuple(0.08 / 2.0**i for i in range(8)),
}


def _srgb(x):
    return np.where(
        x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055
    )


FORMS = {
    "linear": lambda x: x,
    "gamma 1.4": lambda x: x ** (1 / 1.4),
    "sRGB": _srgb,
    "S-shaped": lambda x: (
        0.75 * _srgb(x) + 0.25 * (3 * _srgb(x) ** 2 - 2 * _srgb(x) ** 3)
    ),
    "logarithmic": lambda x: np.log1p(200 * x) / np.log(201),
}


def photograph(radiance, seconds, form, noise, rng):
    """Frames of 12 bits in 16 with shot and read noise; `noise` is electrons at the
    white level and read noise.
    """
    full, read = noise
    frames = []
    for second in seconds:
        electrons = radiance * second * full
        electrons = electrons + np.sqrt(electrons + read**2) * rng.standard_normal(
            radiance.shape
        )
        frames.append(np.rint(64 + form(np.clip(electrons / full, 0, 1)) * 4031) * 16)
    return np.stack(frames)


def errors(form, seconds, noise):
    """Root mean square (octave,) of the relative error."""
    exposure = 0.98 * 2.0**-OCTAVES
    results = []
    for seed in (100, 101):
        rng = np.random.default_rng(seed)
        patches = np.exp(rng.uniform(np.log(0.01), np.log(300), (40, 40)))
        radiance = np.kron(patches, np.ones((8, 8)))[..., None] * np.ones(3)
        stack = photograph(radiance, seconds, form, noise, rng)
        table = recover_response(stack, seconds, black=BLACK, white=WHITE)
        value = (table[:, 0] - BLACK) / (WHITE - BLACK)
        ratio = np.stack(
            [
                np.interp(form(exposure), value, table[:, c]) / exposure
                for c in (1, 2, 3)
            ]
        )
        results.append(ratio / np.median(ratio[:, -5:], axis=1, keepdims=True) - 1)
    return np.sqrt((np.concatenate(results) ** 2).mean(axis=0))


def main(*, electrons: float = 20000.0, read_noise: float = 6.0) -> None:
    """Print one row for each form and number of exposures."""
    print(
        "| response | exposures | "
        + " | ".join(f"1/{2**o}" if o else "0.98" for o in OCTAVES)
        + " |"
    )
    print("|---" * (len(OCTAVES) + 2) + "|")
    for name, form in FORMS.items():
        for count, seconds in EXPOSURES.items():
            cells = " | ".join(
                f"{100 * e:.2f} %"
                for e in errors(form, seconds, (electrons, read_noise))
            )
            print(f"| {name} | {count} | {cells} |")
