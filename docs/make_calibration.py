"""Write docs/pictures/calibration_*.png from simulated calibration frames: python
docs/make_calibration.py.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np

from skindb.calibration.lens import fit_vignette
from skindb.calibration.response import fit_noise, recover_response

PICTURES = Path(__file__).parent / "pictures"
BLACK = 1024.0
WHITE = 65520.0
FULL = 20000.0
READ = 6.0
STACKS = {
    2: (0.04, 0.005),
    4: (0.04, 0.02, 0.01, 0.005),
    8: tuple(0.08 / 2.0**i for i in range(8)),
}


def main() -> None:
    """Draw all pictures with fixed seeds."""
    draw_response(np.random.default_rng(1))
    draw_noise(np.random.default_rng(2))
    draw_residuals(np.random.default_rng(3))


def encoded(exposure):
    """Response with a gamma of 2.2 and a linear toe below 0.004."""
    power = 1 / 2.2
    toe = 0.004
    slope = power * toe ** (power - 1)
    lift = toe**power - slope * toe
    return np.where(
        exposure < toe, slope * exposure, np.maximum(exposure, toe) ** power - lift
    ) / (1 - lift)


def photograph(radiance, seconds, rng):
    """Frame of 12 bits in 16 with shot and read noise."""
    electrons = radiance * seconds * FULL
    electrons = electrons + np.sqrt(electrons + READ**2) * rng.standard_normal(
        radiance.shape
    )
    return np.rint(64 + encoded(np.clip(electrons / FULL, 0, 1)) * 4031) * 16


def draw_response(rng) -> None:
    """Draw the recovered and true response, and their relative difference."""
    patches = np.exp(rng.uniform(np.log(0.01), np.log(300), (40, 40)))
    radiance = np.kron(patches, np.ones((8, 8)))[..., None] * np.ones(3)
    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.3), layout="constrained")
    exposure = np.logspace(-4, 0, 400)
    left.loglog(exposure, encoded(exposure), "k", lw=3, alpha=0.3, label="truth")
    for count, seconds in STACKS.items():
        stack = np.stack([photograph(radiance, s, rng) for s in seconds])
        table = recover_response(stack, seconds, black=BLACK, white=WHITE)
        value = (table[:, 0] - BLACK) / (WHITE - BLACK)
        left.loglog(table[1:, 2], value[1:], lw=1, label=f"{count} exposures")
        error = np.interp(encoded(exposure), value, table[:, 2]) / exposure
        right.semilogx(
            exposure, 100 * (error / np.median(error[exposure > 0.05]) - 1), lw=1
        )
    left.set(
        xlabel="relative exposure", ylabel="value, 0 black, 1 white", xlim=(1e-4, 1)
    )
    right.set(
        xlabel="relative exposure",
        ylabel="error of the recovered exposure [%]",
        ylim=(-5, 5),
    )
    left.legend()
    figure.savefig(PICTURES / "calibration_response.png", dpi=80)


def draw_noise(rng) -> None:
    """Draw a photon transfer curve."""
    pairs = []
    pattern = 1 + 0.02 * rng.standard_normal((100, 100))
    for level in (0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 0.6, 0.9):
        electrons = rng.poisson(
            level * FULL * pattern, (2, 100, 100)
        ) + READ * rng.standard_normal((2, 100, 100))
        pairs.append(
            np.clip(
                np.rint((BLACK + electrons / FULL * (WHITE - BLACK)) / 16) * 16,
                0,
                WHITE,
            )
        )
    frames = np.array(pairs)
    fit = fit_noise(frames, black=BLACK, white=WHITE, step=16.0)
    figure, ax = plt.subplots(figsize=(5, 3.3), layout="constrained")
    signal = (frames.mean(axis=(1, 2, 3)) - BLACK) * fit.electrons_per_dn
    deviation = (frames[:, 0] - frames[:, 1]).std(axis=(1, 2)) / np.sqrt(2)
    ax.loglog(
        np.maximum(signal, 1),
        deviation * fit.electrons_per_dn,
        "o",
        label="pairs of flat frames",
    )
    line = np.logspace(0, 4.3, 100)
    label = (
        f"fit: read noise {fit.read_noise:.2f} ± {fit.read_noise_error:.2f} e,\n"
        f"{fit.electrons_per_dn:.4f} ± {fit.electrons_per_dn_error:.4f} e per value"
    )
    ax.loglog(
        line,
        np.sqrt(line + fit.read_noise**2 + (16 * fit.electrons_per_dn) ** 2 / 12),
        label=label,
    )
    ax.set(xlabel="signal [electrons]", ylabel="noise [electrons]")
    ax.legend()
    figure.savefig(PICTURES / "calibration_noise.png", dpi=80)


def draw_residuals(rng) -> None:
    """Draw a flat frame, and its residual after the fit of the vignette."""
    row, column = np.mgrid[:48, :64] + 0.5
    r2 = ((column - 31) ** 2 + (row - 24.5) ** 2) / 40.0**2
    frame = (1 - 0.21 * r2 - 0.06 * r2**2 - 0.03 * r2**3) * (
        1 + 0.005 * rng.standard_normal(r2.shape)
    )
    frame[12:15, 16:20] *= 0.97  # dust
    a2, a4, a6 = fit_vignette(frame, [31.0, 24.5]).coefficients
    gain = 1 + r2 * (a2 + r2 * (a4 + r2 * a6))
    flat = frame / gain
    figure, axes = plt.subplots(1, 2, figsize=(8, 2.8), layout="constrained")
    for ax, image, title in (
        (axes[0], frame, "flat frame, relative"),
        (
            axes[1],
            100 * (flat / np.median(flat) - 1),
            "residual of the fit [%], with dust",
        ),
    ):
        figure.colorbar(ax.imshow(image), ax=ax)
        ax.set_title(title)
        ax.set_axis_off()
    figure.savefig(PICTURES / "calibration_residuals.png", dpi=70)


if __name__ == "__main__":
    main()
