"""The truth beside a capture."""

from __future__ import annotations

import numpy as np

from benchmarks.truth import TrueVisibility, mirror_bases, read_truth, regions


def _plates():
    """A square of 20 mm that looks up, below one of 10 mm that looks down."""
    corner = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    face = np.array([[0, 1, 2], [0, 2, 3]])
    below = [[0.0, 0, 0]]
    vertices = np.concatenate([10 * corner, below, 5 * corner + [0, 0, 5]])
    grid = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    return {
        "vertices": vertices,
        "faces": np.concatenate([grid, face[:, ::-1] + 5]),
        "normals": np.repeat([[0.0, 0, 1], [0, 0, -1]], [5, 4], axis=0),
    }


def test_true_visibility__traces_rays_on_the_true_surface():
    visible = TrueVisibility(_plates()).of("light", 0, np.array([0.0, 0, 500]))
    assert visible.tolist() == [True] * 4 + [False] * 5


def test_true_visibility__takes_what_the_generator_wrote():
    bits = np.packbits(np.eye(9, 16, dtype=bool), axis=1)
    true = TrueVisibility(_plates() | {"visible_camera": bits})
    visible = true.of("camera", 3, np.array([0.0, 0, 500]))
    assert np.flatnonzero(visible).tolist() == [3]


def test_regions__of_membership_or_of_an_index():
    names = np.array(["nose", "chin"])
    membership = np.array([[0.2, 0.8], [1.0, 0.0], [0.0, 0.0]])
    truth = {"region_names": names, "region_membership": membership}
    assert regions(truth).tolist() == ["chin", "nose", "other"]
    truth = {"region_names": names, "region": np.array([1, 0])}
    assert regions(truth).tolist() == ["chin", "nose"]


def test_read_truth__is_beside_the_capture(tmp_path):
    np.savez(tmp_path / "V001.truth.npz", eta=1.3)
    assert read_truth(tmp_path / "V001")["eta"] == 1.3


def test_mirror_bases__of_the_three_kinds_of_brdfs():
    theta = np.radians(25.0)
    # of theta_d alone, so that its node at 22.5 and 45 degrees are interpolated
    table = np.broadcast_to(np.array([0.0, 1.0, 2.0, 3.0, 4.0])[:, None], (1, 3, 5, 4))
    truth = {"surface_kind": "table", "surface_tables": table}
    assert np.allclose(mirror_bases(truth, theta), [25.0 / 22.5])
    lobe = np.array([[[-1.0] * 3, [1.0] * 3, [7.0] * 3]])  # of the mirror direction
    truth = {"surface_kind": "lafortune", "surface_lobes": lobe}
    assert np.allclose(mirror_bases(truth, theta), [1.0])
    truth = {"surface_kind": "abc", "surface_abc": np.array([3.0, 9.0, 2.0, 1.5])}
    assert np.allclose(mirror_bases(truth, 0.0), [3.0 * 0.2**2 / np.pi])
