"""What skindb writes belongs to its owner alone, whatever the umask is and whichever
library writes it.
"""

from __future__ import annotations

import ast
import os
import stat
from pathlib import Path

import numpy as np
import pytest
import trimesh
from permissions import open_to_others, open_umask
from small_face import small_face

import skindb
from skindb.cache import cached_arrays
from skindb.cli import main
from skindb.files import private_file, private_umask
from skindb.format.frames import write_frame
from skindb.geometry.scan import Crop
from skindb.reflectance.brdf_files import write_merl, write_tables
from skindb.reflectance.dictionary import embedded_dictionary
from skindb.render.figures import write_field
from skindb.render.image import write_exr, write_png
from skindb.view.face import face_record
from skindb.view.landmarks import landmark_task, save_landmarks
from skindb.view.page import PagedFace, write_page
from skindb.virtual.face import FaceShape
from skindb.virtual.head import parametric_head


@pytest.fixture(autouse=True)
def _open_umask():
    with open_umask():
        yield


@pytest.fixture(scope="module")
def model():
    return small_face()


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_private_file__creates_or_closes_a_file(tmp_path):
    assert mode(private_file(tmp_path / "new")) == 0o600
    before = tmp_path / "before"
    before.write_text("content")
    before.chmod(0o666)
    (tmp_path / "link").symlink_to(before)
    assert mode(private_file(str(tmp_path / "link"))) == 0o600
    assert before.read_text() == "content"
    with pytest.raises(FileNotFoundError):
        private_file(tmp_path / "absent/file")


def test_private_file__leaves_pipes_and_devices(tmp_path):
    os.mkfifo(tmp_path / "pipe", 0o644)
    assert mode(private_file(tmp_path / "pipe")) & 0o777 == 0o644
    before = mode(Path("/dev/null"))
    assert mode(private_file("/dev/null")) == before


def test_private_umask__is_restored(tmp_path):
    with private_umask():
        (tmp_path / "a").mkdir()
        (tmp_path / "a/b").touch()
    assert open_to_others(tmp_path / "a") == {}
    (tmp_path / "c").touch()
    assert mode(tmp_path / "c") == 0o666


def write_images(out, model):
    write_png(out / "a.png", np.zeros((4, 4, 3), np.uint8))
    write_exr(out / "a.exr", np.zeros((4, 4, 3), np.float32))
    for suffix in ("png", "tif"):
        write_frame(out / f"frame.{suffix}", np.zeros((4, 4, 3), np.uint16))
    write_frame(out / "frame.exr", np.zeros((4, 4, 3), np.float32))
    write_field({"model": model}, "diffuse_reflectance", out / "field.png")


def write_tables_of_brdfs(out, model):
    write_tables(out / "tables.npz", embedded_dictionary())
    write_merl(out / "a.binary", np.zeros((90, 90, 180, 3)))


def write_pages(out, model):
    record = face_record(model, take="S1", attributes={})
    write_page(out / "face.html", [PagedFace.of(record, "")])


def write_landmarks(out, model):
    head = parametric_head(FaceShape(), spacing_mm=8.0)
    scan = private_file(out / "scan.ply")
    trimesh.Trimesh(head.vertices, head.faces, process=False).export(scan)
    task = landmark_task(scan, out / "landmarks.json")
    save_landmarks(
        task, head.landmarks, Crop((-200, -200, -200), (200, 200, 200), None)
    )


def write_captures(out, model):
    skindb.workflow.simulate(
        out / "captures", takes=1, cameras=2, lights=3, width=16, height=20
    )


def write_cache(out, model):
    os.environ["SKINDB_CACHE"] = str(out / "cache/skindb")
    cached_arrays("x", (1,), sources=("skindb.cache",), make=lambda: {"a": np.zeros(3)})


WRITERS = (
    write_images,
    write_tables_of_brdfs,
    write_pages,
    write_landmarks,
    write_captures,
    write_cache,
)


@pytest.mark.slow
@pytest.mark.parametrize("write", WRITERS, ids=lambda one: one.__name__)
def test_writers__their_files_are_private(tmp_path, model, write, monkeypatch):
    monkeypatch.setenv("SKINDB_CACHE", str(tmp_path / "cache"))
    full = model.copy(deep=True)
    full.attrs["generation"] = 1
    write(tmp_path, full)
    written = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert written
    assert open_to_others(tmp_path, itself=False) == {}
    for path in written:
        path.chmod(0o666)
    # which replace their files
    if write in (write_images, write_pages, write_landmarks):
        write(tmp_path, full)
        assert open_to_others(tmp_path, itself=False) == {}


CALLS = {
    "write_text",
    "write_bytes",
    "savefig",
    "savez",
    "savetxt",
    "np.save",
    "imwrite",
    "imsave",
    "to_csv",
    "shutil.copy",
    "copyfile",
    "copy2",
    "copytree",
    "mkdir",
    "makedirs",
    "touch",
    "export",
}
# reasons why a call that writes does not name `private_file` or `make_private`
EXCEPTIONS = {
    "files.py": "it is where they are",
    "hw": "a session runs with a private umask",
    "virtual/laboratory.py": "a session runs with a private umask",
    "store": "a database has the permissions of its root",
}


@pytest.mark.slow
def test_package__every_writer_makes_its_files_private():
    root = Path(skindb.__file__).parent
    found = []
    for path in root.rglob("*.py"):
        name = path.relative_to(root).as_posix()
        if any(name == one or name.startswith(f"{one}/") for one in EXCEPTIONS):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            if node.args and ast.unparse(node.args[0]) == "buffer":  # in memory
                continue
            text = ast.unparse(node)
            called = ast.unparse(node.func)
            opens = called.rpartition(".")[2] == "open" and any(
                f"'{how}" in text for how in ("w", "a", "x")
            )
            if (
                opens or {called, called.rpartition(".")[2]} & CALLS
            ) and "private_file(" not in text:
                found.append(f"{name}:{node.lineno}: {text}")
    assert found == []


def test_cli__what_libraries_write_is_private(monkeypatch):
    """The command line has a private umask, which its worker processes inherit."""
    monkeypatch.setattr("sys.argv", ["skindb", "info", "db"])
    seen = []

    def look(_, **__):
        seen.append(os.umask(0o077))
        raise SystemExit

    monkeypatch.setattr(skindb, "open", look)
    with pytest.raises(SystemExit):
        main()
    assert seen == [0o077]
    assert os.umask(0) == 0
