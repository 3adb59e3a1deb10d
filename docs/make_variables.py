"""Write docs/variables.md from the schema, or check with --check whether it is up to date."""

from __future__ import annotations

import sys
from pathlib import Path

from skindb.schema import GROUPS, Explained, FitStatus, ProbeStatus, Variable

PAGE = Path(__file__).with_name("variables.md")
HEAD = """# Variables

This page is generated from `skindb/schema` by `make docs`. It lists every stored
variable with its dtype, its dims in round brackets and its units in square ones;
variables without units are dimensionless. Published sources follow the meaning.
"""


def _row(v: Variable) -> str:
    dims = f"({', '.join(v.dims)})" if v.dims else ""
    units = "" if v.units == "1" else f" [{v.units}]"
    source = "" if v.source == "skindb" else f" ({v.source})"
    return f"| `{v.name}` | {v.dtype}{dims}{units} | {v.doc}{source} |"


def _group(name: str) -> str:
    return "\n".join(
        [
            f"\n## {name}\n",
            "| variable | type | meaning |",
            "|---|---|---|",
            *map(_row, GROUPS[name]),
        ]
    )


def _status(status: type[Explained], variable: str) -> str:
    rows = [
        f"| {int(member)} | {member.name.lower()} | {member.explanation} |"
        for member in status
    ]
    return "\n".join(
        [
            f"\n## Values of `{variable}`\n",
            "| value | name | meaning |",
            "|---|---|---|",
            *rows,
        ]
    )


def main() -> int:
    """Write the page, or check it."""
    parts = [
        HEAD,
        *map(_group, GROUPS),
        _status(FitStatus, "fit_status"),
        _status(ProbeStatus, "site_status"),
    ]
    text = "\n".join(parts) + "\n"
    if "--check" in sys.argv[1:]:
        if PAGE.read_text(encoding="utf-8") == text:
            return 0
        sys.stderr.write(
            "docs/variables.md is out of date; run `make docs` and commit it\n"
        )
        return 1
    PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
