"""`python -m benchmarks`: the list, and options from the parameters of `main`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import pytest

from benchmarks.__main__ import FOLDER, add_options, main, summaries


def test_main__lists_every_benchmark_with_one_line(capsys):
    assert main([]) == 0
    printed = capsys.readouterr().out
    for name, text in summaries().items():
        assert (FOLDER / f"{name}.py").is_file()
        assert f"{name} " in printed
        assert text in printed
        assert text.endswith(".")


def test_main__names_the_benchmarks_if_there_is_none_of_this_name(capsys):
    assert main(["absent"]) == 2
    assert "choose from atlas, basis_size" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("call", "values"),
    [
        (
            "A B --json r.json",
            {"captures": [Path("A"), Path("B")], "json_": Path("r.json")},
        ),
        ("A --delay-ms 0 2.5 --full", {"delay_ms": [0.0, 2.5], "full": True}),
        ("A", {"part": "all", "json_": None, "delay_ms": (1.0,), "full": False}),
    ],
)
def test_add_options__from_the_parameters_of_a_function(call, values):
    def measure(
        captures: Sequence[Path],
        *,
        part: Annotated[str, "What is measured.", ("all", "some")] = "all",
        delay_ms: Sequence[float] = (1.0,),
        full: bool = False,
        json_: Path | None = None,
    ) -> None:
        del captures, part, delay_ms, full, json_

    parser = argparse.ArgumentParser()
    add_options(parser, measure)
    parsed = vars(parser.parse_args(call.split()))
    assert parsed | values == parsed
    assert "What is measured." in parser.format_help()
    with pytest.raises(SystemExit):
        parser.parse_args(["A", "--part", "none"])
