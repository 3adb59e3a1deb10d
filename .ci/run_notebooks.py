"""Run every notebook from its own folder, as a reader would, against the database that `make demo` wrote.

The executed copies go to `docs/_build/notebooks`, from where `make docs` takes them: notebooks are executed only once.
"""

from __future__ import annotations

import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[1]
EXECUTED = ROOT / "docs" / "_build" / "notebooks"


def main() -> int:
    """Run the notebooks and keep what they show; an exception in a cell stops with its traceback."""
    EXECUTED.mkdir(parents=True, exist_ok=True)
    paths = sorted((ROOT / "notebooks").glob("*.ipynb"))
    for path in paths:
        notebook = nbformat.read(path, as_version=4)
        NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(path.parent)}}).execute()
        nbformat.write(notebook, EXECUTED / path.name)
        sys.stdout.write(f"{path.name}: {sum(c.cell_type == 'code' for c in notebook.cells)} cells run\n")
    return 0 if paths else 1


if __name__ == "__main__":
    sys.exit(main())
