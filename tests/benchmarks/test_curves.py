"""Curves of error against CPU time: the file, methods that fail and kernels that stop."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks import curves
from benchmarks.curve import Curve, Point
from benchmarks.curves_photometry import model_samples
from skindb.fit import refit
from skindb.reflectance.separation import surface_lobes
from skindb.reflectance.tables import stored_brdf
from skindb.schema import dataset, label


@pytest.mark.slow
def test_main__writes_the_curves_that_are_named(tmp_path):
    names = ["inverse", "exposures", "components", "permutations"]
    assert curves.main(names, out=tmp_path, quick=True) == 0
    written = json.loads((tmp_path / "curves.json").read_text())
    assert {p["kernel"] for p in written["points"]} == set(names)
    assert all((tmp_path / f"{name}.png").is_file() for name in names)
    inverse = {p["method"]: p for p in written["points"] if p["kernel"] == "inverse"}
    assert inverse["skindb dipole_s"]["error"] < 1e-12
    # an unsuitable method, with the reason
    assert inverse["alpha' in single precision"]["error"] > 0.3
    assert "cancellation" in inverse["alpha' in single precision"]["failure"]


def test_main__a_kernel_that_stops_is_listed_and_the_others_are_measured(
    tmp_path, monkeypatch, capsys
):
    points = [Point("a", "1", 2.0, 0.1, "too slow"), Point("b", "", 0.5, 0.2)]
    curve = Curve("nmf", "e", "r", "s", "a, 1", points)
    monkeypatch.setitem(curves.CURVES, "exposures", lambda quick: [][0])
    monkeypatch.setitem(curves.CURVES, "nmf", lambda quick: [curve])
    assert curves.main(["exposures", "nmf"], out=tmp_path) == 1
    printed = capsys.readouterr().out
    assert "fails: exposures: IndexError: list index out of range" in printed
    assert "fails: nmf: a, 1: too slow" in printed
    written = json.loads((tmp_path / "curves.json").read_text())
    assert [(p["kernel"], p["ratio"]) for p in written["points"]] == [
        ("nmf", 1.0),
        ("nmf", 0.25),
    ]
    assert curves.main(["guess"], out=tmp_path) == 2


def test_model_samples__have_what_fits_of_surfaces_read():
    """`benchmarks/stated_errors.py` refits them."""
    size = {"surfels": 2, "lights": 12, "cameras": 2}
    skin = model_samples(np.random.default_rng(0), **size, noise=0.01, gloss=0.1)
    diffuse = label("diffuse_reflectance", skin.diffuse)
    table, _ = surface_lobes()
    basis = dataset({"basis_brdf": stored_brdf(table[..., :1])})
    refitted = refit(skin.with_normals.assign(diffuse_reflectance=diffuse), basis=basis)
    assert refitted["basis_weight"].shape == (2, 1)
