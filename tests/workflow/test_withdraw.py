"""Withdrawal: no data of the subject remain in the raw bytes of a database, and the
rest is intact.
"""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import subprocess
import sys
from functools import wraps
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr
from click.testing import CliRunner
from planted_population import TABLES, population
from planted_sheet import face_take
from traces import contents

from skindb import workflow
from skindb.analysis import translucency
from skindb.cli import cli
from skindb.errors import InputError
from skindb.store import Database, WithdrawnError, seal_of, stale_versions
from skindb.store.bucket import Bucket
from skindb.store.log import Log
from skindb.workflow import studies

MARKER = np.float32(0.12345679)  # planted in the data of the subject
WORD = "marker-of-nobody"  # planted in its attributes


pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("small_textures")]


@pytest.fixture(scope="module", autouse=True)
def _tables():
    with pytest.MonkeyPatch.context() as patch:
        # 8 of the 59
        patch.setattr(studies, "dictionary_tables", lambda *_: TABLES)
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder of a database made by `_planted`, which is only copied."""
    return _planted(tmp_path_factory.mktemp("planted") / "db").root


@pytest.fixture
def db(made, tmp_path):
    """A database made by `_planted`."""
    return Database(shutil.copytree(made, tmp_path / "db"))


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Folder of a database of takes A, A.lotion, B, C, a study and a release, which is
    only copied.
    """
    db = Database(tmp_path_factory.mktemp("small") / "db")
    for take, model in population().items():
        if take.startswith("A"):
            model.attrs["remark"] = WORD
        _commit(db, "model", take, model)
    workflow.translucency(db)
    db.create_release("r1")
    return db.root


def _commit(db, kind, take, tree, **about):
    with db.stage(kind, take) as stage:
        stage.write(
            {str(name): node.to_dataset() for name, node in tree.children.items()}
        )
        return stage.commit(tree.attrs | about)


def _planted(url: Path) -> Database:
    """Takes A, A.lotion, B, C in two generations each; studies, an edit and a release
    that used all of them.
    """
    db = Database(url)
    for take, model in population().items():
        if take.startswith("A"):
            fitted = model["fitted"].to_dataset()
            fitted["diffuse_reflectance"][3] = MARKER
            model["fitted"] = fitted
            model.attrs["remark"] = WORD
        _commit(db, "model", take, model)
    workflow.translucency(db)
    for take in db.takes("model"):
        _commit(db, "model", take, db.read("model", take).load())
    workflow.traits(db, k=3)
    workflow.translucency(db)
    workflow.edit(db, "B", {"lotion": 0.5})
    db.create_release("r1")
    workflow.translucency(db, release="r1")
    return db


def _found(root: Path, subject: str) -> list[str]:
    """Files that hold the marker, the word or the name of the subject: raw, and with
    every chunk decompressed.
    """
    name = re.compile(rf"(?<![A-Za-z0-9_-]){subject}(?![A-Za-z0-9_-])".encode())
    hits = []
    for path in root.rglob("*"):
        if name.search(path.name.encode()):
            hits.append(f"named: {path}")
        if path.is_file():
            raw = path.read_bytes()
            hits += [str(path)] * (MARKER.tobytes() in raw or WORD.encode() in raw)
            if path.suffix == ".json" and name.search(raw):
                hits.append(f"name: {path}")
    for path in root.rglob("*.zarr"):
        for key, array in zarr.open_group(path, mode="r").members(max_depth=None):
            if isinstance(array, zarr.Array):
                values = np.asarray(array[...])
                if (
                    values.dtype.kind == "f"
                    and np.isclose(
                        values.astype("f8"), float(MARKER), rtol=1e-7, atol=0
                    ).any()
                ):
                    hits.append(f"values: {path}/{key}")
                if values.dtype.kind == "T" and any(
                    name.search(str(one).encode()) for one in values.ravel()
                ):
                    hits.append(f"labels: {path}/{key}")
    return hits


def _outcomes(done) -> dict[str, str]:
    """Kind and take of every result that was removed -> fault of its computation, or an
    empty text.
    """
    return {one.name: one.fault for one in done.repeated}


def test_withdraw__leaves_nothing_of_a_subject(db):
    assert len(_found(db.root, "A")) > 10  # the search works
    plan = workflow.plan_withdrawal(db, "A")
    assert plan.versions[-2:] == (
        "model of A: 2 versions",
        "model of A.lotion: 2 versions",
    )
    assert "population 2 of translucency" in plan.users
    assert "edit 1 of B" in plan.users
    assert len(_found(db.root, "A")) > 10  # a plan removes nothing
    done = workflow.withdraw(db, "A")
    assert _found(db.root, "A") == []
    assert db.subjects() == []
    assert db.takes("model") == ["B", "C"]
    assert db.verify() == []
    assert stale_versions(db) == []
    assert done.revised == ("r1",)
    fault = _outcomes(done).pop("edit of B")
    assert "lotion" in fault  # which no other subject used
    assert _outcomes(done) | {"edit of B": ""} == {
        "edit of B": "",
        "population of traits.k-3": "",
        "population of translucency": "",
        "population of translucency.release-r1": "",
    }
    assert not db.has("edit", "B")
    study = db.read("population", "translucency")
    assert [one["take"] for one in study.attrs["inputs"]] == ["B", "C"]
    assert db.takes("model", release="r1") == ["B", "C"]
    removed = {"edit": 1, "model": 4, "population": 4, "release": 1, "summary": 4}
    assert done.removed == plan.removed == removed
    (entry,) = (db.root / "withdrawn").rglob("*.json")
    assert json.loads(entry.read_text())["removed"] == removed


def _copy(url: str, folder: Path) -> Path:
    """Every object of a bucket as a file."""
    place = Bucket("/".join(url.split("/")[:3]))
    for top in place.names() or ():
        for name in place.sizes(top):
            path = folder / top / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(place.read(f"{top}/{name}"))
    return folder


def test_withdraw__leaves_nothing_of_a_subject_in_a_bucket(made, bucket, tmp_path):
    db = Database(bucket)
    for key, content in contents(made).items():
        db.place.replace(key, content)
    assert len(_found(_copy(bucket, tmp_path / "before"), "A")) > 10
    done = workflow.withdraw(db, "A")
    assert _found(_copy(bucket, tmp_path / "after"), "A") == []
    assert db.takes("model") == ["B", "C"] == db.takes("model", release="r1")
    assert db.takes("model", where="subject == 'B'") == ["B"]
    assert db.verify() == []
    assert stale_versions(db) == []
    assert done.removed["model"] == 4
    # as in a folder
    assert [name for name, fault in _outcomes(done).items() if fault] == ["edit of B"]
    assert db.garbage() == db.clean() == []


def test_withdraw__registrations_of_others_are_made_without_the_subject(tmp_path):
    db = Database(tmp_path / "db")
    for seed, take in enumerate(("A", "B", "C"), 1):
        _commit(db, "model", take, face_take(seed=seed))
    workflow.register_takes(db)
    workflow.albedo(db)
    db.create_release("r1")
    alone = Database(tmp_path / "alone")
    for seed, take in enumerate(("B", "C"), 2):
        _commit(alone, "model", take, face_take(seed=seed))
    wanted = workflow.register_takes(alone)
    done = workflow.withdraw(db, "A")
    assert _outcomes(done) == {
        "registration": "",
        "population of albedo": "",
        "release of r1": "",
    }
    assert db.requests() == []
    assert _found(db.root, "A") == []
    for take in "BC":
        found = db.read("registration", take)["registration"].to_dataset().load()
        xr.testing.assert_identical(
            found, alone.read("registration", take)["registration"].to_dataset().load()
        )
        assert [one["take"] for one in db.record("registration", take).made_from] == [
            "B",
            "C",
        ]
    assert db.takes("registration", release="r1") == ["B", "C"] == sorted(wanted)
    assert db.verify() == []
    assert stale_versions(db) == []


def test_withdraw__a_model_of_faces_is_made_without_the_subject(tmp_path):
    people = {take: face_take(seed=seed) for seed, take in enumerate("ABCDEF", 1)}
    rng = np.random.default_rng(0)
    for take, model in people.items():
        fitted = model["fitted"].to_dataset()
        level = rng.uniform(0.5, 1)
        colour = fitted["diffuse_reflectance"] * np.float32(level)
        model["fitted"] = fitted.assign(diffuse_reflectance=colour)
        model.attrs["subject"] = take
    db, alone = (Database(tmp_path / name) for name in ("db", "alone"))
    for take, model in people.items():
        _commit(db, "model", take, model)
        if take != "A":
            _commit(alone, "model", take, model)
    before = workflow.components(db, k=2)
    assert "A" in before["face_model"]["subject"].values
    done = workflow.withdraw(db, "A")
    assert _outcomes(done)["population of components.k-2"] == ""
    assert _found(db.root, "A") == []
    after = db.read("population", "components.k-2")["face_model"].to_dataset().load()
    expected = workflow.components(alone, k=2)["face_model"].to_dataset().load()
    xr.testing.assert_identical(after, expected)
    assert after["subject"].values.tolist() == [*"BCDEF"]


def test_withdraw__a_study_that_only_named_the_subject_as_skipped(tmp_path):
    db = Database(tmp_path / "db")
    for take, model in population().items():
        _commit(
            db,
            "model",
            take,
            model,
            **({"consent_scope": ["fit"]} if take == "C" else {}),
        )
    workflow.translucency(db)
    assert any("population" in hit for hit in _found(db.root, "C"))
    workflow.withdraw(db, "C")
    assert _found(db.root, "C") == []
    assert db.read("population", "translucency").attrs["skipped"] == []


@pytest.mark.parametrize("step", range(0, 60, 4))
def test_withdraw__killed_at_any_step_the_same_call_completes_it(
    small, tmp_path, monkeypatch, step
):
    """The process may be killed after every change of a file or folder; no result of
    others is lost.
    """
    db = Database(shutil.copytree(small, tmp_path / "db"))
    left = [step]

    def counted(call):
        def run(*args, **options):
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
            return call(*args, **options)

        return run

    for name in ("remove", "create", "replace", "sweep"):
        monkeypatch.setattr(
            type(db.place), name, counted(getattr(type(db.place), name))
        )
    with contextlib.suppress(KeyboardInterrupt):
        workflow.withdraw(db, "A")
    monkeypatch.undo()
    # of this process, which has not ended
    shutil.rmtree(db.root / "leases", ignore_errors=True)
    if db.withdrawal("A"):
        assert db.cohort("tables")["take"].values.tolist() == ["B", "C"]
    with contextlib.suppress(InputError):  # everything was removed before it was killed
        workflow.withdraw(db, "A")
    workflow.refresh(db)
    assert _found(db.root, "A") == []
    assert [fault for fault in db.verify() if "tmp" not in str(fault)] == []
    assert [
        one["take"] for one in db.record("population", "translucency").made_from
    ] == ["B", "C"]
    assert db.takes("model", release="r1") == ["B", "C"]
    assert db.requests() == []


@pytest.mark.parametrize("complete", [lambda db: db.clean(), workflow.refresh])
def test_withdraw__interrupted_is_completed_by_other_commands(
    small, tmp_path, monkeypatch, complete
):
    db = Database(shutil.copytree(small, tmp_path / "db"))
    monkeypatch.setattr("skindb.store.erasure.erase_withdrawn", lambda _: None)
    db.erase("A")
    monkeypatch.undo()
    assert len(_found(db.root, "A")) > 5
    faults = db.verify()
    assert {fault.rule for fault in faults} == {
        "nothing of a withdrawn subject must remain"
    }
    assert {fault.cure for fault in faults} == {"run skindb clean --yes"}
    assert any(
        one.what == "it is of a withdrawn subject, or refers to one"
        for one in db.garbage()
    )
    complete(db)
    assert _found(db.root, "A") == []
    assert db.verify() == []
    workflow.refresh(db)
    assert [
        one["take"] for one in db.record("population", "translucency").made_from
    ] == ["B", "C"]


def test_withdraw__damaged_records_and_scratch_of_the_subject_go_too(db):
    (db.root / "log/model/A/00000002.json").write_text(WORD)
    scratch = db.root / "tmp" / "A.lotion-0123456789abcdef"
    other = db.root / "tmp" / "AB-0123456789abcdef"
    for folder in (scratch, other):
        folder.mkdir(parents=True)
        (folder / "samples").write_text("pictures")
    workflow.withdraw(db, "A")
    assert not scratch.exists()
    assert other.exists()
    assert _found(db.root, "A") == []


def test_withdraw__of_an_unknown_subject(db):
    for name in ("nobody", "A.lotion", "..", ""):
        with pytest.raises(InputError, match="the database must hold the subject"):
            workflow.withdraw(db, name)
    assert Log(db.place, "model", "A").generations() == [1, 2]


def test_withdraw__a_study_of_another_version_of_skindb_waits(small, tmp_path):
    """Its parameters are not those of this version; earlier, withdrawals and `refresh`
    ended in a traceback.
    """
    db = Database(shutil.copytree(small, tmp_path / "db"))
    models = [db.record("model", take) for take in ("A", "B")]
    parameters = {"what": "translucency", "frobnicate": 1, "takes": [], "release": ""}
    for key, given in (
        ("translucency.other", parameters),
        ("moles", {"what": "moles"}),
    ):
        with db.stage("population", key, names=["A", "B"]) as stage:
            stage.commit(
                {"inputs": [model.as_input() for model in models], "parameters": given}
            )
    rule = "a study must be one that this version of skindb can compute; found"
    done = workflow.withdraw(db, "A")
    for outcomes in (
        _outcomes(done),
        {one.name: one.fault for one in workflow.refresh(db)},
    ):
        assert outcomes["population of translucency.other"].startswith(
            f"translucency.other: {rule} the parameters frob"
        )
        assert outcomes["population of moles"].startswith(
            f"moles: {rule} the study 'moles'"
        )
    assert _found(db.root, "A") == []
    assert db.verify() == []
    assert {one.name for one in workflow.stale_results(db)} == {
        "population of translucency.other",
        "population of moles",
    }


@pytest.mark.parametrize(
    "error",
    [
        TypeError("unknown option"),
        MemoryError(),
        RecursionError(),
        ZeroDivisionError("x"),
    ],
)
def test_withdraw__whatever_a_computation_raises_is_named_and_repeated(
    small, tmp_path, monkeypatch, error
):
    db = Database(shutil.copytree(small, tmp_path / "db"))

    study = vars(translucency.STUDY)

    @wraps(study["compute"])  # its digest is that of the original
    def fail(*_, **__):
        raise error

    with monkeypatch.context() as patch:
        patch.setitem(study, "compute", fail)
        outcomes = _outcomes(workflow.withdraw(db, "A"))
    assert outcomes["population of translucency"].startswith(
        f"cannot be computed by this version: {type(error).__name__}"
    )
    assert _found(db.root, "A") == []
    assert not db.has("population", "translucency")
    [again] = workflow.refresh(db)
    assert again.record.take == "translucency"
    assert db.requests() == []
    assert workflow.refresh(db) == []


def test_withdraw__while_a_study_is_computed(small, tmp_path, monkeypatch):
    """The study is suspended, for example by a closed laptop, and continues after the
    withdrawal.
    """
    db = Database(shutil.copytree(small, tmp_path / "db"))
    study = vars(translucency.STUDY)
    compute = study["compute"]

    @wraps(compute)
    def suspended(*args):
        table = compute(*args)
        monkeypatch.setitem(study, "compute", compute)
        Database(db.root).erase("A")
        return table

    monkeypatch.setitem(study, "compute", suspended)
    with pytest.raises(
        WithdrawnError, match="A: the subject must not be withdrawn while a version"
    ):
        workflow.translucency(db, name="mine")
    assert _found(db.root, "A") == []
    assert db.verify() == []
    workflow.translucency(db, name="mine")
    assert [
        one["take"] for one in db.record("population", "translucency.mine").made_from
    ] == ["B", "C"]


def test_withdraw__a_release_is_revised_again_with_the_new_registrations(
    tmp_path, monkeypatch
):
    db = Database(tmp_path / "db")
    for seed, take in enumerate(("A", "B", "C"), 1):
        _commit(db, "model", take, face_take(seed=seed))
    workflow.register_takes(db)
    db.create_release("r1")

    def fail(*_, **__):
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr("skindb.workflow.cohorts.common_frame", fail)
        outcomes = _outcomes(workflow.withdraw(db, "A"))
    assert all(outcomes.values())
    assert (
        "the registrations of a release must be computed before"
        in outcomes["release of r1"]
    )
    assert db.takes("registration", release="r1") == []
    assert db.takes("model", release="r1") == ["B", "C"]
    workflow.refresh(db)
    assert db.takes("registration", release="r1") == ["B", "C"]
    assert [record.generation for record in db.history("release", "r1")] == [2, 3]
    assert db.verify() == []


def test_withdraw_command__writes_a_report_without_personal_data(db, tmp_path):
    arguments = [
        "withdraw",
        str(db.root),
        "A",
        "--yes",
        "--report",
        str(tmp_path / "erasure.json"),
    ]
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 0, result.output
    assert "revised without A: release r1" in result.stdout
    assert (
        "removed versions: 1 of kind edit, 4 of kind model, 4 of kind population, 1 of kind release"
        in result.stdout
    )
    report = json.loads((tmp_path / "erasure.json").read_text())
    assert report["removed_versions"] == {
        "edit": 1,
        "model": 4,
        "population": 4,
        "release": 1,
        "summary": 4,
    }
    assert report["computed_again"] == {"population": 3}
    assert report["waiting_for_refresh"] == {"edit": 1}
    assert report["revised_releases"] == 1
    assert "capture folders" in report["not_reached"]
    seal = report.pop("seal")
    assert seal == seal_of(report)
    words = {
        "A",
        "B",
        "lotion",
        "female",
        "r1",
        "translucency",
        str(tmp_path),
        str(db.root),
    }
    assert not words & set(re.findall(r"[\w./-]+", json.dumps(report)))
    assert (tmp_path / "erasure.json").stat().st_mode & 0o777 == 0o600


def test_withdraw_command__refuses_a_report_in_a_missing_folder_before_anything_is_removed(
    db, tmp_path
):
    before = len(_found(db.root, "A"))
    result = CliRunner().invoke(
        cli,
        ["withdraw", str(db.root), "A", "--yes", "--report", str(tmp_path / "none/x")],
    )
    assert "its folder must exist" in str(result.exception)
    assert len(_found(db.root, "A")) == before


def test_withdraw__erases_although_no_code_that_computes_can_be_imported(
    small, tmp_path
):
    """A broken installation of numba does not block an erasure."""
    root = shutil.copytree(small, tmp_path / "db")
    code = (
        "import sys\n"
        "science = 'fit analysis ingest render optics numerics geometry'.split()\n"
        "sys.modules.update(dict.fromkeys(['numba', *('skindb.' + name for name in science)]))\n"
        "import skindb\n"
        "skindb.workflow.withdraw(skindb.open(sys.argv[1]), 'A')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(root)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert "ModuleNotFoundError" in done.stderr or "ImportError" in done.stderr
    assert _found(root, "A") == []
    db = Database(root)
    assert db.verify() == []
    assert [str(request) for request in db.requests()] == ["population of translucency"]
