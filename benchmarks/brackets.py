"""Error and time of merging exposures, by the number of brackets that span the same range.

python -m benchmarks brackets [--picture FILE]
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from skindb.calibration.radiance import merge_exposures
from skindb.format.frames import FrameKind
from skindb.format.sensor import SensorRecord

SIDE = 512  # px
SENSOR = SensorRecord(
    FrameKind(SIDE, SIDE, 16), 1024.0, 65520.0, 6.0, 20000 / (65520.0 - 1024.0), 16.0
)
# s; longest over shortest exposure
LONGEST = 0.04
RANGE = 64.0
COUNTS = (1, 2, 3, 4, 7, 13)


def photographs(radiance, seconds, rng):
    """Frames with shot noise, read noise and 12 bits in 16."""
    frames = []
    for exposure in seconds:
        electrons = rng.poisson(
            radiance * exposure * 20000
        ) + 6.0 * rng.standard_normal(radiance.shape)
        value = np.rint((1024 + electrons / 20000 * (65520 - 1024)) / 16) * 16
        frames.append(np.clip(value, 0, 65520).astype(np.uint16))
    return frames


def measure(count, radiance, rng):
    """Exposure time, merge time per million pixels, error by decade of radiance,
    z-score, and fraction lost.
    """
    ratio = RANGE ** (1 / max(count - 1, 1))
    seconds = tuple(LONGEST / ratio**i for i in range(count))
    frames = photographs(radiance, seconds, rng)
    started = time.process_time()
    merged, error, flag = merge_exposures(frames, seconds, SENSOR)
    spent = (time.process_time() - started) * 1e6 / SIDE**2
    decade = np.floor(np.log10(radiance[..., 0] * LONGEST)).astype(int)
    usable = np.isfinite(merged).all(axis=-1)
    relative = [
        _rms((merged / radiance - 1)[decade == d], usable[decade == d])
        for d in range(-3, 2)
    ]
    z = ((merged - radiance) / error)[usable & (flag == 0)]
    return sum(seconds), spent, relative, float(z.std()), float((~usable).mean())


def _rms(error, usable):
    """Root mean square of the usable errors; NaN if most pixels are lost, because the
    others are a biased sample.
    """
    return np.sqrt(np.mean(error[usable] ** 2)) if usable.mean() > 0.5 else np.nan


def main(*, picture: Path | None = None) -> None:
    """Print the table, and plot error against radiance."""
    rng = np.random.default_rng(1)
    exposure = 10 ** rng.uniform(-3, np.log10(60), (SIDE, SIDE, 1))
    radiance = np.broadcast_to(exposure / LONGEST, (SIDE, SIDE, 3))
    rows = {count: measure(count, radiance, rng) for count in COUNTS}
    print(
        "| brackets | exposure [s] | merging [CPU s per Mpx] | rms error by decade "
        "from 0.001 of white | z | lost |"
    )
    print("|---" * 6 + "|")
    for count, (shot, spent, relative, z, lost) in rows.items():
        cells = ", ".join("-" if np.isnan(r) else f"{100 * r:.2f} %" for r in relative)
        print(
            f"| {count} | {shot:.3f} | {spent:.2f} | {cells} | {z:.3f} | {100 * lost:.1f} % |"
        )
    if picture:
        draw(rows, picture)


def draw(rows, path):
    """Plot the error against the relative exposure of the longest bracket."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    figure, ax = plt.subplots(figsize=(6, 3.6), layout="constrained")
    for count, (shot, _, relative, _, _) in rows.items():
        ax.loglog(
            10.0 ** (np.arange(-3, 2) + 0.5),
            100 * np.array(relative),
            "o-",
            label=f"{count} ({shot:.2f} s)",
        )
    ax.set(
        xlabel="radiance, 1 = white of the longest exposure",
        ylabel="rms error of radiance [%]",
    )
    ax.legend(
        title="brackets (exposure)",
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
        ncols=6,
        fontsize=7,
        frameon=False,
    )
    figure.savefig(path, dpi=80)
