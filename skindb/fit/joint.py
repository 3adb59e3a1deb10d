"""Joint refinement of the normal and R_d together with the surface."""

from __future__ import annotations

import numpy as np
import xarray as xr

from skindb.elementwise import elementwise
from skindb.fit.albedo import MODEL_ERROR_ALBEDO
from skindb.fit.lumitexels import (
    GEOMETRY,
    POLARISATION,
    Arrays,
    block_of,
    by_name,
    noise_inputs,
)
from skindb.fit.surface import noise_floor
from skindb.optics.diffusion import dipole_s
from skindb.parameters import BARE_SKIN, SCAN_ERROR_DEGREES
from skindb.reflectance._lumitexel_kernels import (
    MIN_SAMPLES_GLOSS,
    MIN_SAMPLES_LOBES,
)
from skindb.reflectance.joint import (
    LOBE_REFLECTANCE,
    SHARED_LOBES,
    UNKNOWN_GLOSS,
    Gloss,
    JointFit,
    refine_block,
)
from skindb.reflectance.model import MIN_LOBE_WIDTH, Comparison
from skindb.schema import check, variables
from skindb.schema.declaration import LARGEST_R_D, SMALLEST_R_D
from skindb.types import Array, dots

# Factors of the errors by device and by samples, and an angle [degree], of which the total
# error of a normal consists. Chosen on six captures with known truth, where 93 to 99 % of
# the angles were below 1.73 times it with a whole step of the normal; not chosen on the
# cat of DiLiGenT, where 88 % are (docs/results). The factor of the errors by samples is
# the root of their number up to this one: errors of the model do not fall with it. Chosen
# on the cat under 4 to 48 lights; the faces confirm it.
TOTAL_SHARED = 2.0
TOTAL_NOISE = 6.0
TOTAL_ANGLE = 0.5
# of a solution that has converged: above the rounding of its equations, 1e-7
MAX_KKT = 1e-6
# what a surface of skin reflects, which R_d by Lambert's law includes
MODEL_ERROR_LAMBERT = BARE_SKIN[0]
REFINED = (
    "shading_normal",
    "normal_error",
    "normal_total_error",
    "diffuse_reflectance",
    "diffuse_reflectance_error",
    "diffuse_reflectance_total_error",
    "dipole_s",
)


def refine_jointly(
    lumitexels: xr.Dataset,
    *,
    eta: float = 1.3,
    scan_error: float = SCAN_ERROR_DEGREES,
    gloss: Gloss = UNKNOWN_GLOSS,
) -> xr.Dataset:
    """Normal and R_d, estimated together with the surface from estimates in sequence.

    Parameters
    ----------
    lumitexels
        Samples with geometry, `surfel_normal`, and the variables of the result from
        `estimate_normals` and `estimate_diffuse_reflectance`.
    eta, scan_error
        As in these functions.
    gloss
        From `estimate_gloss`: prior of the gloss of surfels with few samples.

    Returns
    -------
    Dataset
        The variables of both functions, refined (see `skindb.reflectance.joint`); as
        given for surfels with fewer than three samples, whose parameters cannot be
        distinguished, or whose fit has not converged. The surface has lobes of a fixed
        shape from four samples on, whose strength is near that of the capture, and eight
        free ones from twelve on; below four there is none, and the total error of R_d includes
        all that the surface of skin reflects. R_d of
        captures with polarisers, measured behind crossed ones, is kept.
    """
    check(lumitexels, (*GEOMETRY, "surfel_normal", *REFINED), where="lumitexels")
    comparison = Comparison(
        "perceptual", eta, noise_floor(lumitexels), min_width=MIN_LOBE_WIDTH
    )
    names = tuple(
        dict.fromkeys((*GEOMETRY, "surfel_normal", *noise_inputs(lumitexels), *REFINED))
    )

    def kernel(arrays: Arrays) -> tuple[Array, ...]:
        lobes = shared_lobes(arrays, gloss)
        refined = refine_block(
            block_of(arrays),
            comparison,
            scan_normal=arrays["surfel_normal"],
            scan_error=float(np.deg2rad(scan_error) / np.sqrt(2)),
            gloss=gloss,
            lobes=lobes,
        )
        reflectance = np.clip(refined.diffuse, SMALLEST_R_D, LARGEST_R_D)
        columns = (
            refined.normal,
            np.degrees(refined.normal_error),
            _total_angle(refined, arrays["shading_normal"]),
            reflectance,
            refined.diffuse_error,
            _total_diffuse(refined, gloss, lobes),
            dipole_s(reflectance, eta=eta)[0],
        )
        converged = np.isfinite(refined.normal_error) & (refined.kkt < MAX_KKT)
        unchanged = REFINED[3:] if POLARISATION[0] in arrays else ()
        return tuple(
            arrays[name]
            if name in unchanged
            else np.where(
                converged[:, None] if column.ndim > 1 else converged,
                column,
                arrays[name],
            )
            for name, column in zip(REFINED, columns, strict=True)
        )

    return elementwise(
        by_name(kernel, names),
        lumitexels,
        over="surfel",
        inputs=names,
        outputs=REFINED,
    )


def shared_lobes(arrays: Arrays, gloss: Gloss) -> Array:
    """Strengths ([n,] 8), at factor 1, of the lobes of surfels with few samples."""
    if gloss.of_rig:
        return arrays[variables.LOBE_STRENGTH_APPLIED]
    return np.array([SHARED_LOBES])


def _total_diffuse(refined: JointFit, gloss: Gloss, lobes: Array) -> Array:
    """Total error (n, 3) of R_d, with what the surface may reflect more or less than it
    does elsewhere in the capture.
    """
    samples = refined.samples[:, None]
    model = np.where(
        samples < MIN_SAMPLES_GLOSS, MODEL_ERROR_LAMBERT, MODEL_ERROR_ALBEDO
    )
    if gloss.strength > 0:
        few = (samples >= MIN_SAMPLES_GLOSS) & (samples < MIN_SAMPLES_LOBES)
        surface = gloss.spread * (lobes @ LOBE_REFLECTANCE)
        model = np.hypot(model, np.where(few, surface[:, None], 0.0))
    return np.hypot(refined.diffuse_shared, model)


def _total_angle(refined: JointFit, sequential: Array) -> Array:
    """Total error (n,) of the normals [degree], which the errors of the samples alone do
    not explain: lobes of other shapes and partly hidden lights turn normals too.
    """
    cosine = dots(refined.normal, sequential)
    change = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    shared = np.degrees(refined.normal_shared)
    noise = np.degrees(refined.normal_error)
    factor = np.minimum(TOTAL_NOISE, np.sqrt(refined.samples))
    square = TOTAL_SHARED**2 * (shared**2 + change**2) + (factor * noise) ** 2
    return np.sqrt(square + TOTAL_ANGLE**2)
