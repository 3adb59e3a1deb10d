"""The bundle rendered again: by Mitsuba 3 where it is installed, and by skindb from the
files alone.

SKINDB_MITSUBA_PYTHON names an interpreter that has mitsuba and numpy, if the one of the
tests has no mitsuba; `.ci/run` makes one.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
import xarray as xr
from scipy.ndimage import binary_erosion, map_coordinates

from skindb.export.bundle import export_bundle
from skindb.reflectance.brdf_files import read_dictionary
from skindb.reflectance.mixture import Mixture
from skindb.render.image import read_exr, write_exr
from skindb.render.scene import Camera, Lights, Surface, from_model
from tests.pictures import render_view

pytestmark = pytest.mark.slow

LIGHT = np.array([[150.0, 100, 500]])
WIDTH = 480
HEIGHT = 600
DISTANCE = 800.0


def rendered(surface: Surface) -> np.ndarray:
    """As `skin.scene` of the bundle: a camera 800 mm in front, 20 degrees wide, and a
    point light.
    """
    focal = WIDTH / 2 / np.tan(np.radians(10))
    K = np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])
    R = np.diag([1.0, -1, -1])
    camera = Camera(K, R, np.array([0, 0, DISTANCE]), np.zeros(5), WIDTH, HEIGHT)
    lamp = Lights(
        LIGHT,
        np.full((1, 3), 1e6),
        np.zeros(1),
        -LIGHT / np.linalg.norm(LIGHT),
        np.zeros(1),
    )
    return render_view(surface, camera, lamp, samples=2, disc_samples=1).sum(axis=0)


def difference(found: np.ndarray, true: np.ndarray) -> float:
    """RMS difference over RMS where both pictures show skin, away from edges."""
    both = binary_erosion(
        (found > 0).all(axis=-1) & (true > 0).all(axis=-1), iterations=3
    )
    assert both.sum() > 10_000
    return float(np.sqrt(np.mean((found - true)[both] ** 2) / np.mean(true[both] ** 2)))


def read_back(bundle: Path) -> Surface:
    """The surface by the files of a bundle alone."""
    mesh = trimesh.load(bundle / "mitsuba/face.ply", process=False)
    data = mesh.metadata["_ply_raw"]["vertex"]["data"]
    uv = np.stack([data["u"], data["v"]], axis=1).astype(np.float64)

    def values(name: str) -> np.ndarray:
        image = read_exr(bundle / f"maps/{name}.exr")[0]
        at = (uv * image.shape[0] - 0.5)[:, ::-1].T
        return np.stack(
            [
                map_coordinates(plane, at, order=1, mode="nearest")
                for plane in np.moveaxis(image, -1, 0)
            ],
            1,
        )

    count = len(list((bundle / "maps").glob("weight_*.exr")))
    weights = np.concatenate([values(f"weight_{k}") for k in range(count)], axis=1)
    tables = read_dictionary(bundle / "bases").table
    eta = json.loads((bundle / "manifest.json").read_text())["refractive_index"]
    return Surface(
        mesh.vertices,
        mesh.faces,
        mesh.vertex_normals,
        values("albedo"),
        weights,
        Mixture(tables),
        eta=eta,
    )


def of_model(model: xr.DataTree) -> Surface:
    fitted = model["fitted"].to_dataset()
    # which direct light does not need
    fitted["dipole_s"] = fitted["diffuse_reflectance"].copy()
    model["fitted"] = fitted
    return from_model(model)


def test_bundle__read_back_gives_the_same_picture(
    model: xr.DataTree, bundle: Path
) -> None:
    """Maps of 2.7 texels for each surfel and half floats: 2 % is what their
    interpolation may cost.
    """
    true = rendered(of_model(model))
    assert difference(rendered(read_back(bundle)), true) < 0.02


TWO_FACES = """
import sys
import mitsuba as mi
mi.set_variant("scalar_rgb")
sys.path += sys.argv[1:]
import first, second
for one in first, second:
    scene = one.scene([0.0, 0.0, 700.0])
    scene["sensor"]["film"] |= {"width": 16, "height": 20}
    print(max(mi.render(mi.load_dict(scene), spp=1).array))
"""


@pytest.fixture
def mitsuba() -> str:
    """The interpreter of Python that has mitsuba."""
    found = os.environ.get(
        "SKINDB_MITSUBA_PYTHON",
        sys.executable if importlib.util.find_spec("mitsuba") else "",
    )
    if not found:
        pytest.skip(
            "SKINDB_MITSUBA_PYTHON must name a Python with the packages mitsuba and numpy"
        )
    return found


def output(command: list[str], folder: Path) -> str:
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_export_mitsuba__renders_as_skindb_does(
    model: xr.DataTree, bundle: Path, tmp_path: Path, mitsuba: str
) -> None:
    bundle = shutil.copytree(bundle, tmp_path / "bundle")
    light = [str(x) for x in LIGHT[0]]
    output(
        [
            mitsuba,
            "skin.py",
            str(tmp_path / "a.exr"),
            "--light",
            *light,
            "--samples",
            "4",
        ],
        bundle / "mitsuba",
    )
    found = read_exr(tmp_path / "a.exr")[0][..., :3]
    true = rendered(of_model(model))
    assert difference(found, true) < 0.02
    both = (found > 0).all(axis=-1) & (true > 0).all(axis=-1)
    assert np.median(found[both] / true[both]) == pytest.approx(1, abs=0.005)


def test_export_mitsuba__several_faces_keep_their_own_maps(
    model: xr.DataTree, tmp_path: Path, mitsuba: str
) -> None:
    one = export_bundle(model, tmp_path / "one", size=64, merl=False).parent
    black = shutil.copytree(one, tmp_path / "black")
    for name in ("albedo", "weight_0", "weight_1"):
        write_exr(
            black / f"maps/{name}.exr",
            0 * read_exr(one / f"maps/{name}.exr")[0].squeeze(),
        )
    (one / "mitsuba/skin.py").rename(one / "mitsuba/first.py")
    (black / "mitsuba/skin.py").rename(black / "mitsuba/second.py")
    command = [mitsuba, "-c", TWO_FACES, str(one / "mitsuba"), str(black / "mitsuba")]
    first, second = map(float, output(command, tmp_path).split())
    assert first > 0
    assert second == 0
