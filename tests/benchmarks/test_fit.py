"""The benchmark of the fit with and without another revision; the driver is replaced."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from benchmarks import fit

PARTS = ("normals", "albedo", "dictionary fit", "linear refit of 4 components")
STAGE = {"cpu": 2.0, "wall": 4.0}


@pytest.fixture
def calls(monkeypatch):
    """Calls of the driver: folder of the code, action, and folder of the database."""
    calls = []

    def drive(code, action, folder, name, threads=None):
        calls.append((code.name, action, folder.name))
        folder.mkdir(exist_ok=True)
        return {
            "ingest": {"take": "V001"},
            "parts": dict.fromkeys(PARTS, 10.0),
            "fit": {"stages": {"first pass": STAGE, "all": STAGE}, "peak": 0.5},
            "read": {"cpu": 0.1, "wall": 0.4},
        }[action]

    opened = SimpleNamespace(
        takes=lambda kind: ["V001"], read=lambda kind, take: "a model"
    )
    monkeypatch.setattr(fit, "drive", drive)
    monkeypatch.setattr(fit, "extract", lambda revision, folder: folder.mkdir())
    monkeypatch.setattr(fit.skindb, "open", lambda folder: opened)
    monkeypatch.setattr(fit, "differences", lambda *models: {"normal": 0.25})
    return calls


def test_measure__of_the_present_code(calls, tmp_path):
    text = fit.report(fit.measure(tmp_path, None, 2, tmp_path))
    assert {database for _, _, database in calls} == {"after"}
    assert "| stage | CPU [s] | wall [s] |" in text
    assert "| first pass | 2.0 | 4.0 |" in text
    assert "| normals | 10.0 |" in text
    assert "Reading all samples twice: 10.0% of the CPU time, 20.0%" in text
    assert "stated errors" not in text


def test_measure__compared_with_a_revision(calls, tmp_path):
    text = fit.report(fit.measure(tmp_path, "v1", 2, tmp_path))
    assert calls[0] == ("code", "ingest", "before")
    fits = [(code, database) for code, action, database in calls if action == "fit"]
    # the first ones compile
    assert fits == [("code", "before"), (fit.ROOT.name, "after")] * 3
    assert "| stage | CPU before, after [s] | wall before, after [s] |" in text
    assert "| all | 2.0, 2.0 | 4.0, 4.0 |" in text
    assert "| normal | 0.25 |" in text
