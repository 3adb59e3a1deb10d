from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from skindb.geometry._ring_kernels import grown, mixed


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 1.0])
def test_grown_and_mixed__as_by_the_matrix_of_neighbours(share):
    """Compared with a count of the vertices in the mask among each vertex and its neighbours."""
    rng = np.random.default_rng(8)
    faces = rng.integers(0, 200, (150, 3))
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    a, b, c = faces.T
    edges = sp.coo_matrix(
        (np.ones(3 * len(a)), (np.r_[a, b, c], np.r_[b, c, a])), shape=(210, 210)
    ).tocsr()
    near = ((edges + edges.T + sp.eye(210)) > 0).astype(int)
    mask = rng.random(210) < share
    found = near @ mask.astype(int)
    np.testing.assert_array_equal(grown(faces, mask), found > 0)
    np.testing.assert_array_equal(
        mixed(faces, mask), (found > 0) & (found < np.asarray(near.sum(1)).ravel())
    )
