"""Time and size of storing the first pass of a fit, compared with the time that a
resumed fit saves.

    python -m benchmarks first_pass [--surfels 16384] [--repeat 3]

Planted skin under 60 lights and 8 cameras is fitted with the embedded dictionary by
`fit_take`. The first fit compiles and is not counted; medians of the others are
printed.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

from planted_skin import capture_of, make_skin

from skindb.store import Database
from skindb.workflow import fit as fit_module
from skindb.workflow.derive import groups_of

TAKE = "S01"


def main(*, surfels: int = 16384, repeat: int = 3) -> None:
    seconds: dict[str, list[float]] = {"keep": [], "first pass": [], "fit": []}
    keep = fit_module._store_first_pass

    def timed(scratch: Path, *args: Any) -> None:
        begin = time.perf_counter()
        keep(scratch, *args)
        seconds["keep"].append(time.perf_counter() - begin)
        size.append(Database(scratch).record("model", TAKE).bytes)

    size: list[int] = []
    fit_module._store_first_pass = timed
    with tempfile.TemporaryDirectory() as folder:
        db = Database(folder)
        capture = capture_of(make_skin(surfels=surfels))
        with db.stage("capture", TAKE) as stage:
            stage.write(groups_of(capture))
            stage.commit(capture.attrs)
        for _ in range(repeat + 1):
            begin = time.perf_counter()
            record = fit_module.fit_take(db, TAKE)
            seconds["fit"].append(time.perf_counter() - begin)
            seconds["first pass"].append(record.provenance["seconds"]["first pass"])
    of_fit, of_storing, of_first_pass = (
        median(seconds[name][1:]) for name in ("fit", "keep", "first pass")
    )
    print(
        f"{surfels} surfels: fit {of_fit:.1f} s, of which first pass "
        f"{of_first_pass:.1f} s and storing it {of_storing:.2f} s"
    )
    print(f"storing it: {of_storing / of_fit:.1%} of the fit, {size[-1] / 1e6:.1f} MB")
