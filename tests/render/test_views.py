"""Cameras and lights around a head, pictures with a transparent background, and turntables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import PIL.Image
import pytest
import xarray as xr

from skindb.errors import InputError
from skindb.render.image import write_webp
from skindb.render.rendering import render_picture
from skindb.render.scene import from_model
from skindb.render.views import VIEWS, camera_around, light_from, turntable_azimuths
from tests.pictures import read_png
from tests.small_face import small_face


@pytest.fixture(scope="module")
def model() -> xr.DataTree:
    return small_face()


@pytest.mark.parametrize(("name", "towards"), [("front", 2), ("left", 0), ("right", 0)])
def test_camera_around__looks_from_that_side_at_the_whole_surface(
    model, name: str, towards: int
) -> None:
    """+x is the subject's left, +z the front."""
    surface = from_model(model)
    camera = camera_around(surface, VIEWS[name], 200)
    place = camera.centre - surface.vertices.mean(axis=0)
    assert abs(place[towards]) > 0.95 * np.linalg.norm(place)
    assert (place[towards] < 0) == (name == "right")
    np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera.R) == pytest.approx(1)
    seen = camera.project(surface.vertices)
    assert (seen > 0).all()
    assert (seen < [200, 250]).all()
    # up in the picture is +y
    top, bottom = surface.vertices[:, 1].argmax(), surface.vertices[:, 1].argmin()
    assert seen[top, 1] < seen[bottom, 1]


def test_light_from__its_azimuth_and_elevation(model) -> None:
    light = light_from(from_model(model), "90,30")
    towards = -light.axis[0]
    np.testing.assert_allclose(towards, [np.sqrt(3) / 2, 0.5, 0], atol=1e-12)


@pytest.mark.parametrize("text", ["", "40", "1,2,3", "a,b", "nan,0", "200,0", "0,91"])
def test_light_from__mistakes_give_one_line(model, text: str) -> None:
    with pytest.raises(InputError, match=r"light_from: must be an azimuth in \[-180"):
        light_from(from_model(model), text)


def test_turntable_azimuths__start_at_the_front_and_close() -> None:
    azimuths = turntable_azimuths()
    steps = np.diff(np.append(azimuths, azimuths[0]))
    assert azimuths[0] == 0
    assert np.abs(steps).max() < 15  # degrees from frame to frame


def test_write_webp__keeps_the_frames(tmp_path: Path) -> None:
    frames = [np.full((8, 6, 3), level, np.uint8) for level in (20, 120, 220)]
    write_webp(tmp_path / "a.webp", frames)
    with PIL.Image.open(tmp_path / "a.webp") as animation:
        assert (animation.n_frames, animation.size) == (3, (6, 8))
        for i, frame in enumerate(frames):
            animation.seek(i)
            # lossy
            assert np.abs(np.asarray(animation.convert("RGB")) - 1.0 * frame).max() < 4


def test_render_picture__alpha_is_the_coverage(model, tmp_path: Path) -> None:
    options = {"view": "front", "light_from": "0,0", "size": 24, "samples": 8}
    render_picture(model, tmp_path / "a.png", **options, alpha=True)
    render_picture(model, tmp_path / "b.png", **options)
    clear, black = read_png(tmp_path / "a.png"), read_png(tmp_path / "b.png")
    assert clear.shape == (30, 24, 4)
    assert black.shape == (30, 24, 3)
    assert set(np.unique(clear[..., 3])) > {0, 255}
    inside = clear[..., 3] == 255
    np.testing.assert_array_equal(clear[inside, :3], black[inside])
    assert black[clear[..., 3] == 0].max() == 0
    # an edge is not darker because a part of it shows the background
    edge = (clear[..., 3] > 60) & ~inside
    assert (clear[edge, :3] >= black[edge]).all()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"view": "left", "camera": "c0"}, "camera and view: only one"),
        ({"lights": ("l0",), "light_from": "0,0"}, "light and light_from: only one"),
        ({"view": "front", "size": 8192}, "size: a picture must have"),
        ({"view": "above"}, "view: must be one of dome, front"),
    ],
)
def test_render_picture__mistakes_give_one_line(model, tmp_path, options, said) -> None:
    with pytest.raises(InputError, match=said):
        render_picture(model, tmp_path / "a.png", **options)
    assert not list(tmp_path.iterdir())
