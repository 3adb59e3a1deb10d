"""Run the quick commands and the Python blocks of the documentation pages on a copy of
the database of `make demo`.

    python .ci/check_commands.py

`check_docs.py` parses all commands of the pages; this program runs those that finish
within seconds on a fitted database, which is called `faces` as in the pages.
`check_readme.py` runs the commands of the README.
"""

from __future__ import annotations

import os
import re
import sys
import traceback
from contextlib import chdir, redirect_stdout
from io import StringIO
from pathlib import Path

from check_docs import ROOT, commands, pages
from click.testing import CliRunner
from demo_copy import demo_copy

from skindb.cli import cli
from skindb.virtual.targets import write_laboratory

# or add a study or a release
READ_ONLY = {"info", "verify", "show", "compare", "analyze", "release", "dictionary"}
LAST = {"clean", "consent"}  # change what later commands find
# studies of more than seconds
SLOW = {"brdf", "albedo", "traits", "maps", "surface", "chromophores", "components"}
# takes of the pages, and those of the demo
TAKES = {"S01": "V001", "S02": "V002", "P010": "V003"}
# the demo has six subjects, each at one visit; some comparisons need more
TOO_FEW = (
    "the subjects must determine the effect",
    "subjects must have two takes",
    "some region must determine it",
    "must differ between takes",
)

# the rehearsal of a laboratory, in less than a minute
SMALL = {"cameras": 3, "lights": 10, "width": 160, "height": 200}
FEWER = {
    "board": ["--placements", "5"],
    "ball": ["--placements", "2"],
    "ingest": ["--spacing", "4"],
}


def is_run(words: list[str]) -> bool:
    """Whether a command of a page is run."""
    if words[:1] != ["skindb"] or SLOW & set(words) or "--scheduler" in words:
        return False
    if words[1:] == ["dictionary"]:
        return True
    quick = (
        words[1] in READ_ONLY | LAST
        or "--dry-run" in words
        or (words[1:2] == ["fit"] and "--explain" in words)
    )
    return quick and words[2:3] in (["faces"], ["demo/db"])


def calls() -> list[list[str]]:
    """Commands and Python blocks that are run, each of them once."""
    found: dict[tuple[str, ...], None] = {}
    for page in pages():
        text = page.read_text(encoding="utf-8")
        if page.name == "README.md":
            continue
        for _, words in commands(text):
            if is_run(words):
                found["skindb", *(TAKES.get(word, word) for word in words[1:])] = None
        for block in re.findall(r"^```python\n(.*?)^```", text, re.S | re.M):
            if 'skindb.open("demo/db")' in block:
                found["python", f"import skindb\n{block}"] = None
    return sorted(map(list, found), key=lambda call: call[1] in LAST)


def failure(call: list[str]) -> str:
    """Messages of a call that fails; empty if it succeeds.

    All run in this process, which imports skindb once; the README and the tests of the
    command line start `skindb` as a user does.
    """
    if call[0] == "skindb":
        result = CliRunner().invoke(cli, call[1:])
        messages = f"{result.output}{result.exception or ''}"
        return messages if result.exit_code else ""
    try:
        with redirect_stdout(StringIO()):
            exec(call[1], {})
    except Exception:  # noqa: BLE001  whatever a block raises
        return traceback.format_exc()
    return ""


def rehearsal() -> list[list[str]]:
    """Commands and Python block of the page that rehearses a laboratory, in their order, with
    fewer poses and places.
    """
    page = (ROOT / "docs/howto/laboratory.md").read_text(encoding="utf-8")
    called = [
        words + [option for word in words for option in FEWER.get(word, [])]
        for _, words in commands(page)
    ]
    block = re.findall(r"^```python\n(.*?)^```", page, re.S | re.M)
    return [*called, ["python", *block]]


def main() -> int:
    """Run the commands, and stop at the first one that fails."""
    os.environ["MPLBACKEND"] = "agg"
    with demo_copy() as folder, chdir(folder):
        Path("faces").symlink_to("demo/db")
        write_laboratory(Path("LAB"), **SMALL)
        found = calls() + rehearsal()
        for call in found:
            messages = failure(call)
            if messages and not any(rule in messages for rule in TOO_FEW):
                sys.stderr.write(
                    f"{' '.join(call)}\n{messages}\nthis command of the pages failed\n"
                )
                return 1
    sys.stdout.write(f"{len(found)} commands and Python blocks of the pages run\n")
    return 0 if found else 1


if __name__ == "__main__":
    sys.exit(main())
