"""Comparison with photographs: differences of images."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.color import deltaE_ciede2000, rgb2lab
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from skindb.render.image import encode_srgb
from skindb.render.photographs import compare_images, delta_e, fine_contrast


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
    assert found["relative_median"] == pytest.approx(0.1)
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


def test_fine_contrast__of_known_patterns_with_noise() -> None:
    """Rationale: the rendering has 0.6 of the photograph's pattern and another pattern of 0.2.
    Expected: 0.6, and the root of the sum of their squares. Without the variance, the noise would
    lower both by 14 % or more.
    """
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(240.0), np.arange(200.0))
    pattern = 0.14 * np.cos(2 * np.pi * x / 5)
    other = 0.14 * np.cos(2 * np.pi * y / 6)
    shape = 5 + x / 100
    photo = shape * (1 + pattern) + 0.5 * rng.standard_normal((3, *x.shape))
    ours = np.repeat((shape * (1 + 0.6 * pattern + 0.2 * other))[..., None], 3, axis=2)
    theirs = np.moveaxis(photo, 0, 2)
    mask = np.hypot(x - 120, y - 100) < 90
    variance = np.full(x.shape, 0.5**2 / 3)
    found = fine_contrast(ours, theirs, mask, variance, 4.0)
    # noise times pattern over 20,000 pixels: 0.6 %
    assert found["fine_gain"] == pytest.approx(0.6, rel=0.02)
    assert found["fine_contrast"] == pytest.approx(np.hypot(0.6, 0.2), rel=0.02)
    flat = np.full_like(theirs, 5)
    assert np.isnan(fine_contrast(ours, flat, mask, variance, 4.0)["fine_gain"])
