"""Distances between groups of vectors: permutation tests that are valid for unequal
spreads, and maps of distances.

The statistic of two groups is the squared distance of their means divided by the sum of
their mean squared scatters, each over its number of subjects; in one dimension it is
the square of Welch's t. Without the scatters, the test would report a difference when
one group is merely smaller and wider than the other (Anderson and Walsh 2013). Such
statistics are permuted as in Chung and Romano (2016) and adjusted by the largest
statistic as in Westfall and Young (1993).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, islice, permutations, product
from math import factorial, prod

import numpy as np
from numpy.typing import NDArray

from skindb.numerics.inference import BATCH, ROUNDING
from skindb.types import Array

Labels = NDArray[np.intp]
REACHED = 1 - 1e-9  # tolerance for the same statistic summed in another order


def between_groups_p(
    values: Array, group: Labels, *, most: int, rng: np.random.Generator
) -> tuple[Array, Array, int]:
    """Statistics and p values of all pairs of groups of different subjects, by
    permutation of the subjects.

    Parameters
    ----------
    values
        (n, k) one vector per subject, in coordinates in which distances are Euclidean.
    group
        (n,) group of each subject, counted from 0; each group must have at least two subjects.
    most
        Maximum number of permutations; all distinct ones are used if there are fewer.
    rng
        Random generator for the permutations.

    Returns
    -------
    statistic, p, count
        Statistics (pairs,) in the order of ``itertools.combinations``; p values
        (pairs,) adjusted by the largest statistic of all pairs; the number of
        permutations. The smallest p is 1 / (count + 1).
    """
    sizes = np.bincount(group)
    total = factorial(len(group)) // prod(factorial(int(n)) for n in sizes)
    if total - 1 <= most:
        draws = _arrangements(sizes.tolist())
        count = total - 1
        # the first arrangement has the groups in order, like the sorted values
        observed = next(draws)
    else:
        observed = np.repeat(np.arange(len(sizes)), sizes)
        draws = (rng.permutation(observed) for _ in range(most))
        count = most
    # sorted by group, so that the order of the subjects does not change the bits of the result
    y = values[np.argsort(group, kind="stable")]
    y = _without_rounding(y - y.mean(axis=0), values)
    statistic = _between(y, observed[None], sizes)[0]
    reached = np.zeros(len(statistic))
    while batch := list(islice(draws, max(1, BATCH // max(len(y) * len(sizes), 1)))):
        largest = _between(y, np.stack(batch), sizes).max(axis=1)
        reached += (largest[:, None] >= REACHED * statistic).sum(axis=0)
    return statistic, (reached + 1) / (count + 1), count


def within_subjects_p(
    values: Array, *, most: int, rng: np.random.Generator
) -> tuple[Array, Array, int]:
    """Statistics and p values of all pairs of conditions of the same subjects, by
    permutation within subjects.

    Parameters
    ----------
    values
        (n, groups, k), NaN where a subject lacks a condition; each pair must have at
        least two subjects with both.
    most, rng
        See `between_groups_p`. With two conditions, a permutation changes the signs of
        the subjects' differences.

    Returns
    -------
    statistic, p, count
        See `between_groups_p`.
    """
    orders = [_orders(row) for row in np.asarray(np.isfinite(values).all(axis=2))]
    lengths = [len(one) for one in orders]
    total = prod(lengths)
    chosen: Iterator[Labels]
    if total - 1 <= most:
        chosen = islice(
            (np.array(one) for one in product(*map(range, lengths))), 1, None
        )
        count = total - 1
    else:
        chosen = (rng.integers(lengths) for _ in range(most))
        count = most
    statistic = _within(values[None])[0]
    rows = np.arange(len(values))[:, None]
    reached = np.zeros(len(statistic))
    while batch := list(islice(chosen, max(1, BATCH // max(values.size, 1)))):
        order = np.stack(
            [
                own[choice]
                for own, choice in zip(orders, np.stack(batch).T, strict=True)
            ],
            axis=1,
        )
        largest = _within(values[rows, order]).max(axis=1)
        reached += (largest[:, None] >= REACHED * statistic).sum(axis=0)
    return statistic, (reached + 1) / (count + 1), count


def classical_scaling(distance: Array, axes: int = 2) -> tuple[Array, Array, float]:
    """Points whose distances approximate the given ones: principal coordinates
    (Torgerson 1952, Gower 1966).

    Parameters
    ----------
    distance
        (n, n) symmetric.
    axes
        Number of dimensions of the map.

    Returns
    -------
    place, explained, error
        Centred points (n, axes), with the largest entry of each axis positive; fraction
        of the scatter along each axis (axes,); RMS difference between distances in the
        map and the given ones, over the RMS distance.
    """
    n = len(distance)
    centre = np.eye(n) - 1 / n
    gram = -0.5 * centre @ distance**2 @ centre
    variance, vectors = np.linalg.eigh((gram + gram.T) / 2)
    variance = np.maximum(variance[::-1], 0.0)
    vectors = vectors[:, ::-1]
    total = variance.sum() or 1.0
    kept = variance[:axes]
    place = vectors[:, :axes] * np.sqrt(np.where(kept > ROUNDING * total, kept, 0.0))
    place = place * np.where(
        place[np.abs(place).argmax(axis=0), np.arange(place.shape[1])] < 0, -1.0, 1.0
    )
    place = np.pad(place, ((0, 0), (0, axes - place.shape[1])))
    explained = np.pad(kept, (0, axes - len(kept))) / total
    found = np.linalg.norm(place[:, None] - place[None], axis=-1)
    error = float(
        np.sqrt(((found - distance) ** 2).sum() / ((distance**2).sum() or 1.0))
    )
    return place, explained, error


def _between(values: Array, group: Labels, sizes: Labels) -> Array:
    """Statistics (b, pairs) of centred values (n, k) for labels (b, n)."""
    square = (values**2).sum(axis=1)
    means = []
    errors = []
    for g, size in enumerate(sizes.tolist()):
        member = (group == g).astype(np.float64)
        mean = member @ values / size
        scatter = np.maximum(member @ square - size * (mean**2).sum(axis=1), 0.0) / (
            size - 1
        )
        means.append(mean)
        errors.append(np.where(scatter > ROUNDING * square.max(), scatter, 0.0) / size)
    pairs = combinations(range(len(sizes)), 2)
    return np.stack(
        [_ratio(means[a] - means[b], errors[a] + errors[b]) for a, b in pairs], axis=1
    )


def _within(values: Array) -> Array:
    """Statistics (b, pairs) of values (b, n, groups, k), from the subjects who have
    both conditions of a pair.
    """
    found = []
    for a, b in combinations(range(values.shape[2]), 2):
        difference = values[:, :, a] - values[:, :, b]
        # the same subjects in all permutations
        difference = difference[:, np.isfinite(difference[0]).all(axis=1)]
        n = difference.shape[1]
        mean = difference.mean(axis=1)
        scatter = ((difference - mean[:, None]) ** 2).sum(axis=(1, 2)) / (n - 1)
        largest = (difference**2).sum(axis=2).max(axis=1)
        found.append(
            _ratio(mean, np.where(scatter > ROUNDING * largest, scatter, 0.0) / n)
        )
    return np.stack(found, axis=1)


def _ratio(step: Array, error: Array) -> Array:
    """Squared lengths of steps (b, k) over squared errors (b,); infinite if the error
    is zero, 0 for a zero step.
    """
    square = (step**2).sum(axis=1)
    lone = np.where(square > 0, np.inf, 0.0)
    return np.divide(square, error, out=lone, where=error > 0)


def _without_rounding(centred: Array, values: Array) -> Array:
    return np.where(np.abs(centred) > ROUNDING * np.abs(values).max(), centred, 0.0)


def _arrangements(sizes: Sequence[int]) -> Iterator[Labels]:
    """Every distinct order of labels, given the number of labels of each group; the
    first is sorted.
    """

    def placed(labels: Labels, free: Labels, g: int) -> Iterator[Labels]:
        if g == len(sizes) - 1:
            labels[free] = g
            yield labels.copy()
            return
        for own in combinations(free.tolist(), sizes[g]):
            following = labels.copy()
            following[list(own)] = g
            yield from placed(following, np.setdiff1d(free, own), g + 1)

    n = sum(sizes)
    yield from placed(np.zeros(n, np.intp), np.arange(n), 0)


def _orders(there: NDArray[np.bool_]) -> Labels:
    """Permutations (orders, groups) of the conditions that a subject has; the first is
    the identity.
    """
    known = np.flatnonzero(there)
    every = np.array(list(permutations(known.tolist())), np.intp).reshape(
        -1, len(known)
    )
    orders = np.tile(np.arange(len(there)), (len(every), 1))
    orders[:, known] = every
    return orders
