"""Variables as colours on the face, and grids of pictures with one exposure."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import xarray as xr

from skindb.errors import InputError
from skindb.render.figures import field_figure, trace_front, write_grid
from tests.pictures import read_png

SIDE = 9


@pytest.fixture
def plate():
    """A plate of 80 x 40 mm that faces the front: position, triangle."""
    x, y = np.meshgrid(np.linspace(-40, 40, SIDE), np.linspace(-20, 20, SIDE))
    position = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    i = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    a = i[:-1, :-1].ravel()
    b = i[:-1, 1:].ravel()
    c = i[1:, :-1].ravel()
    d = i[1:, 1:].ravel()
    return position, np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)])


@pytest.fixture
def take(plate):
    position, triangle = plate
    count = len(position)
    colour = np.stack([position[:, 0], position[:, 1], np.zeros(count)], axis=-1)
    status = xr.DataArray(
        (np.arange(count) % 2).astype(np.uint8),
        dims="surfel",
        attrs={"flag_values": [0, 1, 2], "flag_meanings": "fitted unseen never"},
    )
    fitted = xr.Dataset(
        {
            "surfel_position": (("surfel", "xyz"), position, {"units": "mm"}),
            "shading_normal": (
                ("surfel", "xyz"),
                np.tile([0.6, 0.0, 0.8], (count, 1)),
                {"units": "1"},
            ),
            "basis_weight": (("surfel", "component"), np.ones((count, 3))),
            "sigma_tr": (
                ("surfel", "channel"),
                np.tile([0.5, 1.0, 2.0], (count, 1)),
                {"units": "mm-1"},
            ),
            "sample": (
                ("surfel", "light", "channel"),
                np.ones((count, 2, 3)) * [[0.1], [0.4]],
                {"units": "sr-1"},
            ),
            "diffuse_reflectance": (("surfel", "channel"), colour, {"units": "1"}),
            "surfel_area": ("surfel", position[:, 1].copy(), {"units": "mm2"}),
            "fit_status": status,
        },
        coords={"channel": ["R", "G", "B"]},
    )
    return xr.DataTree.from_dict(
        {
            "fitted": fitted,
            "mesh": xr.Dataset({"triangle": (("face", "corner"), triangle)}),
        }
    )


@pytest.mark.parametrize("turn", [0.0, 60.0])
def test_trace_front__a_plate_in_parallel_rays(plate, turn):
    """Columns and rows are where the plate's points project to; it turns away by the cosine."""
    position, triangle = plate
    corner, weight, shade = trace_front(position, triangle, turn, size=200)
    hit = np.isfinite(shade)
    np.testing.assert_allclose(shade[hit], np.cos(np.radians(turn)), atol=1e-9)
    assert (corner[~hit] == -1).all()
    met = np.einsum("nk,nkc->nc", weight[hit], position[corner[hit]])
    rows, columns = np.nonzero(hit)
    across = met[:, 0] * np.cos(np.radians(turn))
    longer = max(40, 80 * np.cos(np.radians(turn)))
    pixel = longer * 1.06 / 200
    np.testing.assert_allclose(
        met[:, 1], 0.53 * longer - (rows + 0.5) * pixel, atol=1e-4
    )
    np.testing.assert_allclose(np.diff(across), np.diff(columns) * pixel, atol=1e-4)
    # the whole plate is in the picture, and nothing else
    assert hit.sum() == pytest.approx(
        80 * np.cos(np.radians(turn)) * 40 / pixel**2, rel=0.02
    )


def test_trace_front__a_plate_seen_edge_on_has_a_picture_all_the_same(plate):
    position, triangle = plate
    for turned in (position[:, [0, 2, 1]], position[:, [2, 1, 0]] * [1, 1e-3, 1]):
        _, _, shade = trace_front(turned, triangle, size=100)
        assert shade.shape == (100, 100)


def test_field_figure__colours_say_the_value_and_the_scale_its_unit(take):
    figure = field_figure(take, "surfel_area", turns=[0.0])
    image = figure.axes[0].images[0].get_array()
    bar = figure.axes[1]
    assert figure.get_suptitle() == "surfel_area [mm2]"
    assert bar.get_ylim() == pytest.approx(
        np.percentile(take["fitted/surfel_area"], (1, 99)), rel=0.05
    )
    bright = image[:, image.shape[1] // 2].sum(axis=-1)
    middle = bright[bright < 3][20:-20]  # without the white above and below
    # y falls from the top; viridis is darkest at the least
    assert middle[5] > middle[len(middle) // 2] > middle[-5]


def test_field_figure__what_is_unknown_is_grey_and_what_is_beside_the_face_white(take):
    take["fitted/surfel_area"].values[:] = np.where(
        take["fitted/surfel_position"].values[:, 0] > 1, np.nan, 3.0
    )
    image = field_figure(take, "surfel_area", turns=[0.0]).axes[0].images[0].get_array()
    middle = image[len(image) // 2]
    assert (image[0, 0] == 1).all()
    assert np.ptp(middle[-60]) == 0
    assert middle[-60, 0] == pytest.approx(0.72)
    assert np.ptp(middle[60]) > 0.1


def test_field_figure__a_status_has_the_names_that_occur(take):
    bar = field_figure(take, "fit_status").axes[-1]
    assert [label.get_text() for label in bar.get_yticklabels()] == ["fitted", "unseen"]


def test_field_figure__a_label_chooses_the_channel(take):
    low = [
        field_figure(take, "diffuse_reflectance", at={"channel": name}, turns=[0.0])
        .axes[1]
        .get_ylim()[0]
        for name in "RG"
    ]
    assert low == pytest.approx([-40, -20], rel=0.05)


def test_field_figure__a_colour_is_a_picture_whose_white_the_title_says(take):
    figure = field_figure(take, "sigma_tr")
    assert figure.get_suptitle() == "sigma_tr (sRGB, white is 2 mm-1)"
    assert len(figure.axes) == 2  # two views and no scale
    image = figure.axes[0].images[0].get_array()
    # the transfer function of sRGB at 0.25 and 0.5, by hand: 1.055 x^(1 / 2.4) - 0.055;
    # the tilt does not darken it
    for axis in figure.axes:
        image = axis.images[0].get_array()
        np.testing.assert_allclose(
            image[len(image) // 2, image.shape[1] // 2], [0.5371, 0.7354, 1], atol=1e-3
        )
        assert (image[0, 0] == 1).all()


def test_field_figure__unknown_colours_are_grey(take):
    take["fitted/sigma_tr"].values[
        take["fitted/surfel_position"].values[:, 0] > 1, 1
    ] = np.nan
    image = field_figure(take, "sigma_tr", turns=[0.0]).axes[0].images[0].get_array()
    middle = image[len(image) // 2]
    np.testing.assert_allclose(middle[-60], 0.72)
    assert middle[60, 2] == pytest.approx(1)


def test_field_figure__a_light_of_the_samples_is_a_picture(take):
    assert (
        field_figure(take, "sample", at={"light": "1"}).get_suptitle()
        == "sample, light 1 (sRGB, white is 0.4 sr-1)"
    )


def test_field_figure__unit_vectors_are_colours(take):
    figure = field_figure(take, "shading_normal", turns=[0.0])
    assert (
        figure.get_suptitle()
        == "shading_normal (red, green, blue = (x + 1, y + 1, z + 1) / 2)"
    )
    image = figure.axes[0].images[0].get_array()
    np.testing.assert_allclose(
        image[len(image) // 2, image.shape[1] // 2], [0.8, 0.5, 0.9], atol=1e-6
    )


def test_field_figure__colours_that_are_all_zero_are_black(take):
    take["fitted/sigma_tr"].values[:] = 0
    image = field_figure(take, "sigma_tr", turns=[0.0]).axes[0].images[0].get_array()
    assert (image[len(image) // 2, image.shape[1] // 2] == 0).all()


@pytest.mark.parametrize(
    ("variable", "at", "said"),
    [
        (
            "nose",
            {},
            (
                "variable: must be a variable of the surfels; found nose; choose "
                "basis_weight, diffuse_reflectance"
            ),
        ),
        (
            "surfel_position",
            {},
            "must select one xyz of surfel_position; found no xyz; choose xyz=0, 1, 2",
        ),
        (
            "basis_weight",
            {},
            (
                "must select one component of basis_weight; found no component; choose "
                "component=0, 1, 2"
            ),
        ),
        (
            "sample",
            {},
            "must select one light of sample; found no light; choose light=0, 1",
        ),
        ("sample", {"light": "7"}, "found light=7; choose light=0, 1"),
        (
            "diffuse_reflectance",
            {"channel": "X"},
            "found channel=X; choose channel=R, G, B",
        ),
        ("surfel_area", {"channel": "R"}, "found channel; remove the others"),
    ],
)
def test_field_figure__what_cannot_be_drawn_is_said(take, variable, at, said):
    with pytest.raises(InputError, match=said):
        field_figure(take, variable, at=at)


def radiance(level):
    """A lit square on black."""
    image = np.zeros((40, 30, 3), np.float32)
    image[10:30, 5:25] = level
    return image


def cells(picture, columns):
    """Brightest value of each column of pictures: labels are black on white, pictures
    are on black, and their margins of 4 pixels are all that is between
    their 20 lit ones.
    """
    lit = (picture[..., :3] < 250).any(axis=2) & (picture[..., :3] > 5).any(axis=2)
    found = np.flatnonzero(lit.sum(axis=0) > 50)  # labels are not that tall
    parts = np.split(found, np.flatnonzero(np.diff(found) > 1) + 1)
    assert len(parts) == columns
    gaps = [part[0] - before[-1] for before, part in itertools.pairwise(parts)]
    assert max(gaps) < 0.45 * len(parts[0])
    return [float(np.median(picture[:, part][lit[:, part]])) for part in parts]


def test_write_grid__one_exposure_for_all(tmp_path):
    path = tmp_path / "grid.png"
    write_grid(
        path,
        {row: [radiance(0.5), radiance(0.25), radiance(0.5)] for row in "abcde"},
        ["A", r"$\x$", "full"],
        exposure=1.5,
    )
    first, half, full = cells(read_png(path), 3)
    assert first == full
    assert first == pytest.approx(255 * (1.055 * 0.75 ** (1 / 2.4) - 0.055), abs=2)
    assert half == pytest.approx(255 * (1.055 * 0.375 ** (1 / 2.4) - 0.055), abs=2)


@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_write_grid__formats_and_dark_pictures(tmp_path, ending):
    path = tmp_path / f"grid.{ending}"
    write_grid(path, {"a": [radiance(0.0)], "b": [radiance(0.0)]}, ["X"])
    assert path.stat().st_size > 500
