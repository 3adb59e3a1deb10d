"""Run every ```sh and ```python block of the README, in order, in the root of the repository."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# commands of `make test-all`, which calls this program
DONE_BEFORE = {"make test", "make test-all"}


def main() -> int:
    """Run the blocks, and stop at the first one that fails."""
    for leftover in ("captures", "faces", "bundle"):  # outputs of an earlier run
        shutil.rmtree(ROOT / leftover, ignore_errors=True)
    env = os.environ | {
        "PATH": f"{ROOT / '.venv/bin'}{os.pathsep}{os.environ['PATH']}",
        "MPLBACKEND": "agg",
    }
    blocks = re.findall(
        r"^```(sh|python)\n(.*?)^```",
        (ROOT / "README.md").read_text(encoding="utf-8"),
        re.S | re.M,
    )
    for language, text in blocks:
        if language == "sh":
            lines = [
                line
                for line in text.splitlines()
                if line.partition("#")[0].strip() not in DONE_BEFORE
            ]
            call = ["bash", "-euo", "pipefail", "-c", "\n".join(lines)]
        else:
            call = [
                sys.executable,
                "-W",
                "error::DeprecationWarning:skindb",
                "-c",
                text,
            ]
        sys.stderr.write(f"--- README, {language}:\n{text}")
        if subprocess.run(call, cwd=ROOT, env=env, check=False).returncode:
            sys.stderr.write("this block of the README failed\n")
            return 1
    sys.stdout.write(f"{len(blocks)} blocks of the README run\n")
    return 0 if blocks else 1


if __name__ == "__main__":
    sys.exit(main())
