"""Hostile conditions are refused in one line, or are harmless; none writes a file or
imports a module.

    python tests/destructive/fuzz_where.py --cases 100000 --seed 3

The conditions are random sequences of parts of Python: calls, attributes, lambdas,
powers, nesting, and characters that look like others. The program ends with 1 if there
is any other outcome.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from hostile_conditions import HARMLESS, REFUSED, hostile_conditions, outcome


def main() -> None:
    """Evaluate the conditions in an empty folder, and count the outcomes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    modules = {*sys.modules}
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        outcomes = Counter(
            outcome(text)
            for text in hostile_conditions(options.cases, seed=options.seed)
        )
        outcomes |= Counter({f"wrote {path}": 1 for path in Path().iterdir()})
        os.chdir("/")
    outcomes |= Counter({f"imported {name}": 1 for name in {*sys.modules} - modules})
    for name, count in outcomes.most_common(20):
        print(f"{count:8d}  {name}")
    sys.exit(bool({*outcomes} - {REFUSED, HARMLESS}))


if __name__ == "__main__":
    main()
