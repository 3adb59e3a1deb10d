"""What the command line prints: control characters in data never reach the terminal."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

import skindb
from skindb.cli import _one_line, cli
from skindb.cli.shared import aligned
from skindb.cli.terminal import HelpFormatter, Progress, echo
from skindb.cli.upkeep import _info_lines
from skindb.errors import SkindbWarning

sys.path.insert(0, str(Path(__file__).parent / "store"))
from stored import commit
from test_cli import _run

HOSTILE = "S1\x1b[2J\x07\x9b31m\r\nS01: intact \u202etxt\u2028\udc80\x00"
SAFE = r"S1\x1b[2J\x07\x9b31m\r\nS01: intact \u202etxt\u2028\udc80\x00"


def lines_of(text):
    """Lines of an output that must not contain a control character."""
    assert all(line.isprintable() for line in text.split("\n")), repr(text)
    return text.split("\n")


def test_echo__prints_one_line_for_each(capsys):
    echo(HOSTILE, "plain größe", err=True)
    assert lines_of(capsys.readouterr().err) == [SAFE, "plain größe", ""]


def test_main__escapes_results_faults_and_wrong_usage(tmp_path):
    """Records that another program wrote may hold anything; this one names a scope of consent."""
    root = str(tmp_path / "db")
    commit(root, take="S1", consent_scope=["fit", HOSTILE])
    assert f"fit, {SAFE}" in lines_of(_run("consent", root, "S1").stdout)[0]
    # which no argument can hold
    shown = HOSTILE.replace("\0", "").replace("\udc80", "")
    assert r"\x1b[2J" in lines_of(_run("info", shown).stderr)[0]
    assert any(
        r"No such option '--S1\x1b[2J" in line
        for line in lines_of(_run("info", f"--{shown}").stderr)
    )
    # a message of several lines
    assert lines_of(_run("analyze", "x").stderr)[-2].strip() == "plan"


def test_main__escapes_warnings():
    assert _one_line(HOSTILE, SkindbWarning, "f.py", 3) == f"skindb: warning: {SAFE}\n"
    assert (
        _one_line(HOSTILE, UserWarning, "f.py", 3)
        == f"skindb: warning: f.py:3: UserWarning: {SAFE}\n"
    )


@pytest.mark.parametrize("columns", [20, 60, 80, 200])
def test_progress__a_bar_fits_the_terminal(capsys, monkeypatch, columns):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", str(columns))
    progress = Progress("bar")
    progress.begin_takes(3)
    progress("samples of the surfels from 2,400 photographs", 1, 2)
    assert 10 < len(capsys.readouterr().err.strip("\r\n")) < columns


def test_aligned__continues_a_wide_table_below_with_its_text_columns():
    rows = [["site", "channel", "mean", "count"], ["cheek", "R", 0.25, 12]]
    assert aligned(rows, 30) == [
        "site   channel  mean  count",
        "cheek  R        0.25  12",
    ]
    assert aligned(rows, 22) == [
        "site   channel  mean",
        "cheek  R        0.25",
        "site   channel  count",
        "cheek  R        12",
    ]


def test_info__explains_the_star_of_a_take_alone():
    version = {"generation": 3, "bytes": 0, "created": "2026-01-02T03", "stale": ["x"]}
    lines = _info_lines(None, {"takes": {"A": {"edit": version}}}, details=False)
    assert lines[1].split() == ["A", "2026-01-02", "0.0", "3*"]
    assert lines[2] == "* out of date: skindb refresh computes it again"


def test_help__has_a_section_for_each_purpose_and_colour_on_terminals_alone():
    said = _run("--help").stdout
    assert "\nSubjects:\n  consent   Show" in said
    assert {line.split()[0] for line in lines_of(said) if line[:3].strip()} >= set(
        cli.commands
    )
    formatter = HelpFormatter()
    formatter.write_heading("Options")
    formatter.write_dl([("--out PATH", "Picture of one take")])
    assert formatter.getvalue() == (
        "\x1b[1mOptions\x1b[0m:\n\x1b[36m--out PATH\x1b[0m  Picture of one take\n"
    )


def test_progress__escapes_stages(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    progress = Progress("bar")
    progress(HOSTILE, 1, 2)
    progress(HOSTILE, 2, 2)
    printed = capsys.readouterr().err
    assert printed.count("\r") == 2
    assert all(SAFE[:40] in line for line in lines_of(printed.replace("\r", ""))[:-1])


def test_cli__prints_through_one_module():
    """Modules of the command line call no other function that prints."""
    printing = {
        "echo",
        "secho",
        "print",
        "prompt",
        "confirm",
        "pause",
        "echo_via_pager",
        "write",
    }
    folder = Path(skindb.__file__).parent / "cli"
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if path.name != "terminal.py" and isinstance(node, ast.Call):
                called = node.func
                of_click = isinstance(called, ast.Attribute) and ast.unparse(
                    called.value
                ) in ("click", "sys.stdout")
                assert not of_click or called.attr not in printing, (
                    f"{path.name}:{node.lineno}"
                )
                assert not isinstance(called, ast.Name) or called.id != "print", (
                    f"{path.name}:{node.lineno}"
                )
