"""Stale results are refused or read with a warning, and `refresh` computes them again
in order of dependence.
"""

from __future__ import annotations

import shutil
import warnings

import numpy as np
import pytest
from planted_population import TABLES, population

from skindb import workflow
from skindb.errors import InputError
from skindb.store import Database, StaleWarning, require_fresh, stale_versions
from skindb.workflow import studies

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", autouse=True)
def _tables():
    with pytest.MonkeyPatch.context() as patch:
        # 8 of the 59
        patch.setattr(studies, "dictionary_tables", lambda *_: TABLES)
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder of a database of takes A, A.lotion, B, C and studies of them, which is only copied."""
    db = Database(tmp_path_factory.mktemp("made") / "db")
    for take in population():
        _commit(db, take)
    workflow.translucency(db)
    workflow.translucency(db, group_by="condition")
    workflow.traits(db, k=3, name="three")
    workflow.edit(db, "B", {"lotion": 0.5})
    return db.root


@pytest.fixture
def db(made, tmp_path):
    """Takes A, A.lotion, B, C and studies of them."""
    return Database(shutil.copytree(made, tmp_path / "db"))


def _commit(db, take, **about):
    model = population()[take]
    with db.stage("model", take) as stage:
        stage.write(
            {str(name): node.to_dataset() for name, node in model.children.items()}
        )
        stage.commit(model.attrs | about)


def _stale(db):
    return {
        (r.kind, r.take): sorted({one.why for one in reasons})
        for r, reasons in stale_versions(db)
    }


def test_studies__one_asked_for_differently_replaces_no_other(db):
    assert db.takes("population") == [
        "traits.three",
        "translucency",
        "translucency.group_by-condition",
    ]
    assert (
        db.read("population", "translucency")["translucency_table"].sizes["group"] == 1
    )
    workflow.translucency(db, takes=["A", "B"])
    [other] = set(db.takes("population")) - {
        "traits.three",
        "translucency",
        "translucency.group_by-condition",
    }
    assert len(other) == len("translucency.") + 16
    with pytest.raises(InputError, match="name of a study: must match"):
        workflow.translucency(db, name="../x")


def test_groups__are_stored_by_what_is_compared_and_made_again(db):
    for who in ("D", "E"):
        with db.stage("model", who) as stage:
            model = population()["A"]
            stage.write(
                {str(name): node.to_dataset() for name, node in model.children.items()}
            )
            traits = {
                "age": 30 + ord(who),
                "gender": "male" if who == "D" else "female",
            }
            stage.commit(model.attrs | {"subject": who, "traits": traits})
    first = workflow.groups(db, group_by="gender", adjust=["age"], permutations=100)
    assert first.attrs["study"] == "groups.group_by-gender_adjust-age_permutations-100"
    assert first["effects"]["effect_count"].sel(
        quantity="sigma_tr cheek R"
    ).values.tolist() == [[3, 2]]
    _commit(db, "C")
    assert _stale(db)["population", first.attrs["study"]] == ["superseded"]
    workflow.refresh(db)
    second = db.read("population", first.attrs["study"])
    assert second.attrs["generation"] == first.attrs["generation"] + 1
    np.testing.assert_array_equal(
        second["effects"]["effect_p"], first["effects"]["effect_p"]
    )


def test_edit__names_the_studies_there_are(db):
    with pytest.raises(
        InputError,
        match=(
            r"study traits.k-9: must be a study of traits .*studies of traits: "
            r"traits.three; name one"
        ),
    ):
        workflow.edit(db, "B", {"lotion": 0.5}, study="traits.k-9")


def test_stale_versions__a_new_model_supersedes_what_was_made_from_the_old_one(db):
    assert _stale(db) == {}
    _commit(db, "C")
    assert _stale(db) == {
        ("population", "traits.three"): ["superseded"],
        ("population", "translucency"): ["superseded"],
        ("population", "translucency.group_by-condition"): ["superseded"],
        ("edit", "B"): ["superseded"],  # through the study of traits
    }
    with pytest.warns(
        StaleWarning, match="edit 1 of B is out of date: model 1 of C was superseded"
    ):
        require_fresh(db, "edit", "B")


def test_refresh__makes_results_again_in_order_of_dependence(db):
    _commit(db, "C")
    done = workflow.refresh(db)
    assert [(one.kind, one.take) for one in done] == [
        ("population", "traits.three"),
        ("population", "translucency"),
        ("population", "translucency.group_by-condition"),
        ("edit", "B"),
    ]
    assert all(
        one.record is not None and one.record.generation == 2 and not one.fault
        for one in done
    )
    assert _stale(db) == {}
    assert (
        db.record("edit", "B").made_from[1]
        == db.record("population", "traits.three").as_input()
    )
    again = db.read("population", "traits.three")
    assert (
        again.attrs["parameters"]
        == db.read("population", "traits.three", generation=1).attrs["parameters"]
    )
    # the model of C is the same as before, so the result is
    np.testing.assert_array_equal(
        again["traits/trait_brdf_shift"],
        db.read("population", "traits.three", generation=1)["traits/trait_brdf_shift"],
    )
    assert workflow.refresh(db) == []


def test_refresh__leaves_out_whose_consent_was_narrowed(db):
    db.record_consent("C", ["fit"])
    assert list(_stale(db).values()) == [["not covered"]] * 4
    with pytest.raises(
        InputError,
        match=r"population 1 of traits.three: .*found C: consent no longer covers",
    ):
        workflow.edit(db, "B", {"lotion": 0.5})
    workflow.refresh(db)
    assert _stale(db) == {}
    study = db.read("population", "traits.three")
    assert [one["take"] for one in study.attrs["inputs"]] == ["A", "A.lotion", "B"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        workflow.edit(db, "B", {"lotion": 0.5})


def test_refresh__reports_what_cannot_be_made_again(db):
    for subject in "ABC":
        db.record_consent(subject, ["fit"])
    done = workflow.refresh(db)
    assert all(one.record is None and "consent" in one.fault for one in done)
    assert len(done) == 4


def test_studies__of_a_release_are_repeated_with_the_same_values(db):
    db.create_release("r1")
    first = workflow.translucency(db, release="r1")
    assert first.attrs["study"] == "translucency.release-r1"
    changed = population()["B"]
    sites = changed["translucency"].to_dataset()
    changed["translucency"] = sites.assign(site_sigma_tr=sites["site_sigma_tr"] * 2)
    with db.stage("model", "B") as stage:
        stage.write(
            {str(name): node.to_dataset() for name, node in changed.children.items()}
        )
        stage.commit(changed.attrs)
    assert ("population", "translucency.release-r1") not in _stale(db)
    second = workflow.translucency(db, release="r1")
    newest = workflow.translucency(db)
    one, two, other = (
        tree["translucency_table/sigma_tr_mean"].values
        for tree in (first, second, newest)
    )
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other, equal_nan=True)
    db.record_consent("A", ["fit"])  # the newest consent counts in a release, too
    assert ("population", "translucency.release-r1") in _stale(db)


def test_stale_versions__a_damaged_input_is_no_withdrawn_one(db):
    """Nothing is computed again without the data of a damaged record, and messages do
    not call it removed.
    """
    path = db.folder / "log/model/A/00000001.json"
    path.chmod(0o600)
    path.write_text(path.read_text().replace('"contents"', '"content"'))
    assert _stale(db) == {}
    with pytest.raises(
        InputError,
        match=r"model 1 of A cannot be read \(skindb verify.*restore the damaged records",
    ):
        require_fresh(db, "population", "traits.three")
    assert (
        "cannot be read"
        in db.info()["studies"]["traits.three"]["population"]["stale"][0]
    )
