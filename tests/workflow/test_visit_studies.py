"""Studies of repeated takes on the command line, from a database."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner
from planted_population import model_of

from skindb.cli import cli
from skindb.store import Database

PEOPLE = {"A": "female", "B": "male", "C": "female", "D": "male"}


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """Models of four subjects at two visits."""
    db = Database(tmp_path_factory.mktemp("visits") / "db")
    for number, (subject, gender) in enumerate(PEOPLE.items()):
        for take in (subject, f"{subject}.normal.2"):
            model = model_of(
                10 * number + len(take),
                tint=0.6 + 0.1 * number,
                subject=subject,
                traits={"gender": gender},
            )
            with db.stage("model", take) as stage:
                groups = model.children.items()
                stage.write({name: group.to_dataset() for name, group in groups})
                stage.commit(model.attrs)
    return db


def analyze(db, *arguments):
    result = CliRunner().invoke(cli, ["analyze", db.url, *arguments])
    assert result.exit_code == 0, result.output
    return result.output


def test_analyze__says_how_visits_count(db):
    printed = analyze(db, "groups", "--group-by", "gender").splitlines()
    assert printed[0] == (
        "visits: 8 takes of 4 subjects; a subject counts with the mean over its visits "
        "and repeats in a condition"
    )


def test_analyze__names_with_a_comma_are_in_quotes(db):
    options = ["--group-by", "gender", "--adjust", '"skin, hand"']
    result = CliRunner().invoke(cli, ["analyze", db.url, "groups", *options])
    assert str(result.exception).startswith("adjust skin, hand: must be an attribute")


def test_analyze_repeatability__is_a_stored_study(db, tmp_path):
    plot = tmp_path / "icc.png"
    report = json.loads(analyze(db, "repeatability", "--json", "--plot", str(plot)))
    assert report["study"] == "repeatability"
    assert report["visits"] == ""
    row = dict(zip(report["header"], report["rows"][0], strict=True))
    assert (row["quantity"], row["repeat_takes"]) == ("R_d face R", 8)
    assert row["icc_low"] < row["icc"] < row["icc_high"]
    assert plot.stat().st_size > 1000


def test_analyze_model__is_a_stored_study(db, tmp_path):
    plot = tmp_path / "model.png"
    formula = "ITA ~ gender + visit + (1 | subject)"
    report = json.loads(analyze(db, "model", formula, "--json", "--plot", str(plot)))
    assert report["study"].startswith("model.")
    rows = [dict(zip(report["header"], row, strict=True)) for row in report["rows"]]
    of_face = [row["term"] for row in rows if row["quantity"] == "ITA face"]
    assert of_face == ["Intercept", "gender[T.male]", "visit"]
    assert rows[0]["model_subjects"] == 4
    assert report["notes"][0].startswith(
        f"{formula}; every visit and repeat counts, in"
    )
    assert plot.stat().st_size > 1000
    stored = db.read("population", report["study"])["linear_model"]
    assert stored.attrs["formula"] == formula


def test_analyze_plan__is_a_stored_study(db, tmp_path):
    plot = tmp_path / "plan.png"
    formula = "ITA ~ treatment + (1 | subject)"
    options = ["--effect", "3", "--design", "crossover", "--plot", str(plot)]
    report = json.loads(analyze(db, "plan", formula, *options, "--json"))
    rows = [dict(zip(report["header"], row, strict=True)) for row in report["rows"]]
    assert (rows[0]["quantity"], rows[0]["known_subjects"]) == ("ITA face", 4)
    assert rows[0]["plan_subjects"] >= 2
    assert plot.stat().st_size > 1000
