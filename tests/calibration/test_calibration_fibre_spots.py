from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from skindb.calibration.fibres import Spots, fibre_gain, find_fibres, match_fibres
from skindb.errors import InputError


def fibre_picture(rng, noise=0.005):
    """28 discs, drawn at 8 times the resolution, of differing brightness on stray light."""
    centre = np.array(
        [[30 + 22.3 * (i % 7), 28 + 25.7 * (i // 7)] for i in range(28)]
    ) + rng.uniform(-2, 2, (28, 2))
    radius = rng.uniform(6.0, 7.0, 28)
    fine = 8
    row, column = (np.mgrid[: 140 * fine, : 200 * fine] + 0.5) / fine
    picture = np.zeros(row.shape)
    for (x, y), r in zip(centre, radius, strict=True):
        picture[(column - x) ** 2 + (row - y) ** 2 < r * r] = rng.uniform(0.6, 1.0)
    small = ndimage.gaussian_filter(
        picture.reshape(140, fine, 200, fine).mean(axis=(1, 3)), 0.5
    )
    order = np.lexsort(centre.T[::-1])
    return 0.3 + small + noise * rng.standard_normal(small.shape), Spots(
        centre[order], radius[order]
    )


def test_find_fibres__finds_centres_and_radii():
    picture, truth = fibre_picture(np.random.default_rng(1))
    found = find_fibres(picture, count=28)
    compared = match_fibres(found, truth)
    # noise of 0.5 % over 130 px: 0.01 px of the centre and 0.05 % of the area; the
    # middle's percentile adds 0.5 %
    assert np.abs(compared.offset).max() < 0.05
    assert np.abs(compared.radius_ratio - 1).max() < 0.01


@pytest.mark.parametrize(
    ("picture", "match"),
    [
        (np.zeros((50, 50)), "28 separate spots; found 0"),
        (np.ones((50, 50)), "28 separate spots; found 0"),
        (np.full((50, 50), np.nan), "must be finite"),
        (np.zeros((50, 50, 3)), "the shape"),
    ],
)
def test_find_fibres__refuses_a_picture_without_fibres(picture, match):
    with pytest.raises(InputError, match=match):
        find_fibres(picture, count=28)


def test_match_fibres__finds_each_in_any_order_and_refuses_shifts():
    _, truth = fibre_picture(np.random.default_rng(2))
    order = np.random.default_rng(3).permutation(28)
    found = match_fibres(Spots(truth.centre[order] + 0.5, truth.radius[order]), truth)
    np.testing.assert_allclose(found.offset, 0.5)
    assert (order[found.order] == np.arange(28)).all()
    with pytest.raises(InputError, match="within its radius"):
        match_fibres(replace(truth, centre=truth.centre + 8), truth)
    with pytest.raises(InputError, match="as many fibres"):
        match_fibres(Spots(truth.centre[:5], truth.radius[:5]), truth)


def test_fibre_gain__knows_its_error():
    rng = np.random.default_rng(4)
    truth = rng.uniform(0.8, 1.2, (28, 3))
    truth /= truth.mean(axis=0)
    z = []
    for _ in range(40):
        level = rng.uniform(0.5, 2.0, (12, 1, 1))
        found = fibre_gain(
            level * truth * (1 + 0.004 * rng.standard_normal((12, 28, 3)))
        )
        z.append((found.gain - truth) / found.error)
    # Student's t of 11 degrees of freedom has a deviation of 1.106; the means of 28
    # fibres take 2 % off
    assert abs(np.std(z) - 1.09) < 0.05
    for bad in (np.zeros((5, 28, 3)), np.full((5, 28, 3), np.nan), np.ones((1, 28, 3))):
        with pytest.raises(InputError, match="flat field of the fibres"):
            fibre_gain(bad)
