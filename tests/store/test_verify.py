"""`verify` also finds lost, exchanged and edited records, foreign files, pipes and links."""

from __future__ import annotations

import json
import os
import shutil
import socket

import pytest
from stored import commit

from skindb.errors import InputError
from skindb.schema import dataset
from skindb.store import Database
from skindb.store.log import Log
from skindb.store.record import seal_of

UNNAMED = "a record of the log must name every version that was written completely"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder of two captures of A1, a model of the second one, a capture of B1, which
    is only copied.
    """
    root = tmp_path_factory.mktemp("made")
    for value in (1.0, 2.0):
        record = commit(root, value, consent_scope=["statistics"])
    commit(root, kind="model", inputs=[record.as_input()])
    commit(root, take="B1")
    return root


@pytest.fixture
def db(made, tmp_path):
    """Two captures of A1, a model of the second one, a capture of B1."""
    return Database(shutil.copytree(made, tmp_path, dirs_exist_ok=True))


def _record(db, generation=2, kind="capture", take="A1"):
    return db.root / f"log/{kind}/{take}/{generation:08d}.json"


def _head(db, kind="capture", take="A1"):
    return db.root / f"heads/{kind}/{take}.json"


def _edit(file, change):
    """Edit a record and seal it again."""
    body = json.loads(file.read_text())
    body.pop("seal")
    change(body)
    file.write_text(json.dumps(body | {"seal": seal_of(body)}))


def _rules(db):
    return [fault.rule for fault in db.verify()]


def test_read__a_lost_newest_record_is_no_older_version(db):
    _record(db).unlink()
    for call in (
        lambda: db.read("capture", "A1"),
        lambda: db.stage("capture", "A1"),
        lambda: db.record("capture", "A1"),
    ):
        with pytest.raises(
            InputError,
            match=r"generation 2 must exist; found generations \[1\]; restore it",
        ):
            call()
    assert "generation 2 must exist" in db.info()["takes"]["A1"]["capture"]["fault"]
    assert (
        float(db.read("capture", "A1", generation=1)["surfels/surfel_area"][0]) == 1.0
    )


def test_read__a_link_in_place_of_the_newest_record_is_no_older_version(db):
    """Also if no head refers to it."""
    _head(db).unlink()
    _record(db).rename(db.root / "aside")
    _record(db).symlink_to(db.root / "aside")
    with pytest.raises(
        InputError,
        match=r"a symbolic link at log/capture/A1/00000002\.json; restore it",
    ):
        db.read("capture", "A1")


def test_takes__a_take_whose_records_were_lost_is_still_known(db):
    shutil.rmtree(db.root / "log/model")
    assert db.takes("model") == ["A1"]
    assert db.kinds("A1") == ["capture", "model"]
    assert "generation 1 must exist" in db.info()["takes"]["A1"]["model"]["fault"]
    for call in (lambda: db.cohort("tables"), lambda: db.history("model", "A1")):
        with pytest.raises(
            InputError, match="model of A1: generation 1 must exist; found nothing"
        ):
            call()


def test_verify__a_lost_record_is_revealed_without_the_head_too(db):
    """It is revealed by its data, and by the model that was made from it."""
    data = db.root / db.record("capture", "A1").path
    _record(db).unlink()
    _head(db).unlink()
    assert sorted(_rules(db)) == [
        UNNAMED,
        "generation 2, from which model 1 of A1 was made, must exist",
    ]
    shutil.rmtree(data)
    for file in data.parent.glob(f"{data.stem}.*"):
        file.unlink()
    assert _rules(db) == ["generation 2, from which model 1 of A1 was made, must exist"]


def test_verify__a_running_or_killed_writer_is_no_damage(db):
    with db.stage("capture", "A1") as stage:
        stage.write({})
        (db.root / stage.path).mkdir(exist_ok=True, parents=True)
        (db.root / f"staging/.{'0' * 32}.tmp").touch()
        assert db.verify() == []


def test_read__another_record_in_place_of_the_newest_is_refused(db, tmp_path):
    other = Database(tmp_path / "other")
    commit(other.root, take="B1")
    shutil.copy(_record(other, 1, take="B1"), _record(db, 1, take="B1"))
    with pytest.raises(
        InputError,
        match="generation 1 must be the record that was committed; found a different record",
    ):
        db.read("capture", "B1")
    assert "generation 1 must be the record that was committed" in _rules(db)


@pytest.mark.parametrize(
    "other", [(1, "capture", "A1"), (1, "model", "A1"), (1, "capture", "B1")]
)
def test_verify__a_record_copied_over_another_one(db, other):
    shutil.copy(_record(db, *other), _record(db))
    with pytest.raises(
        InputError,
        match=f"found the record of {other[1]} 1 of {other[2]}; restore it from a backup",
    ):
        db.read("capture", "A1")
    assert any("found the record of" in str(fault) for fault in db.verify())


@pytest.mark.parametrize(
    "content",
    ["{head}x", "7", "[" * 5000 + "]" * 5000, "{other}", '{{"generation": true}}'],
)
def test_head__that_is_damaged_or_of_another_take_changes_nothing(db, content):
    other = _head(db, take="B1").read_text()
    _head(db).write_text(content.format(head=_head(db).read_text(), other=other))
    assert db.verify() == []
    assert float(db.read("capture", "A1")["surfels/surfel_area"][0]) == 2.0
    _head(db).write_text(
        _head(db, "model").read_text().replace('"generation": 1', '"generation": 9')
    )
    assert db.verify() == []


def _nested(depth):
    value = []
    for _ in range(depth):
        value = [value]
    return value


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda body: body.update(provenance={}),
            "a record without provenance; restore",
        ),
        (lambda body: body.pop("provenance"), "fields that do not match its format"),
        (
            lambda body: body.update(provenance=None),
            "invalid values of provenance; restore",
        ),
        (
            lambda body: body["provenance"].update(schema_version=9),
            "a schema of format 9; update skindb if that is a later one",
        ),
        (
            lambda body: body["provenance"].update(inputs=[1]),
            "invalid values of provenance",
        ),
        (
            lambda body: body["provenance"].update(consent_scope="fit"),
            "invalid values of provenance",
        ),
        (
            lambda body: body["provenance"].update(traits=[]),
            "invalid values of provenance",
        ),
        (
            lambda body: body["provenance"].update(deep=_nested(40)),
            "more than 32 levels of nested brackets",
        ),
        (
            lambda body: body["provenance"].update(deep=_nested(400)),
            "more than 32 levels of nested brackets",
        ),
        (
            lambda body: body.update(format=9),
            "a record of format 9; update skindb if that is a later one",
        ),
        (lambda body: body.update(format=True), "a record of format True; update"),
        (lambda body: body.update(bytes="1"), "invalid values of bytes"),
        (lambda body: body.update(generation=2.0), "invalid values of generation"),
        (lambda body: body.update(contents=[]), "invalid values of contents"),
        (
            lambda body: body["contents"]["samples"]["sizes"].update(light=-1),
            "invalid values of contents",
        ),
        (
            lambda body: body["contents"]["samples"]["variables"].append("nose"),
            "invalid values of contents",
        ),
        (
            lambda body: body["contents"]["samples"]["labels"]["light"].pop(),
            "invalid values of contents",
        ),
    ],
)
def test_read__a_record_of_odd_values_is_refused_although_its_seal_fits(
    db, change, said
):
    _head(db).unlink()
    _edit(_record(db), change)
    for call in (
        lambda: db.read("capture", "A1"),
        db.table,
        lambda: db.stage("capture", "A1"),
    ):
        with pytest.raises(
            InputError, match="a record of the log must be as committed; found"
        ) as caught:
            call()
        assert said in str(caught.value)
    assert any(said in str(fault) for fault in db.verify())


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda body: body["provenance"].update(seeds=[2]), "provenance"),
        (
            lambda body: body["contents"]["surfels"]["sizes"].update(surfel=9),
            "contents",
        ),
        (lambda body: body.update(bytes=7), "bytes"),
    ],
)
def test_verify__an_edited_record_contradicts_its_version(db, change, name):
    """The record is sealed again, and no head refers to it."""
    _head(db, take="B1").unlink()
    _edit(_record(db, 1, take="B1"), change)
    (fault,) = db.verify()
    assert str(fault).startswith(
        "capture 1 of B1: the record must agree with the attributes of its version;"
    )
    assert fault.found == f"different {name}"


def test_cohort__a_record_that_describes_other_tables_is_refused(db):
    """The layout of a cohort comes from the record, with which the tables must agree."""
    tables = dataset({"region_area": [1.0, 2.0]}, coords={"region": ["face", "nose"]})
    with db.stage("model", "C1") as stage:
        stage.write({}, tables=tables)
        stage.commit({"consent_scope": ["statistics"]})
    assert db.cohort("tables", takes=["C1"])["region_area"].values.tolist() == [
        [1.0, 2.0]
    ]
    _head(db, "model", "C1").unlink()
    record = _record(db, 1, "model", "C1")
    _edit(
        record,
        lambda body: body["contents"]["tables"]["labels"].update(
            region=["nose", "face"]
        ),
    )
    with pytest.raises(
        InputError,
        match="model 1 of C1: the record must agree with the attributes of its version",
    ):
        db.cohort("tables", takes=["C1"])["region_area"].compute(
            scheduler="synchronous"
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    "place",
    [
        "log/X",
        "log/capture/a b",
        "log/capture/A1/x.json",
        "log/capture/A1/1.json",
        "log/capture/A1/٠٠٠٠٠٠٠٣.json",
        "data/X",
        "data/capture/A1/x",
        "data/capture/A1/x.zarr",
        "data/Capture",
        "heads/capture/A1",
        "tombstones/x.json",
    ],
)
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_verify__foreign_files_are_named(db, place, kind):
    path = db.root / place
    path.parent.mkdir(parents=True, exist_ok=True)
    path.mkdir() if kind == "folder" else path.touch()
    (fault,) = db.verify()
    assert (fault.where, fault.cure) == (str(path), "remove it")
    assert float(db.read("capture", "A1")["surfels/surfel_area"][0]) == 2.0


def _bind(path):
    with socket.socket(socket.AF_UNIX) as one:
        os.chdir(path.parent)  # names of sockets are short
        one.bind(path.name)


SUBSTITUTES = {
    "pipe": os.mkfifo,
    "socket": _bind,
    "folder": os.mkdir,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "loop": lambda path: path.symlink_to(path.name),
    "outside": lambda path: path.symlink_to("/etc"),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", SUBSTITUTES)
@pytest.mark.parametrize(
    "name", ["record", "manifest", "head", "chunk", "log", "heads", "take"]
)
def test_verify__only_regular_files_inside_are_opened(db, monkeypatch, name, what):
    """`verify` ends, and names what replaces a file; reads are refused, except if the
    head, a cache, is replaced.
    """
    monkeypatch.chdir(db.root)
    record = db.record("capture", "A1")
    path = {
        "record": _record(db),
        "manifest": db.root / record.beside("manifest"),
        "head": _head(db),
        "chunk": db.root / record.path / "surfels/zarr.json",
        "log": db.root / "log",
        "heads": db.root / "heads",
        "take": db.root / "log/capture/A1",
    }[name]
    path.rename(db.root / "aside")
    SUBSTITUTES[what](path)
    told = [str(fault) for fault in db.verify()]
    cache = name in ("head", "heads")
    assert any(str(path) in line or name in line for line in told) or (
        what == "folder" and name != "record"
    )
    assert all(";" in line.partition("; found ")[2] for line in told)  # a cure
    if cache:
        assert float(db.read("capture", "A1")["surfels/surfel_area"][0]) == 2.0
    else:
        with pytest.raises(InputError, match="; found "):
            db.read("capture", "A1")


def test_verify__an_empty_folder_in_a_version_is_foreign(db):
    path = db.root / db.record("capture", "A1").path / "surfels/surfel_area/c/x"
    path.mkdir()
    (fault,) = db.verify()
    assert (fault.where, fault.found) == (str(path), "an unknown file or folder")
    assert float(db.read("capture", "A1")["surfels/surfel_area"][0]) == 2.0


def test_verify__a_record_of_a_far_generation_does_not_hang(db):
    shutil.copy(_record(db), _record(db, 99_999_999))
    assert any("the record of capture 2 of A1" in str(fault) for fault in db.verify())
    _edit(_record(db, 99_999_999), lambda body: body.update(generation=99_999_999))
    assert "generations 3 to 99999998 must exist" in _rules(db)


def test_verify__endless_folders_and_files(db):
    version = db.root / db.record("capture", "A1").path
    (version / "/".join(["d"] * 40)).mkdir(parents=True)
    os.truncate(version / "surfels/zarr.json", 1 << 40)
    os.truncate(_record(db, 1, take="B1"), 1 << 40)
    told = [str(fault) for fault in db.verify()]
    assert [
        line for line in told if "an unknown file" in line and f"{'d/' * 16}d: " in line
    ]
    assert any("1099511627776 bytes instead of" in line for line in told)
    assert any(
        "B1/00000001.json: a record of the log must be as committed; found 1,099,5"
        in line
        for line in told
    )


def test_remove__leaves_nothing_of_the_version(db):
    record = db.record("capture", "B1")
    Log(db.place, "capture", "B1").remove(1)
    assert db.verify() == []
    assert not [
        path
        for path in db.root.rglob("*")
        if path.stem.startswith(record.path.split("/")[-1][:24])
    ]
