"""Corrections of the samples before a fit: gains of the lights, and light that other
parts of the face reflect with one diffuse bounce.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from skindb.errors import require
from skindb.fit.lumitexels import POLARISATION, cosines, directions
from skindb.geometry.interreflection import bounce_transfer, tangent_frames
from skindb.optics.fresnel import fresnel_transmittance
from skindb.schema import check, dataset
from skindb.types import AnyArray, Array, Float32, Index, finite_rows, float64, lengths

# surfels in a camera that are used: twice as many changed gains by 0.1 to 0.4 %, at
# most 2.2 %
VIEWS = 6_000
MIN_COSINE_GAIN = 0.25  # to light and camera; below it F_t changes too fast
MIN_HALF_ANGLE = 25.0  # degrees between half vector and normal; highlights are narrower
# number of smooth functions that model the shading; required lights in excess of it
SMOOTH = 3
SPARE = 3
# range of sample over smooth model; outside it are shadows, hair and motion, not gains
LOWEST = 0.5
HIGHEST = 1.5
# relative to the median; ratios to smaller values are unreliable
SMALLEST_SHADING = 0.2
# weight of the prior that gains are 1, relative to the information of the views on the
# median light. Chosen on three captures of measured materials; on these and on two with
# other surfaces, with errors of the lights of 0 to 15 %, errors of 0.2 to 2.5 % remain
# (docs/results).
PRIOR = 0.03
# the same of the prior that a light is where it is stated, per rad^2: 0.3 to 1 predict eight
# faces under strobes within 0.05 points; 0.03 is worse by 0.2, and 2 by 0.15
PRIOR_TURN = 0.3
TURN = 1e-3  # rad, for derivatives
ROUNDS = 10  # in which rows that lack different gains are made relative to each other
# `gain_spread` of gains that are used: estimates for correct lights have 0.2 to 1.0 % on nine
# captures with known truth; planted 3 % are above it
MIN_GAIN_SPREAD = 0.02
SURFELS_PER_BLOCK = 2048  # whose bounced light is gathered at once
NEEDED = ("surfel_position", "surfel_normal", "light_position", "camera_position")


def estimate_light_gains(
    lumitexels: xr.Dataset,
    *,
    rng: np.random.Generator,
    eta: float = 1.3,
) -> xr.Dataset:
    """Ratio of the true to the calibrated intensity of each light, by comparison of
    samples under different lights.

    Away from highlights, one camera sees diffuse light from a surfel: F_t times a
    linear function of the direction of the light, which is a cosine with some normal.
    The gains are chosen so that the samples of all surfels are as close to such
    functions as possible: a least-squares problem that is linear in the inverse gains
    after the functions are eliminated (variable projection, Golub and Pereyra 1973).
    Gains that are smooth over the dome cannot be distinguished from rotated normals; a
    prior keeps them at 1.

    Parameters
    ----------
    lumitexels
        Samples with geometry and `surfel_normal`.
    rng
        Selects the surfels that are used.
    eta
        Refractive index of F_t.

    Returns
    -------
    Dataset
        `light_gain` (light), whose median over the lights with usable surfels is 1, as the
        gain of the others. Errors
        of up to 2.5 % remained on captures with known truth: use the gains for lights
        whose intensities are less accurate than this.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> gains = estimate_light_gains(lumitexels(capture), rng=rng)  # doctest: +SKIP
    """
    light = float64(lumitexels["light_position"].values)
    matrix = _residual_form(lumitexels, [light], rng=rng, eta=eta)
    gain = _solved(matrix, len(light))[0]
    return dataset(
        {"light_gain": np.nan_to_num(gain, nan=1.0)},
        coords={"light": lumitexels["light"].values}
        if "light" in lumitexels.coords
        else None,
    )


class LightErrors(NamedTuple):
    """Gains (light,), whose median is 1, and offsets (light, 3) mm of the true from the
    stated position, across the direction to the light; NaN for unseen lights.
    """

    gain: Array
    offset: Array


@dataclass(frozen=True)
class LightResiduals:
    """Residuals of the samples of a take from functions that are smooth over the dome,
    by gains and offsets of the lights; see `light_residuals`.
    """

    form: Array  # (3 light, 3 light), see `_residual_form`
    axes: Array  # (2, light, 3) mm/rad across the directions to the lights
    applied: LightErrors  # with which the samples were made

    def of_lights(self, places: Sequence[int], lights: int) -> LightResiduals:
        """The same among the lights of a rig, in which they have some of the places; the
        take knows nothing of the others.
        """
        place = np.array(places)
        index = (np.arange(3)[:, None] * lights + place).ravel()
        form = np.zeros((3 * lights, 3 * lights))
        form[np.ix_(index, index)] = self.form
        axes = np.ones((2, lights, 3))
        axes[:, place] = self.axes
        gain, offset = np.ones(lights), np.zeros((lights, 3))
        gain[place], offset[place] = self.applied
        return LightResiduals(form, axes, LightErrors(gain, offset))

    def errors(self, *, turned: bool) -> LightErrors:
        """Gains, and offsets if `turned` or else those that were applied, with the
        smallest residual.

        Lights that are turned together cannot be distinguished from turned normals, nor
        distances from gains: a prior keeps offsets and gains small.
        """
        lights = len(self.applied.gain)
        form = self.form if turned else self.form[:lights, :lights]
        gain, *turns = _solved(form, lights)
        gain = gain * self.applied.gain
        offset = np.where(np.isnan(gain)[:, None], np.nan, self.applied.offset)
        if turned:
            offset = offset + np.einsum("il,ilk->lk", np.array(turns), self.axes)
        known = gain[np.isfinite(gain)]
        return LightErrors(gain / np.median(known) if known.size else gain, offset)

    def misfit(self, errors: LightErrors) -> float:
        """Root of the sum of squared relative residuals with gains and offsets that
        other takes found; lights of which they know nothing keep those applied.
        """
        unseen = np.isnan(errors.gain) | (
            np.diagonal(self.form)[: len(errors.gain)] == 0
        )
        inverse = np.ones(len(unseen))
        if not unseen.all():
            known = (self.applied.gain / errors.gain)[~unseen]
            inverse[~unseen] = known / np.median(known)
        move = np.where(unseen[:, None], 0.0, errors.offset - self.applied.offset)
        square = np.square(self.axes).sum(axis=2)
        turns = np.einsum("ilk,lk->il", self.axes, move) / square
        x = np.concatenate([inverse, *turns])
        return float(np.sqrt(x @ self.form @ x))


def light_residuals(
    lumitexels: xr.Dataset,
    *,
    rng: np.random.Generator,
    eta: float = 1.3,
    applied: LightErrors | None = None,
) -> LightResiduals:
    """What the samples of a take say about gains and offsets of its lights, as in
    `estimate_light_gains` with two more unknowns for each light.

    Parameters
    ----------
    lumitexels, rng, eta
        See `estimate_light_gains`.
    applied
        Gains and offsets of a calibration, with which the samples were made; default
        none.
    """
    light = float64(lumitexels["light_position"].values)
    away = light - lumitexels["surfel_position"].values.mean(axis=0, dtype=np.float64)
    distance = lengths(away)[:, None]
    axes = (tangent_frames(away / distance)[:, :2] * distance[:, None]).swapaxes(0, 1)
    moved = [light, *(light + TURN * axis for axis in axes)]
    form = _residual_form(lumitexels, moved, rng=rng, eta=eta)
    none = LightErrors(np.ones(len(light)), np.zeros((len(light), 3)))
    return LightResiduals(form, axes, applied or none)


def estimate_camera_gains(
    lumitexels: xr.Dataset, *, rng: np.random.Generator, eta: float = 1.3
) -> xr.DataArray:
    """Ratio of the true to the calibrated sensitivity of each camera, by comparison of the
    diffuse light that several cameras see from the same surfels.

    Parameters
    ----------
    lumitexels, rng, eta
        See `estimate_light_gains`.

    Returns
    -------
    DataArray
        (camera, channel), whose median over the cameras is 1 in every channel; NaN for
        cameras that share no usable surfel with others, and with polarisers, behind which
        cameras see different parts of the light from the surface.
    """
    few, lights = _chosen(lumitexels, rng)
    samples = float64(few["reflectance_sample"].values)
    shape = (samples.shape[0], *samples.shape[2:])
    logs = np.full(shape, np.nan)
    for view in _views(few, [lights], eta=eta):
        seen = samples[view.surfel, view.lights, view.camera]
        columns = view.shading[0][view.lights]
        if _smooth(columns, seen.mean(axis=1)) is None:
            continue
        level = np.linalg.lstsq(columns, seen)[0][2]
        leaves = fresnel_transmittance(view.cosine, eta)
        if (level > 0).all():
            logs[view.surfel, view.camera] = np.log(level / leaves)
    logs[finite_rows(logs).sum(axis=1) < 2] = np.nan
    gains = np.full(shape[1:], np.nan)
    shared = np.isfinite(logs).any(axis=(0, 2))
    if shared.any() and not all(name in lumitexels for name in POLARISATION):
        gains[shared] = np.stack(
            [
                np.nanmedian(aligned(x), axis=0)
                for x in np.moveaxis(logs[:, shared], 2, 0)
            ],
            axis=1,
        )
        gains = np.exp(gains - np.median(gains[shared], axis=0))
    names = {"camera": np.arange(shape[1]), "channel": np.arange(shape[2])}
    coords = {name: lumitexels.coords.get(name, names[name]) for name in names}
    return xr.DataArray(gains, coords, [*names])


def aligned(logs: Array) -> Array:
    """Logarithms (n, m) of gains, relative to those that all rows have in common, as each
    row may lack others.
    """
    known = np.isfinite(logs).any(axis=1)
    even = logs.copy()
    even[known] -= np.nanmedian(logs[known], axis=1, keepdims=True)
    for _ in range(ROUNDS):
        middle = np.nanmedian(even, axis=0)
        middle -= np.median(middle)
        even[known] -= np.nanmedian(even[known] - middle, axis=1, keepdims=True)
    return even


def gain_spread(logs: Array, towards: Array) -> float:
    """Standard deviation of logarithms (light,) of gains without what is linear in the
    directions (light, 3) to the lights, as turned normals and bounced light are; NaN if
    no more than one is finite.
    """
    known = np.isfinite(logs)
    linear = np.column_stack([np.ones(known.sum()), towards[known]])
    if len(linear) < 2 * linear.shape[1]:
        linear = linear[:, :1]
    rest = logs[known] - linear @ np.linalg.lstsq(linear, logs[known])[0]
    spare = len(linear) - linear.shape[1]
    return float(np.sqrt(np.square(rest).sum() / spare)) if spare > 0 else np.nan


def divided_by_gains(lumitexels: xr.Dataset, light_gain: xr.DataArray) -> xr.Dataset:
    """The samples divided by the gains of their lights."""
    sample = lumitexels["reflectance_sample"]
    gain = light_gain.variable.astype(np.float32)
    right = (sample.astype(np.float32) / gain).astype(sample.dtype)
    return lumitexels.assign(
        reflectance_sample=right.transpose(*sample.dims).assign_attrs(sample.attrs)
    )


def summarise_gains(gains: xr.Dataset) -> dict[str, Any]:
    """Standard deviation of the gains, and the light whose gain is farthest from 1, for
    attributes.
    """
    gain = gains["light_gain"].values
    names = gains["light"].values if "light" in gains.coords else np.arange(gain.size)
    far = int(np.abs(np.log(gain)).argmax())
    return {
        "spread": float(gain.std()),
        "light": str(names[far]),
        "gain": float(gain[far]),
    }


def _residual_form(
    lumitexels: xr.Dataset,
    lights: Sequence[Array],
    *,
    rng: np.random.Generator,
    eta: float,
) -> Array:
    """Squared residuals of smooth functions, as a quadratic form in the inverse gains
    and in the angles [rad] by which the lights are moved towards further positions.

    Parameters
    ----------
    lumitexels, rng, eta
        See `estimate_light_gains`.
    lights
        Stated positions (light, 3), and positions at an angle of `TURN` from them.

    Returns
    -------
    ndarray
        (p light, p light) for p sets of positions.
    """
    few, _ = _chosen(lumitexels, rng)
    samples = float64(few["reflectance_sample"].values).mean(axis=3)
    matrix = np.zeros((len(lights) * samples.shape[1],) * 2)
    for view in _views(few, lights, eta=eta):
        _add_view(
            samples[view.surfel, :, view.camera], view.shading, view.lights, matrix
        )
    return matrix


def _chosen(
    lumitexels: xr.Dataset, rng: np.random.Generator
) -> tuple[xr.Dataset, Array]:
    """Samples and geometry of the surfels that are used, and positions of the lights."""
    names = ("reflectance_sample", *NEEDED)
    check(lumitexels, names, where="lumitexels")
    surfels = lumitexels.sizes["surfel"]
    count = min(-(-VIEWS // lumitexels.sizes["camera"]), surfels)
    chosen = np.sort(rng.choice(surfels, count, replace=False))
    few = lumitexels[list(names)].isel(surfel=chosen).compute()
    return few, float64(few["light_position"].values)


class _View(NamedTuple):
    """A surfel in a camera, and the lights whose samples are finite, neither grazing nor
    near a highlight.
    """

    surfel: int
    camera: int
    cosine: float  # to the camera
    shading: Sequence[Array]  # (light, SMOOTH) for each set of positions of the lights
    lights: Index


def _views(few: xr.Dataset, lights: Sequence[Array], *, eta: float) -> Iterator[_View]:
    """Views of enough lights."""
    finite = finite_rows(few["reflectance_sample"].values)
    position, normal, camera = (
        float64(few[name].values) for name in (*NEEDED[:2], NEEDED[3])
    )
    to_light = directions(position, lights[0])
    to_camera = directions(position, camera)
    square = _square_distance(position, lights[0])
    # direction, and irradiance over that of the stated position
    moved = [
        (directions(position, light), square / _square_distance(position, light))
        for light in lights
    ]
    lit = cosines(normal, to_light)
    seen = cosines(normal, to_camera)
    for i, axes in enumerate(tangent_frames(normal)):
        shading = [
            _shading(towards[i] @ axes.T, eta) * nearer[i, :, None]
            for towards, nearer in moved
        ]
        for c in np.flatnonzero(seen[i] > MIN_COSINE_GAIN):
            half = (lit[i] + seen[i, c]) / np.linalg.norm(
                to_light[i] + to_camera[i, c], axis=1
            )
            usable = (lit[i] > MIN_COSINE_GAIN) & (
                half < np.cos(np.radians(MIN_HALF_ANGLE))
            )
            at = np.flatnonzero(usable & finite[i, :, c])
            if len(at) >= SMOOTH + SPARE:
                yield _View(i, int(c), seen[i, c], shading, at)


def _smooth(columns: Array, seen: Array) -> Array | None:
    """Coefficients (SMOOTH,) of the smooth function that is nearest to samples (light,);
    None if a sample is far from it, or the function near 0.
    """
    smooth = np.linalg.lstsq(columns, seen)[0]
    fitted = columns @ smooth
    if fitted.min() <= SMALLEST_SHADING * max(np.median(fitted), 0.0):
        return None
    ratio = seen / fitted
    return None if ratio.min() < LOWEST or ratio.max() > HIGHEST else smooth


def _add_view(
    sample: Array, shading: Sequence[Array], at: Index, matrix: Array
) -> None:
    """Add to `matrix` the squared residuals of a smooth function for the samples of
    lights `at`; `shading` (light, SMOOTH) for each set of positions.
    """
    columns = shading[0][at]
    smooth = _smooth(columns, sample[at])
    if smooth is None:
        return
    fitted = columns @ smooth
    q, _ = np.linalg.qr(columns / fitted[:, None])
    changes = [
        sample[at] / fitted,
        *((fitted - s[at] @ smooth) / fitted / TURN for s in shading[1:]),
    ]
    slope = np.concatenate(
        [np.diag(change) - q @ (q.T * change) for change in changes], axis=1
    )
    lights = len(sample)
    index = np.concatenate([k * lights + at for k in range(len(shading))])
    matrix[np.ix_(index, index)] += slope.T @ slope


def _solved(form: Array, lights: int) -> Array:
    """Gains, and angles [rad] about each axis of the form, (p, light); NaN where it has
    no information.
    """
    information = np.diagonal(form)[:lights]
    known = information > 0
    if not known.any():
        return np.full((len(form) // lights, lights), np.nan)
    is_gain = np.arange(len(form)) < lights
    scale = float(np.median(information[known]))
    prior = scale * np.where(is_gain, PRIOR, PRIOR_TURN)
    solved = np.linalg.solve(form + np.diag(prior), is_gain * prior).reshape(-1, lights)
    gain = 1 / solved[0]
    solved[0] = gain / np.median(gain[known])
    return np.where(known, solved, np.nan)


def _shading(direction: Array, eta: float) -> Array:
    """F_t times each coordinate (light, SMOOTH) of directions (light, 3) in the frame
    of the surfel.
    """
    enters = fresnel_transmittance(np.clip(direction[:, 2], MIN_COSINE_GAIN, 1.0), eta)
    return direction * enters[:, None]


def bounced_light(
    lumitexels: xr.Dataset,
    diffuse: AnyArray,
    visible: AnyArray,
    triangles: AnyArray,
    *,
    eta: float = 1.3,
    receivers: Index | slice = slice(None),
) -> Float32:
    """Light that reaches each surfel after one diffuse reflection elsewhere, relative
    to the direct light facing it.

    Rays are traced from every surfel to the first hit, where light of each lamp that is
    not in shadow enters by F_t, leaves by R_d / pi and F_t, and enters the surfel by
    F_t. The intensity of a lamp is assumed equal towards the whole face, its distance
    is not.

    Parameters
    ----------
    lumitexels
        `surfel_position`, `surfel_normal`, `light_position`.
    diffuse
        R_d (surfel, channel); NaN is replaced by the median.
    visible
        (surfel, light) visible fraction of the lights' discs.
    triangles
        (f, 3) of the surfels.
    eta
        Refractive index of F_t.
    receivers
        Indices of the surfels that are wanted; default all.

    Returns
    -------
    ndarray
        (receiver, light, channel): transmitted irradiance over that of a surface that
        faces the light.
    """
    check(lumitexels, NEEDED, where="lumitexels")
    position, normal, light = (float64(lumitexels[name].values) for name in NEEDED[:3])
    require(
        len(position) == len(visible) == len(diffuse),
        "inter-reflection",
        "samples, visibility and R_d must be of the same surfels",
        f"{len(position)}, {len(visible)} and {len(diffuse)} surfels",
        "run skindb ingest --again",
    )
    reflectance = np.where(
        np.isfinite(diffuse), diffuse, np.nanmedian(diffuse, axis=0)
    ).astype(np.float32)
    wanted = np.arange(len(position))[receivers]
    transmittance = partial(fresnel_transmittance, eta=eta)
    transfer = bounce_transfer(
        position, normal, triangles, transmittance, receivers=wanted
    )
    senders = np.unique(transfer.indices)
    transfer = transfer[:, senders]
    # transmitted light of each lamp over its intensity
    lit = cosines(normal[senders], directions(position[senders], light))
    enters = (
        np.maximum(lit, 0)
        * fresnel_transmittance(np.clip(lit, 1e-3, 1), eta)
        * np.nan_to_num(visible[senders])
    )
    sent = (enters / _square_distance(position[senders], light)).astype(np.float32)
    out = np.zeros((len(wanted), len(light), reflectance.shape[1]), np.float32)
    for begin in range(0, len(wanted), SURFELS_PER_BLOCK):
        block = slice(begin, begin + SURFELS_PER_BLOCK)
        square = _square_distance(position[wanted[block]], light)
        for c in range(reflectance.shape[1]):
            reflected = transfer[block].multiply(reflectance[senders, c]).tocsr()
            out[block, :, c] = (reflected @ sent) * square
    return out


def _square_distance(points: Array, light: Array) -> Array:
    """(n, l) squared distances in mm^2."""
    return np.square(points[:, None] - light).sum(axis=2)


def without_bounce(
    lumitexels: xr.Dataset,
    bounced: Float32,
    diffuse: AnyArray,
    *,
    eta: float = 1.3,
) -> xr.Dataset:
    """The samples minus the contribution of `bounced_light`, which is F_t R_d / pi of
    it towards each camera.
    """
    position, normal, camera = (
        float64(lumitexels[name].values)
        for name in ("surfel_position", "surfel_normal", "camera_position")
    )
    seen = cosines(normal, directions(position, camera))
    leaves = (fresnel_transmittance(np.clip(seen, 1e-3, 1), eta) / np.pi).astype(
        np.float32
    )
    back = bounced * np.nan_to_num(diffuse)[:, None].astype(np.float32)
    sample = lumitexels["reflectance_sample"]
    arrives = xr.Variable(("surfel", "light", "channel"), back)
    towards = xr.Variable(("surfel", "camera"), leaves)
    # otherwise the contribution to all samples would be computed at once
    if sample.chunks is not None:
        arrives, towards = (
            variable.chunk({"surfel": sample.chunksizes["surfel"]})
            for variable in (arrives, towards)
        )
    direct = (
        (sample.astype(np.float32) - arrives * towards)
        .clip(min=0)
        .astype(sample.dtype)
        .transpose(*sample.dims)
    )
    return lumitexels.assign(reflectance_sample=direct.assign_attrs(sample.attrs))
