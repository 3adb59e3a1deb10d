"""Causes of residuals: what was planted is what is measured and named."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from skindb.render.photographs import find_causes

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
