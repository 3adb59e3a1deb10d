"""`skindb landmarks` as a process serves pages, saves landmarks, and exits without an
error when interrupted.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from page_session import Session

from skindb.virtual.face import FaceShape
from skindb.virtual.head import parametric_head

pytestmark = pytest.mark.slow


def call(*args):
    return [
        sys.executable,
        "-c",
        "from skindb.cli import main; main()",
        "landmarks",
        *map(str, args),
    ]


def test_landmarks__serves_and_saves_until_it_is_interrupted(tmp_path):
    head = parametric_head(FaceShape(), spacing_mm=4.0)
    trimesh.Trimesh(head.vertices, head.faces, process=False).export(
        tmp_path / "scan.ply"
    )
    out = tmp_path / "landmarks.json"
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    # tests in the background of a shell ignore Ctrl-C, and the command would inherit this
    with subprocess.Popen(
        call(tmp_path / "scan.ply", "--out", out),
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        **pipes,
    ) as running:
        try:
            session = Session.opened(running.stdout.readline().split()[0])
            points = {
                "nose_tip": head.vertices[np.argmax(head.vertices[:, 2])].tolist()
            }
            body = {"points": points, "confirmed": []}
            questions = session.post("save", body)["questions"]
            assert len(questions) == 1
            assert not out.exists()
            assert session.post("save", body | {"confirmed": questions})[
                "saved"
            ].startswith("1 point was saved")
        finally:
            running.send_signal(signal.SIGINT)
            try:
                said = running.communicate(timeout=60)
            except subprocess.TimeoutExpired:
                running.kill()
                raise
    assert (running.returncode, said[1]) == (0, "")
    # decimals
    np.testing.assert_allclose(
        json.loads(out.read_text())["nose_tip"], points["nose_tip"], atol=0.5e-3
    )


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (("none.ply",), "none.ply: the file must exist"),
        (("scan.stl",), "a scan must be a .ply or .obj file"),
        (("none.ply", "--out", "marks.txt"), "must end in .json"),
        (("none.ply", "--out", "none/marks.json"), "its folder must exist"),
    ],
)
def test_landmarks__mistakes_are_one_line(tmp_path, args, said):
    done = subprocess.run(
        call(*args), capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert done.returncode == 1
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1
