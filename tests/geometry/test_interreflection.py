"""Transfer of one bounce, against form factors of radiometry."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.geometry.interreflection import bounce_transfer

CELLS = 12
# form factors of the faces of a cube (Howell, catalogue of radiation configuration factors)
OPPOSITE = 0.19982
ADJACENT = (1 - OPPOSITE) / 4
ERROR = 0.007  # half a ray of 64


def box(sides=6):
    """The inside of a cube of 100 mm as separate faces: vertices, inward normals, triangles, and
    which vertices are centres of cells, (sides, CELLS**2).
    """
    line = np.concatenate([[0], (np.arange(CELLS) + 0.5) / CELLS, [1]]) * 100
    count = len(line)
    u, v = (a.ravel() for a in np.meshgrid(line, line, indexing="ij"))
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    cells = np.concatenate(
        [
            np.stack([corner, corner + count, corner + 1], 1),
            np.stack([corner + 1, corner + count, corner + count + 1], 1),
        ]
    )
    inner = np.zeros((count, count), bool)
    inner[1:-1, 1:-1] = True
    vertices, normals, faces, centres = [], [], [], []
    for side in range(sides):
        axis, far = divmod(side, 2)
        points = np.insert(np.stack([u, v], 1), axis, 100.0 * far, axis=1)
        faces.append(cells + len(u) * side)
        centres.append(np.flatnonzero(inner.ravel()) + len(u) * side)
        vertices.append(points)
        normals.append(np.tile(np.eye(3)[axis] * (1 - 2 * far), (len(u), 1)))
    return (
        np.concatenate(vertices),
        np.concatenate(normals),
        np.concatenate(faces),
        np.array(centres),
    )


def test_bounce_transfer__between_faces_of_a_cube_are_the_form_factors():
    vertices, normals, faces, centres = box()
    receivers = centres.ravel()
    transfer = bounce_transfer(
        vertices, normals, faces, np.ones_like, receivers=receivers
    )
    assert transfer.shape == (len(receivers), len(vertices))
    by_side = transfer.toarray().reshape(6, CELLS**2, 6, -1).sum(axis=3).mean(axis=1)
    expected = np.full((6, 6), ADJACENT)
    for side in range(6):
        expected[side, side] = 0
        expected[side, side ^ 1] = OPPOSITE
    # the cells share 64 directions, of which 12 or 13 meet a side
    np.testing.assert_allclose(by_side, expected, atol=ERROR)
    # in an enclosure no light is lost
    np.testing.assert_allclose(transfer.sum(axis=1), 1, atol=1e-6)


def test_bounce_transfer__the_boundary_acts_at_both_ends():
    vertices, normals, faces, centres = box()
    receivers = centres[0, :5]
    transfer = bounce_transfer(
        vertices,
        normals,
        faces,
        lambda cosine: np.full_like(cosine, 0.5),
        receivers=receivers,
    )
    np.testing.assert_allclose(transfer.sum(axis=1), 0.25, rtol=1e-6)


def test_bounce_transfer__backs_and_nothing_send_no_light():
    vertices, normals, faces, centres = box(sides=2)
    away = normals.copy()
    away[len(normals) // 2 :] *= -1
    receivers = centres[0]
    seen = bounce_transfer(vertices, normals, faces, np.ones_like, receivers=receivers)
    assert seen.sum() / len(receivers) == pytest.approx(OPPOSITE, abs=ERROR)
    assert (
        bounce_transfer(vertices, away, faces, np.ones_like, receivers=receivers).nnz
        == 0
    )
