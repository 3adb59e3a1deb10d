"""Named points of a surface: the mean shape of many takes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating[Any]]
MAX_SHAPE_ROUNDS = 100  # of the mean shape; a face needs about 5
SETTLED = 1e-12  # relative change of the mean shape at which it has converged


def similarity(
    source: Float, target: Float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation and scale (d, d) and shift (d,) that best map source to target, without
    reflection (Umeyama 1991).

    Parameters
    ----------
    source, target
        (k, d), k > 0; a single point, or points that coincide, are only shifted.

    Returns
    -------
    matrix, shift : ndarray
        `source @ matrix + shift` approximates target.
    """
    x = np.asarray(source, np.float64)
    y = np.asarray(target, np.float64)
    a = x - x.mean(axis=0)
    b = y - y.mean(axis=0)
    left, value, right = np.linalg.svd(a.T @ b)
    sign = np.ones(len(value))
    sign[-1] = np.sign(np.linalg.det(left @ right))
    length = float((a**2).sum())
    along = float(value @ sign)
    matrix = (
        along / length * (left * sign) @ right
        if along > 0 and length > 0
        else np.eye(len(value))
    )
    return matrix, y.mean(axis=0) - x.mean(axis=0) @ matrix


def width(points: Float) -> float:
    """Second largest extent of points (k, d) over the largest; 0 for a single point."""
    value = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(value[1] / value[0]) if len(value) > 1 and value[0] > 0 else 0.0


def mean_shape(shapes: Float) -> NDArray[np.float64]:
    """Mean of shapes after rotation, scale and shift are removed (Gower 1975), in the
    mean pose of the shapes.

    Parameters
    ----------
    shapes
        (t, k, 2); NaN where a shape lacks a point.

    Returns
    -------
    ndarray
        (k, 2); NaN for a point no shape has.
    """
    all_of = np.asarray(shapes, np.float64)
    pose = mean = _known_mean(all_of)
    size = float(np.nanmax(np.abs(pose - np.nanmean(pose, axis=0)), initial=0.0))
    for _ in range(MAX_SHAPE_ROUNDS):
        before = mean
        mean = _onto(
            _known_mean(np.stack([_onto(shape, before) for shape in all_of])), pose
        )
        if not np.nanmax(np.abs(mean - before), initial=0.0) > SETTLED * size:
            break
    return mean


def _onto(shape: Float, target: Float) -> NDArray[np.float64]:
    known = np.isfinite(shape).all(axis=1) & np.isfinite(target).all(axis=1)
    if not known.any():
        return np.asarray(shape, np.float64)
    matrix, shift = similarity(shape[known], target[known])
    return np.asarray(shape @ matrix + shift)


def _known_mean(shapes: Float) -> NDArray[np.float64]:
    known = np.isfinite(shapes).all(axis=2, keepdims=True)
    total = np.where(known, shapes, 0.0).sum(axis=0)
    count = known.sum(axis=0)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))
