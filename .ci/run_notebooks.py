"""Run every notebook in its own folder with the database that `make demo` wrote.

The executed copies are written to `docs/_build/notebooks` and used by `make docs`, so
that notebooks run only once.
"""

from __future__ import annotations

import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[1]
EXECUTED = ROOT / "docs" / "_build" / "notebooks"


def main() -> int:
    """Run the notebooks and store their outputs; stops with the traceback of an
    exception in a cell.
    """
    EXECUTED.mkdir(parents=True, exist_ok=True)
    paths = sorted((ROOT / "notebooks").glob("*.ipynb"))
    for path in paths:
        notebook = nbformat.read(path, as_version=4)
        NotebookClient(
            notebook, timeout=600, resources={"metadata": {"path": str(path.parent)}}
        ).execute()
        nbformat.write(notebook, EXECUTED / path.name)
        sys.stdout.write(
            f"{path.name}: {sum(c.cell_type == 'code' for c in notebook.cells)} cells run\n"
        )
    return 0 if paths else 1


if __name__ == "__main__":
    sys.exit(main())
