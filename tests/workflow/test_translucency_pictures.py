"""Pictures of the least and the most translucent take."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner
from small_face import small_face

from skindb.cli import cli
from skindb.errors import InputError
from skindb.schema import dataset
from skindb.store import Database
from skindb.workflow import pictures, translucency_grid
from tests.pictures import read_png

pytestmark = pytest.mark.slow


@pytest.fixture
def db(tmp_path):
    """Three takes with diffusion lengths of 0.7, 2 and 1 mm; a fourth one with a longer
    one may not be exported.
    """
    db = Database(tmp_path / "db")
    for take, length, scope in (
        ("A", 0.7, "export"),
        ("B", 2.0, "export"),
        ("C", 1.0, "export"),
        ("D", 9.0, "fit"),
    ):
        _commit(db, take, length, [scope])
    return db


def _commit(db, take, length, scope):
    face = small_face()
    sigma = np.full((len(face["fitted/surfel_position"]), 3), 1 / length)
    fitted = face["fitted"].to_dataset()
    fitted["sigma_tr"] = fitted["sigma_tr"].copy(data=sigma)
    sites = dataset(
        {"site_sigma_tr": np.full((1, 3), 1 / length)},
        coords={"site": ["cheek"], "channel": ["R", "G", "B"]},
    )
    tip = fitted["surfel_position"].values[
        [np.argmax(fitted["surfel_position"].values[:, 2])]
    ]
    mesh = dataset(
        {"triangle": face["mesh/triangle"].values, "landmark_position": tip},
        coords={"landmark": ["nose_tip"]},
    )
    groups = {name: node.to_dataset() for name, node in face.children.items()}
    with db.stage("model", take) as stage:
        stage.write(groups | {"fitted": fitted, "translucency": sites, "mesh": mesh})
        stage.commit(
            {
                "subject": take,
                "condition": "normal",
                "traits": {},
                "consent_scope": scope,
            }
        )


def test_translucency_grid__shows_the_extremes(db, tmp_path, monkeypatch):
    drawn = {}
    write = pictures.write_grid

    def keep(out, rows, names, **options):
        drawn.update(rows)
        write(out, rows, names, **options)

    monkeypatch.setattr(pictures, "write_grid", keep)
    monkeypatch.setattr(pictures, "SIDE_PX", 112)
    found = translucency_grid(db, tmp_path / "grid.png")
    assert [*found] == ["A", "B"]
    np.testing.assert_allclose([*found.values()], [0.7, 2.0])
    assert read_png(tmp_path / "grid.png").std() > 0.05
    # light reaches further into the shadow of the more translucent take: less of the
    # close-up is dark
    (near, local), (wide, _) = drawn.values()
    level = 0.05 * np.median(local[local > 0])
    dark = [
        float((picture.mean(axis=-1) < level).mean()) for picture in (wide, near, local)
    ]
    assert dark[0] < dark[1] < dark[2]


def test_translucency_grid__mistakes(db, tmp_path):
    with pytest.raises(
        InputError, match="two takes must have translucency at forehead; found 0"
    ):
        translucency_grid(db, tmp_path / "grid.png", site="forehead")
    for options, said in (
        (
            ["analyze", str(db.folder), "albedo", "--faces", str(tmp_path / "a.png")],
            "No such option '--faces'",
        ),
        (
            [
                "analyze",
                str(db.folder),
                "translucency",
                "--faces",
                str(tmp_path / "a.gif"),
            ],
            "a.gif",
        ),
    ):
        result = CliRunner().invoke(cli, options)
        assert said in f"{result.output} {result.exception}"
