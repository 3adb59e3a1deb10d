"""Coverage of the 95 % intervals of sigma_tr, for noisy profiles of random media with
known and free gain.

python -m benchmarks probe_intervals [--profiles N]
"""

from __future__ import annotations

import numpy as np

from skindb.fit.translucency import fit_profile
from skindb.optics.transport import transport_profile
from skindb.schema import ProbeStatus

DISTANCE = 1 + 0.5 * np.arange(28)  # mm
# errors of the fibres: a fraction of the profile, and mm^-2
RELATIVE = (0.004, 0.02)
FLOOR = (3e-9, 3e-7)


def draws(count, *, relative, floor, free, seed=1):
    """Fits and true sigma_tr of `count` media: sigma_s' 1.5 mm^-1 within a factor of
    e^0.5, sigma_tr 0.3 to 2.4.
    """
    rng = np.random.default_rng([seed, round(1e4 * relative), round(1e10 * floor)])
    for _ in range(count):
        s = 1.5 * np.exp(0.5 * rng.normal())
        true = np.exp(rng.uniform(np.log(0.3), np.log(2.4)))
        a = (np.sqrt(s * s + 4 * true**2 / 3) - s) / 2
        value = transport_profile(DISTANCE, a, s, eta=1.3)
        error = np.hypot(relative * value, floor)
        taken = value + error * rng.normal(size=len(DISTANCE))
        fit = fit_profile(
            DISTANCE,
            taken,
            error,
            radius=0.0,
            eta=1.3,
            free_gain=free,
        )
        if fit.status != ProbeStatus.TOO_FEW_FIBRES:
            yield fit, true


def main(*, profiles: int = 200) -> None:
    """Print coverage, errors of profiles with the status fitted, and the fraction that
    is flagged.
    """
    count = profiles
    print(
        "| gain | noise | floor [mm^-2] | in the interval | median error | largest "
        "error, status fitted | flagged |"
    )
    print("|---" * 7 + "|")
    for free in (False, True):
        for relative in RELATIVE:
            for floor in FLOOR:
                results = list(draws(count, relative=relative, floor=floor, free=free))
                off = np.array([fit.sigma_tr / true - 1 for fit, true in results])
                inside = [
                    abs(fit.sigma_tr - true) < 1.96 * fit.sigma_tr_error
                    for fit, true in results
                ]
                fitted = np.array(
                    [fit.status == ProbeStatus.FITTED for fit, _ in results]
                )
                gain = "free" if free else "known"
                print(
                    f"| {gain} | {100 * relative:g} % | {floor:g} | {100 * np.mean(inside):.1f} %"
                    f" | {100 * np.median(np.abs(off)):.2f} % | "
                    f"{100 * np.abs(off[fitted]).max():.1f} %"
                    f" | {100 * np.mean(~fitted):.0f} % |",
                    flush=True,
                )
