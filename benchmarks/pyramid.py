"""Time and error of the steerable pyramid compared with pyrtools, in one run.

python -m benchmarks pyramid [--size 2048] [--rounds 3] [--threads 1]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from pyrtools.pyramids import SteerablePyramidFreq
from scipy.fft import set_workers

from skindb.numerics.texture import build, reconstruct


def best(call: Callable[[], Any], rounds: int) -> tuple[float, Any]:
    """Wall time [s] of the fastest of several calls, and the result of the last one."""
    seconds = []
    for _ in range(rounds):
        begin = time.perf_counter()
        found = call()
        seconds.append(time.perf_counter() - begin)
    return min(seconds), found


def main(*, size: int = 2048, rounds: int = 3, threads: int = 1) -> None:
    """Run and print."""
    image = np.random.default_rng(0).normal(size=(size, size))
    print(
        f"{'':<22} {'build [s]':>10} {'reconstruct [s]':>16} {'largest error / range':>22}"
    )
    whole = {}
    for name, x in (
        ("skindb, float64", image),
        ("skindb, float32", image.astype(np.float32)),
    ):
        with set_workers(threads):
            built, pyramid = best(lambda x=x: build(x), rounds)
            back, again = best(lambda p=pyramid: reconstruct(p), rounds)
        whole[name] = built + back
        print(
            f"{name:<22} {built:>10.2f} {back:>16.2f} {np.abs(again - x).max() / np.ptp(x):>22.1e}"
        )
    built, other = best(lambda: SteerablePyramidFreq(image, height=7, order=3), rounds)
    back, again = best(other.recon_pyr, rounds)
    print(
        f"{'pyrtools':<22} {built:>10.2f} {back:>16.2f} "
        f"{np.abs(again - image).max() / np.ptp(image):>22.1e}"
    )
    print(
        ", ".join(
            f"{name}: {seconds / (built + back):.2f} of its time"
            for name, seconds in whole.items()
        )
    )
