"""One analytic GGX lobe per surfel as a surface model (Walter et al. 2007, Heitz 2014).

f_s = w F(theta_d) D(theta_h; alpha) G / (4 cos theta_i cos theta_o)

F is the exact Fresnel reflectance at the refractive index of the fit, D the GGX
distribution and G the height-correlated masking of Smith. The strength w and the
roughness alpha are those of a surfel, as in fits of Torrance and Sparrow's model to faces
(Weyrich et al. 2006). The width includes that of the dome's lights.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from skindb.errors import require
from skindb.reflectance import _ggx_kernels
from skindb.reflectance._ggx_kernels import (
    MAX_ROUGHNESS,
    MIN_ROUGHNESS,
    ROUGHNESS,
    STRENGTH,
)
from skindb.reflectance.block import (
    FIT_VARIABLES,
    empty_fit,
    gloss_columns,
    kernel_block,
    kernel_errors,
    kernel_options,
    shade_diffuse,
)
from skindb.reflectance.lobes import evaluate_lobe
from skindb.reflectance.model import (
    MAX_TABLES,
    NO_JUDGEMENT,
    Block,
    Comparison,
    FitRequest,
    Judgement,
    Lamp,
    Points,
    ReflectanceModel,
    SurfaceFit,
)
from skindb.reflectance.reduction import fitted_surfels
from skindb.reflectance.sampling import tangents
from skindb.reflectance.tables import NARROW_ANGLE, Table, tabulate
from skindb.schema import FitStatus, check, dataset, variables
from skindb.types import Array, Float32, float64, lengths

ALBEDO_NODES = 24  # roughnesses at which the reflectance of a lobe is integrated
# tables that stand for all lobes of a take, between which weights are interpolated; with a
# ratio of 1.3 between neighbours, values differ by up to 2 % of the peak
TABLES = MAX_TABLES
# of the roughnesses of a take, between which tables are placed
TABLE_QUANTILES = (0.01, 0.99)


@lru_cache(maxsize=4)
def _normal_albedo(index: float) -> tuple[Array, Array]:
    """Roughnesses (n,), and the fractions (2, n) of light along the normal that their lobes
    reflect: all of it, and that within `NARROW_ANGLE`.
    """
    alpha = np.geomspace(MIN_ROUGHNESS, MAX_ROUGHNESS, ALBEDO_NODES)
    node, weight = np.polynomial.legendre.leggauss(400)
    parts = []
    for start, end in pairwise([0.0, 2 * NARROW_ANGLE, np.pi / 2]):
        theta = start + (node + 1) * (end - start) / 2
        wi = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=-1)
        wo = np.broadcast_to([0.0, 0.0, 1.0], wi.shape)
        value = evaluate_lobe(wi, wo, alpha[:, None], index)
        ring = weight * (end - start) * np.pi * np.sin(theta) * np.cos(theta)
        parts.append(value @ ring)
    return alpha, np.stack([parts[0] + parts[1], parts[0]])


@dataclass(frozen=True)
class GGX(ReflectanceModel):
    """GGX lobes with a common refractive index of their Fresnel term."""

    BASIS_VARIABLE: ClassVar[str] = variables.LOBE_INDEX
    PARAMETERS: ClassVar[tuple[str, ...]] = (
        variables.LOBE_STRENGTH,
        variables.LOBE_ROUGHNESS,
    )
    index: float = 1.3
    disc_angular_radius: float = 0.0  # rad, of the lights whose width the lobes include

    @classmethod
    def unfitted(cls, request: FitRequest) -> GGX:
        """The model before a fit; there is none of a dictionary."""
        require(
            request.dictionary is None,
            "dictionary",
            "mixtures alone are of a dictionary",
            "ggx",
            "omit it, or fit a mixture",
        )
        return cls(request.eta, request.disc_angular_radius)

    @classmethod
    def of_basis(cls, basis: xr.Dataset) -> GGX:
        """The model in the group "basis"."""
        names = (variables.LOBE_INDEX, variables.DISC_ANGULAR_RADIUS)
        check(basis, names, where="basis")
        return cls(*(float(basis[name]) for name in names))

    @property
    def disc_included(self) -> bool:
        """Whether the lobes are those of the dome's lights: true, as they are fitted so."""
        return True

    @property
    def parameter_variables(self) -> tuple[str, ...]:
        """Variables of strength and roughness."""
        return self.PARAMETERS

    @property
    def fit_variables(self) -> tuple[str, ...]:
        """Variables from `fit`."""
        return (*self.PARAMETERS, *FIT_VARIABLES)

    @property
    def provenance(self) -> dict[str, Any]:
        """What the surface was fitted by."""
        return {"surface": f"GGX lobe, refractive index {self.index:g}"}

    def parameters_of(self, fitted: xr.Dataset) -> Array:
        """Strength and roughness (n, 2)."""
        return np.column_stack([fitted[name].values for name in self.PARAMETERS])

    def fit(
        self,
        block: Block,
        comparison: Comparison,
        judgement: Judgement = NO_JUDGEMENT,
        parameters: Array | None = None,
    ) -> SurfaceFit:
        """Strength and roughness of n surfels, or given ones (n, 2), with their errors,
        held-out samples and outliers.
        """
        out = empty_fit(block, judgement, len(self.PARAMETERS), parameters)
        options = kernel_options(comparison, solve=parameters is None)
        errors = kernel_errors(block, judgement)
        _ggx_kernels.fit_ggx(
            kernel_block(block), float(self.index), options, errors, out
        )
        return out

    def fit_columns(self, fit: SurfaceFit) -> dict[str, Array]:
        """Variables of a fit."""
        return dict(
            zip(self.fit_variables, [*fit.parameters.T, *fit[1:]], strict=False)
        )

    def reduced(
        self,
        fitted: xr.Dataset,
        *,
        k: int,  # noqa: ARG002
        rng: np.random.Generator,  # noqa: ARG002
    ) -> xr.Dataset:
        """The refractive index; lobes have no components."""
        if not (fitted[variables.FIT_STATUS] == FitStatus.LAMBERT).any():
            fitted_surfels(fitted, self.PARAMETERS)
        shared = {
            variables.LOBE_INDEX: self.index,
            variables.DISC_ANGULAR_RADIUS: self.disc_angular_radius,
        }
        return dataset(shared)

    def judged_columns(self, judged: SurfaceFit) -> dict[str, Array]:
        """Strength, roughness, the reflectance along the normal and the glossiness with
        their errors; those are NaN without a lobe.
        """
        error = np.sqrt(np.diagonal(judged.covariance, axis1=1, axis2=2))
        strength, roughness = judged.parameters.T
        nodes, albedo = _normal_albedo(self.index)
        fraction, slope = (
            np.stack([np.interp(roughness, nodes, row) for row in rows])
            for rows in (albedo, np.gradient(albedo, nodes, axis=1))
        )
        gradient = np.stack([fraction, strength * slope], axis=-1)
        return {
            variables.LOBE_STRENGTH: strength,
            variables.LOBE_ROUGHNESS: roughness,
            variables.LOBE_STRENGTH_ERROR: error[:, STRENGTH],
            variables.LOBE_ROUGHNESS_ERROR: error[:, ROUGHNESS],
            **gloss_columns(judged, strength * fraction, gradient),
        }

    def shade(self, points: Points, lamp: Lamp, *, eta: float) -> Float32:
        """Radiance (n, 3) per radiant intensity [sr^-1 mm^-2], see `ReflectanceModel`."""
        out = shade_diffuse(points, lamp, eta=eta)
        if points.parameters.shape[1] == 0:
            return out
        way = lamp.place - points.position[:, None]
        distance = lengths(way)
        towards = way / distance[..., None]
        axes = np.stack([*tangents(points.normal), points.normal], axis=1)
        wi = np.einsum("nak,npk->npa", axes, towards)
        wo = np.einsum("nak,nk->na", axes, points.view)[:, None]
        strength = points.parameters[:, [STRENGTH]]
        roughness = points.parameters[:, [ROUGHNESS]]
        value = evaluate_lobe(wi, wo, np.maximum(roughness, MIN_ROUGHNESS), self.index)
        fall_off = np.maximum(-(towards @ lamp.axis), 0.0) ** lamp.falloff
        received = lamp.lit * np.maximum(wi[..., 2], 0.0) * fall_off / distance**2
        gloss = (strength * received * value).mean(axis=1)
        gloss = np.where((wo[:, 0, 2] > 0) & (strength[:, 0] > 0), gloss, 0.0)
        return np.asarray(out + gloss[:, None], np.float32)

    def normal_reflectance(self, parameters: Array) -> Array:
        """Fractions (2, n) of light along the normal that the lobes reflect."""
        nodes, albedo = _normal_albedo(self.index)
        strength, roughness = parameters.T
        return strength * np.stack([np.interp(roughness, nodes, row) for row in albedo])

    def resample(self, parameters: Array) -> tuple[Table, Array]:
        """Tables of lobes at `TABLES` roughnesses, and weights (n, TABLES) that interpolate
        between them; a roughness beyond the outermost takes that one.
        """
        strength = float64(parameters[:, STRENGTH])
        roughness = np.clip(parameters[:, ROUGHNESS], MIN_ROUGHNESS, MAX_ROUGHNESS)
        shiny = np.isfinite(roughness) & (strength > 0)
        ends = np.array([MIN_ROUGHNESS, MAX_ROUGHNESS])
        if shiny.any():
            ends = np.quantile(roughness[shiny], TABLE_QUANTILES)
        nodes = np.geomspace(ends[0], ends[1], TABLES)
        nodes = nodes if nodes[-1] > nodes[0] * 1.01 else nodes[:1]
        tables = tabulate(
            lambda wi, wo: evaluate_lobe(
                wi[..., None, :], wo[..., None, :], nodes, self.index
            )
        )
        place = np.interp(np.log(roughness), np.log(nodes), np.arange(len(nodes)))
        distance = np.abs(place[:, None] - np.arange(len(nodes)))
        return tables, strength[:, None] * np.maximum(1 - distance, 0.0)
