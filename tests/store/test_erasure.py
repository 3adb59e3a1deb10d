"""What a withdrawal removes: everything of a subject and everything that refers to one,
and nothing else.
"""

from __future__ import annotations

import errno

import numpy as np
import pytest
from traces import contents

from skindb.errors import InputError
from skindb.schema import dataset
from skindb.store import Database, Request, Staleness, WithdrawnError
from skindb.store import erasure as erasure_module
from skindb.store.folder import Folder
from skindb.store.stale import write_request

SCOPE = {"consent_scope": ["fit", "statistics"]}


def _commit(db, kind, take, inputs=(), names=(), *, groups=None, **about):
    takes = [
        *names,
        *(
            record.take
            for record in inputs
            if record.kind not in ("calibration", "population")
        ),
    ]
    takes += [name for record in inputs for name in record.names]
    with db.stage(
        kind, take, names=takes if kind not in ("capture", "model") else ()
    ) as stage:
        stage.write(groups or {})
        return stage.commit(
            SCOPE | {"inputs": [record.as_input() for record in inputs]} | about
        )


def _fitted(db, take, *shared, **about):
    """A capture and a model of a take; the record of the model."""
    return _commit(db, "model", take, [_commit(db, "capture", take), *shared], **about)


@pytest.fixture
def db(tmp_path):
    """An empty database."""
    return Database(tmp_path / "db")


@pytest.mark.parametrize(
    "subject", ["3", "5", "16", "43", "59", "94", "98", "a", "no", "to", "rays"]
)
def test_erase__a_pseudonym_that_is_a_word_of_messages_removes_nothing_of_others(
    db, subject
):
    """Every default fit records these words; earlier versions removed all results of
    all subjects.
    """
    message = (
        "dictionary: 43 of 59 are skipped (rank 16; no rays to a 3 x 5 block); 94 % "
        "and 98 % of the energy"
    )
    models = [_fitted(db, take, skipped=[message]) for take in ("P1", "P2")]
    _commit(db, "registration", "P1", models, registration=message)
    _commit(
        db, "population", "traits", models, skipped=[{"take": "", "reason": message}]
    )
    before = contents(db.root)
    _commit(db, "capture", subject)
    erasure = db.erase(subject)
    assert erasure.removed == {"capture": 1}
    left = contents(db.root)
    assert {key: left[key] for key in before} == before
    assert db.verify() == []


def test_erase__a_probe_site_named_like_the_subject_removes_no_capture_of_another(db):
    sites = dataset(
        {"site_sigma_tr": np.ones((2, 3))},
        coords={"site": ["1", "2"], "channel": ["R", "G", "B"]},
    )
    capture = _commit(
        db,
        "capture",
        "P1",
        groups={"translucency": sites},
        traits={"1": "1"},
        session="1",
    )
    _commit(db, "population", "1", [_fitted(db, "P2")])
    _fitted(db, "1")
    db.erase("1")
    assert db.record("capture", "P1") == capture
    assert db.takes("population") == ["1"]
    assert db.takes() == ["P1", "P2"]


def test_erase__of_one_condition_of_a_take_is_not_possible(db):
    _fitted(db, "A.lotion")
    _fitted(db, "AB")
    for name in ("A.lotion", "lotion", "a", "", "..", "A/B", "A*"):
        with pytest.raises(InputError, match="the database must hold the subject"):
            db.erase(name)
    db.erase("A")
    assert db.takes() == ["AB"]
    with pytest.raises(
        InputError,
        match="A: the database must hold the subject; found that the subject was withdrawn",
    ):
        db.erase("A")


def test_erase__a_take_whose_condition_is_the_end_of_a_file_name(db):
    for take in ("A.json", "A.tables", "A.zarr", "A.manifest", "A.tmp", "B.json"):
        _fitted(db, take)
    assert db.verify() == []
    db.erase("A")
    assert [str(path) for path in db.root.rglob("A.*")] == []
    assert db.takes("model") == ["B.json"]
    assert db.verify() == []


def test_erase__of_a_product_of_many_subjects_keeps_the_models_of_others(db):
    shared = _commit(db, "calibration", "basis", [_fitted(db, "A"), _fitted(db, "B")])
    model = _fitted(db, "C", shared)
    other = _fitted(db, "D")
    study = _commit(
        db, "population", "traits", [model, other], parameters={"what": "traits"}
    )
    _commit(db, "population", "albedo", [other])
    db.create_release("r1")
    erasure = db.erase("A")
    assert erasure.removed == {
        "calibration": 1,
        "capture": 1,
        "model": 1,
        "population": 1,
        "release": 1,
    }
    assert db.record("model", "C") == model
    assert db.takes("population") == ["albedo"]
    assert db.takes("model", release="r1") == ["B", "C", "D"]
    [reason] = Staleness(db).reasons(model)
    assert str(reason) == "calibration 1 of basis was removed from the database"
    assert db.requests() == [Request("population", "traits", {"what": "traits"})]
    with pytest.raises(
        InputError,
        match=r"model 1 of C: the inputs of an input must exist; found calibration 1 of basis",
    ):
        _commit(db, "population", "traits", [model, other])
    again = _fitted(db, "C")
    assert _commit(db, "population", "traits", [again, other]).seal != study.seal
    assert db.verify() == []


def test_stage__a_capture_or_model_refers_to_no_other_subject(db):
    other = _commit(db, "capture", "B")
    with pytest.raises(
        InputError,
        match=r"model of A: a model must refer to takes of its own subject only; found .* B;",
    ):
        _commit(db, "model", "A", [other])
    with pytest.raises(
        InputError,
        match="capture of A: a capture must refer to takes of its own subject only",
    ):
        db.stage("capture", "A", names=["B.lotion"])
    _commit(db, "model", "B.lotion", [other])
    assert db.takes("model") == ["B.lotion"]


def test_stage__takes_are_named_before_they_are_written(db):
    model = _fitted(db, "A")
    line = (
        r"population of traits: a version must name the takes that it refers to .*; "
        r"found no A; call db.stage\('popu"
    )
    with (
        pytest.raises(InputError, match=line),
        db.stage("population", "traits") as stage,
    ):
        stage.commit({"inputs": [model.as_input()]})
    registration = _commit(db, "registration", "A", [model, _fitted(db, "B")])
    with pytest.raises(InputError, match="found no B;"), db.stage("edit", "A") as stage:
        stage.commit({"inputs": [registration.as_input()]})
    labels = dataset({"take_distance": np.zeros((1, 1))}, coords={"take": ["A"]})
    with (
        pytest.raises(InputError, match=line),
        db.stage("population", "traits") as stage,
    ):
        stage.write({"traits": labels})
    assert db.takes("population") == []
    assert db.garbage() == []


def test_record__refers_to_takes_through_any_number_of_inputs(db):
    study = _commit(
        db, "population", "A", [_fitted(db, "A"), _fitted(db, "B")], names=["C"]
    )
    edit = _commit(db, "edit", "D", [_fitted(db, "D"), study])
    assert study.names == ("A", "B", "C")  # although the study has the name of a take
    assert study.subjects == {"A", "B", "C"}
    assert edit.names == ("A", "B", "C")
    assert edit.subjects == {"A", "B", "C", "D"}


def test_erase__unfinished_versions_of_others_are_removed_only_if_they_may_hold_its_data(
    db,
):
    a = _fitted(db, "A")
    b = _fitted(db, "B")
    stages = [
        db.stage("population", name, names=names)
        for name, names in (("one", ["A", "B"]), ("two", ["B"]))
    ]
    stages.append(db.stage("population", "unknown", names=["B"]))
    for stage in stages:
        stage.write({"surfels": dataset({"surfel_area": np.ones(3)})})
    (db.root / stages[2].path.replace(".zarr", ".names.json")).unlink()
    db.erase("A")
    assert [(db.root / stage.path).exists() for stage in stages] == [False, True, False]
    with pytest.raises(
        WithdrawnError, match="A: the subject must not be withdrawn while"
    ):
        stages[0].commit({"inputs": [a.as_input(), b.as_input()]})
    stages[1].commit({"inputs": [b.as_input()]})
    assert db.takes("population") == ["two"]
    assert db.verify() == []


def test_erase__a_damaged_record_of_a_study_with_its_data_goes_too(db):
    models = [_fitted(db, take) for take in ("A", "B")]
    for name, used in (("both", models), ("other", models[1:])):
        _commit(db, "population", name, used)
        (db.root / f"log/population/{name}/00000001.json").write_text('{"take": "A"')
    db.erase("A")
    assert not list((db.root / "data/population/both").iterdir())
    assert not list((db.root / "log/population/both").iterdir())
    assert len(list((db.root / "data/population/other").iterdir())) == 3
    assert (db.root / "log/population/other/00000001.json").exists()


def test_erase__scratch_folders_of_the_subject_alone(db):
    names = {
        "A-0123456789abcdef": False,
        "A.lotion-0123456789abcdef": False,
        "AB-0123456789abcdef": True,
        "A-0123456789abcdef-0123456789abcdef": True,  # of a subject with this pseudonym
        "A-0123": True,
    }
    _fitted(db, "A")
    for name in names:
        (db.root / "tmp" / name).mkdir(parents=True)
        (db.root / "tmp" / name / "samples").write_text("photographs")
    db.erase("A")
    assert {name: (db.root / "tmp" / name).exists() for name in names} == names


def test_erase__only_the_first_pass_of_a_killed_fit(db):
    _fitted(db, "B")
    scratch = db.root / "tmp" / "A-0123456789abcdef"
    scratch.mkdir(parents=True)
    assert db.erase("A").removed == {}
    assert not scratch.exists()
    assert db.withdrawal("A") is not None


def test_erase__requests_results_without_takes_of_the_subject(db):
    models = [_fitted(db, take) for take in ("A", "B", "C")]
    parameters = {"what": "traits", "takes": ["A", "B", "C"], "k": 3}
    _commit(db, "population", "traits.three", models, parameters=parameters)
    _commit(
        db,
        "population",
        "albedo.alone",
        models[:1],
        parameters={"what": "albedo", "takes": ["A"]},
    )
    for take in ("B", "C"):
        _commit(db, "registration", take, models, parameters={"reference": "A"})
    _commit(
        db,
        "edit",
        "C",
        models,
        parameters={"amounts": {"A": 0.5}, "study": "traits.three"},
    )
    erasure = db.erase("A")
    assert erasure.lost == ["population of albedo.alone: no other take was used"]
    requests = {str(request): request.parameters for request in db.requests()}
    assert requests == {
        "population of traits.three": {"what": "traits", "takes": ["B", "C"], "k": 3},
        "registration": {"reference": ""},
        # A is the name of a trait here
        "edit of C": {"amounts": {"A": 0.5}, "study": "traits.three"},
    }
    db.erase("C")
    requests = {str(request): request.parameters for request in db.requests()}
    assert requests.keys() == {"population of traits.three", "registration"}
    assert requests["population of traits.three"]["takes"] == ["B"]
    db.erase("B")
    assert {request.kind for request in db.requests()} == {"registration"}
    assert db.verify() == []


def test_erase__only_the_newest_version_is_requested_and_older_ones_of_others_stay(db):
    models = [_fitted(db, take) for take in ("A", "B")]
    older = _commit(db, "population", "traits", models[1:])
    _commit(db, "population", "traits", models)
    newer = _commit(db, "population", "albedo", models)
    newer = _commit(db, "population", "albedo", models[1:])
    db.erase("A")
    assert db.record("population", "traits") == older
    assert db.record("population", "albedo") == newer
    assert [str(request) for request in db.requests()] == ["population of traits"]
    assert db.verify() == []


def test_erase__releases_get_a_revision_without_the_subject(db):
    models = {take: _fitted(db, take) for take in ("A", "B", "C")}
    for take in ("B", "C"):
        _commit(db, "registration", take, models.values())
    db.create_release("all")
    db.create_release("alone", ["A"])
    db.create_release("others", ["C"])
    erasure = db.erase("A")
    # the registration of the second one contains the subject
    assert erasure.revised == ["all", "others"]
    assert erasure.lost == ["release of alone: no other take was used"]
    assert db.takes("release") == ["all", "others"]
    assert db.takes("model", release="all") == ["B", "C"]
    assert db.takes("registration", release="all") == []
    assert {str(request): request.parameters for request in db.requests()} == {
        "registration": {"reference": ""},
        "release of all": {"takes": ["B", "C"]},
        "release of others": {"takes": ["C"]},
    }
    assert [record.generation for record in db.history("release", "all")] == [2]
    assert db.verify() == []


def test_erase__a_release_that_names_a_damaged_version_waits(db):
    for take in ("A", "B", "C"):
        _fitted(db, take)
    db.create_release("all")
    record = db.root / "log/model/B/00000001.json"
    content = record.read_bytes()
    record.write_text("{}")
    erasure = db.erase("A")
    assert (erasure.revised, erasure.lost) == ([], [])
    [request] = db.requests()
    assert {pin["take"] for pin in request.parameters["pins"]} == {"B", "C"}
    record.write_bytes(content)
    assert db.verify() == []
    db.erase("C")
    [request] = db.requests()
    assert {pin["take"] for pin in request.parameters["pins"]} == {"B"}


def test_verify__names_a_damaged_request(db):
    _fitted(db, "B")
    write_request(db.place, Request("edit", "B", {"amounts": {"age": 1}}))
    [file] = (db.root / "requests").iterdir()
    assert db.verify() == []
    file.write_text(file.read_text().replace("age", "sex"))
    assert [(fault.where, fault.rule) for fault in db.verify()] == [
        (str(file), "a request must be as it was written")
    ]
    assert db.requests() == []


class _FullDisk:
    """Refuses to write until the data of the subject were removed."""

    def __init__(self, monkeypatch, root, *, keeps="A"):
        self.refused = 0
        self.data = root / "data/model" / keeps
        write = Folder._temporary

        def refuse(place, data, *, for_file):
            if self.data.exists():
                self.refused += 1
                raise OSError(errno.ENOSPC, "No space left on device", str(for_file))
            return write(place, data, for_file=for_file)

        monkeypatch.setattr(Folder, "_temporary", refuse)


def test_erase__on_a_full_disk_removes_the_data_of_the_subject_first(db, monkeypatch):
    models = [_fitted(db, take) for take in ("A", "B")]
    _commit(db, "population", "traits", models)
    db.create_release("all")
    disk = _FullDisk(monkeypatch, db.root)
    db.erase("A")
    assert disk.refused > 0
    assert db.takes("model") == ["B"] == db.takes("model", release="all")
    assert [str(request) for request in db.requests()] == ["population of traits"]
    assert db.verify() == []


def test_erase__on_a_disk_that_stays_full_is_completed_later(db, monkeypatch):
    models = [_fitted(db, take) for take in ("A", "B")]
    _commit(db, "population", "traits", models)
    with monkeypatch.context() as patch:
        _FullDisk(patch, db.root, keeps="B")
        with pytest.raises(OSError, match="No space left"):
            db.erase("A")
    assert not (db.root / "data/model/A").exists()
    assert not list((db.root / "data/population/traits").glob("*.zarr"))
    db.erase("A")
    assert db.verify() == []
    assert [str(request) for request in db.requests()] == ["population of traits"]


@pytest.mark.parametrize("error", [PermissionError(errno.EACCES, "Permission denied")])
def test_erase__what_cannot_be_removed_is_an_error(db, monkeypatch, error):
    _fitted(db, "A")

    def refuse(*_, **__):
        raise error

    with monkeypatch.context() as patch:
        patch.setattr("skindb.store.folder.shutil.rmtree", refuse)
        with pytest.raises(PermissionError, match="Permission denied"):
            db.erase("A")
    assert db.takes() == []
    db.erase("A")
    assert not list(db.root.rglob("A"))


def test_erase__waits_for_a_run_that_works_on_a_take_and_changes_nothing_until_then(db):
    _fitted(db, "A.lotion")
    before = contents(db.root / "log")
    with db.lease("A.lotion", "model", command="skindb fit"):
        with pytest.raises(
            InputError,
            match=r"model of A.lotion: only one run at a time may work on it; found skindb fit",
        ):
            db.erase("A")
        assert contents(db.root / "log") == before
        assert db.withdrawal("A") is None
    db.erase("A", wait=1)
    assert db.takes() == []


def test_erase__a_second_run_is_refused_before_the_first_has_an_effect_on_it(
    db, monkeypatch
):
    """Two processes withdraw the same subject: both succeed."""
    _fitted(db, "A")
    mark = erasure_module.mark_withdrawn

    def race(place, subject, counts):
        monkeypatch.setattr(erasure_module, "mark_withdrawn", mark)
        mark(place, subject, counts)
        mark(place, subject, counts)

    monkeypatch.setattr(erasure_module, "mark_withdrawn", race)
    db.erase("A")
    assert len(db.place.children("withdrawn")) == 1
    assert db.verify() == []
