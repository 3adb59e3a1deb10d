"""From pictures to maps in one command."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import tempfile
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from numba.core import event
from planted_pictures import directions, sphere_normals, write_pictures, write_table

import skindb
from skindb.analysis import STUDIES
from skindb.cli import main
from skindb.errors import InputError
from skindb.format.frames import read_frame, write_frame
from skindb.ingest import import_images
from skindb.render.image import read_exr
from skindb.store.lease import this_process
from skindb.workflow.studies import _require_one_scale
from tests.pictures import read_png

LIGHTS = directions(13)


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    folder = tmp_path / "my pictures"
    write_table(folder / "lights.csv", write_pictures(folder, LIGHTS), LIGHTS)
    return folder


def run(*words: object) -> subprocess.CompletedProcess[str]:
    """A command in this process."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        mock.patch.object(sys, "argv", ["skindb", *map(str, words)]),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def test_quick_writes_maps_and_a_page(pictures: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = run("quick", pictures, out, "--eta", 1, "--no-progress")
    assert result.returncode == 0, result.stderr
    assert "relative" in result.stderr
    assert "maps have a pixel" not in result.stderr
    normal = read_exr(out / "normals.exr")[0]
    truth = sphere_normals()
    inner = truth[..., 2] > 0.5
    cosine = (normal * truth).sum(axis=-1)[inner]
    assert np.isfinite(cosine).mean() > 0.99
    # with the smooth boundary of skin, which the sphere lacks, 2.4 degrees
    assert np.degrees(np.arccos(np.nanquantile(cosine.clip(-1, 1), 0.5))) < 0.5
    albedo = read_exr(out / "albedo.exr")[0][inner]
    assert np.nanmedian(albedo[:, 2] / albedo[:, 0]) == pytest.approx(0.6, rel=0.02)
    assert read_png(out / "normals.png").shape == (*truth.shape[:2], 4)
    page = (out / "page.html").read_text()
    assert "<script" in page
    # the name of the folder may be that of a person
    assert "my pictures" not in page
    assert "my-pictures" not in page
    again = run("quick", pictures, out, "--no-progress")
    assert again.returncode == 1
    assert "results are not replaced" in again.stderr
    among = run("quick", pictures, pictures, "--no-progress")
    assert "results must not be among the pictures" in among.stderr
    on_file = run("quick", pictures, out / "page.html" / "a", "--no-progress")
    assert "must be a folder that can be written" in on_file.stderr


def test_three_lights_are_enough(tmp_path: Path) -> None:
    lights = directions(4)[1:]
    folder = tmp_path / "three"
    write_table(folder / "lights.csv", write_pictures(folder, lights), lights)
    result = run("quick", folder, tmp_path / "out", "--no-progress")
    assert result.returncode == 0, result.stderr
    assert "lambert 100.0%" in result.stdout


def test_quick_measures_crops_of_a_few_pixels(pictures: Path, tmp_path: Path) -> None:
    crop = np.s_[14:18, 30:34]
    for file in pictures.glob("*.png"):
        write_frame(file, read_frame(file)[crop])
    result = run("quick", pictures, tmp_path / "out", "--eta", 1, "--no-progress")
    assert result.returncode == 0, result.stderr
    assert "24 mm wide" in result.stderr
    normal = read_exr(tmp_path / "out/normals.exr")[0]
    cosine = (normal * sphere_normals()[crop]).sum(axis=-1)
    # the limit of the whole sphere
    assert np.degrees(np.arccos(cosine.min().clip(-1, 1))) < 0.5


def test_quick_says_how_coarse_its_maps_are(pictures: Path, tmp_path: Path) -> None:
    result = run("quick", pictures, tmp_path / "out", "--no-progress", "--points", 1000)
    assert "maps have a pixel for 2 x 2 of the pictures" in result.stderr
    assert read_exr(tmp_path / "out/normals.exr")[0].shape == (24, 24, 3)


def test_quick_names_the_pictures_of_the_user(pictures: Path, tmp_path: Path) -> None:
    write_pictures(pictures, LIGHTS, albedo=(0.0, 0.0, 0.0))
    result = run("quick", pictures, tmp_path / "out", "--no-progress")
    assert result.returncode == 1
    assert f"{pictures}: at least 3 lights" in result.stderr


def test_quick_reports_notes_of_the_ingest(pictures: Path, tmp_path: Path) -> None:
    names = [f"picture {k}.png" for k in range(len(LIGHTS))]
    write_table(pictures / "lights.csv", names, LIGHTS * [-1, 1, 1])
    result = run("quick", pictures, tmp_path / "out", "--no-progress", "--points", 1000)
    assert "note: the lights seem to be mirrored" in result.stderr


def test_import_then_ingest_and_fit(pictures: Path, tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    person = ["--subject", "3", "--consent", "fit", "--reference", "form 1"]
    person += ["--visit", "2"]
    result = run("import", pictures, capture, "--as", "images", *person)
    assert result.returncode == 0, result.stderr
    assert "250 mm wide" in result.stderr
    for words in (
        ["ingest", tmp_path / "db", capture, "--spacing", 8],
        ["fit", tmp_path / "db"],
    ):
        result = run(*words, "--no-progress")
        assert result.returncode == 0, result.stderr
    result = run("info", tmp_path / "db")
    assert "3.normal.2" in result.stdout


def test_a_capture_that_is_unchanged_is_not_stored_again(
    pictures: Path, tmp_path: Path
) -> None:
    capture = tmp_path / "capture"
    consent = {"scope": ["fit"], "reference": "form"}
    import_images(pictures, capture, {"subject": "P1", "consent": consent})
    db = skindb.open(str(tmp_path / "db"), create=True)
    words = ["ingest", tmp_path / "db", capture, "--no-progress", "--spacing"]

    def ingested(*more: object) -> tuple[int, bool]:
        """The newest generation, and whether it is said to be unchanged."""
        result = run(*words, *more)
        assert result.returncode == 0, result.stderr
        unchanged = "P1: unchanged since capture" in result.stdout
        return db.record("capture", "P1").generation, unchanged

    assert ingested(8) == (1, False)
    assert ingested(8) == (1, True)
    assert ingested(8, "--again") == (2, False)
    assert ingested(9) == (3, False)
    frame = min((capture / "dome/frames").iterdir())
    write_frame(frame, read_frame(frame) // 2)
    assert ingested(9) == (4, False)
    record = json.loads((capture / "capture.json").read_text())
    (capture / "capture.json").write_text(json.dumps(record | {"age": 30}))
    assert ingested(9) == (5, False)
    assert ingested(9) == (5, True)
    db.record_consent("P1", ["statistics"])
    refused = run(*words, 9)
    assert refused.returncode == 1
    assert "needs the scope 'fit'" in refused.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--as", "olat", "--mask", "x.png"], "mask: does not apply"),
        (["--as", "images", "--scan", "x.ply"], "scan: does not apply"),
        (["--as", "images", "--consent", "all"], "must be from"),
        (["--as", "images", "--subject", "Jane Doe"], "letters, digits"),
        (["--as", "images", "--lights", "gone.csv"], "gone.csv"),
        (["--as", "images", "--response", "sRGB"], "must be auto, srgb, linear"),
    ],
)
def test_wrong_imports_are_one_line(
    pictures: Path, tmp_path: Path, words: list[str], message: str
) -> None:
    person = ["--subject", "P1", "--consent", "fit", "--reference", "form 1"]
    result = run("import", pictures, tmp_path / "out", *person, *words)
    assert result.returncode == 1
    assert message in result.stderr
    assert "Traceback" not in result.stdout
    assert not (tmp_path / "out").exists()


def test_relative_and_absolute_reflectance_are_not_mixed(
    pictures: Path, tmp_path: Path
) -> None:
    db = skindb.open(str(tmp_path / "db"), create=True)
    for name in ("relative", "absolute"):
        folder = tmp_path / name
        consent = {"scope": ["fit", "statistics"], "reference": "form"}
        import_images(pictures, folder, {"subject": name, "consent": consent})
        path = folder / "dome/dome.json"
        dome = json.loads(path.read_text())
        path.write_text(json.dumps(dome | {"relative": name == "relative"}))
        skindb.workflow.ingest_take(db, folder, spacing_mm=8)
        skindb.workflow.fit_take(db, name)
    for _ in range(2):  # the second time from the cache
        unknown = db.cohort("tables")["fit_relative_reflectance"].values.tolist()
        assert unknown == [False, True]  # absolute, relative
    with pytest.raises(InputError, match="relative: all takes of a study"):
        skindb.workflow.study(db, "correlations")
    with pytest.raises(InputError, match="needs absolute reflectance"):
        _require_one_scale(
            db, STUDIES["chromophores"], [db.record("model", "relative")]
        )
    # one subject is too few for correlations, but its scale is not the reason
    with pytest.raises(InputError) as error:
        skindb.workflow.study(db, "correlations", takes=["relative"])
    assert "all takes of a study" not in str(error.value)


def test_takes_of_different_exposures_are_not_mixed(
    pictures: Path, tmp_path: Path
) -> None:
    db = skindb.open(str(tmp_path / "db"), create=True)
    for name, exposure in (("short", 0.01), ("same", 0.0101), ("long", 0.02)):
        folder = tmp_path / name
        consent = {"scope": ["fit", "statistics"], "reference": "form"}
        import_images(pictures, folder, {"subject": name, "consent": consent})
        path = folder / "dome/dome.json"
        dome = json.loads(path.read_text())
        assert "relative_exposure" not in dome  # the pictures do not state it
        path.write_text(json.dumps(dome | {"relative_exposure": exposure}))
        skindb.workflow.ingest_take(db, folder, spacing_mm=8)
        skindb.workflow.fit_take(db, name)
    records = {name: db.record("model", name) for name in db.takes("model")}
    study = STUDIES["correlations"]
    _require_one_scale(db, study, [records["short"], records["same"]])
    with pytest.raises(InputError, match=r"one exposure; found 0\.01 and 0\.02"):
        _require_one_scale(db, study, [*records.values()])


def test_quick_removes_what_a_killed_run_left(
    pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    program = (
        "import json; from skindb.store.lease import this_process\n"
        "print(json.dumps(this_process()))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    for name, holder in (
        ("skindb-quick-ended", ended.stdout),
        ("skindb-quick-running", json.dumps(this_process())),
        ("skindb-quick-unknown", "{"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "process.json").write_text(holder)
    result = run("quick", pictures, tmp_path / "out", "--no-progress", "--points", 1000)
    assert result.returncode == 0, result.stderr
    left = sorted(path.name for path in tmp_path.glob("skindb-*"))
    assert left == ["skindb-quick-running", "skindb-quick-unknown"]


def test_quick_prints_once_that_it_compiles(
    pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def compile_two(*_: object, **__: object) -> None:
        for _ in range(2):
            with event.trigger_event("numba:compile"):
                pass
        raise KeyboardInterrupt

    monkeypatch.setattr("skindb.workflow.quicklook.ingest_take", compile_two)
    result = run("quick", pictures, tmp_path / "out", "--no-progress")
    note = "note: kernels are compiled, which takes minutes after an installation"
    assert [*filter(None, result.stderr.split("\n"))] == [note, "skindb: interrupted"]
    assert result.returncode == 130
