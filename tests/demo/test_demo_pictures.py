"""Pictures of the report: one scale, one exposure."""

from __future__ import annotations

import numpy as np
import pytest
from planted_results import comparison
from small_face import small_face

from skindb.demo.page import MARGIN, crop_alike, draw_portraits, predictions


def _disc(row, col, radius, size=60):
    i, j = np.mgrid[:size, :size]
    return (i - row) ** 2 + (j - col) ** 2 <= radius**2


def test_crop_alike__windows_of_one_size_around_all_faces():
    masks = [_disc(30, 30, 10), _disc(25, 40, 5)]
    pictures = [
        np.repeat(mask[..., None], 3, axis=2).astype(np.uint8) for mask in masks
    ]
    cut = crop_alike(pictures, masks)
    # rows 20 to 40 and columns 20 to 45
    assert [one.shape for one in cut] == [(21 + 2 * MARGIN, 26 + 2 * MARGIN, 3)] * 2
    for one, mask in zip(cut, masks, strict=True):
        assert one[..., 0].sum() == mask.sum()  # not clipped and not scaled


def test_crop_alike__without_a_face_the_whole_picture():
    picture = np.ones((4, 5, 3), np.uint8)
    [cut] = crop_alike([picture], [np.zeros((4, 5), bool)])
    np.testing.assert_array_equal(cut, picture)


@pytest.mark.slow
def test_draw_portraits__darker_skin_is_shown_darker():
    portraits = draw_portraits(
        {"light": small_face(), "dark": small_face((0.15, 0.1, 0.08))}
    )
    shown = portraits.cut(portraits.images)
    mean = {name: image[image.any(axis=2)].mean() for name, image in shown.items()}
    # with separate exposures, both would be equally bright
    assert mean["dark"] < 0.8 * mean["light"]
    assert shown["dark"].shape == shown["light"].shape


def test_predictions__one_exposure_whatever_each_photograph_has():
    shown = [
        comparison("l0", held_out=True, exposure=exposure) for exposure in (0.3, 1.0)
    ]
    first, second = predictions(shown, 0.5)
    np.testing.assert_array_equal(first, second)
    photograph = first[20, 15]
    difference = first[20, -15]
    # IEC 61966-2-1 of 0.5 times 0.5
    assert photograph[0] == round(255 * (1.055 * 0.25 ** (1 / 2.4) - 0.055))
    np.testing.assert_array_equal(difference, 127)  # grey: the prediction is equal
