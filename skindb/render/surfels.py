"""What a fitted surfel reflects, and the confidence of surfels and of texels of a map."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from skindb.errors import Fault, InputError
from skindb.reflectance.kinds import even_diffuse, surface_model
from skindb.reflectance.model import Lamp, Points, ReflectanceModel
from skindb.render.scene import usable_surfels
from skindb.schema import FitStatus, TexelStatus, Use, check, names_of, variables
from skindb.schema.declaration import MAX_CONDITION_TRUSTED, MIN_SAMPLES_TRUSTED
from skindb.types import Array

Codes = NDArray[np.uint8]
STATUS = {FitStatus.FITTED: TexelStatus.MEASURED} | dict.fromkeys(
    (FitStatus.DIFFUSE_CLAMPED, FitStatus.NOT_CONVERGED, FitStatus.OBSTRUCTED),
    TexelStatus.DOUBTFUL_FIT,
)
# confidence by `TexelStatus`
TRUST = np.array([1.0, 0.5, 0.5, 0.5, 0.0, 0.0, 0.0], np.float32)
NEEDED = (variables.SHADING_NORMAL, variables.DIFFUSE_REFLECTANCE, variables.FIT_STATUS)
MAX_LENGTH_ERROR = 1e-3  # of a unit direction; directions in half precision have 5e-4


def surfel_texels(fitted: xr.Dataset) -> Codes:
    """(n,) codes of `TexelStatus`, which depend on the condition and number of samples
    of fits if these are stored.

    Edited models do not store them.
    """
    status = fitted[variables.FIT_STATUS].values
    code = np.full(status.shape, TexelStatus.FILLED, np.uint8)
    for member, value in STATUS.items():
        code[status == member] = value
    for name, doubt in (
        (variables.FIT_SAMPLES, TexelStatus.FEW_SAMPLES),
        (variables.FIT_CONDITION, TexelStatus.ILL_CONDITIONED),
    ):
        if name in fitted:
            values = fitted[name].values
            wrong = (
                values < MIN_SAMPLES_TRUSTED
                if name == variables.FIT_SAMPLES
                else values > MAX_CONDITION_TRUSTED
            )
            code[wrong & (code < TexelStatus.FILLED)] = doubt
    surface = [name for name in names_of(Use.SURFACE) if name in fitted]
    needed = (variables.SHADING_NORMAL, variables.DIFFUSE_REFLECTANCE, *surface)
    for name in needed:
        finite = np.isfinite(fitted[name].values.reshape(len(code), -1)).all(axis=1)
        code[~finite] = TexelStatus.FILLED
    return code


def surfel_confidence(fitted: xr.Dataset) -> NDArray[np.float32]:
    """(n,) 1 for fitted surfels, 0.5 for doubtful fits, 0 for all others."""
    trust: NDArray[np.float32] = TRUST[surfel_texels(fitted)]
    if not trust.any():
        rule = "at least one surfel must be fitted for an export"
        raise InputError(
            Fault("fitted[fit_status]", rule, "none", "see the report of the fit")
        )
    return trust


def texel_codes(
    code: Codes,
    triangles: NDArray[np.integer],
    face: NDArray[np.int32],
    weight: NDArray[np.float32],
) -> Codes:
    """(size, size) codes of texels: on the surface that of the nearest surfel; openings
    are holes that it encloses.
    """
    empty = face < 0
    piece, n = ndimage.label(empty)
    open_to_border = np.zeros(n + 1, bool)
    for border in (piece[0], piece[-1], piece[:, 0], piece[:, -1]):
        open_to_border[border] = True
    codes = np.where(
        open_to_border[piece], TexelStatus.OUTSIDE, TexelStatus.OPENING
    ).astype(np.uint8)
    on = ~empty
    codes[on] = code[triangles[face[on], weight[on].argmax(axis=1)]]
    return codes


def evaluate(
    model: xr.DataTree, surfel: int, wi: ArrayLike, wo: ArrayLike
) -> NDArray[np.float32]:
    """BRDF f_r of one surfel, as used in rendering (Weyrich et al. 2005, eq. 1 to 4 and 8).

        f_r(wi, wo) = F_t(wi) F_t(wo) R_d / pi + sum_k w_k b_k(theta_h, theta_d, phi_d)

    F_t is the Fresnel transmittance at the model's refractive index, R_d the surfel's
    diffuse reflectance per channel plus `even_reflection`, and w_k its weights of the
    reduced basis b_k, which is the same for all channels. The angles are those of
    Rusinkiewicz about the surfel's shading normal.

    Parameters
    ----------
    model
        Version of kind "model": groups fitted and basis.
    surfel
        Index of the surfel along the dimension surfel, from 0.
    wi, wo
        (..., 3) unit vectors in head coordinates that point away from the surface: to
        the light and to the camera. Their leading dimensions are broadcast against each
        other.

    Returns
    -------
    ndarray
        (..., 3) float32 f_r in R, G, B [sr^-1]. 0 where either direction is at or below
        the horizon of the shading normal.

    Raises
    ------
    InputError
        If the model does not match the schema, the surfel is out of range or was not
        fitted, or the directions are not unit vectors.

    Notes
    -----
    f_r does not contain the cosine of the incident light: reflected radiance is f_r
    times irradiance, and the samples of a capture are f_r cos(theta_i). Where
    `disc_angular_radius` of the basis is above 0, its tables are averaged over the disc
    of the dome's lights, and so is the surface term returned here. The diffuse term
    describes light that leaves where it enters; a BRDF does not include subsurface
    transport between surfels.

    Examples
    --------
    >>> f_r = evaluate(model, 1200, wi=[0.0, 0.0, 1.0], wo=[0.0, 0.6, 0.8])  # doctest: +SKIP
    """
    fitted = model["fitted"].to_dataset()
    basis = model["basis"].to_dataset()
    reflectance = surface_model(basis)
    names = (*NEEDED, *reflectance.parameter_variables, variables.REFRACTIVE_INDEX)
    check(fitted, names, where="fitted")
    values = _values_of(fitted, surfel, reflectance)
    to_light, to_camera = np.broadcast_arrays(_unit("wi", wi), _unit("wo", wo))
    shape = to_light.shape
    to_light = to_light.reshape(-1, 3)
    to_camera = to_camera.reshape(-1, 3)
    normal, diffuse, parameters = (
        np.broadcast_to(values[name], (len(to_light), values[name].shape[1]))
        for name in (
            variables.SHADING_NORMAL,
            variables.DIFFUSE_REFLECTANCE,
            "parameters",
        )
    )
    points = Points(np.zeros_like(to_light), normal, to_camera, diffuse, parameters)
    lit = np.ones((len(to_light), 1), np.float32)
    lamp = Lamp(to_light[:, None], lit, np.zeros(3), 0.0)
    radiance = reflectance.shade(
        points, lamp, eta=float(fitted[variables.REFRACTIVE_INDEX])
    )
    # for a lamp at a distance of 1 mm, radiance per radiant intensity is f_r cos(theta_i) per mm2
    cosine = np.einsum("nc,nc->n", normal, to_light)[:, None]
    above = (cosine > 0) & (np.einsum("nc,nc->n", normal, to_camera)[:, None] > 0)
    f_r = np.divide(radiance, cosine, out=np.zeros(radiance.shape), where=above)
    return np.asarray(f_r.reshape(shape), np.float32)


def _values_of(
    fitted: xr.Dataset, surfel: int, reflectance: ReflectanceModel
) -> dict[str, Array]:
    """Values of `NEEDED` and the parameters of one surfel, each with a leading dimension of
    length one.
    """
    count = fitted.sizes["surfel"]
    if not 0 <= surfel < count:
        rule = f"surfel must be an index from 0 to {count - 1}"
        raise InputError(
            Fault("surfel", rule, str(surfel), "choose a surfel of this model")
        )
    names = [*NEEDED, *reflectance.parameter_variables]
    names += [variables.EVEN_REFLECTION] * (variables.EVEN_REFLECTION in fitted)
    row = fitted[names].isel(surfel=[surfel]).compute()
    values = {name: np.asarray(row[name].values) for name in NEEDED}
    values[variables.DIFFUSE_REFLECTANCE] = even_diffuse(row)
    values["parameters"] = reflectance.parameters_of(row)
    if not usable_surfels(values)[0]:
        status = FitStatus(int(values[variables.FIT_STATUS][0]))
        reason = f"the status {status.name} ({status.explanation})"
        cure = "choose a surfel whose fit_status is FITTED"
        raise InputError(
            Fault(
                f"fitted[fit_status] of surfel {surfel}",
                "the surfel must be fitted",
                reason,
                cure,
            )
        )
    return values


def _unit(name: str, direction: ArrayLike) -> Array:
    """Directions (..., 3) in double precision, checked to be unit vectors and then normalised."""
    vectors = np.asarray(direction, np.float64)
    if vectors.ndim == 0 or vectors.shape[-1] != 3:
        shape = f"the shape {vectors.shape}"
        raise InputError(
            Fault(
                name,
                "directions must have the shape (..., 3)",
                shape,
                "put x, y, z last",
            )
        )
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    if not (np.abs(length - 1) < MAX_LENGTH_ERROR).all():
        worst = length.flat[
            np.argmax(np.where(np.isfinite(length), np.abs(length - 1), np.inf))
        ]
        raise InputError(
            Fault(
                name,
                "directions must be unit vectors",
                f"a length of {worst:.4g}",
                "normalise them",
            )
        )
    return np.asarray(vectors / length)
