import json

import imagecodecs
import numpy as np
import pytest

from skindb.optics.transport import radial_profile
from skindb.virtual.probe import (
    BIN,
    BRACKETS,
    FIBRE_RADIUS,
    FIBRES,
    _disc_shares,
    fibre_profiles,
    shared_walk,
    write_probe,
)
from skindb.virtual.skin import Site

ETA = 1.3
SITE = Site(
    "cheek",
    np.zeros(3),
    np.array([0.45, 0.27, 0.2]),
    np.array([0.56, 0.97, 1.5]),
    *np.array([[0.086, 0.28, 0.58], [1.13, 0.85, 0.72]]),
)


@pytest.fixture(scope="module")
def walk():
    return shared_walk(ETA, 40_000)


def test_fibre_profiles__near_fibres_are_the_walk_itself(walk):
    truth = fibre_profiles(walk, [SITE])
    assert truth.profile.shape == (1, FIBRES, 3)
    for c in range(3):
        edges = np.array([0.75, 1.25])  # the ring that the first fibre lies in
        ring, error = radial_profile(
            walk, SITE.sigma_a[c], SITE.sigma_s_prime[c], edges
        )
        # 12 %: a fibre's face is not a ring, and the profile is steep there
        assert truth.profile[0, 0, c] == pytest.approx(
            ring[0], rel=0.12, abs=5 * error[0]
        )


def test_disc_shares__have_mean_and_variance_of_two_faces():
    middle = BIN * (np.arange(620) + 0.5)
    share = _disc_shares(middle, np.array([14.5])) @ _disc_shares(middle, middle)
    mean = (share @ middle)[0]
    # variance across / (2 r)
    assert mean == pytest.approx(14.5 + FIBRE_RADIUS**2 / 4 / 14.5, abs=1e-3)
    # half the squared radius: a quarter of each face; rings of a tenth of the radius
    # miss some of it
    assert share @ (middle - mean) ** 2 == pytest.approx(FIBRE_RADIUS**2 / 2, rel=0.02)


def test_fibre_profiles__fall_with_distance_and_faster_in_blue(walk):
    profile = fibre_profiles(walk, [SITE]).profile[0]
    assert (np.diff(np.log(profile), axis=0) < 0).all()
    slope = np.log(profile[4] / profile[20])
    assert slope[0] < slope[1] < slope[2]


def test_fibre_profiles__far_slope_is_near_the_effective_transport_coefficient(walk):
    truth = fibre_profiles(walk, [SITE])
    red = np.log(truth.profile[0, :, 0] * truth.distance**2)
    slope = -np.polyfit(truth.distance[8:], red[8:], 1)[0]
    # asymptote exp(-sigma_tr r) / r^2, reached only at a distance: 15 %
    assert slope == pytest.approx(SITE.sigma_tr[0], rel=0.15)


def test_write_probe__the_images_decode_to_the_profile(tmp_path):
    (tmp_path / "contact" / "cheek").mkdir(parents=True)
    truth = write_probe(tmp_path, [SITE], eta=ETA, rng=np.random.default_rng(4))
    meta = json.loads((tmp_path / "contact" / "probe.json").read_text())
    assert len(meta["exposures"]) == BRACKETS
    seconds = [e["seconds"] for e in meta["exposures"]]
    np.testing.assert_allclose(np.log2(np.array(seconds[:-1]) / seconds[1:]), 2 / 3)
    frames = [
        imagecodecs.imread(
            tmp_path / meta["frames"].format(site="cheek", exposure=e["id"])
        )
        for e in meta["exposures"]
    ]
    assert frames[0].dtype == np.uint16
    y, x = np.mgrid[: frames[0].shape[0], : frames[0].shape[1]] + 0.5
    black = meta["black_level"]
    white = meta["white_level"]
    decoded = np.full((FIBRES, 3), np.nan)
    for i, fibre in enumerate(meta["fibres"]):
        inside = (
            np.hypot(x - fibre["centre"][0], y - fibre["centre"][1]) <= fibre["radius"]
        )
        for c in range(3):
            # the longest exposure that is not saturated
            for frame, time in zip(frames, seconds, strict=True):
                if frame[inside, c].max() < 0.95 * white:
                    signal = (frame[inside, c].mean() - black) / (white - black) / time
                    decoded[i, c] = (
                        meta["scale"] * signal / np.broadcast_to(meta["gain"][i], 3)[c]
                    )
                    break
    bright = truth.profile[0] > 1e-5
    assert bright.sum() > 30
    np.testing.assert_allclose(decoded[bright], truth.profile[0][bright], rtol=0.03)
