"""A study that is asked for again is computed only if something changed."""

from __future__ import annotations

import shutil

import pytest
from planted_population import TABLES, population

from skindb import workflow
from skindb.errors import InputError
from skindb.schema.notes import note
from skindb.store import Database
from skindb.workflow import studies
from skindb.workflow.upkeep import repeat_study


@pytest.fixture(scope="module", autouse=True)
def _tables():
    with pytest.MonkeyPatch.context() as patch:
        # 8 of the 59
        patch.setattr(studies, "dictionary_tables", lambda *_: TABLES)
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder of a database of models with `_studies`, which is only copied."""
    db = Database(tmp_path_factory.mktemp("made") / "db")
    for take, model in population().items():
        _store(db, take, model)
    assert _studies(db) == [1, 1]
    return db.root


@pytest.fixture
def db(made, tmp_path):
    """A database of models with `_studies`."""
    return Database(shutil.copytree(made, tmp_path / "db"))


def _store(db, take, model, **about):
    with db.stage("model", take) as stage:
        stage.write(
            {str(name): node.to_dataset() for name, node in model.children.items()}
        )
        stage.commit(model.attrs | about)


def _studies(db):
    """A study of tables and one of samples; their generations."""
    made = [
        workflow.translucency(db),
        workflow.traits(db, k=3),
    ]
    return [tree.attrs["generation"] for tree in made]


@pytest.mark.slow
def test_made__nothing_changed(db, monkeypatch):
    monkeypatch.setattr(
        studies, "dictionary_tables", lambda *_: pytest.fail("computed again")
    )
    assert _studies(db) == [1, 1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "change", ["a model", "an attribute", "a new take", "consent", "code"]
)
def test_made__computed_again_after(db, change_code, change):
    first = "B"
    model = db.read("model", first).load()
    if change == "a model":
        _store(db, first, model)
    elif change == "an attribute":
        traits = {**model.attrs["traits"], "age": 99}
        _store(db, first, model, traits=traits)
    elif change == "a new take":
        model.attrs |= {"subject": "new", "condition": "normal"}
        _store(db, "new", model)
    elif change == "consent":
        db.record_consent(model.attrs["subject"], scope=["fit"])
    else:
        change_code(
            "workflow/studies.py",
            "mixed_fits=bool(takes)",
            "mixed_fits=takes != ()",
        )
    assert _studies(db) == [2, 2]


def test_made__another_seed_is_another_generation(db):
    assert workflow.traits(db, k=3, seed=1).attrs["generation"] == 2
    assert workflow.traits(db, k=3, seed=1).attrs["generation"] == 2


def test_subjects_without_a_normal_take_are_skipped_unless_their_condition_is_chosen(
    db,
):
    takes = ["A.lotion", "B", "C"]
    usual = workflow.translucency(db, takes=takes)
    assert usual.attrs["skipped"][0]["take"] == "A"
    chosen = workflow.translucency(db, takes=takes, as_normal=["lotion"])
    counts = [
        int(tree["translucency_table"]["sigma_tr_count"].max())
        for tree in (usual, chosen)
    ]
    assert counts == [2, 3]
    assert not chosen.attrs["skipped"]
    assert chosen.attrs["as_normal"] == [note("A.lotion", "counts")]
    assert usual.attrs["as_normal"] == []
    # a subject with a normal take is not affected
    assert workflow.translucency(db, as_normal=["lotion"]).attrs["skipped"] == []
    again = repeat_study(db, chosen.attrs["study"], chosen.attrs["parameters"])
    assert again.generation == 1
    with pytest.raises(InputError, match="must be among lotion, normal"):
        workflow.translucency(db, as_normal=["glue"])


def test_attributes_digest__is_of_what_takes_are_said_to_be(db):
    """A new capture may have another age while the model stays the same, so that groups differ."""
    cohort = db.cohort("tables")
    before = studies._attributes_digest(cohort)
    condition = cohort["condition"].values.copy()
    again = cohort.drop_vars("condition").assign_coords(condition=("take", condition))
    assert studies._attributes_digest(again) == before
    condition[0] = "another"
    assert (
        studies._attributes_digest(again.assign_coords(condition=("take", condition)))
        != before
    )
