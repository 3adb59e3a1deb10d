"""Subsurface transport over a surface by the dipole and an octree (Jensen, Buhler 2002;
Weyrich et al. 2005, eq. 9).
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from skindb.optics._tree_kernels import (
    LIGHTS_IN_REGISTERS,
    Sources,
    Tree,
    build,
    gather,
    sum_nodes,
)
from skindb.optics.diffusion import S_FLOOR, diffuse_reflectance, reduced_albedo
from skindb.optics.fresnel import boundary_factor
from skindb.types import Array, Float32, Float64, Index, Mask, float64

MAX_LEAF_POINTS = 8  # nodes with more points are divided
# mean paths 1 / sigma_tr after which the profile is below 1e-7 of its integral
REACH_MEAN_PATHS = 18.0
RECEIVERS_PER_BLOCK = 2048  # receivers that a thread processes at a time
# lights of one traversal; at 250,000 points 40 MB of power and 190 MB of sums
LIGHTS_PER_WALK = 32


def subsurface_exitance(
    points: Array,
    areas: Array,
    irradiance: Array,
    s: Array,
    sigma_tr: Array,
    *,
    eta: float,
    tolerance: float = 0.1,
    normalise: bool = True,
    receivers: Mask | None = None,
) -> Float32:
    """Radiant exitance under the boundary at every point, for many lights in one
    traversal of the tree.

    Parameters
    ----------
    points, areas
        (n, 3) mm and (n,) mm2, samples of the surface; at most 0.6 / sigma_t' apart for
        an error below 1 %.
    irradiance
        (n, l) irradiance that enters the skin, one column per light. The colour of a
        light is a factor of the result; light whose colour varies over the surface
        needs one column per channel.
    s, sigma_tr
        (n, 3) dipole s and sigma_tr [mm^-1] of the receiving point, per channel.
    eta
        Relative index of refraction.
    tolerance
        A node is treated as one point if its area is below `tolerance` times its
        squared distance. With 0.1 the error is about 0.2 %; 0 sums over all pairs.
    normalise
        Whether to divide by the sum of the kernel over the surface and multiply by R_d.
        Uniform light then gives exactly R_d, and a coarse or curved surface, which
        captures only part of the kernel, is not darkened.
    receivers
        (n,) points whose exitance is computed, default all; the time is proportional to
        their number.

    Returns
    -------
    ndarray
        (l, n, 3) exitance of each light; 0 at points that are not receivers.
    """
    points, areas, irradiance = (float64(x) for x in (points, areas, irradiance))
    result = np.zeros((irradiance.shape[1], len(points), 3), np.float32)
    if result.size == 0:
        return result
    code = _morton(points)
    order = np.argsort(code, kind="stable")
    code = code[order]
    points = points[order]
    areas = areas[order]
    s = np.maximum(float64(s)[order], S_FLOOR)
    decay = float64(sigma_tr)[order]
    depth = s / decay
    above = depth * (1.0 + 4.0 / 3.0 * boundary_factor(eta))
    parameters = np.stack([depth, above, decay, reduced_albedo(s)], axis=-1)
    tree = build(code, points, areas, MAX_LEAF_POINTS)
    place = np.concatenate([points, tree.centre])
    area = np.concatenate([areas, tree.area])
    reach = REACH_MEAN_PATHS / float(decay.min())
    chosen = np.arange(len(points))
    if receivers is not None:
        chosen = np.flatnonzero(receivers[order])
    for low in range(0, len(result), LIGHTS_PER_WALK):
        lights = irradiance[order, low : low + LIGHTS_PER_WALK]
        sources = Sources(place, area, _powers(lights * areas[:, None], tree))
        limits = (tolerance, reach)
        even, sums = _gather_parallel(chosen, parameters, sources, tree, limits)
        gain = np.ones(1)
        if normalise:
            gain = diffuse_reflectance(s[chosen], eta=eta) / np.maximum(even, 1e-300)
        for i in range(lights.shape[1]):
            group, lane = divmod(i, LIGHTS_IN_REGISTERS)
            result[low + i, order[chosen]] = sums[:, group, :, lane] * gain
    return result


def _gather_parallel(
    chosen: Index,
    parameters: Float64,
    sources: Sources,
    tree: Tree,
    limits: tuple[float, float],
) -> tuple[Array, Array]:
    """Dipole sums at chosen points, see `_tree_kernels.gather`; the limits are the
    tolerance and the reach.
    """
    even = np.zeros((len(chosen), 3))
    sums = np.zeros((len(chosen), len(sources.power), 3, LIGHTS_IN_REGISTERS))

    def walk(start: int) -> None:
        stop = min(start + RECEIVERS_PER_BLOCK, len(chosen))
        gather(start, stop, chosen, parameters, sources, tree, *limits, even, sums)

    # plain threads, as the kernel releases the GIL, and numba's own threads abort when
    # two threads render at once
    with ThreadPoolExecutor() as pool:
        list(pool.map(walk, range(0, len(chosen), RECEIVERS_PER_BLOCK)))
    return even, sums


def _powers(power: Array, tree: Tree) -> Float32:
    """Power (groups, points and nodes, LIGHTS_IN_REGISTERS) [irradiance mm2] from the
    power (n, l) of points.

    The last group is padded with zeros.
    """
    n, lights = power.shape
    groups = -(-lights // LIGHTS_IN_REGISTERS)
    out = np.zeros((groups, n + len(tree.begin), LIGHTS_IN_REGISTERS), np.float32)
    for i in range(lights):
        group, lane = divmod(i, LIGHTS_IN_REGISTERS)
        out[group, :n, lane] = power[:, i]
    sum_nodes(out, n, tree)
    return out


def _morton(points: Array) -> Index:
    """Morton codes of ten bits per axis."""
    low = points.min(axis=0)
    span = max(float(np.ptp(points, axis=0).max()), 1e-12)
    cell = np.minimum((points - low) / span * 1024, 1023).astype(int)
    code = np.zeros(len(points), int)
    for bit in range(10):
        for axis in range(3):
            code |= ((cell[:, axis] >> bit) & 1) << (3 * bit + 2 - axis)
    return code
