"""Tables and figures of the paper from a database."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from skindb import workflow
from skindb.errors import InputError
from skindb.store import Database
from skindb.workflow import paper

pytestmark = pytest.mark.slow


def test_reproduce__writes_what_the_takes_allow_and_says_why_not(
    fitted_database, tmp_path
):
    workflow.record_consent(fitted_database, "S02", ["fit", "statistics"])
    reasons = workflow.reproduce(fitted_database, tmp_path)
    page = (tmp_path / "figures.md").read_text()
    assert page.startswith("# Tables")
    assert "3 takes of 2 subjects; figures of one face are of S01." in page
    for title, reason in reasons.items():
        part = page.partition(f"## {title}\n")[2].partition("\n## ")[0]
        assert "The paper: " in part
        if reason:
            assert f"Not made: {reason}" in part
        else:
            assert "Not made" not in part
    made = {title.partition(":")[0] for title, reason in reasons.items() if not reason}
    # the takes have neither photographs nor the whole dictionary
    figures = {5, 6, 10, 16}
    assert made == {"Table 1", "Table 2", *(f"Figure {number}" for number in figures)}
    pictures = {path.name for path in tmp_path.glob("*.png")}
    assert pictures == {f"figure_{number}.png" for number in figures}


def test_reproduce__prints_the_means_and_variances_of_the_study(
    fitted_database, tmp_path
):
    workflow.reproduce(fitted_database, tmp_path, take="S02")
    page = (tmp_path / "figures.md").read_text()
    table = workflow.translucency(fitted_database)["translucency_table"].isel(group=0)
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in page.splitlines()
        if line.startswith("| cheek |")
    ]
    for channel, row, published in zip(
        "RGB", rows, (0.5572, 0.9751, 1.5494), strict=True
    ):
        at = table.sel(site="cheek", channel=channel)
        assert int(row[2]) == at["sigma_tr_count"]
        np.testing.assert_allclose(float(row[3]), at["sigma_tr_mean"], rtol=1e-3)
        np.testing.assert_allclose(float(row[4]), at["sigma_tr_variance"], rtol=1e-3)
        assert float(row[5]) == published


def test_edits__name_the_traits_that_the_takes_do_not_have(
    fitted_database, tmp_path, monkeypatch
):
    found = xr.Dataset(coords={"trait": ["condition:lotion", "age"]})
    found = xr.DataTree.from_dict({"traits": found})
    # both need the whole dictionary
    monkeypatch.setattr(paper, "study", lambda *_, **__: found)
    monkeypatch.setattr(paper, "edit_grid", lambda *_, **__: {})
    source = paper.Source(
        fitted_database, fitted_database.table(), "S01", None, paper.silent
    )
    lines = paper._edits(source, tmp_path / "figure.png")
    assert lines[-3:] == [
        "The takes have no beard_density.",
        "The takes have no ancestry:european.",
        "The takes have no condition:tan.",
    ]


def test_reproduce__refuses_a_database_without_models(tmp_path):
    with pytest.raises(InputError, match="fit"):
        workflow.reproduce(Database(tmp_path / "db"), tmp_path / "out")


def test_reproduce__refuses_a_take_without_a_model(fitted_database, tmp_path):
    with pytest.raises(InputError, match="S09"):
        workflow.reproduce(fitted_database, tmp_path / "out", take="S09")
    assert not (tmp_path / "out").exists()


def test_people__have_any_words_for_their_attributes():
    table = pd.DataFrame(
        {
            "subject": ["3", "nan", "3"],
            "condition": "normal",
            "age": [31, "31-40", None],
            "gender": ["f", 2, "f"],
        }
    )
    source = paper.Source(None, table, "3", None, print)
    (page,) = paper._people(source, None)
    assert page.splitlines()[2:] == [
        "| normal | - | f | 1 | 31 | 31 |",
        "| normal | - | 2 | 1 | - | - |",
    ]
