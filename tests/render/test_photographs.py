"""Comparison with photographs: differences of images, and causes that were planted."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from skimage.color import deltaE_ciede2000, rgb2lab
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from skindb.render.image import encode_srgb
from skindb.render.photographs import compare_images, delta_e, find_causes


@pytest.fixture
def photograph() -> np.ndarray:
    y, x = np.mgrid[:40, :50] / 50
    return np.stack([0.2 + x, 0.3 + 0.5 * y, 0.1 + 0.2 * x * y], axis=-1) * 30


def test_compare_images__equal_images_have_no_error(photograph: np.ndarray) -> None:
    found = compare_images(photograph, photograph)
    assert found["rmse"] == 0
    assert found["psnr"] == np.inf
    assert found["ssim"] == pytest.approx(1)
    assert found["delta_e_95"] == 0


def test_compare_images__known_scale(photograph: np.ndarray) -> None:
    found = compare_images(photograph * 1.1, photograph)
    assert found["relative_rmse"] == pytest.approx(0.1)
    assert found["rmse"] == pytest.approx(0.1 * np.sqrt((photograph**2).mean()))


def test_compare_images__psnr_and_colour_agree_with_another_library(
    photograph: np.ndarray,
) -> None:
    other = photograph * [0.9, 1.05, 1.2]
    found = compare_images(other, photograph, exposure=0.02)
    shown = [encode_srgb(image * 0.02) for image in (photograph, other)]
    assert found["psnr"] == pytest.approx(peak_signal_noise_ratio(*shown, data_range=1))
    expected = deltaE_ciede2000(rgb2lab(shown[0]), rgb2lab(shown[1]))
    # the two libraries round the sRGB matrix and white point differently
    assert found["delta_e_mean"] == pytest.approx(expected.mean(), rel=3e-3)


def test_delta_e__published_pair() -> None:
    # pair 1 of Sharma, Wu and Dalal 2005 is out of gamut; a neutral pair of equal
    # lightness has no difference
    assert delta_e([0.2, 0.2, 0.2], [0.2, 0.2, 0.2]) == pytest.approx(0, abs=1e-12)
    # black against white is 100 by construction of L*
    assert delta_e([0.0, 0.0, 0.0], [1.0, 1.0, 1.0]) == pytest.approx(100, abs=0.01)


def test_compare_images__mask_and_unknown_pixels_do_not_count(
    photograph: np.ndarray,
) -> None:
    broken = photograph.copy()
    mask = np.ones(photograph.shape[:2], bool)
    broken[:10] = 1e4
    mask[:10] = False
    broken[20, 20] = np.nan
    found = compare_images(broken, photograph, mask=mask)
    assert found["rmse"] == 0
    assert found["pixels"] == 30 * 50 - 1
    assert found["ssim"] == pytest.approx(1)


def test_compare_images__ssim_falls_with_structure_not_with_an_empty_background(
    photograph: np.ndarray,
) -> None:
    noisy = photograph * np.random.default_rng(0).uniform(0.7, 1.3, photograph.shape)
    mask = np.zeros(photograph.shape[:2], bool)
    mask[10:30, 10:30] = True
    padded = [np.where(mask[..., None], image, 0) for image in (noisy, photograph)]
    found = compare_images(*padded, mask=mask, exposure=0.02)["ssim"]
    shown = [encode_srgb(image[10:30, 10:30] * 0.02) for image in (noisy, photograph)]
    _, local = structural_similarity(*shown, data_range=1, channel_axis=-1, full=True)
    # windows of 7 pixels inside the square
    assert found == pytest.approx(local[3:-3, 3:-3].mean())
    assert found < 0.9


def test_compare_images__nothing_to_compare() -> None:
    with pytest.raises(ValueError, match="mask is empty"):
        compare_images(
            np.ones((9, 9, 3)), np.ones((9, 9, 3)), mask=np.zeros((9, 9), bool)
        )
    with pytest.raises(ValueError, match="both images must have the shape"):
        compare_images(np.ones((9, 9, 3)), np.ones((9, 8, 3)))


SIZE = 120


def scene():
    """A rendering with spots of albedo, a shadow to the left and a highlight, and its
    surface part.
    """
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:SIZE, :SIZE]
    spots = 1 + 0.4 * ndimage.gaussian_filter(rng.standard_normal((SIZE, SIZE)), 3) * 10
    matte = np.where(x > 30, 0.5 + 0.3 * x / SIZE, 0.0) * spots
    gloss = 0.8 * np.exp(-((x - 80) ** 2 + (y - 60) ** 2) / 200)
    picture = np.repeat(
        ndimage.gaussian_filter(matte + gloss, 1)[..., None], 3, axis=-1
    )
    return picture, np.repeat(ndimage.gaussian_filter(gloss, 1)[..., None], 3, axis=-1)


def found(photo, rendered, gloss, doubtful=None):
    mask = np.zeros((SIZE, SIZE), bool)
    mask[5:-5, 5:-5] = True
    return find_causes(
        photo,
        rendered,
        gloss,
        mask=mask,
        doubtful=np.zeros((SIZE, SIZE)) if doubtful is None else doubtful,
    )


def test_find_causes__nothing_is_named_where_nothing_is_wrong():
    rendered, gloss = scene()
    rng = np.random.default_rng(1)
    causes = found(
        rendered * (1 + 0.01 * rng.standard_normal(rendered.shape)), rendered, gloss
    )
    assert causes.notable == []
    assert np.hypot(*causes.shift) < 0.05
    assert causes.gain == pytest.approx(1, abs=0.005)


@pytest.mark.parametrize("move", [(0.8, 0.0), (-0.5, 0.7), (0.0, -1.0)])
def test_find_causes__a_shift(move):
    """A photograph in which the face lies farther to the right and down."""
    rendered, gloss = scene()
    photo = ndimage.shift(rendered, (move[1], move[0], 0), order=3, mode="nearest")
    causes = found(photo, rendered, gloss)
    # linear in the shift, of spots that are 3 px wide
    np.testing.assert_allclose(causes.shift, move, atol=0.15)
    assert any("calibration of the camera or motion" in one for one in causes.notable)


def test_find_causes__intensity_of_the_light():
    rendered, gloss = scene()
    causes = found(1.12 * rendered, rendered, gloss)
    assert causes.gain == pytest.approx(1.12, abs=1e-6)
    assert causes.notable == ["intensity of the light (+12 %)"]


def test_find_causes__light_in_the_shadow():
    rendered, gloss = scene()
    causes = found(rendered + 0.05, rendered, gloss)
    assert causes.shadow == pytest.approx(
        0.05 / (rendered[rendered > 0.1].mean() + 0.05), rel=0.2
    )
    assert any("light between parts of the face" in one for one in causes.notable)


def test_find_causes__gloss():
    rendered, gloss = scene()
    causes = found(rendered + 0.5 * gloss, rendered, gloss)
    assert any("gloss or normals (+" in one for one in causes.notable)
    assert not any("light between" in one for one in causes.notable)


def test_find_causes__hair():
    rendered, gloss = scene()
    doubtful = np.zeros((SIZE, SIZE))
    doubtful[20:40, 60:110] = 1.0
    photo = rendered * np.where(doubtful[..., None] > 0, 0.4, 1.0)
    causes = found(photo, rendered, gloss, doubtful)
    assert causes.doubtful > 0.9
    assert any("hair, eyes or doubtful fits" in one for one in causes.notable)


def test_find_causes__a_dark_picture_says_nothing():
    causes = found(
        np.zeros((SIZE, SIZE, 3)), np.zeros((SIZE, SIZE, 3)), np.zeros((SIZE, SIZE, 3))
    )
    assert np.isnan(causes.gain)
    assert causes.notable == []
