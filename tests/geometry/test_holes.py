"""Hole filling against every triangulation of the loop."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.geometry.holes import fill_hole, sliver_mask

ROUNDING = 1e-9


def all_triangulations(ring: list[int]):
    """Every triangulation of a convex polygon with these corners."""
    if len(ring) < 3:
        yield []
        return
    for j in range(1, len(ring) - 1):
        for left in all_triangulations(ring[: j + 1]):
            for right in all_triangulations(ring[j:]):
                yield [*left, *right, (ring[0], ring[j], ring[-1])]


def area(v: np.ndarray, triangles) -> float:
    return sum(
        float(np.linalg.norm(np.cross(v[b] - v[a], v[c] - v[a]))) / 2
        for a, b, c in triangles
    )


def ring(n: int, seed: int = 0) -> np.ndarray:
    angle = 2 * np.pi * np.arange(n) / n
    flat = 5 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return flat + np.random.default_rng(seed).normal(size=(n, 3))


@pytest.mark.parametrize("n", [3, 4, 5, 8])
def test_fill_hole__has_the_least_area_of_all(n):
    v = ring(n)
    patch = fill_hole(v, np.arange(n), set())
    assert patch is not None
    assert patch.shape == (n - 2, 3)
    least = min(area(v, t) for t in all_triangulations(list(range(n))))
    assert area(v, patch) == pytest.approx(least, rel=ROUNDING)


def test_fill_hole__runs_against_the_loop():
    patch = fill_hole(ring(6), np.arange(6), set())
    sides = {
        (int(a), int(b))
        for face in patch
        for a, b in zip(face, np.roll(face, -1), strict=True)
    }
    assert {((i + 1) % 6, i) for i in range(6)} <= sides


def test_fill_hole__repeats_no_edge():
    v = ring(4)
    free = fill_hole(v, np.arange(4), set())
    diagonal = set.intersection(*({int(x) for x in face} for face in free))
    other = fill_hole(v, np.arange(4), {tuple(sorted(diagonal))})
    assert (
        set.intersection(*({int(x) for x in face} for face in other))
        == set(range(4)) - diagonal
    )
    assert fill_hole(v, np.arange(4), {(0, 2), (1, 3)}) is None


def test_fill_hole__makes_no_sliver():
    line = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], float)
    assert fill_hole(line, np.arange(3), set()) is None
    # three of four in a line: the diagonal from the middle one is the only one left
    patch = fill_hole(
        np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 2, 0]], float),
        np.arange(4),
        set(),
    )
    assert not sliver_mask(
        np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 2, 0]], float), patch
    ).any()


def test_sliver_mask__by_height_over_longest_side():
    v = np.array(
        [[0, 0, 0], [100, 0, 0], [50, 0.2, 0], [50, 0.05, 0], [0, 0, 0]], float
    )
    faces = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4], [0, 0, 4]])
    assert sliver_mask(v, faces).tolist() == [False, True, True, True]
    assert sliver_mask(v * 1e-6, faces).tolist() == [False, True, True, True]
