from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from skindb.calibration.lens import fit_edge, veiling_glare
from skindb.errors import InputError


def edge_picture(blur, rng, *, shape=(80, 64), noise=0.002, slant=0.09):
    """An edge drawn at 8 times the resolution, blurred there, and averaged over the pixels."""
    fine = 8
    row, column = (np.mgrid[: shape[0] * fine, : shape[1] * fine] + 0.5) / fine
    sharp = np.where(column - shape[1] / 2 - slant * (row - shape[0] / 2) > 0, 1.0, 0.0)
    soft = (
        ndimage.gaussian_filter(sharp, blur * fine, mode="nearest") if blur else sharp
    )
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
    image = (
        (1 - glare) * scene
        + glare * scene.mean()
        + 0.001 * rng.standard_normal(scene.shape)
    )
    assert veiling_glare(
        fit_edge(image), mean=float(image.mean()), contrast=0.05
    ) == pytest.approx(glare, abs=0.001)
    with pytest.raises(InputError, match="the mean must be positive"):
        veiling_glare(fit_edge(image), mean=0.0)


@pytest.mark.parametrize(
    ("picture", "match"),
    [
        (np.zeros((40, 40)), "a uniform picture"),
        (np.full((40, 40), np.nan), "must be finite"),
        (np.zeros((8, 8)), "16 px"),
        (
            np.where(np.arange(40) < 20, 0.0, 1.0) + np.zeros((40, 40)),
            "slanted by 0.0 degrees",
        ),
        (np.random.default_rng(7).standard_normal((40, 40)), "slanted edge"),
    ],
)
def test_fit_edge__refuses_what_is_no_slanted_edge(picture, match):
    with pytest.raises(InputError, match=match):
        fit_edge(picture)
