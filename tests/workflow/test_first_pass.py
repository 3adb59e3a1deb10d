"""A fit that was killed after its first pass continues there, and gives the same model
as an uninterrupted fit.
"""

from __future__ import annotations

import json
import shutil
import stat
from dataclasses import replace

import pytest
from planted_cohort import PARAMETERS, PEOPLE, capture, few_materials

import skindb
from skindb.errors import InputError
from skindb.store import lease as lease_module
from skindb.workflow import fit as fit_module
from skindb.workflow.derive import groups_of
from skindb.workflow.fit import fit_take

TAKE = "S01"


class Killed(BaseException):
    """Raised in place of a kill."""


@pytest.fixture
def db(tmp_path):
    return _database(tmp_path)


def _database(folder):
    db = skindb.open(folder / "db", create=True)
    _ingest(db)
    return db


def _ingest(db):
    tree = capture(TAKE, PEOPLE[TAKE], 1)
    with db.stage("capture", TAKE) as stage:
        stage.write(groups_of(tree))
        stage.commit(tree.attrs)


def _fit(db, parameters=PARAMETERS, **options):
    """Fit, and return the record and the stages that were computed."""
    stages = []
    options = {
        "dictionary": few_materials(),
        "progress": lambda stage, *_: stages.append(stage),
    } | options
    return fit_take(db, TAKE, parameters, **options), [
        stage for stage in dict.fromkeys(stages) if "compil" not in stage
    ]


def _kill(db, monkeypatch, parameters=PARAMETERS, **options):
    """Kill a fit at the start of its second pass."""

    def die(*_, **__):
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(fit_module, "second_pass", die)
        with pytest.raises(Killed):
            _fit(db, parameters, **options)
    return db


@pytest.fixture(scope="module")
def left(tmp_path_factory):
    """Folder of the database after a killed fit, which is only copied."""
    with pytest.MonkeyPatch.context() as patch:
        return _kill(_database(tmp_path_factory.mktemp("left")), patch).root


@pytest.fixture
def killed(left, tmp_path):
    """The database after a killed fit."""
    return skindb.open(shutil.copytree(left, tmp_path / "db"))


def _files(db, record):
    """Digests of the files of a version except for the provenance, and the tables."""
    manifest = json.loads((db.root / record.beside("manifest")).read_text())
    manifest.pop("zarr.json")
    return manifest, (db.root / record.beside("tables")).read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [{}, {"light_gains": True, "hold_out_cameras": 0.3}]
)
def test_fit_take__continues_after_the_first_pass_of_a_killed_run(
    db, monkeypatch, options
):
    parameters = replace(PARAMETERS, **options)
    _kill(db, monkeypatch, parameters)
    resumed, stages = _fit(db, parameters)
    assert stages[0] == "first pass of the run before"
    assert "first pass" not in stages
    again, stages = _fit(db, parameters)  # the first pass was removed with the commit
    assert "first pass" in stages
    assert _files(db, resumed) == _files(db, again)
    about = [
        {name: v for name, v in one.provenance.items() if name != "seconds"}
        for one in (resumed, again)
    ]
    assert about[0] == about[1]
    assert resumed.provenance["seconds"].keys() == again.provenance["seconds"].keys()


@pytest.mark.slow
@pytest.mark.parametrize("change", ["parameters", "capture", "dictionary", "code"])
def test_fit_take__uses_no_first_pass_that_would_be_another(
    killed, change, change_code, monkeypatch
):
    parameters = PARAMETERS
    stages = []
    options = {"progress": lambda stage, *_: stages.append(stage)}
    if change == "parameters":
        parameters = replace(PARAMETERS, eta=1.31)
    elif change == "capture":
        _ingest(killed)
    elif change == "dictionary":
        options["dictionary"] = None
    else:
        change_code("fit/normals.py", "return ", "return 1 and ")
    _kill(killed, monkeypatch, parameters, **options)
    assert "first pass" in stages


@pytest.mark.slow
def test_fit_take__repeats_a_first_pass_that_is_damaged(killed):
    for file in killed.root.glob("tmp/*/data/**/c/*"):
        if file.is_file():
            file.write_bytes(b"damaged")
    _, stages = _fit(killed)
    assert "first pass" in stages
    assert killed.verify() == []


def test_first_pass__is_no_result_and_leaves_nothing(killed):
    assert killed.kinds() == ["capture"]
    assert killed.info()["takes"].keys() == {TAKE}
    assert killed.info()["takes"][TAKE].keys() == {"capture"}
    assert killed.verify() == []
    [scratch] = killed.scratch().iterdir()
    [garbage] = killed.garbage()
    assert garbage.key == f"tmp/{scratch.name}"
    assert "so that the same run can resume" in garbage.kept
    _fit(killed)
    assert [*killed.scratch().iterdir()] == []
    assert killed.garbage() == []


def test_first_pass__lets_others_work_in_a_shared_database(db, monkeypatch):
    db.root.chmod(0o2770)
    _kill(db, monkeypatch)
    [scratch] = db.scratch().iterdir()
    for folder in (db.scratch(), scratch, scratch / "data" / "model"):
        assert stat.S_IMODE(folder.stat().st_mode) == 0o2770


def test_first_pass__of_another_fit_is_removed(killed):
    _fit(killed, replace(PARAMETERS, eta=1.31))
    assert [*killed.scratch().iterdir()] == []


def test_first_pass__is_removed_with_its_subject(killed):
    killed.erase(TAKE)
    assert [*killed.scratch().iterdir()] == []


def test_first_pass__of_a_subject_who_is_withdrawn_meanwhile_is_removed(
    db, monkeypatch
):
    store = fit_module._store_first_pass

    def withdrawn(*arguments):
        monkeypatch.setattr(lease_module, "_has_ended", lambda *_: True)
        db.erase(TAKE)
        store(*arguments)

    monkeypatch.setattr(fit_module, "_store_first_pass", withdrawn)
    with pytest.raises(InputError):
        _fit(db)
    assert [*db.scratch().iterdir()] == []
    assert db.verify() == []


def test_fit_take__refuses_while_another_run_works_on_the_take(db):
    for kinds in (["model"], ["capture", "model"]):  # a fit, an ingest
        with (
            db.lease(TAKE, *kinds, command="skindb ingest"),
            pytest.raises(
                InputError,
                match="model of S01: only one run at a time may work on it; found skindb ingest on",
            ),
        ):
            _fit(db)
    assert not db.has("model", TAKE)


def test_fit_take__of_a_take_that_there_is_not_writes_nothing(db):
    with pytest.raises(InputError, match="capture of S99: the database must hold it"):
        fit_take(db, "S99", PARAMETERS)
    assert not (db.root / "leases/model/S99").exists()
