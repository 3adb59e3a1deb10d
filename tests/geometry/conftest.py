from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import Delaunay


@pytest.fixture(scope="session")
def hemisphere() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices [mm] and faces of a dome that opens towards -z, and Lambert's azimuthal
    projection to the unit disc.
    """
    theta = np.linspace(0, np.pi / 2, 41)[1:]
    phi = 2 * np.pi * np.arange(160) / 160
    theta, phi = (x.ravel() for x in np.meshgrid(theta, phi, indexing="ij"))
    around = np.column_stack([np.cos(phi), np.sin(phi)])
    v = 80 * np.column_stack([np.sin(theta)[:, None] * around, np.cos(theta)])
    v = np.r_[[[0, 0, 80.0]], v]
    lambert = np.r_[[[0, 0]], np.sqrt(2) * np.sin(theta / 2)[:, None] * around]
    f = Delaunay(lambert).simplices.astype(np.int64)
    a, b = (lambert[f[:, k]] - lambert[f[:, 0]] for k in (1, 2))
    return (
        v,
        np.where((a[:, 0] * b[:, 1] > a[:, 1] * b[:, 0])[:, None], f, f[:, ::-1]),
        lambert,
    )
