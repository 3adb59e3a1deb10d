"""Registrations and studies of registered takes, stored."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from planted_sheet import (
    NAMES,
    face_take,
    nodes,
    on_sheet,
    sheet,
    sheet_pair,
    sheet_take,
)

from skindb import workflow
from skindb.analysis.registration import register, tabulate_registration
from skindb.cli import cli
from skindb.errors import InputError
from skindb.schema.notes import note, note_lines
from skindb.store import SUMMARY, Database
from skindb.workflow.cohorts import (
    current_registrations,
    registered_datasets,
    takes_with_landmarks,
)

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("small_textures")]


def _stored(tmp_path, models: dict[str, xr.DataTree]) -> Database:
    db = Database(tmp_path / "db")
    for take, model in models.items():
        with db.stage("model", take) as stage:
            stage.write(
                {str(name): node.to_dataset() for name, node in model.children.items()}
            )
            stage.commit(model.attrs)
    return db


def test_albedo__reports_the_quality_of_the_registration(tmp_path):
    models = {"A": face_take(own=True), "B": face_take(seed=2), "C": face_take(seed=3)}
    models["C"]["mesh"] = models["C"]["mesh"].to_dataset().drop_dims("landmark")
    db = _stored(tmp_path, models)
    tree = workflow.albedo(db)
    said = tree.attrs["registration"]
    assert said[0]["reason"].startswith(
        "2 takes with up to 20 landmarks (thin plate); error of a landmark "
    )
    assert said[1]["reason"].startswith("the largest error is that of ")
    assert note_lines(said[2:]) == ["C: no landmarks", "made for this study"]
    mean = tree["albedo"]["albedo_mean"]
    assert mean["region"].values.tolist() == ["face", "beard", "no_beard"]
    assert np.isfinite(mean.sel(take=["A", "B"])).all()
    assert np.isnan(mean.sel(take="C", region="beard")).all()
    versions = [db.record("registration", take).as_input() for take in "AB"]
    # the study is the same with the stored registration, and reports it
    again = workflow.albedo(db, name="again")
    xr.testing.assert_identical(
        again["albedo"].to_dataset().load(), tree["albedo"].to_dataset().load()
    )
    assert again.attrs["registration"] == [*said[:-1], note("", "the stored one")]
    assert again.attrs["inputs"] == tree.attrs["inputs"]
    assert again.attrs["inputs"][-2:] == versions


def test_register_takes__commits_what_register_finds(tmp_path):
    models = {"A": face_take(), "B": face_take(seed=2), "silent": face_take(seed=3)}
    models["silent"].attrs["consent_scope"] = ["fit"]
    db = _stored(tmp_path, models)
    records = workflow.register_takes(db)
    found = registered_datasets(db, records)
    assert list(records) == list(found) == db.takes("registration") == ["A", "B"]
    stored = db.read("registration", "A")
    want = register({take: models[take] for take in "AB"})["A"]
    np.testing.assert_array_equal(stored["registration/common_uv"], want["common_uv"])
    assert [one["take"] for one in stored.attrs["inputs"]] == ["A", "B"]
    header, rows = tabulate_registration(found)
    row = dict(zip(header, rows[0], strict=True))
    error = want["landmark_prediction_error"] * float(want["mm_per_uv"])
    assert (row["take"], row["warp"], row["landmarks"]) == ("A", "thin plate", 20)
    assert row["worst_mm"] == pytest.approx(float(error.max()))
    assert row["worst"] == str(error["landmark"].values[error.values.argmax()])
    plain = {"A": sheet_take(sheet()[0], on_sheet(nodes())[:1], names=NAMES[:1])}
    one = _stored(tmp_path / "one", plain)
    workflow.register_takes(one)
    assert (
        tabulate_registration(
            {"A": one.read("registration", "A")["registration"].to_dataset()}
        )[1][0][1]
        == "shift"
    )
    bare = xr.DataTree.from_dict({"fitted": plain["A"]["fitted"].to_dataset()})
    bare.attrs = {"consent_scope": ["statistics"]}
    with pytest.raises(InputError, match="a registration needs landmarks"):
        workflow.register_takes(_stored(tmp_path / "bare", {"A": bare}))


def test_register_takes__maps_of_the_common_coordinates(tmp_path):
    """Albedo is a linear function of the coordinates of the sheet; at a common (u, v)
    it is that of the point there.
    """
    models = sheet_pair()
    db = _stored(tmp_path, models)
    workflow.register_takes(db, reference="A")
    maps = db.cohort("maps")
    assert maps["texel_diffuse_reflectance"].dims == ("take", "v", "u", "channel")
    centre = (np.arange(512) + 0.5) / 512
    inside = (maps["texel_coverage"].values > 0.99) & (maps["texel_status"].values == 0)
    assert inside.mean() > 0.9
    found = maps["texel_diffuse_reflectance"].sel(channel="R").values
    want = np.broadcast_to(centre / 2 + 0.2, found.shape)
    assert np.abs(found - want)[0][inside[0]].max() < 1e-4
    # B's warp is known between the landmarks alone; its ramp is 0.5 wide
    assert np.median(np.abs(found - want)[1][inside[1]]) < 5e-3
    with pytest.raises(
        InputError, match=r"maps of 64 texels.*call skindb\.workflow\.summarise"
    ):
        db.cohort("maps", size=64)
    assert workflow.summarise(db, size=64) == ["A", "B"]
    assert db.cohort("maps", size=64).sizes["u"] == 64


def test_summarise__some_maps_and_then_all(tmp_path):
    db = _stored(tmp_path, sheet_pair())
    workflow.register_takes(db, reference="A")
    some = ["texel_diffuse_reflectance", "texel_coverage"]
    assert workflow.summarise(db, size=32, maps=some) == ["A", "B"]
    stored = db.read(SUMMARY, "A")
    assert list(stored.children) == ["maps"]
    assert set(stored["maps"].data_vars) == set(some)
    few = db.cohort("maps", size=32, variables=some).load()
    assert workflow.summarise(db, size=32, maps=some[:1]) == []
    with pytest.raises(InputError, match=r"maps of 32 texels.*summarise"):
        db.cohort("maps", size=32)
    assert workflow.summarise(db, size=32) == ["A", "B"]
    every = db.cohort("maps", size=32)
    assert set(every.data_vars) == set(db.cohort("maps").data_vars)
    xr.testing.assert_identical(every[some].load(), few)


def _replace(
    db: Database, kind: str, take: str, version: xr.DataTree, **changed: str
) -> None:
    """A newer version like this one."""
    inputs = version.attrs.get("inputs", [])
    with db.stage(kind, take, names=[one["take"] for one in inputs]) as stage:
        stage.write(
            {
                str(name): node.to_dataset().compute()
                for name, node in version.children.items()
            }
        )
        stage.commit(version.attrs | changed)


def test_current_registrations__are_used_only_while_they_are_current(tmp_path):
    models = {"A": face_take(), "B": face_take(seed=2), "bare": face_take(seed=3)}
    models["bare"]["mesh"] = models["bare"]["mesh"].to_dataset().drop_dims("landmark")
    db = _stored(tmp_path, models)

    def used(*takes: str) -> list[str]:
        """Takes whose stored coordinates a study of these takes gets."""
        found = current_registrations(db, takes_with_landmarks(db, takes))
        assert all(
            record == db.record("registration", take) for take, record in found.items()
        )
        return list(found)

    def store(*takes: str, by: str | None = None) -> None:
        workflow.register_takes(db, takes=takes, reference=by)

    assert used() == []  # nothing is stored
    store()
    assert used() == ["A", "B"]
    assert used("B", "A") == ["B", "A"]
    assert used("A") == ["A"]  # more takes than requested are harmless
    store("A")
    assert used("A") == ["A"]
    assert used() == []  # A's is that of A alone
    mixed = db.cohort("surfels", kind="registration")
    assert mixed.sizes["take"] == 1
    assert (
        "not registered together with the others" in mixed.attrs["skipped"][0]["reason"]
    )
    store(by="B")
    assert used() == ["A", "B"]
    # of a run without the reference
    _replace(db, "registration", "A", db.read("registration", "A", generation=1))
    assert used() == []
    store()
    assert used() == ["A", "B"]
    _replace(
        db, "registration", "B", db.read("registration", "B"), code_digest="another"
    )
    assert used() == []
    store()
    _replace(db, "model", "B", models["B"])  # fitted again
    assert used() == []
    # the common coordinates were made from an earlier version of B
    assert used("A") == []
    with pytest.raises(InputError, match="registration was made from an earlier model"):
        db.cohort("surfels", kind="registration", takes=["B"])
    store()
    assert used() == ["A", "B"]
    models["C"] = face_take(seed=4)
    _replace(db, "model", "C", models["C"])  # one additional take
    assert used() == []
    assert used("A", "B") == ["A", "B"]


def test_albedo__of_some_takes_registers_all_of_them(tmp_path):
    """Otherwise studies of different takes would repeatedly register each other's takes."""
    db = _stored(
        tmp_path, {"A": face_take(), "B": face_take(seed=2), "C": face_take(seed=3)}
    )
    workflow.albedo(db, takes=["A", "B"])
    first = db.record("registration", "A").generation
    workflow.albedo(db, takes=["B", "C"])
    workflow.albedo(db)
    assert [db.record("registration", take).generation for take in "ABC"] == [first] * 3


def test_current_registrations__a_database_made_anew_has_none_of_the_old(
    tmp_path, monkeypatch
):
    """Versions are identified by seals: the first model of the new database is the
    second one of the old.
    """
    # no commit would accept this
    monkeypatch.setattr("skindb.store.stage.require_inputs", lambda *_: [])
    models = {"A": face_take()}
    db = _stored(tmp_path, models)
    other = _stored(tmp_path / "other", models)
    workflow.register_takes(other)
    _replace(db, "registration", "A", other.read("registration", "A"))
    assert current_registrations(db, ["A"]) == {}
    assert list(current_registrations(other, ["A"])) == ["A"]


def test_registered_datasets__coordinates_stay_in_the_database(tmp_path):
    db = _stored(tmp_path, {"A": face_take(), "B": face_take(seed=2)})
    registered = registered_datasets(db, workflow.register_takes(db))
    assert all(one["common_uv"].chunks is not None for one in registered.values())
    assert all(
        isinstance(one["common_landmark"].variable._data, np.ndarray)
        for one in registered.values()
    )


def _narrowed(tmp_path, scope=("fit",)):
    """Three registered takes with a study, a release, and one subject who narrowed the
    consent afterwards.
    """
    models = {
        take: face_take(seed=seed) for take, seed in (("A", 1), ("B", 2), ("C", 3))
    }
    for take, model in models.items():
        model.attrs |= {"subject": take}
    db = _stored(tmp_path, models)
    workflow.albedo(db)
    db.create_release("paper", ["A", "B", "C"])
    db.record_consent("C", scope)
    return db


def _generations(db):
    return {
        (kind, take): db.record(kind, take).generation
        for kind in db.kinds()
        for take in db.takes(kind)
    }


def test_refresh__of_registrations_with_a_subject_who_refused_comes_to_rest(tmp_path):
    """The registration of C cannot be made again; the others must not be registered
    again each time because of it.
    """
    db = _narrowed(tmp_path)
    first = workflow.refresh(db)
    assert {one.take for one in first if one.record is not None} == {"A", "B", "albedo"}
    [refused] = [one for one in first if one.record is None]
    assert (refused.kind, refused.take) == ("registration", "C")
    assert refused.fault.startswith("its consent does not cover statistics")
    before = _generations(db)
    again = workflow.refresh(db)
    assert [(one.kind, one.take, one.record) for one in again] == [
        ("registration", "C", None)
    ]
    assert _generations(db) == before
    assert [one.reasons for one in workflow.stale_results(db)] == [
        ("C: consent no longer covers statistics",)
    ]


def test_albedo__of_a_release_whose_registrations_contain_who_refused_is_refused(
    tmp_path,
):
    db = _narrowed(tmp_path, ["fit", "export"])
    line = (
        "release paper: the registrations of a release must be covered by consent; "
        "found C: consent no longer covers"
    )
    with pytest.raises(InputError, match=line):
        workflow.albedo(db, release="paper")
    assert db.takes("population") == ["albedo"]
    workflow.refresh(db)
    db.create_release("paper2", ["A", "B"])
    assert workflow.albedo(db, release="paper2").attrs["registration"][-1] == note(
        "", "that of the release"
    )


def test_register_takes__who_refused_is_named(tmp_path):
    db = _narrowed(tmp_path)
    for takes in (["C"], ["A", "C"]):
        with pytest.raises(
            InputError,
            match=r"C: consent_scope: this step needs the scope 'statistics'",
        ):
            workflow.register_takes(db, takes=takes)
    said = CliRunner().invoke(cli, ["register", str(db.root)], catch_exceptions=False)
    assert "skipped: C: its consent does not cover statistics" in said.stdout


def test_register_takes__the_same_again_leaves_what_there_is(tmp_path):
    db = _stored(tmp_path, {"A": face_take(), "B": face_take(seed=2)})
    study = workflow.albedo(db)
    before = _generations(db)
    assert workflow.register_takes(db) == {
        take: db.record("registration", take) for take in "AB"
    }
    assert _generations(db) == before
    assert workflow.stale_results(db) == []
    assert workflow.register_takes(db, reference="A")["A"].generation == 2
    assert [one.take for one in workflow.stale_results(db)] == [study.attrs["study"]]
