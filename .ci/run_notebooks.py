"""Run every notebook with a copy of its own of the database that `make demo` wrote, two at
a time.

The executed copies are written to `docs/_build/notebooks` and used by `make docs`, so
that notebooks run only once.
"""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import nbformat
from demo_copy import ROOT, demo_copy
from nbclient import NotebookClient

EXECUTED = ROOT / "docs" / "_build" / "notebooks"


def run(path: Path) -> None:
    """Run a notebook and store its outputs; raises the exception of a cell."""
    notebook = nbformat.read(path, as_version=4)
    with demo_copy() as folder:
        work = folder / "notebooks"
        work.mkdir()
        place = {"metadata": {"path": str(work)}}
        NotebookClient(notebook, timeout=None, resources=place).execute()
    nbformat.write(notebook, EXECUTED / path.name)
    cells = sum(cell.cell_type == "code" for cell in notebook.cells)
    sys.stdout.write(f"{path.name}: {cells} cells run\n")


def main() -> int:
    """Run the notebooks; stops with the traceback of an exception in a cell."""
    EXECUTED.mkdir(parents=True, exist_ok=True)
    paths = sorted((ROOT / "notebooks").glob("*.ipynb"))
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(run, paths))
    return 0 if paths else 1


if __name__ == "__main__":
    sys.exit(main())
