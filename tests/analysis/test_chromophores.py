"""Melanin and haemoglobin from maps with planted pigments, and populations where they
cannot be separated.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import gaussian_filter

from skindb.analysis import (
    chromophore_axes,
    chromophore_maps,
    chromophore_statistics,
    chromophore_table,
    describe_chromophores,
    plot_chromophores,
)
from skindb.analysis.chromophores import INDEPENDENT, TABLE_AXES
from skindb.analysis.regions import map_regions
from skindb.errors import InputError
from skindb.virtual.skin import skin_tables

mpl.use("Agg")
SIZE = 128
PLANTED = np.stack([skin_tables().melanin, skin_tables().haemoglobin])
BASE = -np.log([0.45, 0.27, 0.2])
TABLES = Path(__file__).resolve().parents[3] / "shared/data/optics"
# of a plain face in the common (u, v)
LANDMARKS = {
    "forehead_centre": (0.5, 0.25),
    "nasion": (0.5, 0.35),
    "nose_tip": (0.5, 0.5),
    "subnasale": (0.5, 0.55),
    "lip_upper": (0.5, 0.58),
    "chin": (0.5, 0.75),
    "forehead_right": (0.38, 0.25),
    "forehead_left": (0.62, 0.25),
    "brow_right": (0.4, 0.32),
    "brow_left": (0.6, 0.32),
    "ala_right": (0.46, 0.53),
    "ala_left": (0.54, 0.53),
    "eye_outer_right": (0.36, 0.37),
    "eye_outer_left": (0.64, 0.37),
    "eye_inner_right": (0.45, 0.37),
    "eye_inner_left": (0.55, 0.37),
    "mouth_corner_right": (0.43, 0.62),
    "mouth_corner_left": (0.57, 0.62),
    "jaw_right": (0.34, 0.66),
    "jaw_left": (0.66, 0.66),
}
POINTS = {name: np.array(at) for name, at in LANDMARKS.items()}


def freckles(rng):
    """Melanin (v, u): small dark spots on mottled skin."""
    spots = gaussian_filter((rng.random((SIZE, SIZE)) < 0.004).astype(float), 1.5)
    return (
        4.0 * spots + 0.03 * gaussian_filter(rng.standard_normal((SIZE, SIZE)), 4) * 8
    )


def flush(rng):
    """Haemoglobin (v, u): patches with soft edges."""
    field = gaussian_filter(rng.standard_normal((SIZE, SIZE)), 5)
    return 0.25 / (1 + np.exp(-4 * field / field.std()))


def pigments(n=6, *, melanin=freckles, blood=flush):
    """Amounts (take, v, u, 2): persons have different mean levels, in which both
    pigments are correlated.
    """
    rng = np.random.default_rng(5)
    people = [
        np.stack([melanin(rng) + 0.3 * i, blood(rng) + 0.05 * i], axis=-1)
        for i in range(n)
    ]
    return np.stack(people)


def maps_of(amounts, axes=PLANTED, noise=0.004, coverage=None):
    density = BASE + amounts @ axes
    density = density + noise * np.random.default_rng(1).standard_normal(density.shape)
    covered = np.ones(density.shape[:3], np.float32) if coverage is None else coverage
    dims = ("take", "v", "u")
    n = len(amounts)
    return xr.Dataset(
        {
            "texel_diffuse_reflectance": (
                (*dims, "channel"),
                np.exp(-density).astype(np.float32),
            ),
            "texel_coverage": (dims, covered),
        },
        coords={
            "take": [f"T{i}" for i in range(n)],
            "subject": ("take", np.array([f"S{i // 2}" for i in range(n)], object)),
            "condition": ("take", np.array(["normal"] * n, object)),
            "gender": (
                "take",
                np.array(
                    ["female" if i < n // 2 else "male" for i in range(n)], object
                ),
            ),
        },
    )


def found_axes(maps, **options):
    return chromophore_axes(maps, rng=np.random.default_rng(0), **options)


def degrees(a, b):
    cosine = (a * b).sum(-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)
    return np.degrees(np.arccos(cosine))


@pytest.fixture(scope="module")
def planted():
    amounts = pigments()
    maps = maps_of(amounts)
    return amounts, maps, found_axes(maps)


def test_chromophore_axes__planted_pigments(planted):
    """Within four degrees, although people differ along a mixture of both."""
    _, _, axes = planted
    assert axes.attrs["axes_origin"] == INDEPENDENT
    assert axes.attrs["flags"] == [
        "no landmarks: beards, brows and lips are used as skin and may rotate the axes"
    ]
    assert degrees(axes["chromophore_axis"].values, PLANTED).max() < 4
    assert (axes["chromophore_axis"].sel(channel="G") == 1).all()
    np.testing.assert_allclose(
        axes["chromophore_table_angle"],
        degrees(axes["chromophore_axis"].values, TABLE_AXES),
        atol=1e-6,
    )
    assert "haemoglobin: absorbs R, G, B as" in "\n".join(describe_chromophores(axes))


def test_chromophore_axes__do_not_depend_on_seed_or_chunks(planted):
    _, maps, axes = planted
    other = chromophore_axes(maps.chunk(take=1, v=50), rng=np.random.default_rng(77))
    assert (
        degrees(other["chromophore_axis"].values, axes["chromophore_axis"].values).max()
        < 0.1
    )
    same = found_axes(maps.chunk(take=2))
    np.testing.assert_array_equal(same["chromophore_axis"], axes["chromophore_axis"])


def test_chromophore_maps__amounts_are_the_planted_ones(planted):
    amounts, maps, axes = planted
    for i in range(len(amounts)):
        found = chromophore_maps(maps.isel(take=i), axes)["texel_chromophore"].values
        for c in range(2):
            assert (
                np.corrcoef(found[..., c].ravel(), amounts[i, ..., c].ravel())[0, 1]
                > 0.95
            )
    # mean levels of persons too
    each = [chromophore_maps(maps.isel(take=i), axes) for i in range(len(amounts))]
    means = np.stack([one["texel_chromophore"].mean(("v", "u")) for one in each])
    np.testing.assert_allclose(np.ptp(means[:, 0]), 1.5, rtol=0.1)


def test_chromophore_maps__exact_with_known_axes(planted):
    _, _, axes = planted
    known = axes.assign(
        chromophore_axis=(("chromophore", "channel"), PLANTED),
        chromophore_offset=("channel", BASE),
    )
    normal = np.cross(*PLANTED) / np.linalg.norm(np.cross(*PLANTED))
    density = BASE + np.array([0.3, -0.1]) @ PLANTED + 0.02 * normal
    one = xr.Dataset(
        {
            "texel_diffuse_reflectance": (
                ("v", "u", "channel"),
                np.exp(-np.tile(density, (2, 2, 1))),
            ),
            "texel_coverage": (("v", "u"), np.array([[1.0, 1.0], [1.0, 0.2]])),
        }
    )
    found = chromophore_maps(one, known)
    np.testing.assert_allclose(
        found["texel_chromophore"].values[0, 0], [0.3, -0.1], atol=1e-6
    )
    assert np.isnan(found["texel_chromophore"].values[1, 1]).all()


def normally(scale):
    return lambda rng: scale * rng.standard_normal((SIZE, SIZE))


@pytest.mark.parametrize(
    ("melanin", "blood", "noise", "why"),
    [
        (
            normally(0.2),
            normally(0.1),
            0.002,
            "between samples, as with normally distributed",
        ),
        (freckles, normally(0.0), 0.01, "as with one pigment and noise"),
        (freckles, normally(0.0), 0.0, "as with one pigment"),
    ],
)
def test_chromophore_axes__falls_back_where_pigments_cannot_be_separated(
    melanin, blood, noise, why
):
    amounts = pigments(melanin=melanin, blood=blood)
    axes = found_axes(maps_of(amounts, noise=noise))
    assert axes.attrs["axes_origin"].startswith("published absorption")
    assert why in axes.attrs["flags"][-1]
    assert (axes["chromophore_axis"] >= 0).all()
    assert (axes["chromophore_axis"].sel(channel="G") == 1).all()


def test_chromophore_axes__projected_fallback_lies_in_the_plane():
    axes = found_axes(
        maps_of(pigments(melanin=normally(0.2), blood=normally(0.1)), noise=0.002)
    )
    assert axes.attrs["axes_origin"].endswith(
        "in the plane of the two largest principal components"
    )
    normal = np.cross(*PLANTED)
    found = axes["chromophore_axis"].values
    assert np.abs(found @ normal).max() < 0.02 * np.linalg.norm(normal)
    np.testing.assert_allclose(found[:, :2], TABLE_AXES[:, :2])
    own = degrees(found, PLANTED)
    other = degrees(found, PLANTED[::-1])
    assert own.sum() < other.sum()  # the pigments are not exchanged


def test_chromophore_axes__refuses_components_that_brighten_skin():
    """For example, a change of exposure or of a filter is not a pigment."""
    axes = found_axes(
        maps_of(pigments(), axes=np.array([skin_tables().melanin, [-0.8, 1.0, 0.6]]))
    )
    assert "would brighten R, which no pigment does" in axes.attrs["flags"][-1]


@pytest.mark.parametrize("case", ["constant", "nothing"])
def test_chromophore_axes__refuses_what_does_not_vary(case):
    flat = np.zeros((2, 32, 32, 2))
    covered = None if case == "constant" else np.zeros((2, 32, 32), np.float32)
    with pytest.raises(
        InputError,
        match={"constant": "found constant maps", "nothing": "must be measured"}[case],
    ):
        found_axes(maps_of(flat, noise=0.0, coverage=covered))


def test_chromophore_axes__one_take_is_enough():
    axes = found_axes(maps_of(pigments(1)))
    assert degrees(axes["chromophore_axis"].values, PLANTED).max() < 6


def test_chromophore_axes__beards_do_not_turn_them():
    """A grey beard is not a pigment; if there are landmarks, it is excluded."""
    amounts = pigments()
    maps = maps_of(amounts)
    beard = map_regions(POINTS, SIZE)["beard"]
    strands = np.random.default_rng(3).random((SIZE, SIZE)) * beard
    maps["texel_diffuse_reflectance"] = maps["texel_diffuse_reflectance"] * (
        1 - 0.7 * strands[None, ..., None]
    )
    axes = found_axes(maps.astype(np.float32), landmarks=POINTS)
    assert axes.attrs["axes_origin"] == INDEPENDENT
    assert not axes.attrs["flags"]
    assert degrees(axes["chromophore_axis"].values, PLANTED).max() < 6


def test_chromophore_statistics__as_numpy(planted):
    _, maps, axes = planted
    covered = np.ones((6, SIZE, SIZE), np.float32)
    covered[1, : SIZE // 2] = 0.0  # the forehead is not measured
    maps = maps.assign(texel_coverage=(("take", "v", "u"), covered))
    found = chromophore_statistics(maps, axes=axes, landmarks=POINTS)
    masks = map_regions(POINTS, SIZE)
    one = chromophore_maps(maps.isel(take=2), axes)
    inside = one["texel_chromophore"].values[masks["cheek"]].astype(np.float64)
    cheek = found.sel(take="T2", region="cheek")
    np.testing.assert_allclose(
        cheek["take_chromophore"], inside.mean(axis=0), atol=1e-5
    )
    np.testing.assert_allclose(
        cheek["take_chromophore_deviation"], inside.std(axis=0), atol=1e-5
    )
    assert found["take_chromophore"].sel(take="T1", region="forehead").isnull().all()
    assert found["take_chromophore"].sel(take="T1", region="face").notnull().all()


def test_chromophore_table__the_unit_is_the_subject(planted):
    _, maps, axes = planted
    statistics = chromophore_statistics(maps, axes=axes)
    table = chromophore_table(maps, statistics=statistics)
    assert (table["group_chromophore_count"] == 3).all()  # of six takes
    takes = statistics["take_chromophore"].sel(region="face").values
    subjects = takes.reshape(3, 2, 2).mean(axis=1)
    own = table.sel(group="all", region="face")
    np.testing.assert_allclose(own["group_chromophore_mean"], subjects.mean(axis=0))
    np.testing.assert_allclose(
        own["group_chromophore_standard_deviation"], subjects.std(axis=0, ddof=1)
    )
    alone = chromophore_table(
        maps.isel(take=[0, 1]), statistics=statistics, group_by="gender"
    )
    assert alone["group_chromophore_mean_low"].isnull().all()
    with pytest.raises(InputError, match="must be an attribute or a trait"):
        chromophore_table(maps, statistics=statistics, group_by="shoes")


def test_plot_chromophores__names_groups_and_counts(planted):
    _, maps, axes = planted
    statistics = chromophore_statistics(maps, axes=axes)
    table = chromophore_table(maps, statistics=statistics, group_by="gender")
    ax = plot_chromophores(table)
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels[0] == "melanin, female (n = 2)"
    assert "-ln R_d at green" in ax.get_xlabel()
    mpl.pyplot.close(ax.figure)


@pytest.mark.skipif(not TABLES.is_dir(), reason="the published tables are not here")
def test_table_axes__recomputed_from_the_published_tables():
    def read(name):
        return np.loadtxt(TABLES / name, delimiter=",", skiprows=1)

    blood = read("hemoglobin_prahl.csv")
    melanin = read("eumelanin_sarna.csv")
    grid = np.arange(400.0, 701.0)
    spectra = [
        np.interp(grid, melanin[:, 0], melanin[:, 1]),
        np.interp(grid, blood[:, 0], 0.75 * blood[:, 1] + 0.25 * blood[:, 2]),
    ]
    bands = np.exp(-0.5 * ((grid - np.array([[600.0], [540.0], [450.0]])) / 30.0) ** 2)
    found = np.array([bands @ one / bands.sum(axis=1) for one in spectra])
    np.testing.assert_allclose(TABLE_AXES, found / found[:, 1:2], atol=0.002)
