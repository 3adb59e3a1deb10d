"""`skindb bench` end to end, and its result for methods that fail and kernels that stop."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner

from skindb.bench import KERNELS, run
from skindb.bench.curve import Curve, Point
from skindb.bench.photometry import model_samples
from skindb.cli import cli
from skindb.fit import refit
from skindb.reflectance.separation import surface_lobes
from skindb.reflectance.tables import stored_brdf
from skindb.schema import dataset, label


def test_kernels__are_those_that_are_measured():
    assert tuple(run.CURVES) == KERNELS


def _run(out, *args):
    return CliRunner().invoke(
        cli, ["bench", "--out", str(out), "--quick", "--no-progress", *args]
    )


def _strict(text):
    def refuse(word):
        raise AssertionError(word)

    return json.loads(text, parse_constant=refuse)


@pytest.mark.slow
def test_bench__writes_the_json_that_it_prints(tmp_path):
    done = _run(
        tmp_path / "new/bench", "--only", "inverse", "--only", "exposures", "--json"
    )
    assert done.exit_code == 0, done.output
    said = _strict(done.stdout)
    assert said == _strict((tmp_path / "new/bench/bench.json").read_text())
    assert {p["kernel"] for p in said["points"]} == {"inverse", "exposures"}
    for p in said["points"]:
        assert p["error"] >= 0
        assert p["reference"]
        assert p["error_of"]
        assert p["seconds"] is None or (p["seconds"] > 0 and p["ratio"] > 0)
    # the method of reference is part of the run
    for kernel in ("inverse", "exposures"):
        assert any(p["ratio"] == 1 for p in said["points"] if p["kernel"] == kernel)
        assert (tmp_path / f"new/bench/{kernel}.png").read_bytes()[:4] == b"\x89PNG"
    own = {p["method"]: p for p in said["points"] if p["kernel"] == "inverse"}
    assert own["skindb dipole_s"]["error"] < 1e-12
    # an unsuitable method, with the reason
    assert own["alpha' in single precision"]["error"] > 0.3
    assert any(
        "alpha' in single precision" in line and "cancellation" in line
        for line in said["failures"]
    )
    assert said["errors"] == {}


def test_bench__a_kernel_that_stops_is_listed_and_the_others_are_measured(
    tmp_path, monkeypatch
):
    curve = Curve("nmf", "e", "r", "s", "a, 1", [Point("a", "1", 2.0, 0.1, "too slow")])
    monkeypatch.setitem(run.CURVES, "exposures", lambda quick: [][0])
    monkeypatch.setitem(run.CURVES, "nmf", lambda quick: [curve])
    done = _run(tmp_path, "--only", "exposures", "--only", "nmf")
    assert done.exit_code == 1
    assert "fails: exposures: IndexError: list index out of range" in done.output
    assert "fails: nmf: a, 1: too slow" in done.output
    assert "Traceback" not in done.output
    said = _strict((tmp_path / "bench.json").read_text())
    assert [p["kernel"] for p in said["points"]] == ["nmf"]
    assert said["errors"] == {"exposures": "IndexError: list index out of range"}


def test_bench__unknown_kernel_is_bad_usage(tmp_path):
    done = _run(tmp_path, "--only", "guess")
    assert done.exit_code == 2
    assert "guess" in done.output


def test_curve__ratio_is_to_the_stated_method():
    curve = Curve(
        "k",
        "e",
        "r",
        "s",
        "a, 1",
        (Point("a", "1", 2.0, 0.1), Point("b", "", 0.5, 0.2)),
    )
    assert [curve.ratio(p) for p in curve.points] == [1.0, 0.25]
    assert math.isnan(curve.ratio(Point("c", "", math.nan, 0.1)))


def test_model_samples__have_what_fits_of_surfaces_read():
    """`benchmarks/stated_errors.py` refits them."""
    size = {"surfels": 2, "lights": 12, "cameras": 2}
    skin = model_samples(np.random.default_rng(0), **size, noise=0.01, gloss=0.1)
    diffuse = label("diffuse_reflectance", skin.diffuse)
    table, _ = surface_lobes()
    basis = dataset({"basis_brdf": stored_brdf(table[..., :1])})
    refitted = refit(skin.with_normals.assign(diffuse_reflectance=diffuse), basis=basis)
    assert refitted["basis_weight"].shape == (2, 1)
