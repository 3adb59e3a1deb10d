"""Distributions of albedo at every scale: planted pigments and beards, and edits that move them."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import gaussian_filter
from sklearn.decomposition import PCA

from skindb.analysis.regions import common_landmarks
from skindb.analysis.texture import (
    at_surfels,
    edit_texture,
    texel_regions,
    texture_statistics,
)
from skindb.errors import InputError
from skindb.numerics.texture import (
    image_parts,
    level_fractions,
    members,
    quantile_function,
)
from skindb.schema import dataset

SIZE = 128
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
PIGMENT = np.array([0.3, 0.6, 0.8])  # decrease of log R_d by one step of melanin
POINTS = {name: np.array(at) for name, at in LANDMARKS.items()}
BEARD = texel_regions(POINTS, SIZE)["beard"]


def stubble(seed, density=1.0):
    """Fine dark strands where a beard grows, as the fraction of light that they absorb."""
    strands = gaussian_filter(
        np.random.default_rng([seed, 9]).standard_normal((SIZE, SIZE)), 0.7
    )
    return density * BEARD * np.clip(0.4 + 0.6 * strands, 0.0, 0.8)


def face(seed, melanin=0.0, beard=0.0):
    """Albedo (v, u, 3) of one person."""
    rng = np.random.default_rng(seed)
    patches = sum(
        gaussian_filter(rng.standard_normal((SIZE, SIZE)), w, mode="wrap") * w * 0.1
        for w in (2, 8)
    )
    log = np.log([0.5, 0.35, 0.28]) - np.outer(
        melanin + 0.02 * rng.standard_normal() + patches, PIGMENT
    ).reshape(SIZE, SIZE, 3)
    return np.exp(log) * (1 - stubble(seed, beard))[..., None]


def maps_of(faces, coverage=None):
    albedo = np.stack(list(faces.values())).astype(np.float32)
    covered = np.ones(albedo.shape[:3], np.float32) if coverage is None else coverage
    dims = ("take", "v", "u")
    return xr.Dataset(
        {
            "texel_diffuse_reflectance": ((*dims, "channel"), albedo),
            "texel_coverage": (dims, covered),
        },
        coords={"take": list(faces)},
    )


def population(n=8):
    """Women without and men with a beard, half of both darker."""
    return {
        f"{'M' if i % 2 else 'F'}{i}": face(
            i, melanin=0.5 * (i // 2 % 2), beard=0.7 * (i % 2)
        )
        for i in range(n)
    }


@pytest.fixture(scope="module")
def studied():
    maps = maps_of(population())
    return maps, texture_statistics(maps, landmarks=POINTS)


def shift_of(texture, with_trait, without):
    q = texture["texture_quantile"].values
    takes = texture["take"].values.tolist()
    both = [[takes.index(take) for take in side] for side in (with_trait, without)]
    return q[both[0]].mean(axis=0) - q[both[1]].mean(axis=0)


def test_texture_statistics__counts_and_sums(studied):
    _, texture = studied
    assert (
        texture.sizes["part"] * texture.sizes["level"] * texture.sizes["axis"] == 23_808
    )
    assert (np.diff(texture["texture_quantile"].values, axis=-1) >= 0).all()
    np.testing.assert_allclose(texture["texture_coverage"], 1.0)


def test_texture_statistics__first_axis_is_the_pigment(studied):
    _, texture = studied
    values, vectors = np.linalg.eigh(
        np.cov(np.log(np.stack(list(population().values()))).reshape(-1, 3).T)
    )
    axis = texture["texture_colour_axis"].values[0]
    np.testing.assert_allclose(
        abs(axis @ vectors[:, -1]) * np.sqrt(values[-1]), 1.0, rtol=0.01
    )


def test_texture_statistics__the_image_part_is_that_of_the_region(studied):
    maps, texture = studied
    log = np.log(maps["texel_diffuse_reflectance"].values[3][BEARD].astype(np.float64))
    want = (log - texture["texture_colour_mean"].values) @ texture[
        "texture_colour_axis"
    ].values.T
    found = (
        texture["texture_quantile"]
        .sel(region="beard", part="image")
        .isel(take=3)
        .values
    )
    # single precision
    np.testing.assert_allclose(found[0], quantile_function(want[:, 0]), atol=1e-4)


def test_texture_statistics__quantiles_of_every_part(studied):
    """As in double precision."""
    maps, texture = studied
    log = np.log(maps["texel_diffuse_reflectance"].values[3].astype(np.float64))
    images = (log - texture["texture_colour_mean"].values) @ texture[
        "texture_colour_axis"
    ].values.T
    stored = texture["texture_quantile"].sel(region="beard").isel(take=3).values
    for a in range(2):  # the third axis is only rounding
        parts = image_parts(images[..., a])
        fractions = level_fractions(BEARD, [part.shape for part in parts])
        for p, (part, fraction) in enumerate(zip(parts, fractions, strict=True)):
            inside = quantile_function(part[members(fraction)])
            # single precision
            np.testing.assert_allclose(stored[a, p], inside, atol=2e-4)


def test_texture_statistics__what_was_not_measured_does_not_count():
    """Values of unmeasured texels do not matter; a region that lacks half of its texels is NaN."""
    covered = np.ones((8, SIZE, SIZE), np.float32)
    covered[0, :, :4] = 0
    covered[1][BEARD] = 0
    one = texture_statistics(maps_of(population(), covered), landmarks=POINTS)
    wild = population()
    wild["F0"][:, :4] = 1e-6
    two = texture_statistics(maps_of(wild, covered), landmarks=POINTS)
    np.testing.assert_allclose(
        one["texture_quantile"], two["texture_quantile"], atol=1e-4
    )
    assert np.isnan(one["texture_quantile"].sel(region="beard").isel(take=1)).all()
    assert np.isfinite(one["texture_quantile"].sel(region="no_beard")).all()
    assert float(one["texture_coverage"].sel(region="beard").isel(take=1)) == 0


def test_texture_statistics__nothing_measured_is_refused():
    with pytest.raises(InputError, match="some texels must be measured"):
        texture_statistics(
            maps_of({"A": face(0)}, np.zeros((1, SIZE, SIZE), np.float32)),
            landmarks=POINTS,
        )


def test_texture_statistics__without_landmarks_the_face_is_one_region():
    texture = texture_statistics(maps_of({"A": face(0), "B": face(1)}), landmarks={})
    assert texture["region"].values.tolist() == ["face"]
    edit = edit_texture(
        maps_of({"A": face(0)}).isel(take=0),
        shift_of(texture, ["B"], ["A"]),
        texture,
        rng=np.random.default_rng(0),
    )
    assert np.isfinite(edit.change).all()
    assert edit.distance is None


def test_common_landmarks__mean_over_takes_that_have_them():
    at = np.array([[0.1, 0.2], [np.nan, np.nan]])
    one = dataset({"common_landmark": at}, coords={"landmark": ["chin", "nasion"]})
    other = dataset(
        {"common_landmark": at + 0.2}, coords={"landmark": ["chin", "nasion"]}
    )
    found = common_landmarks({"A": one, "B": other})
    assert set(found) == {"chin"}
    np.testing.assert_allclose(found["chin"], [0.2, 0.3])


def test_edit_texture__no_shift_returns_the_source(studied):
    maps, texture = studied
    edit = edit_texture(
        maps.sel(take="F0"),
        0 * shift_of(texture, ["M1"], ["F0"]),
        texture,
        rng=np.random.default_rng(0),
    )
    np.testing.assert_array_equal(edit.change, 0.0)
    assert edit.distance == pytest.approx(edit.distance_before)


def test_edit_texture__a_darker_skin_is_darker_by_the_planted_pigment(studied):
    """Half a step of melanin, everywhere, on a subject of another seed."""
    _, texture = studied
    shift = shift_of(texture, ["F2", "F6", "M3", "M7"], ["F0", "F4", "M1", "M5"])
    edit = edit_texture(
        maps_of({"X": face(50)}).isel(take=0),
        shift,
        texture,
        rng=np.random.default_rng(0),
    )
    # 0.02 of melanin differs between subjects: of 4 on each side 0.014 of the 0.5
    np.testing.assert_allclose(
        edit.change.mean(axis=(0, 1)), -0.5 * PIGMENT, atol=3 * 0.014 * PIGMENT.max()
    )


def test_edit_texture__a_beard_grows_where_it_can_and_with_its_strands(studied):
    _, texture = studied
    shift = shift_of(texture, ["M1", "M3", "M5", "M7"], ["F0", "F2", "F4", "F6"])
    source = face(50)
    edit = edit_texture(
        maps_of({"X": source}).isel(take=0),
        shift,
        texture,
        rng=np.random.default_rng(0),
    )
    want = np.log(1 - stubble(50, 0.7))
    inside = gaussian_filter(BEARD.astype(float), 4) > 0.98
    outside = gaussian_filter(BEARD.astype(float), 4) < 0.02
    assert edit.change[inside].mean() == pytest.approx(want[inside].mean(), rel=0.25)
    assert np.abs(edit.change[outside].mean()) < 0.1 * np.abs(want[inside].mean())
    # strands: texels differ from their neighbours as much as in a real beard, unlike in bare skin
    detail = np.std(np.diff(np.log(source) + edit.change, axis=1)[inside[:, 1:]])
    bearded = np.std(np.diff(np.log(face(50, beard=0.7)), axis=1)[inside[:, 1:]])
    shaven = np.std(np.diff(np.log(source), axis=1)[inside[:, 1:]])
    assert detail == pytest.approx(bearded, rel=0.25)
    assert detail > 1.5 * shaven


def test_edit_texture__ten_times_too_strong_converges_and_is_far(studied):
    _, texture = studied
    shift = shift_of(texture, ["M1", "M3"], ["F0", "F2"])
    maps = maps_of({"X": face(50)}).isel(take=0)
    mild, wild = (
        edit_texture(maps, by * shift, texture, rng=np.random.default_rng(0))
        for by in (1.0, 10.0)
    )
    assert np.isfinite(wild.change).all()
    assert wild.distance > 3 * mild.distance
    # the third axis is only rounding
    assert all(trace[-1] < 0.3 * trace[0] for trace in mild.trace[:2])


def test_edit_texture__distance_is_mahalanobis(studied):
    """The distance of a member is the root mean square of its standardised scores from
    scikit-learn.
    """
    maps, texture = studied
    names = texture["region"].values.tolist()
    at = [names.index("beard"), names.index("no_beard")]
    known = texture["texture_quantile"].values[:, at].reshape(8, -1).astype(np.float64)
    share = np.cumsum(PCA().fit(known).explained_variance_ratio_)
    count = int(np.searchsorted(share, 0.99)) + 1
    score = PCA(count, whiten=True).fit_transform(known)
    edit = edit_texture(
        maps.sel(take="M3"),
        0 * shift_of(texture, ["M1"], ["F0"]),
        texture,
        rng=np.random.default_rng(0),
    )
    assert edit.distance_before == pytest.approx(
        np.sqrt((score[3] ** 2).mean()), rel=1e-3
    )


def test_at_surfels__beyond_the_map_its_edge():
    change = np.arange(12.0).reshape(2, 2, 3)
    found = at_surfels(change, np.array([[0.25, 0.25], [-1.0, -1.0], [2.0, 0.75]]))
    np.testing.assert_allclose(found, [change[0, 0], change[0, 0], change[1, 1]])


def test_edit_texture__octaves_that_surfels_do_not_sample_stay(studied):
    """A quarter as many surfels as texels: pigment and contrast of level 2 change as in
    the whole map, and the highest frequencies stay.
    """
    _, texture = studied
    shift = shift_of(texture, ["F2", "F6", "M3", "M7"], ["F0", "F4", "M1", "M5"])
    shift[:, :, 6:10] += texture["texture_quantile"].values[:, :, :, 6:10].mean(axis=0)
    interpolated = gaussian_filter(face(50), (1, 1, 0), mode="wrap")
    maps = maps_of({"X": interpolated}).isel(take=0)
    whole, sampled = (
        edit_texture(
            maps, shift, texture, surfels=count, rng=np.random.default_rng(0)
        ).change
        for count in (None, SIZE**2 // 4)
    )
    spectrum = np.abs(np.fft.fft2(sampled, axes=(0, 1)))
    frequency = np.abs(np.fft.fftfreq(SIZE))
    is_fine = np.maximum.outer(frequency, frequency) > 0.25
    assert spectrum[is_fine].max() < 1e-6 * spectrum.max()
    # another seed of the noise changes it by 0.052; the parts of another level by 0.073
    error = np.sqrt(((sampled - whole) ** 2).mean() / (whole**2).mean())
    assert error < 0.06
