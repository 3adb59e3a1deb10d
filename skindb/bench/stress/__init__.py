"""The stress set of DESIGN, section 7: cases with a promised behaviour that is checked
against a number or a law.
"""

from __future__ import annotations

from skindb.bench.case import Case
from skindb.bench.stress.exposures import EXPOSURES
from skindb.bench.stress.normals import ALBEDO, NORMAL
from skindb.bench.stress.optics import OPTICS
from skindb.bench.stress.population import POPULATION
from skindb.bench.stress.probe import PROBE
from skindb.bench.stress.solvers import SOLVERS
from skindb.bench.stress.surface import SURFACE
from skindb.bench.stress.tables import TABLES

CASES: tuple[Case, ...] = (
    *SOLVERS,
    *SURFACE,
    *NORMAL,
    *ALBEDO,
    *PROBE,
    *OPTICS,
    *TABLES,
    *EXPOSURES,
    *POPULATION,
)


def failure_of(case: Case) -> str:
    """Description of a broken promise; empty if it holds."""
    try:
        case.check()
    # # any error is reported as a broken promise
    except Exception as error:  # noqa: BLE001
        lines = str(error).strip().splitlines() or ["no message"]
        return (
            f"{type(error).__name__}: "
            f"{' '.join(line.strip() for line in lines if line.strip())[:300]}"
        )
    return ""
