"""Studies of repeated takes on the command line, from a database."""

from __future__ import annotations

import json
import shutil

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
            tint = 0.6 + 0.1 * number
            about = {"subject": subject, "traits": {"gender": gender}}
            _store(db, take, model_of(10 * number + len(take), tint=tint, **about))
    return db


def _store(db, take, model):
    with db.stage("model", take) as stage:
        groups = model.children.items()
        stage.write({name: group.to_dataset() for name, group in groups})
        stage.commit(model.attrs)


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


@pytest.mark.parametrize(
    ("arguments", "conditions"),
    [
        (["groups", "--group-by", "gender"], "normal"),
        (["albedo", "--group-by", "gender"], "normal"),
        (["repeatability"], "normal"),
        (["model", "ITA ~ gender + (1 | subject)"], "normal"),
        (["model", "ITA ~ visit + powder + (1 | subject)"], "normal or powder"),
        (["plan", "ITA ~ treatment + (1 | subject)", "--visits", "2"], "normal"),
        (["translucency", "--group-by", "lotion"], ""),
        (["model", "ITA ~ condition + (1 | subject)"], ""),
    ],
)
def test_analyze__names_subjects_without_a_take_that_counts(
    db, tmp_path, arguments, conditions
):
    other = Database(shutil.copytree(db.root, tmp_path / "db"))
    for subject, condition in [("B", "powder"), ("C", "powder"), ("E", "lotion")]:
        model = model_of(
            7,
            tint=0.5 + 0.1 * len(condition),
            subject=subject,
            condition=condition,
            traits={"gender": "male", "powder": 2.0},
        )
        _store(other, f"{subject}.{condition}", model)
    report = json.loads(analyze(other, *arguments, "--json"))
    found = [
        line["take"] for line in report["skipped"] if "condition" in line["reason"]
    ]
    assert found == (["E"] if conditions else [])
    if conditions:
        reason = report["skipped"][0]["reason"]
        assert reason == f"no take in the condition {conditions}"
