"""Distances between groups of vectors: permutation tests that hold for unequal spreads, and maps of distances.

The statistic of two groups is the squared distance of their means over the sum of their mean squared scatters, each
over its number of subjects: Welch's t squared in one dimension. Without the scatters, a group that is smaller and wider
than another passes for a different one (Anderson and Walsh 2013). Permutation of such statistics: Chung and Romano
2016; adjustment by the largest statistic: Westfall and Young 1993.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, islice, permutations, product
from math import factorial, prod

import numpy as np
from numpy.typing import NDArray

from skindb._types import Array
from skindb.numerics.inference import BATCH, ROUNDING

Labels = NDArray[np.intp]
REACHED = 1 - 1e-9  # the same statistic in another order of additions


def between_groups_p(values: Array, group: Labels, *, most: int, rng: np.random.Generator) -> tuple[Array, Array, int]:
    """Statistics and p values of all pairs of groups of different subjects, by permutation of the subjects.

    Parameters
    ----------
    values
        (n, k) a vector for each subject, in coordinates whose distance is the Euclidean one.
    group
        (n,) from 0; each group has at least two subjects.
    most
        Permutations; all distinct ones where they are fewer.
    rng
        Of the permutations.

    Returns
    -------
    statistic, p, count
        (pairs,) in the order of ``itertools.combinations``; p of the largest statistic of all pairs, which for two
        groups is that of the pair alone; the number of permutations. The smallest p is 1 / (count + 1).
    """
    sizes = np.bincount(group)
    total = factorial(len(group)) // prod(factorial(int(n)) for n in sizes)
    if total - 1 <= most:
        draws, count = _arrangements(sizes.tolist()), total - 1
        observed = next(draws)  # the first has the groups in order, as the values are sorted
    else:
        observed = np.repeat(np.arange(len(sizes)), sizes)
        draws, count = (rng.permutation(observed) for _ in range(most)), most
    # exact for subjects in the order of their groups
    y = values[np.argsort(group, kind="stable")]
    y = _without_rounding(y - y.mean(axis=0), values)
    statistic = _between(y, observed[None], sizes)[0]
    reached = np.zeros(len(statistic))
    while batch := list(islice(draws, max(1, BATCH // max(len(y) * len(sizes), 1)))):
        largest = _between(y, np.stack(batch), sizes).max(axis=1)
        reached += (largest[:, None] >= REACHED * statistic).sum(axis=0)
    return statistic, (reached + 1) / (count + 1), count


def within_subjects_p(values: Array, *, most: int, rng: np.random.Generator) -> tuple[Array, Array, int]:
    """Statistics and p values of all pairs of conditions of the same subjects, by exchange within subjects.

    Parameters
    ----------
    values
        (n, groups, k), NaN where a subject lacks a condition; each pair has at least two subjects with both.
    most, rng
        See `between_groups_p`. With two conditions an exchange is a change of the sign of a subject's difference.

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
        chosen = islice((np.array(one) for one in product(*map(range, lengths))), 1, None)
        count = total - 1
    else:
        chosen, count = (rng.integers(lengths) for _ in range(most)), most
    statistic = _within(values[None])[0]
    rows = np.arange(len(values))[:, None]
    reached = np.zeros(len(statistic))
    while batch := list(islice(chosen, max(1, BATCH // max(values.size, 1)))):
        order = np.stack([own[choice] for own, choice in zip(orders, np.stack(batch).T, strict=True)], axis=1)
        largest = _within(values[rows, order]).max(axis=1)
        reached += (largest[:, None] >= REACHED * statistic).sum(axis=0)
    return statistic, (reached + 1) / (count + 1), count


def classical_scaling(distance: Array, axes: int = 2) -> tuple[Array, Array, float]:
    """Points whose distances are nearest to those given: principal coordinates (Torgerson 1952, Gower 1966).

    Parameters
    ----------
    distance
        (n, n) symmetric.
    axes
        Dimensions of the map.

    Returns
    -------
    place, explained, error
        (n, axes) centred, the largest entry of each axis positive; (axes,) fraction of the scatter along each; RMS
        difference of distances in the map over the RMS distance.
    """
    n = len(distance)
    centre = np.eye(n) - 1 / n
    gram = -0.5 * centre @ distance**2 @ centre
    variance, vectors = np.linalg.eigh((gram + gram.T) / 2)
    variance, vectors = np.maximum(variance[::-1], 0.0), vectors[:, ::-1]
    total = variance.sum() or 1.0
    kept = variance[:axes]
    place = vectors[:, :axes] * np.sqrt(np.where(kept > ROUNDING * total, kept, 0.0))
    place = place * np.where(place[np.abs(place).argmax(axis=0), np.arange(place.shape[1])] < 0, -1.0, 1.0)
    place = np.pad(place, ((0, 0), (0, axes - place.shape[1])))
    explained = np.pad(kept, (0, axes - len(kept))) / total
    found = np.linalg.norm(place[:, None] - place[None], axis=-1)
    error = float(np.sqrt(((found - distance) ** 2).sum() / ((distance**2).sum() or 1.0)))
    return place, explained, error


def _between(values: Array, group: Labels, sizes: Labels) -> Array:
    """Statistics (b, pairs) of centred values (n, k) for labels (b, n)."""
    square = (values**2).sum(axis=1)
    means, errors = [], []
    for g, size in enumerate(sizes.tolist()):
        member = (group == g).astype(np.float64)
        mean = member @ values / size
        scatter = np.maximum(member @ square - size * (mean**2).sum(axis=1), 0.0) / (size - 1)
        means.append(mean)
        errors.append(np.where(scatter > ROUNDING * square.max(), scatter, 0.0) / size)
    pairs = combinations(range(len(sizes)), 2)
    return np.stack([_ratio(means[a] - means[b], errors[a] + errors[b]) for a, b in pairs], axis=1)


def _within(values: Array) -> Array:
    """Statistics (b, pairs) of values (b, n, groups, k), by the subjects who have both."""
    found = []
    for a, b in combinations(range(values.shape[2]), 2):
        difference = values[:, :, a] - values[:, :, b]
        difference = difference[:, np.isfinite(difference[0]).all(axis=1)]  # exchanges keep what a subject lacks
        n, mean = difference.shape[1], difference.mean(axis=1)
        scatter = ((difference - mean[:, None]) ** 2).sum(axis=(1, 2)) / (n - 1)
        largest = (difference**2).sum(axis=2).max(axis=1)
        found.append(_ratio(mean, np.where(scatter > ROUNDING * largest, scatter, 0.0) / n))
    return np.stack(found, axis=1)


def _ratio(step: Array, error: Array) -> Array:
    """Squared lengths of steps (b, k) over squared errors (b,); infinite without any scatter, 0 for no step."""
    square = (step**2).sum(axis=1)
    lone = np.where(square > 0, np.inf, 0.0)
    return np.divide(square, error, out=lone, where=error > 0)


def _without_rounding(centred: Array, values: Array) -> Array:
    return np.where(np.abs(centred) > ROUNDING * np.abs(values).max(), centred, 0.0)


def _arrangements(sizes: Sequence[int]) -> Iterator[Labels]:
    """Every distinct order of labels, those of group 0 so many times, and so on; the first is sorted."""

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
    """(orders, groups) exchanges of the conditions that a subject has; the first changes nothing."""
    known = np.flatnonzero(there)
    every = np.array(list(permutations(known.tolist())), np.intp).reshape(-1, len(known))
    orders = np.tile(np.arange(len(there)), (len(every), 1))
    orders[:, known] = every
    return orders
