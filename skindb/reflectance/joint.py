"""Joint fit of the normal, R_d and the surface to the samples of surfels.

A sample is cos(theta_i) (F_t F_t R_d / pi + sum_j x_j b_j) with R_d >= 0 of three channels
and strengths x_j >= 0 of GGX lobes b_j of graded widths; surfels with few samples share the
shape of these lobes, or have none. Given the normal this is a non-negative least-squares
problem; the normal is refined with all other parameters by Gauss-Newton steps. Weights are
those of a comparison of cube roots, less for noisy samples and for outliers (Tukey's
function). A surfel has no lobes narrower than 2/3 of the smallest angle at which it was
seen from its normal to a half vector: their peaks would be extrapolated.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from skindb.reflectance._joint_kernels import LOBES, JointFit, Lobes, fit_jointly
from skindb.reflectance._lumitexel_kernels import MIN_SAMPLES_GLOSS
from skindb.reflectance.block import kernel_block, kernel_options
from skindb.reflectance.lobes import GRADED_ROUGHNESS, SURFACE_INDEX
from skindb.reflectance.model import Block, Comparison
from skindb.types import Array, contiguous

__all__ = ["UNKNOWN_GLOSS", "Gloss", "JointFit", "refine_block"]

# Strengths of the lobes of surfels with few samples, times one factor: one lobe, whose width
# is the best of three for eight faces of Extended Yale B under 4 to 12 lights; the next
# narrower one would be better by a twentieth for the cat of DiLiGenT.
SHARED_LOBES = (0.0, 1.0, *[0.0] * (LOBES - 2))
# fractions of light along the normal that lobes of strength 1 reflect, by
# `GGX.normal_reflectance`
LOBE_REFLECTANCE = np.array(
    [0.0105, 0.0176, 0.0231, 0.0260, 0.0271, 0.0276, 0.0277, 0.0277]
)
# rad; larger errors of the scan's normals, or no scan
MAX_SCAN_ERROR = np.radians(15.0)
# Gauss-Newton steps in the normal, and their fraction. Beside a scan the given normals
# are good, and their errors partly independent of those of the joint fit: on six captures
# with known truth, medians are 0.5 to 0.8 degrees (imperfect capture 1.7), best or within
# 0.07 of the better one of both, and a second step changed them by 0.002 degrees. Without
# a scan more steps improve normals and predictions of the cat of DiLiGenT and of eight
# faces (docs/results).
STEPS = (1, 0.7)
STEPS_WITHOUT_SCAN = (4, 1.0)


class Gloss(NamedTuple):
    """Mean and standard deviation of the factor of the lobes of surfels with few samples,
    the number of samples from which they have them, and whether these are the lobes of the
    rig.
    """

    strength: float
    spread: float
    samples: int = MIN_SAMPLES_GLOSS
    of_rig: bool = False


# Without it the lobe explains all light of one in eight pixels of a face under six lights.
UNKNOWN_GLOSS = Gloss(0.0, 8.0)


def refine_block(
    block: Block,
    comparison: Comparison,
    *,
    scan_normal: Array,
    scan_error: float,
    gloss: Gloss = UNKNOWN_GLOSS,
    lobes: ArrayLike = SHARED_LOBES,
) -> JointFit:
    """Normal, R_d and strengths of the lobes of n surfels, from the given ones.

    Parameters
    ----------
    block
        Samples, with estimates of the normal and of R_d.
    comparison
        In mode "perceptual".
    scan_normal
        (n, 3) unit normals of the scan.
    scan_error
        Standard error of the scan's normals about each axis [rad], of a prior.
    gloss
        Prior of the lobes of surfels with fewer than twelve samples.
    lobes
        Strengths ([n,] 8) of these lobes at factor 1.

    Returns
    -------
    JointFit
        NaN for surfels without estimates or with too few samples, and errors are NaN where
        the parameters cannot be distinguished.
    """
    n = len(block.position)
    error, shared, kkt = np.full((3, n), np.nan)
    normal, diffuse, diffuse_error, diffuse_shared = np.full((4, n, 3), np.nan)
    out = JointFit(
        normal=normal,
        normal_error=error,
        normal_shared=shared,
        diffuse=diffuse,
        diffuse_error=diffuse_error,
        diffuse_shared=diffuse_shared,
        strength=np.full((n, LOBES), np.nan),
        kkt=kkt,
        samples=np.zeros(n, np.int64),
    )
    graded = Lobes(
        np.asarray(GRADED_ROUGHNESS**2, np.float32),
        np.ascontiguousarray(np.broadcast_to(lobes, (n, LOBES)), np.float32),
        gloss.strength,
        gloss.spread,
        gloss.samples,
        SURFACE_INDEX,
        contiguous(scan_normal),
        float(scan_error),
        *(STEPS if scan_error < MAX_SCAN_ERROR else STEPS_WITHOUT_SCAN),
    )
    options = kernel_options(comparison, solve=True)
    fit_jointly(kernel_block(block), graded, options, out)
    return out
