"""The programs that check the documentation find all kinds of faults, and run the quick
commands.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / ".ci"))

import check_commands
import check_docs


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("The share of surfels is small.", 1),
        ("It took 12 seconds\npassed.", 1),
        ("Machines share a folder.", 0),
        ("`the share of surfels`", 0),
        ("```text\nleft out\n```\n", 0),
    ],
)
def test_term_faults__finds_terms_outside_code(text, found):
    assert len(list(check_docs.term_faults("page", text))) == found


def test_term_faults__names_the_line():
    (fault,) = check_docs.term_faults(
        "page", "```text\nx\n```\n\nOne is left out here.\n"
    )
    assert fault.startswith("page:5: 'left out'")


def test_comment_faults__names_lines_that_begin_with_a_percent_sign():
    (fault,) = check_docs.comment_faults(
        "page", "```text\n% x\n```\n\nIt is met within 8\n% of the truth.\n"
    )
    assert fault.startswith("page:6: '% of the truth.'")


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ('"""The share of surfels."""', 1),
        ("x = 1  # of nobody", 1),
        ('f"{told} surfels"', 0),
        ('"""See `told`."""', 0),
        ("told = 1", 0),
        ('"compiled once, and then kept"', 0),
    ],
)
def test_source_faults__reads_comments_and_strings(source, found):
    assert len(list(check_docs.source_faults("module", source + "\n"))) == found


@pytest.mark.parametrize(
    ("call", "fault"),
    [
        ("skindb fit DB --rank 8", ""),
        ("skindb render DB --light l000 --light l001 --out x.png", ""),
        ("skindb fits DB", "no command"),
        ("skindb fit DB --ranks 8", "No such option"),
        ("skindb fit DB --mode sharp", "not one of"),
        ("skindb compare DB", "Missing argument"),
        ("python -m benchmarks fit CAPTURE", ""),
        ("python -m benchmarks absent DB", "does not exist"),
        ("make absent", "no target"),
    ],
)
def test_command_fault__is_the_message_of_click(call, fault):
    said = check_docs.command_fault(call.split())
    assert bool(said) == bool(fault)
    assert fault in said


def test_commands__joins_lines_and_drops_prompts_and_comments():
    page = (
        "```console\n$ skindb info DB  # takes\n$ skindb fit DB \\\n    --k 3 && "
        "skindb verify DB\nprinted\n```\n"
    )
    calls = [words for _, words in check_docs.commands(page)]
    assert calls == [
        ["skindb", "info", "DB"],
        ["skindb", "fit", "DB", "--k", "3"],
        ["skindb", "verify", "DB"],
        ["printed"],
    ]


def test_figure_faults__requires_a_command_in_every_section_with_figures():
    page = (
        "# Results\n\n## Good\n\n```bash\nskindb verify DB\n```\n\n3 s\n\n## Bad\n\n4 "
        "s\n\n## Words\n\nNothing.\n"
    )
    (fault,) = check_docs.figure_faults("page", page)
    assert "'## Bad'" in fault


def test_figure_faults__lets_subsections_inherit_the_command_before_them_only():
    command = "```bash\nskindb verify DB\n```\n\n"
    page = f"# Results\n\n## Good\n\n{command}### First\n\n1 s\n\n"
    page += (
        f"## Parts\n\nText.\n\n### Good part\n\n{command}2 s\n\n### Bad part\n\n3 s\n"
    )
    (fault,) = check_docs.figure_faults("page", page)
    assert "'### Bad part'" in fault


def test_link_faults__names_files_that_do_not_exist():
    page = check_docs.ROOT / "README.md"
    text = (
        "[a](docs/index.md), [b](docs/absent.md#c), [d](#e), [f](https://example.org/g)"
    )
    assert list(check_docs.link_faults(page, text)) == [
        "README.md: docs/absent.md does not exist"
    ]


@pytest.mark.parametrize(
    ("call", "run"),
    [
        ("skindb info faces -v", True),
        ("skindb fit faces --explain", True),
        ("skindb withdraw faces S01 --dry-run", True),
        ("skindb withdraw faces S01", False),
        ("skindb fit faces", False),
        ("skindb analyze faces traits", False),
        ("skindb info other", False),
        ("python -m benchmarks bucket", False),
    ],
)
def test_is_run__selects_quick_commands_on_the_database_of_the_pages(call, run):
    assert check_commands.is_run(call.split()) == run


def test_calls__are_unique_and_use_takes_of_the_demo():
    found = check_commands.calls()
    assert len({tuple(call) for call in found}) == len(found) > 20
    assert ["skindb", "compare", "faces", "V001", "--out", "comparison"] in found
    assert found[-1][1] in check_commands.LAST


def test_guides__show_pictures_that_load_quickly():
    guides = check_docs.ROOT / "docs/howto"
    for guide in set(guides.glob("*.md")) - {guides / "index.md"}:
        shown = re.findall(r"\.\./pictures/[\w/]+\.\w+", guide.read_text("utf-8"))
        assert shown, guide.name
        for picture in shown:
            assert (guides / picture).stat().st_size <= 150_000, picture
