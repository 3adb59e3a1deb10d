"""Photographs of a mirror ball by ray tracing: a highlight where the reflected ray
meets a round light.
"""

from __future__ import annotations

import numpy as np

SAMPLES = 4  # along each side of a pixel
DISC_MM = 15.0  # standard deviation of the light's brightness from its centre


def ball_picture(camera, ball, radius, light):
    """Brightness (height, width) of a mirror ball, 0 to 1, in a dark room; `camera` has
    width, height, K, R and t.
    """
    offset = (np.arange(SAMPLES) + 0.5) / SAMPLES
    row, column = np.meshgrid(
        (np.arange(camera["height"])[:, None] + offset).ravel(),
        (np.arange(camera["width"])[:, None] + offset).ravel(),
        indexing="ij",
    )
    K, R, t = (np.asarray(camera[key], float) for key in ("K", "R", "t"))
    view = (
        np.stack(
            [
                (column - K[0, 2]) / K[0, 0],
                (row - K[1, 2]) / K[1, 1],
                np.ones_like(row),
            ],
            -1,
        )
        @ R
    )
    view /= np.linalg.norm(view, axis=-1, keepdims=True)
    eye = -R.T @ t
    along = view @ (np.asarray(ball) - eye)
    under = radius**2 - np.sum((np.asarray(ball) - eye) ** 2) + along**2
    point = eye + (along - np.sqrt(np.maximum(under, 0)))[..., None] * view
    normal = (point - ball) / radius
    out = view - 2 * np.sum(view * normal, axis=-1, keepdims=True) * normal
    way = np.asarray(light) - point
    # distance of the light from the reflected ray
    miss = np.linalg.norm(np.cross(way, out), axis=-1)
    bright = np.where(
        np.sum(way * out, axis=-1) > 0, np.exp(-((miss / DISC_MM) ** 2) / 2), 0.0
    )
    value = np.where(under > 0, 0.02 + bright, 0.0)
    return value.reshape(camera["height"], SAMPLES, camera["width"], SAMPLES).mean(
        axis=(1, 3)
    )


def ball_outline_of(camera, ball, radius):
    """Column, row and radius of the outline in px: of the pixels whose line of sight
    meets the ball.
    """
    inside = ball_picture(camera, ball, radius, np.array([0.0, 0.0, 1e9])) > 0.01
    row, column = np.nonzero(inside)
    return [
        float(column.mean() + 0.5),
        float(row.mean() + 0.5),
        float(np.sqrt(inside.sum() / np.pi)),
    ]
