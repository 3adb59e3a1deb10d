"""Curves of methods that a user does not choose."""

from __future__ import annotations

import json

import pytest

from benchmarks.curves import CURVES, main, transport_curves
from skindb.optics.diffusion import dipole_profile
from skindb.optics.transport import transport_profile


@pytest.mark.slow
def test_transport_curves__distances_are_mean_free_paths():
    """With sigma_t' = 1, the dipole at one mean free path is twice the random walk."""
    (curve,) = transport_curves(quick=True)
    (point,) = [p for p in curve.points if p.name == "skindb dipole, albedo 0.7"]
    for r in (1.0, 2.0):
        ratio = dipole_profile(r, 0.3, 0.7, eta=1.3) / transport_profile(
            r, 0.3, 0.7, eta=1.3
        )
        # noise 8 %
        assert point.details[f"at_{r:g}"] == pytest.approx(float(ratio) - 1, abs=0.25)


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
