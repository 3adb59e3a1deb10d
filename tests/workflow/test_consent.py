"""Records of consent: the newest counts immediately, for every step and every version."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner
from planted_cohort import PARAMETERS, few_materials

from skindb import workflow
from skindb.cli import cli
from skindb.errors import InputError
from skindb.store import Database

pytestmark = pytest.mark.slow


@pytest.fixture
def db(fitted_database):
    return fitted_database


def _run(*args):
    result = CliRunner().invoke(cli, [str(one) for one in args], catch_exceptions=False)
    assert result.exit_code == 0
    return result.output


def _refused(call, pattern):
    with pytest.raises(InputError, match=pattern):
        call()


def test_record_consent__counts_at_once_for_everything(db, tmp_path):
    assert db.consent("S01") == ["fit", "statistics", "export"]
    db.record_consent("S01", ["fit", "statistics"])
    assert db.consent("S02") == ["fit", "statistics", "export"]
    for take in ("S01", "S01.lotion"):  # of the subject, not of the take
        assert db.consent(take) == ["fit", "statistics"]
        for kind in ("capture", "model"):
            assert db.read(kind, take).attrs["consent_scope"] == ["fit", "statistics"]
    needs = (
        r"S01: consent_scope: .*needs the scope 'export'; found only fit, statistics; "
        r".*skindb consent"
    )
    _refused(lambda: workflow.render_take(db, tmp_path / "a.png", "S01"), needs)
    _refused(lambda: workflow.compare_take(db, "S01"), needs)
    _refused(
        lambda: workflow.show_take(db, "S01", "fit_status", tmp_path / "b.png"), needs
    )
    _refused(
        lambda: workflow.export_take(db, tmp_path / "c", "S01"),
        "needs the scope 'export'",
    )
    assert not list(tmp_path.glob("*.png"))
    assert set(db.cohort("tables")["take"].values.tolist()) == {
        "S01",
        "S01.lotion",
        "S02",
    }
    db.record_consent("S01", ["fit", "export"])
    assert db.cohort("tables")["take"].values.tolist() == ["S02"]
    assert db.table().loc["S01.lotion", "consent"] == "fit, export"
    workflow.show_take(db, "S01", "fit_status", tmp_path / "b.png")
    db.record_consent("S01", [])
    refit = "needs the scope 'fit'; found no scope at all"
    _refused(
        lambda: workflow.fit_take(db, "S01.lotion", dictionary=few_materials()), refit
    )
    assert db.verify() == []


def test_commit__of_what_a_subject_refused_during_the_work(db, monkeypatch):
    """The consent is recorded while a fit or a study is computed."""
    begin = Database.stage

    def refused_meanwhile(self, kind, take, lease=None, **options):
        if kind != "consent" and self.url == db.url:  # not for its scratch
            self.record_consent("S01", [])
        return begin(self, kind, take, lease, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Database, "stage", refused_meanwhile)
        line = (
            "model of S01: its subject must consent to fit .*; found no such consent "
            "since 20.*; nothing was"
        )
        _refused(lambda: workflow.fit_take(db, "S01", dictionary=few_materials()), line)
        db.record_consent("S01", ["fit", "statistics"])
        _refused(
            lambda: workflow.translucency(db),
            "study translucency, S01: its subject must consent to statistics",
        )
    assert len(db.history("model", "S01")) == 1
    assert db.takes("population") == []
    assert (db.verify(), [one for one in db.garbage() if not one.kept]) == ([], [])


def test_record_consent__of_unknown_subjects_and_scopes(db):
    _refused(
        lambda: db.record_consent("nobody", ["fit"]),
        "nobody: the database must hold .* found subjects: S01, S02;",
    )
    _refused(
        lambda: db.record_consent("S01", ["fit", "sell"]),
        "a scope must be one of fit, statistics.* found 'sell'",
    )
    _refused(
        lambda: db.record_consent("../S01", ["fit"]),
        "the database must hold the subject",
    )
    assert not db.has("consent", "S01")


def test_edit__needs_statistics_of_whom_it_moves(db):
    study = db.stage("population", "traits")
    with study:
        study.commit({"inputs": []})
    db.record_consent("S01", ["fit", "export"])
    with pytest.raises(InputError, match="needs the scope 'statistics'"):
        workflow.edit(db, "S01", {"gender:male": 1.0})


def test_consent_command__records_and_lists(db):
    listed = json.loads(_run("consent", db.root, "S01", "--json"))
    assert [one["source"] for one in listed] == [
        "capture of S01",
        "capture of S01.lotion",
    ]
    _run("consent", db.root, "S01", "--scope", "fit, statistics")
    assert (
        _run("consent", db.root, "S01", "--scope", "none")
        .splitlines()[-1]
        .endswith("  none  (record)")
    )
    listed = json.loads(_run("consent", db.root, "S01", "--json"))
    assert [one["scope"] for one in listed[-2:]] == [["fit", "statistics"], []]
    [line] = [one for one in _run("info", db.root).splitlines() if " consent " in one]
    assert line.startswith("S01 ")
    assert line.endswith("  none")
    assert db.info()["consents"]["S01"]["consent"]["scope"] == []
    assert set(db.info()["takes"]) == {"S01", "S01.lotion", "S02"}


@pytest.mark.parametrize(
    ("scope", "found"),
    [
        ("", "found '';"),
        (" , ", "found ' , ';"),
        ("none,fit", "found 'none,fit'"),
        ("x", "'x'"),
    ],
)
def test_consent_command__a_scope_that_says_nothing_is_no_refusal_of_everything(
    db, scope, found
):
    """For example, a script has an empty variable: nothing is recorded."""
    result = CliRunner().invoke(cli, ["consent", str(db.root), "S01", "--scope", scope])
    assert found in str(result.exception)
    assert len(db.consent_history("S01")) == 2
    result = CliRunner().invoke(cli, ["consent", str(db.root), "S01.lotion"])
    assert "the database must hold the subject" in str(result.exception)
    assert "the subject of that take is S01" in str(result.exception)


@pytest.mark.parametrize(
    ("answer", "says"), [("n\n", "Nothing was removed."), ("", "must be confirmed")]
)
def test_withdraw_command__without_a_yes_removes_nothing(db, answer, says):
    workflow.translucency(db)
    workflow.fit_take(db, "S01", PARAMETERS, dictionary=few_materials())
    workflow.translucency(db)
    result = CliRunner().invoke(cli, ["withdraw", str(db.root), "S02"], input=answer)
    assert says in result.output + str(result.exception)
    assert (
        "compute the newest again without S02: population of translucency (generations 1, 2)"
        in result.stderr
    )
    assert db.has("model", "S02")


def test_analyze_command__refuses_options_of_other_studies(db):
    for option in (
        ("--k", "3"),
        ("--seed", "1"),
        ("--permutations", "200"),
    ):
        result = CliRunner().invoke(
            cli, ["analyze", str(db.root), "translucency", *option]
        )
        assert result.exit_code == 2
        assert f"No such option '{option[0]}'" in result.output
    assert db.takes("population") == []
