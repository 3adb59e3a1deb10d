"""The simple models and the data sets of `benchmarks/real.py`."""

from __future__ import annotations

import numpy as np

from benchmarks import peers, real, real_photographs


def _lights():
    turn, away = np.meshgrid(np.arange(10) * 0.63, [0.2, 0.5, 0.8, 1.0])
    across = np.sin(away)
    return np.stack(
        [across * np.cos(turn), across * np.sin(turn), np.cos(away)], axis=-1
    ).reshape(-1, 3)


def _normals():
    tilt = np.array([[0.2, 0.1, 1.0], [-0.3, 0.2, 1.0], [0.0, -0.4, 1.0]])
    return tilt / np.linalg.norm(tilt, axis=1, keepdims=True)


def test_fit__recovers_planted_normals_and_unseen_lights():
    light = _lights()
    normal = _normals()
    training = np.arange(len(light)) % 5 > 0
    for peer in peers.PEERS:
        parameters = np.tile(peer.start, (len(normal), 1))
        observed = peer.shading(parameters, normal, light)
        observed[0, 3] *= 0.2  # a cast shadow
        fitted = peers.fit(peer, observed, observed > 0, light, training)
        assert (fitted.normal * normal).sum(axis=1).min() > np.cos(np.radians(0.5)), (
            peer.name
        )
        unseen = ~training & (observed > 0)
        np.testing.assert_allclose(
            fitted.predicted[unseen], observed[unseen], rtol=0.05, err_msg=peer.name
        )


def test_spread_lights__are_apart_and_begin_in_front():
    light = _lights()
    chosen = light[real_photographs.spread_lights(light, 4)]
    gram = chosen @ chosen.T - 2 * np.eye(4)
    assert gram.max() < np.cos(np.radians(40))
    assert light[:, 2].max() in chosen[:, 2]


def test_measure__absent_data_is_skipped_with_the_reason(tmp_path):
    for part in real.PARTS:
        assert "does not exist" in real.measure(tmp_path, part)
