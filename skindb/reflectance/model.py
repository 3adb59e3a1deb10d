"""What a surface model is: the Protocol that fits, renderers and exports know, and the
records that it exchanges with them.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
import xarray as xr

from skindb.reflectance.dictionary import Dictionary
from skindb.reflectance.tables import Table
from skindb.schema.notes import Omission
from skindb.types import AnyArray, Array, Float32, Index

# `Comparison.min_width` of fits: the peaks of narrower lobes would be extrapolated
MIN_LOBE_WIDTH = 2.0 / 3.0
MAX_TABLES = 8  # that the viewer shows: two textures of four channels each


class Noise(NamedTuple):
    """Noise model of the samples of n surfels, mean over the channels; see UNKNOWN_NOISE."""

    per_radiance: Float32  # (n, lights) reflectance of radiance 1
    pixels: Float32  # (n, cameras) effective number of pixels
    # (cameras, exposures) radiance up to which an exposure is usable, from the longest
    limit: Float32
    read: Float32  # (cameras, exposures) variance of radiance 0
    slope: Float32  # (cameras, exposures) variance over radiance


UNKNOWN_NOISE = Noise(*[np.zeros((0, 0), np.float32)] * 5)


class Block(NamedTuple):
    """Samples of n surfels, with all that a fit of their surface needs."""

    sample: AnyArray  # (n, lights, cameras, 3) sr^-1; half floats, or their bits
    position: AnyArray  # (n, 3) mm
    light: AnyArray  # (lights, 3) mm
    camera: AnyArray  # (cameras, 3) mm
    normal: AnyArray  # (n, 3) unit shading normals
    diffuse: AnyArray  # (n, 3) R_d
    noise: Noise = UNKNOWN_NOISE
    # (lights, cameras) product of their degrees of circular polarisation; (0, 0) without
    # polarisers
    polarisation: AnyArray = np.zeros((0, 0))


class Comparison(NamedTuple):
    """How samples are compared with a prediction, and which are used."""

    mode: str = "perceptual"  # or "linear"
    eta: float = 1.3  # refractive index of the diffuse term
    noise_floor: float = 1.0  # sr^-1; samples below it are compared linearly
    min_samples: int = 1  # per surfel
    # half width of the narrowest lobe of a surfel over the smallest angle between its
    # normal and a half vector; 0: lobes of any width
    min_width: float = 0.0


class Judgement(NamedTuple):
    """What `ReflectanceModel.fit` finds in addition to parameters."""

    # (n, 3) standard errors of R_d, and (n,) RMS angles to the true normals [degree];
    # None to skip the errors of the parameters
    diffuse_error: Array | None = None
    normal_error: Array | None = None
    # (lights, cameras) 0 for samples that are fitted, 1 under held-out lights, 2 in
    # held-out cameras, 3 for both
    held: Index | None = None
    outliers: bool = False


NO_JUDGEMENT = Judgement()


class SurfaceFit(NamedTuple):
    """Results of a fit of n surfels; NaN where the status says that nothing was fitted."""

    parameters: Array  # (n, p)
    # (n,), as are the following arrays: gradient by the free parameters, relative; 0 at
    # the minimum
    kkt: Array
    residual: Array  # RMS error over RMS of the samples, diffuse light included
    residual_perceptual: Array  # the same in cube-root space
    # lower bound of the condition number of the parameters; surfels above
    # `MAX_CONDITION_TRUSTED` are doubtful
    condition: Array
    samples: AnyArray
    # smallest angle between the normal and a half vector of the samples [degree]
    half_angle: Array
    iterations: AnyArray
    status: AnyArray
    # (n, p, p) of the parameters that are not at a bound, NaN for the others; (n, 0, 0)
    # without errors
    covariance: Array
    # (n, 2, 2) relative errors at held-out lights and in held-out cameras, linear and
    # in cube roots
    held_error: Array
    outlier: Array  # (n,) fraction of outlying samples
    # (lights, cameras, bins) histograms of scaled residuals, the sum over the surfels
    counts: Index


class Points(NamedTuple):
    """Points of a surface that a camera sees."""

    position: Array  # (n, 3) mm
    normal: Array  # (n, 3) unit
    view: Array  # (n, 3) unit directions towards the camera
    diffuse: Array  # (n, 3) R_d; zeros omit the diffuse term
    parameters: Array  # (n, p); (n, 0) omits the surface term


class Lamp(NamedTuple):
    """A disc light as seen from n points."""

    # (n, q, 3) points [mm] that represent equal parts of the light's disc
    place: Array
    # (n, q) visible fraction, 0 to 1, of the part of the disc that each represents
    lit: Float32
    axis: Array  # (3,) unit direction in which the light shines
    falloff: float  # exponent n of its fall-off cos^n


class FitRequest(NamedTuple):
    """What a surface model is made from before the first pass of a fit."""

    eta: float  # refractive index of skin
    disc_angular_radius: float  # of the lights as seen from the surfels [rad]
    rank: int  # of the reduced dictionary
    k: int  # components that the model is reduced to after the first pass
    dictionary: Dictionary | None = None  # for point lights; default the embedded one


class ReflectanceModel(Protocol):
    """The reflection at the surface of a take: what all surfels share.

    Each surfel has p parameters of its own. The diffuse term (eq. 4) is the same for all
    models: light reaches the camera by F_t(i) F_t(o) R_d / pi plus the surface term.
    """

    @property
    def disc_included(self) -> bool:
        """Whether the surface term is that of the round lights of the dome."""

    @property
    def parameter_variables(self) -> tuple[str, ...]:
        """Variables of the group "fitted" that hold the parameters."""

    @property
    def fit_variables(self) -> tuple[str, ...]:
        """Variables of the group "fitted" that `fit_columns` returns."""

    @property
    def labels(self) -> dict[str, tuple[str, ...]]:
        """Labels of the dims that only variables of this model have; by default none."""
        return {}

    @property
    def provenance(self) -> dict[str, Any]:
        """Attributes of a model that state where this one comes from."""

    @property
    def settings(self) -> dict[str, Any]:
        """Parameters of the fit that were used otherwise: rank, or number of components; by
        default none.
        """
        return {}

    @property
    def omissions(self) -> tuple[Omission, ...]:
        """Parts of the model that are not computed, with a bound on the error; by default
        none.
        """
        return ()

    def parameters_of(self, fitted: xr.Dataset) -> Array:
        """Parameters (n, p) in `parameter_variables`."""

    def fit(
        self,
        block: Block,
        comparison: Comparison,
        judgement: Judgement = NO_JUDGEMENT,
        parameters: Array | None = None,
    ) -> SurfaceFit:
        """Fit the surface term to the samples minus their diffuse part, or only evaluate
        given parameters (n, p), and judge the prediction.
        """

    def fit_columns(self, fit: SurfaceFit) -> dict[str, Array]:
        """Variables of the surfels from `fit`: its parameters, and the next fields of
        `SurfaceFit` under the names of `skindb.reflectance.block.FIT_VARIABLES`.
        """

    def reduced(
        self, fitted: xr.Dataset, *, k: int, rng: np.random.Generator
    ) -> xr.Dataset:
        """The group "basis" for a take: the model that all of its surfels share, with at
        most k components, from the results of `fit` and `surfel_area`.
        """

    def judged_columns(self, judged: SurfaceFit) -> dict[str, Array]:
        """Variables of the surfels from a fit with errors: parameters, their errors,
        and those of `skindb.reflectance.block.gloss_columns`.
        """

    def shade(self, points: Points, lamp: Lamp, *, eta: float) -> Float32:
        """Radiance (n, 3) per radiant intensity [sr^-1 mm^-2] of the diffuse and the
        surface term (eq. 1, 3, 8).
        """

    def normal_reflectance(self, parameters: Array) -> Array:
        """Fractions (2, n) of light along the normal that the surface reflects: all of it,
        and that in the narrow of two lobes.
        """

    def simplified(
        self, parameters: Array
    ) -> tuple[ReflectanceModel, Array, tuple[Omission, ...]]:
        """The model and the parameters (n, p) without what reflects nothing at any of the
        surfels; by default as they are.
        """
        return self, parameters, ()

    def resample(self, parameters: Array) -> tuple[Table, Array]:
        """Tables (nh, nd, np, k) and weights (n, k) whose mixtures are the surface term,
        for programs that read tables and for samplers of directions; the viewer shows at
        most `MAX_TABLES`.
        """


class SurfaceKind(Protocol):
    """What a class that implements `ReflectanceModel` has to be listed in `kinds`."""

    # variable of the group "basis" that only takes with this model have
    BASIS_VARIABLE: str
    # variables of the group "fitted" with the parameters of stored takes
    PARAMETERS: tuple[str, ...]

    def unfitted(self, request: FitRequest) -> ReflectanceModel:
        """The model of the first pass; raises `InputError` if it cannot be fitted so."""

    def of_basis(self, basis: xr.Dataset) -> ReflectanceModel:
        """The model in the group "basis"."""
