"""Check the documentation: wording, commands, links, and that all results have a
command that reproduces them.

    python .ci/check_docs.py

Sphinx (`make docs`) checks the links of the site. This program checks

* that pages, changelog, notebooks, help texts, and the comments, docstrings and
  messages of the code and of the tests use common technical terms (`TERMS`);
* that no line of a page begins with a percent sign, which would make it a comment;
* that every `skindb` command in a block marked bash, console or sh exists and accepts
  its options and arguments, and that scripts, tests and make targets in such blocks
  exist;
* that every section with figures in the pages of results shows a command;
* that links refer to existing files, where pages are read outside the site.

It prints one line for each fault, and its exit code is 1 if there are any. No command
is run; `check_commands.py` runs the quick ones.
"""

from __future__ import annotations

import io
import json
import re
import shlex
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

import click

from skindb.cli import cli
from skindb.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
GENERATED = (
    "docs/_build",
    "docs/api/generated",
    "docs/notebooks",
    "docs/reference/commands.md",
)
RESULTS = ("validation.md", "performance.md", "reliability.md", "results/")

ONCE = r"[(;,] ?once[);:,]"  # of a figure on a page; in the code it is a common word
# pattern of an uncommon wording, which is difficult to read in a second language -> the common term
TERMS = {
    r"\bshares? (?:of|that|within|is|are)\b": "fraction or percentage",
    r"\bbetween (?:the )?(?:cube )?roots\b|\broots alone\b": "in cube-root space",
    r"\bseconds passed\b|\bs passed\b": "wall time",
    r"\b(?:seconds|s) of (?:the|a) processor\b|\bprocessor (?:time|seconds)\b": "CPU time",
    r"\b(?:leaves?|left|leaving) out\b": "skips, omits or excludes",
    ONCE: "the command that repeats the figure, or no figure",
    r"\btold\b": "reported, stated or distinguished",
    r"\b(?:goes|going|go) on where\b": "continues or resumes",
    r"\bstrange\b": "invalid or out of range",
    r"\bmend(?:s|ed|ing)?\b": "corrects or repairs",
    r"\bhonest\b": "correct or calibrated",
    r"\bwithout a word\b": "silently",
    r"\bof nobody\b": "of no subject",
    r"\bof one's own\b": "of your own",
    r"\bonce more\b": "again",
    r"\bat the door\b": "on input",
    r"\bsave for\b|\bbut for\b": "except for",
    r"\bput right\b": "corrected",
    r"\btells (?:the|a|its|how|what|which)\b": "states, shows or reports",
    r"\bthe way of the data\b": "data flow",
    r"\bsmall hours\b|\bhand in hand\b": "a plain description",
}
TEXTS = {
    tokenize.COMMENT,
    tokenize.STRING,
    getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING),
}
CODE = re.compile(r"^(```|~~~).*?^\1|^(?: {4}|\t).*?$|`[^`]*`|\]\([^)]*\)", re.S | re.M)
BLOCK = re.compile(r"^```(?:bash|console|sh)\n(.*?)^```", re.S | re.M)


def pages() -> list[Path]:
    """Hand-written pages."""
    found = [
        *sorted((ROOT / "docs").rglob("*.md")),
        *(ROOT / f"{n}.md" for n in ("README", "CHANGELOG", "CONTRIBUTING")),
    ]
    return [
        page
        for page in found
        if not page.relative_to(ROOT).as_posix().startswith(GENERATED)
    ]


def sources() -> list[Path]:
    """Python files whose comments and strings are read; this program and its tests
    contain the terms.
    """
    folders = ("skindb", "tests", "benchmarks")
    return sorted(
        p
        for f in folders
        for p in (ROOT / f).rglob("*.py")
        if p.name != "test_check_docs.py"
    )


def blank(match: re.Match[str]) -> str:
    """Replace a match by its line breaks, so that line numbers are unchanged."""
    return "\n" * match.group().count("\n")


def term_faults(where: str, text: str) -> Iterator[str]:
    """Uncommon wordings in a text, with the common terms; code is skipped."""
    lines = CODE.sub(blank, text)
    for pattern, term in TERMS.items():
        for match in re.finditer(pattern.replace(" ", r"\s+"), lines, re.I):
            line = lines.count("\n", 0, match.start()) + 1
            yield f"{where}:{line}: {' '.join(match.group().split())!r}; write: {term}"


def source_faults(where: str, source: str) -> Iterator[str]:
    """Wordings in comments and strings of Python code for which there is a common term."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in TEXTS:
            continue
        # code, and values in messages
        text = re.sub(r"`[^`]*`|\{[^}]*\}", "", token.string)
        for pattern, term in TERMS.items():
            if pattern != ONCE and (
                match := re.search(pattern.replace(" ", r"\s+"), text, re.I)
            ):
                line = token.start[0] + text.count("\n", 0, match.start())
                yield f"{where}:{line}: {' '.join(match.group().split())!r}; write: {term}"


def comment_faults(where: str, text: str) -> Iterator[str]:
    """Lines that begin with a percent sign: MyST reads them as comments and drops them."""
    lines = CODE.sub(blank, text)
    for match in re.finditer(r"^ *%.*", lines, re.M):
        line = lines.count("\n", 0, match.start()) + 1
        yield f"{where}:{line}: {match.group()[:40]!r} is a comment; wrap the line elsewhere"


def help_texts() -> Iterator[tuple[str, str]]:
    """Help texts of all commands and options, not wrapped."""
    for name, command in {"": cli, **cli.commands}.items():
        yield f"skindb {name} --help", command.help or ""
        for option in command.params:
            if isinstance(option, click.Option):
                yield f"skindb {name} {option.opts[0]}", option.help or ""


def notebook_texts() -> Iterator[tuple[str, str]]:
    """Markdown cells of the notebooks."""
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        for number, cell in enumerate(cells, 1):
            if cell["cell_type"] == "markdown":
                yield f"notebooks/{path.name}, cell {number}", "".join(cell["source"])


def commands(text: str) -> Iterator[tuple[int, list[str]]]:
    """Line number and words of every simple command in the marked blocks of a page."""
    for block in BLOCK.finditer(text):
        line = text.count("\n", 0, block.start()) + 2
        joined = block.group(1).replace("\\\n", "  ")
        for offset, written in enumerate(joined.splitlines()):
            words = shlex.split(written.removeprefix("$ "), comments=True)
            for part in " ".join(map(shlex.quote, words)).split(" '&&' "):
                yield line + offset, shlex.split(part)


def command_fault(words: list[str]) -> str:
    """Description of the fault of a command; empty if there is none."""
    if words[0] == "skindb":
        return skindb_fault(words[1:])
    if (
        words[0] == "make"
        and len(words) > 1
        and f"\n{words[1]}:" not in (ROOT / "Makefile").read_text("utf-8")
    ):
        return f"the Makefile has no target {words[1]}"
    if words[:3] == ["python", "-m", "benchmarks"] and len(words) > 3:
        program = f"benchmarks/{words[3]}.py"
        return "" if (ROOT / program).is_file() else f"{program} does not exist"
    own = ("benchmarks/", "tests/", "docs/", ".ci/")
    missing = [
        word
        for word in words[1:]
        if word.startswith(own) and not (ROOT / word).exists()
    ]
    if words[0] in {"python", "pytest"} and missing:
        return f"{missing[0]} does not exist"
    return ""


def skindb_fault(words: list[str]) -> str:
    """Error message of click for a call of skindb, which is parsed but not run; empty
    if there is none.
    """
    if not words or words[0] in {"--help", "--version"}:
        return ""
    command = cli.commands.get(words[0])
    if command is None:
        return f"there is no command {words[0]}" if words[0] != "COMMAND" else ""
    if "--help" in words:
        return ""
    try:
        command.make_context(words[0], words[1:])
    except (click.ClickException, InputError) as error:
        said = (
            error.format_message()
            if isinstance(error, click.ClickException)
            else str(error)
        )
        return "" if "does not exist" in said else said
    return ""


def link_faults(page: Path, text: str) -> Iterator[str]:
    """Links to missing files, also where pages are read outside the site."""
    for match in re.finditer(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        if not (page.parent / match.group(1)).exists():
            yield f"{page.name}: {match.group(1)} does not exist"


def figure_faults(where: str, text: str) -> Iterator[str]:
    """Sections of results that show figures but no command.

    The command of a section before its first subsection applies to all of them; otherwise
    each subsection needs its own.
    """
    for section in re.split(r"^(?=## )", text, flags=re.M)[1:]:
        start, *subsections = re.split(r"^(?=### )", section, flags=re.M)
        for part in [start] if _has_command(start) else [start, *subsections]:
            title = part.splitlines()[0]
            figures = re.search(r"\d", CODE.sub(blank, part.partition("\n")[2]))
            if figures and not _has_command(part):
                fault = "has figures, but no command that reproduces them"
                yield f"{where}: the section {title!r} {fault}"


def _has_command(part: str) -> bool:
    return any(
        words[0] in {"skindb", "python", "pytest"}
        for _, words in commands(part)
        if words
    )


def main() -> int:
    """Run all checks, and print the faults."""
    texts = [*help_texts(), *notebook_texts()]
    faults = [fault for where, text in texts for fault in term_faults(where, text)]
    for path in sources():
        faults += source_faults(
            path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")
        )
    calls = 0
    for page in pages():
        where = page.relative_to(ROOT).as_posix()
        text = page.read_text(encoding="utf-8")
        faults += [*term_faults(where, text), *comment_faults(where, text)]
        for line, words in commands(text):
            calls += 1
            said = command_fault(words) if words else ""
            faults += [f"{where}:{line}: {' '.join(words)}: {said}"] if said else []
        faults += (
            figure_faults(where, text)
            if where.removeprefix("docs/").startswith(RESULTS)
            else []
        )
        faults += link_faults(page, text)
    sys.stdout.write("".join(f"{fault}\n" for fault in faults))
    sys.stdout.write(
        f"{calls} commands and {len(pages())} pages checked, {len(faults)} faults\n"
    )
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
