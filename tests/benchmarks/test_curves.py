"""Curves of methods that a user does not choose."""

from __future__ import annotations

import json

import pytest

from benchmarks.curves import CURVES, main


@pytest.mark.slow
def test_main__writes_the_curves_that_are_named(tmp_path):
    main(tmp_path, only=["components", "permutations"], quick=True)
    written = json.loads((tmp_path / "bench.json").read_text())
    assert written["errors"] == {}
    assert {p["kernel"] for p in written["points"]} == {"components", "permutations"}
    assert all(
        (tmp_path / f"{name}.png").is_file()
        for name in written["seconds"]
        if name in CURVES
    )
