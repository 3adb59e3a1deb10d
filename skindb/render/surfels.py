"""What a fitted surfel reflects, and the confidence of surfels and of texels of a map."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from skindb.errors import input_error, require
from skindb.geometry.interreflection import tangent_frames
from skindb.reflectance.kinds import even_diffuse, surface_model
from skindb.reflectance.model import Lamp, Points, ReflectanceModel
from skindb.render.scene import usable_surfels
from skindb.schema import (
    FitStatus,
    TexelStatus,
    Use,
    check,
    fitted_of,
    names_of,
    variables,
)
from skindb.schema.declaration import MAX_CONDITION_TRUSTED, MIN_SAMPLES_TRUSTED
from skindb.types import (
    Array,
    Bytes,
    Float32,
    Index32,
    dots,
    finite_rows,
    float64,
    lengths,
)

Codes = Bytes
STATUS = {FitStatus.FITTED: TexelStatus.MEASURED} | dict.fromkeys(
    (
        FitStatus.DIFFUSE_CLAMPED,
        FitStatus.NOT_CONVERGED,
        FitStatus.OBSTRUCTED,
        FitStatus.LAMBERT,
    ),
    TexelStatus.DOUBTFUL_FIT,
)
# confidence by `TexelStatus`
TRUST = np.array([1.0, 0.5, 0.5, 0.5, 0.0, 0.0, 0.0], np.float32)
NEEDED = (variables.SHADING_NORMAL, variables.DIFFUSE_REFLECTANCE, variables.FIT_STATUS)
ERROR_INPUTS = (
    variables.DIFFUSE_REFLECTANCE_TOTAL_ERROR,
    variables.SURFACE_REFLECTANCE,
    variables.SURFACE_REFLECTANCE_ERROR,
    variables.FIT_RESIDUAL,
    variables.SMALLEST_HALF_ANGLE,
)
MAX_LENGTH_ERROR = 1e-3  # of a unit direction; directions in half precision have 5e-4


def with_matt_surfels(fitted: xr.Dataset) -> xr.Dataset:
    """The surfels without gloss, instead of an unknown one, where three samples do not show it."""
    matt = fitted[variables.FIT_STATUS] == FitStatus.LAMBERT
    surface = [name for name in names_of(Use.SURFACE) if name in fitted]
    return fitted.assign({name: fitted[name].where(~matt, 0) for name in surface})


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
        finite = finite_rows(fitted[name].values.reshape(len(code), -1))
        code[~finite] = TexelStatus.FILLED
    return code


def surfel_confidence(fitted: xr.Dataset) -> Float32:
    """(n,) 1 for fitted surfels, 0.5 for doubtful fits, 0 for all others."""
    trust = TRUST[surfel_texels(fitted)]
    require(
        trust.any(),
        "fitted[fit_status]",
        "at least one surfel must be fitted for an export",
        "none",
        "see the report of the fit",
    )
    return trust


def texel_codes(
    code: Codes,
    triangles: NDArray[np.integer],
    face: Index32,
    weight: Float32,
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
    codes[on] = code[triangles[face[on], weight.argmax(axis=2)[on]]]
    return codes


def evaluate(model: xr.DataTree, surfel: int, wi: ArrayLike, wo: ArrayLike) -> Float32:
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
    rows, surface, to_light, to_camera, shape = _rows_of(model, surfel, wi, wo)
    points = _points(rows, surface, to_camera)
    f_r = _brdfs(surface, points, to_light, float(rows[variables.REFRACTIVE_INDEX]))
    return np.asarray(f_r.reshape(shape), np.float32)


def evaluate_error(
    model: xr.DataTree, surfel: int, wi: ArrayLike, wo: ArrayLike
) -> Float32:
    """Standard error of `evaluate`, which grows towards directions that nobody measured.

    The square root of the sum of the squares of

    - F_t(wi) F_t(wo) / pi times the total error of R_d,
    - the surface term times the relative error of `surface_reflectance`,
    - f_r times the relative residual of the fit, for what the model cannot describe,
    - if the angle theta_h is below `smallest_half_angle`: the difference between the
      surface term and that at this angle, which the model extrapolates.

    Held-out samples with known truth are within 1.96 times this error at the rates in
    docs/results.

    Parameters
    ----------
    model, surfel, wi, wo
        As in `evaluate`; the model is one that was fitted, not edited.

    Returns
    -------
    ndarray
        (..., 3) float32 [sr^-1]; NaN where an error is not stated, and 0 where f_r is.

    Raises
    ------
    InputError
        As `evaluate`.
    """
    check(fitted_of(model), ERROR_INPUTS, where="fitted")
    rows, surface, to_light, to_camera, shape = _rows_of(model, surfel, wi, wo)
    errors = reflectance_errors(rows, surface, to_light, to_camera)
    return np.asarray(errors.reshape(shape), np.float32)


def reflectance_errors(
    fitted: xr.Dataset, surface: ReflectanceModel, to_light: Array, to_camera: Array
) -> Array:
    """`evaluate_error` (n, 3) of n surfels for unit directions (n, 3), one of each."""
    eta = float(fitted[variables.REFRACTIVE_INDEX])
    points = _points(fitted, surface, to_camera)
    normal = points.normal
    total = _brdfs(surface, points, to_light, eta)
    gloss = points._replace(diffuse=np.zeros_like(normal))
    shown = _brdfs(surface, gloss, to_light, eta)
    turn = _to_measured(fitted, normal, to_light, to_camera)
    turned = gloss._replace(view=turn.apply(to_camera))
    measured = _brdfs(surface, turned, turn.apply(to_light), eta)
    none = np.zeros((len(normal), 0))
    unit = points._replace(diffuse=np.ones_like(normal), parameters=none)
    through = _brdfs(surface, unit, to_light, eta)
    albedo = fitted[variables.SURFACE_REFLECTANCE].values[:, None]
    relative = np.divide(
        fitted[variables.SURFACE_REFLECTANCE_ERROR].values[:, None],
        albedo,
        out=np.zeros_like(albedo),
        where=albedo > 0,
    )
    parts = (
        through * fitted[variables.DIFFUSE_REFLECTANCE_TOTAL_ERROR].values,
        relative * shown,
        fitted[variables.FIT_RESIDUAL].values[:, None] * total,
        shown - measured,
    )
    error = np.sqrt(sum(part**2 for part in parts))
    # a turned pair may be above the horizon where the given one is not
    return np.where(through > 0, error, 0.0)


def _to_measured(
    fitted: xr.Dataset, normal: Array, to_light: Array, to_camera: Array
) -> Rotation:
    """Rotations that bring the half vectors to the smallest angle that was measured; theta_d
    and phi_d stay. Where the half vector is the normal, it leaves the plane of incidence.
    """
    half = to_light + to_camera
    half /= np.maximum(lengths(half)[..., None], 1e-12)
    axis = np.cross(normal, half)
    sine = lengths(axis)[..., None]
    across = to_light - to_camera
    tangent = tangent_frames(normal)[:, 0]
    flat = lengths(across)[..., None] < 1e-6
    axis = np.where(sine > 1e-6, axis, np.where(flat, tangent, across))
    axis /= np.maximum(lengths(axis)[..., None], 1e-12)
    angle = np.arctan2(sine[:, 0], dots(normal, half))
    seen = np.radians(fitted[variables.SMALLEST_HALF_ANGLE].values.astype(np.float64))
    return Rotation.from_rotvec(np.maximum(seen - angle, 0.0)[:, None] * axis)


def _brdfs(
    surface: ReflectanceModel, points: Points, to_light: Array, eta: float
) -> Array:
    """f_r (n, 3) [sr^-1]; 0 where a direction is not above the horizon."""
    lit = np.ones((len(to_light), 1), np.float32)
    lamp = Lamp(to_light[:, None], lit, np.zeros(3), 0.0)
    radiance = surface.shade(points, lamp, eta=eta)
    # for a lamp at a distance of 1 mm, radiance per radiant intensity is f_r cos(theta_i) per mm2
    cosine = dots(points.normal, to_light)[:, None]
    seen = dots(points.normal, points.view)[:, None]
    above = (cosine > 0) & (seen > 0)
    return np.divide(radiance, cosine, out=np.zeros(radiance.shape), where=above)


def _points(fitted: xr.Dataset, surface: ReflectanceModel, to_camera: Array) -> Points:
    """Surfels as points, each seen from a direction (n, 3)."""
    normal = fitted[variables.SHADING_NORMAL].values.astype(np.float64)
    normal /= lengths(normal)[..., None]
    parameters = surface.parameters_of(fitted)
    position = np.zeros_like(normal)
    return Points(position, normal, to_camera, even_diffuse(fitted), parameters)


def _rows_of(
    model: xr.DataTree, surfel: int, wi: ArrayLike, wo: ArrayLike
) -> tuple[xr.Dataset, ReflectanceModel, Array, Array, tuple[int, ...]]:
    """One surfel, checked and repeated for every pair of directions, its surface model, the
    directions (n, 3), and their shape.
    """
    fitted = fitted_of(model)
    surface = surface_model(model["basis"].to_dataset())
    names = (*NEEDED, *surface.parameter_variables, variables.REFRACTIVE_INDEX)
    check(fitted, names, where="fitted")
    count = fitted.sizes["surfel"]
    require(
        0 <= surfel < count,
        "surfel",
        f"surfel must be an index from 0 to {count - 1}",
        str(surfel),
        "choose a surfel of this model",
    )
    to_light, to_camera = np.broadcast_arrays(_unit("wi", wi), _unit("wo", wo))
    shape = to_light.shape
    row = fitted.isel(surfel=[surfel]).compute()
    values = {name: np.asarray(row[name].values) for name in NEEDED}
    values["parameters"] = surface.parameters_of(row)
    if not usable_surfels(values)[0]:
        status = FitStatus(int(values[variables.FIT_STATUS][0]))
        raise input_error(
            f"fitted[fit_status] of surfel {surfel}",
            "the surfel must be fitted",
            f"the status {status.name} ({status.explanation})",
            "choose a surfel whose fit_status is FITTED",
        )
    to_light = to_light.reshape(-1, 3)
    rows = row.isel(surfel=np.zeros(len(to_light), int))
    return rows, surface, to_light, to_camera.reshape(-1, 3), shape


def _unit(name: str, direction: ArrayLike) -> Array:
    """Directions (..., 3) in double precision, checked to be unit vectors and then normalised."""
    vectors = float64(direction)
    require(
        vectors.ndim and vectors.shape[-1] == 3,
        name,
        "directions must have the shape (..., 3)",
        f"the shape {vectors.shape}",
        "put x, y, z last",
    )
    length = lengths(vectors)[..., None]
    if not (np.abs(length - 1) < MAX_LENGTH_ERROR).all():
        worst = length.flat[
            np.argmax(np.where(np.isfinite(length), np.abs(length - 1), np.inf))
        ]
        raise input_error(
            name,
            "directions must be unit vectors",
            f"a length of {worst:.4g}",
            "normalise them",
        )
    return vectors / length
