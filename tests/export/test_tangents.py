"""Tangent frames and normals in them."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.export.maps import tangent_axes, tangent_frames


def patch(seed: int, *, mirrored: bool = False):
    """A curved patch whose texture is turned and stretched; mirrored ones run against
    the surface.
    """
    rng = np.random.default_rng(seed)
    side = 20
    x, y = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(-1, 1, side)]))
    position = np.stack([40 * x, 40 * y, 8 * np.sin(2 * x) * np.cos(y)], axis=1)
    slope = np.stack(
        [
            -16 * np.cos(2 * x) * np.cos(y) / 40,
            8 * np.sin(2 * x) * np.sin(y) / 40,
            np.ones_like(x),
        ],
        axis=1,
    )
    normal = slope / np.linalg.norm(slope, axis=1, keepdims=True)
    turn = rng.uniform(0, 2 * np.pi)
    stretch = rng.uniform(0.5, 2)
    flat = np.stack([x * (-1 if mirrored else 1), stretch * y], axis=1)
    c = np.cos(turn)
    s = np.sin(turn)
    uv = 0.5 + 0.2 * flat @ np.array([[c, s], [-s, c]])
    i = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([i, i + 1, i + side], 1),
            np.stack([i + 1, i + side + 1, i + side], 1),
        ]
    )
    return position, normal, uv, faces


@pytest.mark.parametrize("mirrored", [False, True])
def test_tangent_frames__follow_the_texture(mirrored):
    for seed in range(8):
        position, normal, uv, faces = patch(seed, mirrored=mirrored)
        frames = tangent_frames(position, normal, uv, faces)
        tangent = frames[:, :3]
        sign = frames[:, 3]
        np.testing.assert_allclose(np.linalg.norm(tangent, axis=1), 1)
        np.testing.assert_allclose((tangent * normal).sum(axis=1), 0, atol=1e-12)
        # v grows downwards: with y up in space and down in the texture, an unmirrored
        # texture has the sign -1
        assert set(sign) == {1.0 if mirrored else -1.0}
        # the derivative of the position with u, by finite differences over the triangles' corners
        corner = position[faces]
        place = uv[faces]
        step = np.linalg.solve(
            (place[:, 1:] - place[:, :1]), corner[:, 1:] - corner[:, :1]
        )
        along = step[:, 0] / np.linalg.norm(step[:, 0], axis=1, keepdims=True)
        up = -step[:, 1] / np.linalg.norm(step[:, 1], axis=1, keepdims=True)
        mean = tangent[faces].mean(axis=1)
        bitangent = (np.cross(normal, tangent) * sign[:, None])[faces].mean(axis=1)
        # triangles of 4 mm on a surface that bends
        assert (mean * along).sum(axis=1).min() > 0.97
        # a texture that is stretched at an angle is sheared
        assert (bitangent * up).sum(axis=1).min() > 0.75


def test_to_tangent_space__and_back():
    position, normal, uv, faces = patch(1)
    frames = tangent_frames(position, normal, uv, faces)
    rng = np.random.default_rng(0)
    bent = normal + 0.3 * rng.standard_normal(normal.shape)
    bent /= np.linalg.norm(bent, axis=1, keepdims=True)
    local = np.einsum("nkc,nc->nk", tangent_axes(normal, frames), bent)
    bitangent = np.cross(normal, frames[:, :3]) * frames[:, 3:]
    back = (
        local[:, :1] * frames[:, :3] + local[:, 1:2] * bitangent + local[:, 2:] * normal
    )
    np.testing.assert_allclose(back, bent, atol=1e-12)
    np.testing.assert_allclose(
        np.einsum("nkc,nc->nk", tangent_axes(normal, frames), normal),
        np.tile([0.0, 0, 1], (len(normal), 1)),
        atol=1e-12,
    )


def test_tangent_frames__of_a_vertex_without_texture():
    position, normal, uv, faces = patch(2)
    uv[:] = 0.5
    frames = tangent_frames(position, normal, uv, faces)
    assert np.isfinite(frames).all()
    np.testing.assert_allclose((frames[:, :3] * normal).sum(axis=1), 0, atol=1e-12)
