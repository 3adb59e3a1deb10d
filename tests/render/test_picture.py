from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from skindb.errors import InputError
from skindb.optics.diffusion import dipole_s
from skindb.optics.fresnel import circular_reversal
from skindb.reflectance.tables import stored_brdf
from skindb.render import shading
from skindb.render.image import read_exr, write_exr
from skindb.render.photographs import compare_photographs
from skindb.render.rendering import (
    fixed_exposure,
    render,
    render_picture,
)
from skindb.render.scene import (
    Camera,
    Lighting,
    Lights,
    cameras_from_dome,
    from_model,
    lights_from_dome,
)
from skindb.schema import dataset
from tests.pictures import decode_srgb, read_png, render_view


@pytest.fixture
def model() -> xr.DataTree:
    """A square of 16 x 16 surfels under three lights of different colours, before one camera."""
    side = 16
    x, y = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(-20, 20, side)]))
    i = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([i, i + 1, i + side], 1),
            np.stack([i + 1, i + side + 1, i + side], 1),
        ]
    )
    rng = np.random.default_rng(0)
    colour = rng.uniform(0.2, 0.6, (x.size, 3))
    s, _ = dipole_s(colour, eta=1.3)
    values = {
        "surfel_position": np.stack([x, y, 0 * x], axis=1),
        "shading_normal": np.tile([0.0, 0, 1], (x.size, 1)),
        "diffuse_reflectance": colour,
        "dipole_s": s,
        "basis_weight": rng.uniform(0, 0.2, (x.size, 2)),
        "sigma_tr": np.tile([0.5, 0.8, 1.2], (x.size, 1)),
        "fit_status": np.zeros(x.size),
        "refractive_index": 1.3,
    }
    place = np.array([[0.0, 100, 300], [200, 0, 250], [-150, -80, 200]])
    dome = {
        "camera_matrix": np.array([[[200.0, 0, 16], [0, 200, 12], [0, 0, 1]]]),
        "camera_rotation": np.diag([1.0, -1, -1])[None],
        "camera_translation": np.array([[0.0, 0, 250]]),
        "camera_distortion": np.zeros((1, 5)),
        "camera_size": np.array([[32, 24]]),
        "camera_position": np.array([[0.0, 0, 250]]),
        "light_position": place,
        "light_intensity": rng.uniform(1e4, 3e4, (3, 3)),
        "light_disc_radius": np.full(3, 5.0),
        "light_axis": -place / np.linalg.norm(place, axis=1, keepdims=True),
        "light_falloff": np.array([0.0, 1, 2]),
    }
    groups = {
        "/fitted": dataset(values),
        "/mesh": dataset({"triangle": faces}),
        "/basis": dataset(
            {
                "basis_brdf": stored_brdf(rng.uniform(0, 1, (6, 5, 4, 2))),
                "disc_angular_radius": 0.0,
            }
        ),
        "/dome": dataset(dome, coords={"light": ["l0", "l1", "l2"], "camera": ["c0"]}),
    }
    return xr.DataTree.from_dict(groups)


def test_render_picture__subsurface_names_the_channel_without_sigma_tr(
    model: xr.DataTree, tmp_path: Path
) -> None:
    model["fitted/sigma_tr"][:, 2] = np.nan
    message = (
        r"must have sigma_tr in R, G and B for subsurface transport; found no probe "
        r"site with a valid fit in B"
    )
    with pytest.raises(InputError, match=message):
        render_picture(model, tmp_path / "a.exr", subsurface=True)
    photographs = {
        "photograph_radiance": np.ones((1, 24, 32, 3)),
        "photograph_light": [0],
        "photograph_camera": [0],
    }
    capture = xr.DataTree.from_dict(
        {"photographs": dataset(photographs), "dome": model["dome"].to_dataset()}
    )
    with pytest.raises(InputError, match=message):
        compare_photographs(model, capture, subsurface=True)
    model["fitted"] = model["fitted"].to_dataset().drop_vars("sigma_tr")
    with pytest.raises(
        InputError,
        match=r"found no probe site with a valid fit in R, G, B; omit --subsurface",
    ):
        render_picture(model, tmp_path / "a.exr", subsurface=True)
    render_picture(model, tmp_path / "a.exr")


@pytest.mark.parametrize("subsurface", [False, True])
def test_render_picture__plan_leaves_the_picture_the_same(
    model: xr.DataTree, tmp_path: Path, subsurface: bool
) -> None:
    surface = from_model(model)
    camera = cameras_from_dome(model["dome"].to_dataset())[0]
    visible = shading.trace_view(surface, camera).shown(256)
    seen = int(visible.sum())
    assert 50 < seen < 200  # of 256: the square is larger than the picture
    told = render_picture(
        model, tmp_path / "a.exr", samples=8, subsurface=subsurface, explain=True
    )
    assert not list(tmp_path.iterdir())
    said = (
        r"vertices that receive subsurface light: (\d+) of (\d+) are skipped "
        r"\(they are not visible\); results stay the same"
    )
    found = [re.fullmatch(said, line) for line in told["skipped"][:1]]
    # of the refined mesh, in which each triangle of the picture was divided
    assert [int(of[2]) - int(of[1]) > seen for of in found if of] == [True] * subsurface
    assert [line.partition(":")[0] for line in told["skipped"][1:]] == (
        ["levels of the octree"] if subsurface else []
    )
    assert told.pop("kept")
    assert (
        render_picture(
            model, tmp_path / "a.exr", samples=8, subsurface=subsurface
        ).items()
        >= told.items()
    )
    assert (tmp_path / "a.exr").is_file()


def test_compare_photographs__reads_the_half_floats_of_older_stores(
    model: xr.DataTree,
) -> None:
    radiance = (
        np.random.default_rng(4).uniform(0.1, 1, (1, 24, 32, 3)).astype(np.float16)
    )
    kept = dataset(
        {
            "photograph_radiance": radiance,
            "photograph_light": [0],
            "photograph_camera": [0],
        }
    )
    found = []
    for dtype in (np.float32, np.float16):
        old = kept.assign(photograph_radiance=kept["photograph_radiance"].astype(dtype))
        capture = xr.DataTree.from_dict(
            {"photographs": old, "dome": model["dome"].to_dataset()}
        )
        (one,) = compare_photographs(model, capture)
        assert one.photographed.dtype == np.float32
        np.testing.assert_array_equal(one.photographed, radiance[0])
        found.append(one.error)
    assert found[0] == found[1]


def test_compare_photographs__contain_the_gains_of_the_model(
    model: xr.DataTree,
) -> None:
    kept = dataset(
        {
            "photograph_radiance": np.ones((1, 24, 32, 3)),
            "photograph_light": [1],
            "photograph_camera": [0],
        }
    )
    dome = model["dome"].to_dataset()
    capture = xr.DataTree.from_dict({"photographs": kept, "dome": dome})
    (plain,) = compare_photographs(model, capture)
    gain = np.ones((dome.sizes["light"], 1))
    gain[1] = 1.5
    model["dome"] = dome.assign(light_intensity=dome["light_intensity"] * gain)
    (brighter,) = compare_photographs(model, capture)
    assert plain.rendered.max() > 0
    # float32
    np.testing.assert_allclose(brighter.rendered, 1.5 * plain.rendered, rtol=1e-5)


def test_compare_photographs__polarisers_scale_the_surface_alone(
    model: xr.DataTree,
) -> None:
    kept = dataset(
        {
            "photograph_radiance": np.ones((1, 24, 32, 3)),
            "photograph_light": [0],
            "photograph_camera": [0],
        }
    )
    dome = model["dome"].to_dataset()
    found = []
    for hand in (0.0, 0.9, -0.9):
        lights = np.full(dome.sizes["light"], -1.0)
        polarisers = {"light_polarisation": lights, "camera_polarisation": [hand]}
        groups = {"photographs": kept, "dome": dome.merge(dataset(polarisers))}
        (one,) = compare_photographs(model, xr.DataTree.from_dict(groups))
        found.append(one)
    plain, parallel, crossed = (one.rendered - one.diffuse for one in found)
    inside = found[0].mask & (plain.min(axis=-1) > 0)
    assert inside.sum() > 20
    for one in found[1:]:
        np.testing.assert_array_equal(one.diffuse, found[0].diffuse)
    middle = model["fitted"]["surfel_position"].values.mean(axis=0)
    light, camera = (
        dome[f"{device}_position"].values[0] - middle for device in ("light", "camera")
    )
    cosine = light @ camera / np.linalg.norm(light) / np.linalg.norm(camera)
    reversal = circular_reversal(np.sqrt((1 + cosine) / 2), 1.3)
    ratio = crossed[inside] / plain[inside]
    np.testing.assert_allclose(ratio, 1 - 0.9 * reversal, atol=0.1)
    np.testing.assert_allclose(
        (crossed + parallel)[inside], 2 * plain[inside], rtol=1e-3
    )


@pytest.mark.slow
def test_render__is_a_labelled_picture(model: xr.DataTree) -> None:
    seen = render(model, lights=["l0", "l2"], samples=256, scale=2.0)
    dome = model["dome"].to_dataset()
    lamps = lights_from_dome(dome).select([0, 2])
    view = cameras_from_dome(dome)[0].scaled(2.0)
    expected = render_view(from_model(model), view, lamps, samples=4).sum(axis=0)
    assert seen["radiance"].dims == ("image_row", "image_col", "channel")
    assert seen.attrs["lights"] == ["l0", "l2"]
    # discs of 5 mm 300 mm away: hardly any noise is left in the mean of the picture
    assert float(seen["radiance"].mean()) == pytest.approx(expected.mean(), rel=1e-3)
    assert seen.attrs["relative_error"] < 0.01
    assert seen.attrs["samples"] == 256


def test_render__what_is_skipped_does_not_change_the_picture(
    model: xr.DataTree,
) -> None:
    fitted = model["fitted"].to_dataset()
    fitted["basis_weight"][:, 1] = 0.0
    model["fitted"] = fitted
    dome = model["dome"].to_dataset()
    dome["light_position"][1] = [0.0, 50.0, -300.0]
    model["dome"] = dome
    seen = render(model, samples=64)
    assert [str(one).split(" are skipped")[0] for one in seen.attrs["skipped"]] == [
        "basis BRDFs: 1 of 2",
        "lights: 1 of 3",
    ]
    expected = render_view(
        from_model(model), cameras_from_dome(dome)[0], lights_from_dome(dome), samples=4
    ).sum(axis=0)
    np.testing.assert_allclose(seen["radiance"].mean(), expected.mean(), rtol=2e-3)


def test_render_picture__exposure_is_that_of_a_white_surface(
    model: xr.DataTree, tmp_path: Path
) -> None:
    """A darker face stays darker with the fixed exposure, and not with the automatic one."""
    model["fitted"] = (
        model["fitted"]
        .to_dataset()
        .assign(basis_weight=lambda ds: ds["basis_weight"] * 0.1)
    )
    dark = model.copy()
    fitted = dark["fitted"].to_dataset().copy(deep=True)
    fitted["diffuse_reflectance"] *= 0.5
    fitted["basis_weight"] *= 0.5
    dark["fitted"] = fitted
    level = {}
    for exposure in ("fixed", "auto"):
        for name, one in (("plain", model), ("dark", dark)):
            path = tmp_path / f"{exposure}_{name}.png"
            told = render_picture(one, path, exposure=exposure, lights=["l0"])
            level[exposure, name] = (
                decode_srgb(read_png(path) / 255).mean(),
                told["exposure"],
            )
    assert level["fixed", "plain"][1] == level["fixed", "dark"][1]
    # eight bits
    assert level["fixed", "dark"][0] == pytest.approx(
        level["fixed", "plain"][0] / 2, rel=0.02
    )
    assert level["auto", "dark"][0] == pytest.approx(
        level["auto", "plain"][0], rel=0.05
    )
    place = np.array([0.0, 100, 300])
    power = model["dome/light_intensity"].values[0].mean()
    expected = np.pi * np.linalg.norm(place) ** 3 / (place[2] * power)
    assert level["fixed", "plain"][1] == pytest.approx(expected, rel=1e-6)


def test_render_picture__reports_passes_and_rays(
    model: xr.DataTree, tmp_path: Path
) -> None:
    calls = list[tuple[str, int, int]]()
    render_picture(
        model,
        tmp_path / "a.png",
        samples=8,
        subsurface=True,
        error=None,
        progress=lambda *call: calls.append(call),
    )
    light = [("light under the skin", i + 1, 8) for i in range(8)]
    assert calls == [*light, ("render", 4, 8), ("render", 8, 8)]


def test_render_picture__exposure_counts_lights_that_are_skipped(
    model: xr.DataTree, tmp_path: Path
) -> None:
    """It depends on camera and lights only, so that pictures of several faces are comparable."""
    dome = model["dome"].to_dataset()
    # one light from the side, and two from behind, which surfaces that face them receive
    place = np.array([[300.0, 0.0, 20.0], [0.0, 50.0, -300.0], [40.0, 0.0, -300.0]])
    dome["light_position"][:], dome["light_axis"][:] = (
        place,
        -place / np.linalg.norm(place, axis=1, keepdims=True),
    )
    model["dome"] = dome
    told = render_picture(model, tmp_path / "a.png", samples=8)
    assert any(line.startswith("lights: 2 of 3") for line in told["skipped"])
    lighting = Lighting(lights_from_dome(dome))
    assert told["exposure"] == fixed_exposure(lighting, cameras_from_dome(dome)[0])
    assert told["exposure"] != fixed_exposure(
        Lighting(lighting.lights.select([0])), cameras_from_dome(dome)[0]
    )


@pytest.mark.parametrize("azimuth", [100, 180])
def test_fixed_exposure__light_from_the_side_does_not_blow_out(azimuth: int) -> None:
    """The surface that faces the light has at most twice the radiance of display white."""
    turn = np.radians(azimuth)
    towards = np.array([[np.sin(turn), 0.0, np.cos(turn)]])
    lights = Lights(
        1000 * towards, np.full((1, 3), 4e6), np.zeros(1), -towards, np.zeros(1)
    )
    turned = np.diag([1.0, -1, -1])
    front = Camera(np.eye(3), turned, np.array([0.0, 0, 1000]), np.zeros(5), 8, 8)
    gain = fixed_exposure(Lighting(lights), front)
    # an irradiance of 4 is a radiance of 4 / pi; 12 % as surfaces are compared 45 degrees apart
    assert 2 <= gain * 4 / np.pi <= 2 / 0.88


def test_render_picture__an_exr_says_what_it_holds(
    model: xr.DataTree, tmp_path: Path
) -> None:
    sky = tmp_path / "sky.exr"
    write_exr(sky, np.ones((4, 8, 3), np.float32))
    told = render_picture(model, tmp_path / "a.exr", environment=sky, samples=32)
    assert told["lights"] == []
    pixels, names = read_exr(tmp_path / "a.exr")
    assert names == ("R", "G", "B", "A", "variance.B", "variance.G", "variance.R")
    assert (pixels[..., 3] == 1).any()
    assert (pixels[pixels[..., 3] == 1][:, 4:] > 0).all()
    with pytest.raises(InputError, match="the file must exist"):
        render_picture(model, tmp_path / "a.exr", environment=tmp_path / "none.exr")
