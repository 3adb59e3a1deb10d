"""Vignette, dark frames, noise, colour matrix and blur recovered from simulated calibration frames."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from skindb.errors import InputError
from skindb.ingest.colour_chart import chart_reference, fit_colour_matrix
from skindb.ingest.dark_frames import average_dark
from skindb.ingest.lens import fit_edge, veiling_glare
from skindb.ingest.noise_model import fit_noise
from skindb.ingest.vignette import fit_vignette

TRUE_VIGNETTE = np.array([-0.21, -0.06, -0.03])
CENTRE = np.array([158.0, 124.0])


def flat_frame(rng, noise=0.005):
    row, column = np.mgrid[:240, :320] + 0.5
    r2 = ((column - CENTRE[0]) ** 2 + (row - CENTRE[1]) ** 2) / (200.0**2)
    gain = 1 + r2 * (TRUE_VIGNETTE[0] + r2 * (TRUE_VIGNETTE[1] + r2 * TRUE_VIGNETTE[2]))
    return 5 * gain * (1 + noise * rng.standard_normal(gain.shape)), gain


def test_fit_vignette__knows_its_error():
    z = []
    for seed in range(60):
        fit = fit_vignette(flat_frame(np.random.default_rng(seed))[0], CENTRE)
        off = fit.coefficients - TRUE_VIGNETTE
        z.append(off @ np.linalg.solve(fit.covariance, off) / 3)
    assert 0.6 < np.mean(z) < 1.4  # the mean of 60 chi squared of 3 degrees has a deviation of 0.105


def test_fit_vignette__withstands_dust_a_gradient_and_lost_pixels():
    frame, gain = flat_frame(np.random.default_rng(1))
    row, column = np.mgrid[:240, :320] + 0.5
    r2 = ((column - CENTRE[0]) ** 2 + (row - CENTRE[1]) ** 2) / (200.0**2)
    frame[50:70, 60:80] *= 0.8
    frame[:, 200:210] = np.nan
    frame += 5 * 0.05 * (column - CENTRE[0]) / 200
    a2, a4, a6 = fit_vignette(frame, CENTRE).coefficients
    np.testing.assert_allclose(1 + r2 * (a2 + r2 * (a4 + r2 * a6)), gain, atol=0.005)  # half a per cent of the light


@pytest.mark.parametrize(
    "frame", [np.zeros((50, 60)), np.full((50, 60), np.nan), np.ones((50, 60, 3)), np.pad(np.ones((9, 12)), 20)]
)
def test_fit_vignette__refuses_what_tells_nothing(frame):
    with pytest.raises(InputError, match="flat frame"):
        fit_vignette(frame, [30.0, 25.0])


def test_average_dark__marks_hot_stuck_and_noisy_pixels():
    rng = np.random.default_rng(2)
    frames = np.rint(1000 + 5 * rng.standard_normal((16, 100, 120, 3)))
    frames[:, 10, 20, 0] += 300  # hot
    frames[:, 30, 40, 1] = 1000  # stuck at an ordinary value
    frames[:, 50, 60, 2] += 100 * rng.standard_normal(16)  # noisy
    dark = average_dark(frames)
    assert {tuple(at) for at in np.argwhere(dark.defect)} >= {(10, 20, 0), (30, 40, 1), (50, 60, 2)}
    assert dark.defect.sum() <= 5  # of 36,000; the deviation of 16 values has a longer tail than a Gaussian
    z = (dark.mean[~dark.defect] - 1000) / dark.error[~dark.defect]
    assert abs(np.median(np.abs(z)) - 0.691) < 0.02  # Student's t of 15 degrees of freedom


def test_average_dark__of_even_frames_has_no_defect():
    dark = average_dark(np.full((4, 10, 10, 3), 7))
    assert not dark.defect.any()
    assert (dark.mean == 7).all()


@pytest.mark.parametrize("frames", [np.zeros((1, 9, 9, 3)), np.zeros((9, 9, 3)), np.full((2, 9, 9, 3), np.nan)])
def test_average_dark__refuses_what_tells_nothing(frames):
    with pytest.raises(InputError, match="at least two frames"):
        average_dark(frames)


def flat_pairs(rng, gain=0.31, read=6.0, levels=(0.0, 0.01, 0.05, 0.2, 0.5, 0.8), step=1.0):
    pattern = 1 + 0.02 * rng.standard_normal((100, 100))
    pairs = []
    for level in levels:
        electrons = rng.poisson(level * 20000 * pattern, (2, 100, 100)) + read * rng.standard_normal((2, 100, 100))
        pairs.append(np.clip(np.rint((1024 + electrons / gain) / step) * step, 0, 65520))
    return np.array(pairs)


def test_fit_noise__knows_gain_read_noise_and_their_errors():
    fits = [fit_noise(flat_pairs(np.random.default_rng(s)), black=1024, white=65520) for s in range(40)]
    gain = np.array([(f.electrons_per_dn - 0.31) / f.electrons_per_dn_error for f in fits])
    read = np.array([(f.read_noise - 6.0) / f.read_noise_error for f in fits])
    # 40 z-scores: their mean has a deviation of 0.16, their deviation one of 0.11
    assert abs(gain.mean()) < 0.6
    assert abs(read.mean()) < 0.6
    assert 0.65 < gain.std() < 1.35
    assert 0.65 < read.std() < 1.35
    assert 0.5 < np.mean([f.chi_square for f in fits]) < 1.5


def test_fit_noise__takes_quantisation_off_and_leaves_saturated_pairs_out():
    pairs = flat_pairs(np.random.default_rng(3), levels=(0.0, 0.02, 0.1, 0.4, 1.1), step=32.0)
    fit = fit_noise(pairs, black=1024, white=65520, step=32.0)
    assert abs(fit.read_noise - 6) < 4 * fit.read_noise_error
    assert np.isnan(fit.mean).tolist() == [False] * 4 + [True]


@pytest.mark.parametrize(
    "pairs",
    [
        np.full((5, 2, 20, 20), 65520.0),
        np.full((5, 2, 20, 20), 1024.0),
        np.full((5, 2, 20, 20), np.nan),
        np.zeros((2, 20, 20)),
        1024 + np.random.default_rng(1).normal(100, 1, (5, 2, 20, 20)),
    ],
)
def test_fit_noise__refuses_what_tells_nothing(pairs):
    with pytest.raises(InputError, match="pairs of flat frames"):
        fit_noise(pairs, black=1024, white=65520)


MIX = np.array([[0.7, 0.2, 0.1], [0.15, 0.75, 0.1], [0.05, 0.2, 0.75]])


def test_chart_reference__has_six_neutral_patches_and_published_colours():
    reference = chart_reference()
    neutral = reference[18:]
    np.testing.assert_allclose(neutral / neutral[:, 1:2], 1, atol=0.06)  # the chart's own greys are not quite neutral
    assert (np.diff(neutral[:, 1]) < 0).all()
    encoded = 255 * (1.055 * np.clip(reference[14], 0, 1) ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(encoded, [175, 54, 60], atol=6)  # "red" as published by its maker in sRGB


def test_fit_colour_matrix__inverts_a_camera():
    rng = np.random.default_rng(4)
    camera = chart_reference() @ MIX.T * 3.0
    fit = fit_colour_matrix(camera * (1 + 0.002 * rng.standard_normal(camera.shape)))
    expected = np.linalg.inv(MIX)
    expected = expected * (camera[18, 1] / (expected @ camera[18])[1])
    np.testing.assert_allclose(fit.matrix, expected, atol=0.03)  # noise of 0.2 % times the condition of the colours
    assert fit.delta_e_after.max() < 1.0
    assert np.median(fit.delta_e_before) > 5.0
    assert abs((fit.matrix @ camera[18])[1] / camera[18, 1] - 1) < 0.005


def test_fit_colour_matrix__leaves_out_saturated_patches():
    camera = chart_reference() @ MIX.T
    camera[[3, 7]] = np.nan
    fit = fit_colour_matrix(camera)
    assert np.isnan(fit.delta_e_after[[3, 7]]).all()
    assert np.nanmax(fit.delta_e_after) < 1e-4  # exact but for rounding of CIEDE2000


@pytest.mark.parametrize(
    ("patches", "match"),
    [
        (np.ones((24, 3)), "different colours"),
        (np.full((24, 3), np.nan), "0 usable"),
        (np.zeros((24, 3)), "different colours"),
        (np.ones((10, 3)), "the shape"),
    ],
)
def test_fit_colour_matrix__refuses_what_tells_nothing(patches, match):
    with pytest.raises(InputError, match=match):
        fit_colour_matrix(patches)


def edge_picture(blur, rng, *, shape=(80, 64), noise=0.002, slant=0.09):
    """An edge drawn at 8 times the resolution, blurred there, and averaged over the pixels."""
    fine = 8
    row, column = (np.mgrid[: shape[0] * fine, : shape[1] * fine] + 0.5) / fine
    sharp = np.where(column - shape[1] / 2 - slant * (row - shape[0] / 2) > 0, 1.0, 0.0)
    soft = ndimage.gaussian_filter(sharp, blur * fine, mode="nearest") if blur else sharp
    picture = soft.reshape(shape[0], fine, shape[1], fine).mean(axis=(1, 3))
    return picture + noise * rng.standard_normal(shape)


@pytest.mark.parametrize("blur", [0.6, 1.0, 2.0])
@pytest.mark.parametrize("side", [1, -1])
def test_fit_edge__finds_the_blur(blur, side):
    fit = fit_edge(edge_picture(blur, np.random.default_rng(5))[:, ::side])
    # the square pixel adds a variance of 1/12 px2; 1 % as it is no Gaussian
    assert abs(fit.blur / np.sqrt(blur**2 + 1 / 12) - 1) < 0.01 + 4 * fit.blur_error
    assert abs(fit.slant) == pytest.approx(0.09, abs=0.002)
    assert fit.mtf50 == pytest.approx(0.1874 / fit.blur, rel=1e-3)


def test_veiling_glare__is_that_of_an_even_veil():
    rng = np.random.default_rng(6)
    scene = 0.05 + 0.95 * edge_picture(0.6, rng, noise=0.0)
    glare = 0.02
    image = (1 - glare) * scene + glare * scene.mean() + 0.001 * rng.standard_normal(scene.shape)
    assert veiling_glare(fit_edge(image), mean=float(image.mean()), contrast=0.05) == pytest.approx(glare, abs=0.001)
    with pytest.raises(InputError, match="the mean must be positive"):
        veiling_glare(fit_edge(image), mean=0.0)


@pytest.mark.parametrize(
    ("picture", "match"),
    [
        (np.zeros((40, 40)), "an even picture"),
        (np.full((40, 40), np.nan), "must be finite"),
        (np.zeros((8, 8)), "16 px"),
        (np.where(np.arange(40) < 20, 0.0, 1.0) + np.zeros((40, 40)), "slanted by 0.0 degrees"),
        (np.random.default_rng(7).standard_normal((40, 40)), "slanted edge"),
    ],
)
def test_fit_edge__refuses_what_is_no_slanted_edge(picture, match):
    with pytest.raises(InputError, match=match):
        fit_edge(picture)
