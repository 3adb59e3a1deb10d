"""Mixtures of BRDF tables as a surface model: fits of a block of surfels by a dictionary
or by a reduced basis (Weyrich et al. 2005, section 7, eq. 7 and 8).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from skindb.errors import require
from skindb.reflectance import _row_kernels
from skindb.reflectance._block_kernels import Tables, fit_block
from skindb.reflectance.block import (
    NO_TABLE,
    empty_fit,
    gloss_columns,
    kernel_block,
    kernel_errors,
    kernel_options,
    shade_tables,
)
from skindb.reflectance.dictionary import Dictionary, disc_dictionary
from skindb.reflectance.model import (
    NO_JUDGEMENT,
    Block,
    Comparison,
    FitRequest,
    Judgement,
    Lamp,
    Points,
    SurfaceFit,
)
from skindb.reflectance.reduction import (
    rank_truncation,
    reduce_basis,
    reduced_dictionary,
)
from skindb.reflectance.tables import (
    NARROW_ANGLE,
    Table,
    TableGrid,
    directional_albedo,
    half_widths,
    kernel_tables,
    pad_to_lanes,
)
from skindb.schema import FitStatus, check, dataset, variables
from skindb.schema.notes import Omission
from skindb.types import (
    AnyArray,
    Array,
    Float32,
    Float64,
    Index,
    Index32,
    Mask,
    contiguous,
    float64,
)

DICTIONARY_VARIABLES = (  # in the order of `SurfaceFit`
    variables.DICTIONARY_WEIGHT,
    variables.KKT_RESIDUAL,
    variables.DICTIONARY_RESIDUAL,
    variables.DICTIONARY_RESIDUAL_PERCEPTUAL,
    variables.FIT_CONDITION,
    variables.FIT_SAMPLES,
    variables.SMALLEST_HALF_ANGLE,
    variables.FIT_ITERATIONS,
    variables.FIT_STATUS,
)
MAX_LOG_SCALE = np.log(1e9)  # tables within this factor of 1 are used without scaling


@dataclass(frozen=True, eq=False)
class Mixture:
    """Non-negative mixtures of m BRDF tables, whose weights are the parameters.

    The tables may be reduced to a space of r dimensions.
    """

    BASIS_VARIABLE: ClassVar[str] = variables.BASIS_BRDF
    PARAMETERS: ClassVar[tuple[str, ...]] = (variables.BASIS_WEIGHT,)
    table: Table  # (nh, nd, np, r) sr^-1
    lift: Array | None = None  # (r, m) from the reduced space; None: the identity
    disc_angular_radius: float = 0.0  # rad, of the lights that tables are averaged over
    names: tuple[str, ...] = ()  # of the m components
    # of which the weights are, if of all its BRDFs
    dictionary: Dictionary | None = None
    # `table` over `scale`, padded to full vectors
    filled: Table = field(init=False, repr=False)
    matrix: Float64 = field(init=False, repr=False)  # `lift` for the kernels
    # (m,) powers of two; 1 except for tables whose squares exceed single precision
    scale: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Scale and pad the tables."""
        rank = self.table.shape[-1]
        lift = np.eye(rank) if self.lift is None else self.lift
        largest = float64(np.abs(self.table.reshape(-1, rank)).max(axis=0))
        if rank != lift.shape[1]:
            largest[:] = largest.max()
        extreme = np.isfinite(largest) & (largest > 0)
        extreme &= np.abs(np.log(np.maximum(largest, 1e-300))) > MAX_LOG_SCALE
        power = np.round(np.log2(np.where(extreme, largest, 1.0)))
        scale = np.where(extreme, 2.0**power, 1.0)
        table = self.table
        if extreme.any():
            table = np.asarray(self.table / scale, np.float32)
        if rank != lift.shape[1]:
            scale = np.full(lift.shape[1], scale[0])
        object.__setattr__(self, "filled", _read_only(pad_to_lanes(table)))
        matrix = contiguous(lift)
        object.__setattr__(self, "matrix", _read_only(matrix))
        object.__setattr__(self, "scale", scale)
        if not self.names:
            names = tuple(f"component{k}" for k in range(lift.shape[1]))
            object.__setattr__(self, "names", names)

    @classmethod
    def of_dictionary(cls, dictionary: Dictionary, *, rank: int = 16) -> Mixture:
        """Mixtures of all BRDFs of a dictionary, by their `rank` most important dimensions."""
        reduced, lift = reduced_dictionary(dictionary, rank)
        disc = dictionary.disc_angular_radius
        return cls(reduced, lift, disc, dictionary.names, dictionary)

    @classmethod
    def unfitted(cls, request: FitRequest) -> Mixture:
        """Mixtures of all BRDFs of the dictionary, which must have at least k of them."""
        tables = disc_dictionary(request.dictionary, request.disc_angular_radius)
        count = len(tables.names)
        require(  # before the fit
            request.k <= count,
            "k",
            f"a reduced basis of this dictionary has 1 to {count} components",
            str(request.k),
            "choose a smaller k",
        )
        return cls.of_dictionary(tables, rank=request.rank)

    @classmethod
    def of_basis(cls, basis: xr.Dataset) -> Mixture:
        """Mixtures of a reduced basis, the group "basis" of a model."""
        check(basis, (variables.BASIS_BRDF,), where="basis")
        disc = float(basis.get(variables.DISC_ANGULAR_RADIUS, 0.0))
        names: tuple[str, ...] = ()
        if "component" in basis.coords:
            names = tuple(map(str, basis["component"].values))
        return cls(kernel_tables(basis), disc_angular_radius=disc, names=names)

    @property
    def disc_included(self) -> bool:
        """Whether the tables are averaged over the disc of the lights."""
        return self.disc_angular_radius > 0

    @property
    def parameter_variables(self) -> tuple[str, ...]:
        """Variable of the weights."""
        if self.dictionary is None:
            return self.PARAMETERS
        return (variables.DICTIONARY_WEIGHT,)

    @property
    def fit_variables(self) -> tuple[str, ...]:
        """Variables from `fit`."""
        return DICTIONARY_VARIABLES

    @property
    def labels(self) -> dict[str, tuple[str, ...]]:
        """Names of the components or of the BRDFs of the dictionary."""
        return {"component" if self.dictionary is None else "dictionary": self.names}

    @cached_property
    def normal_albedo(self) -> Array:
        """Fractions (2, m) of light along the normal that each BRDF reflects: all of it, and
        that within `NARROW_ANGLE`.
        """
        angles = (np.pi / 2, NARROW_ANGLE)
        albedo = [directional_albedo(self.table, 1.0, angle)[0] for angle in angles]
        return np.stack(albedo) @ self.matrix

    @cached_property
    def half_width(self) -> Float64:
        """Half width (m,) of the lobe of each BRDF that is mixed, see `half_widths`."""
        table = self.table if self.dictionary is None else self.dictionary.table
        return half_widths(table)

    @property
    def provenance(self) -> dict[str, Any]:
        """Source of the dictionary."""
        return {} if self.dictionary is None else self.dictionary.provenance

    @property
    def settings(self) -> dict[str, Any]:
        """Rank of the dictionary, or number of components."""
        count = self.table.shape[-1]
        if self.dictionary is None:
            return {"k": count}
        return {"rank": count - self.dictionary.exact}

    @property
    def omissions(self) -> tuple[Omission, ...]:
        """Error by a reduction of the dictionary (`truncation_bound`).

        The bound applies to a mixture with given weights. On a take of 32 lights and 6
        cameras, fitted mixtures differed by 0.8 % (median) and 3.6 % (maximum; bound 3.9 %)
        at rank 16; the residual was the same as with all 59 in the median surfel, and 5 %
        larger in one of twenty.
        """
        if self.dictionary is None or self.lift is None:
            return ()
        space, count = self.lift.shape
        if space >= count:
            return ()
        rank = space - self.dictionary.exact
        omission = Omission(
            "dimensions of the dictionary",
            count - space,
            count,
            f"rank {rank}, beside {self.dictionary.exact} exact lobes",
            rank_truncation(self.dictionary, rank),
            "mixtures, RMS over directions,",
        )
        return (omission,)

    def parameters_of(self, fitted: xr.Dataset) -> Array:
        """Weights (n, m) of the surfels."""
        return fitted[self.parameter_variables[0]].values

    def fit(
        self,
        block: Block,
        comparison: Comparison,
        judgement: Judgement = NO_JUDGEMENT,
        parameters: Array | None = None,
    ) -> SurfaceFit:
        """Weights of n surfels, or given weights (n, m); their errors and held-out samples
        only for tables that are not reduced.

        Samples below the noise floor are compared linearly; samples whose noise exceeds
        the error of models have less weight.
        """
        options = kernel_options(comparison, solve=parameters is None)
        if parameters is not None:
            parameters = parameters * self.scale
        out = empty_fit(block, judgement, len(self.scale), parameters)
        tables = Tables(self.filled, self.matrix, self.half_width)
        errors = kernel_errors(block, judgement)
        fit_block(kernel_block(block), tables, options, errors, out)
        out.parameters[...] /= self.scale
        if judgement.diffuse_error is not None:
            out.covariance[...] /= np.multiply.outer(self.scale, self.scale)
        return out

    def fit_columns(self, fit: SurfaceFit) -> dict[str, Array]:
        """Variables of a fit by the dictionary."""
        return dict(zip(DICTIONARY_VARIABLES, fit, strict=False))

    def reduced(
        self, fitted: xr.Dataset, *, k: int, rng: np.random.Generator
    ) -> xr.Dataset:
        """Basis of k mixtures of the dictionary, or fewer for few fitted surfels; without
        gloss at any surfel the mean of the dictionary, whose mean weights are NaN.
        """
        assert self.dictionary is not None
        status = fitted[variables.FIT_STATUS].values
        good = int((status == FitStatus.FITTED).sum())
        if not good and (status == FitStatus.LAMBERT).any():
            count = len(self.names)
            fitted = dataset(
                {
                    variables.DICTIONARY_WEIGHT: np.full((1, count), 1 / count),
                    variables.FIT_STATUS: [FitStatus.FITTED],
                    variables.SURFEL_AREA: [1.0],
                }
            )
        k = max(1, min(k, good))
        basis = reduce_basis(fitted, dictionary=self.dictionary, k=k, rng=rng)
        if not good:
            basis[variables.MEAN_DICTIONARY_WEIGHT][:] = np.nan
        return basis

    def judged_columns(self, judged: SurfaceFit) -> dict[str, Array]:
        """Weights, their standard errors, and the reflectance along the normal and the
        glossiness with their errors, which are NaN if no weight is above 0 or weights
        cannot be distinguished.
        """
        reflected = self.normal_reflectance(judged.parameters)
        deviation = np.sqrt(np.diagonal(judged.covariance, axis1=1, axis2=2))
        return {
            variables.BASIS_WEIGHT: judged.parameters,
            variables.BASIS_WEIGHT_ERROR: deviation,
            **gloss_columns(judged, reflected, self.normal_albedo[:, None]),
        }

    def shade(self, points: Points, lamp: Lamp, *, eta: float) -> Float32:
        """Radiance (n, 3) per radiant intensity [sr^-1 mm^-2], see `ReflectanceModel`.

        sum over lamp points of lit cos(theta_i) / d^2 falloff (F_t(i) F_t(o) R_d / pi +
        sum_k w_k b_k) / points

        It is zero where the normal faces away from the light or the camera. Measured
        BRDFs already contain a Fresnel term, so F_r of eq. 2 is not applied to them
        (Weyrich et al. 2005).
        """
        with_surface = points.parameters.shape[1] > 0
        table = self.table if with_surface else NO_TABLE
        return shade_tables(points, table, lamp, eta=eta)

    def normal_reflectance(self, parameters: Array) -> Array:
        """Fractions (2, n) of light along the normal that mixtures (n, m) reflect."""
        return self.normal_albedo @ parameters.T

    def simplified(
        self, parameters: Array
    ) -> tuple[Mixture, Array, tuple[Omission, ...]]:
        """The mixture without the tables whose weight is zero at all surfels."""
        positive = (parameters != 0).any(axis=0)
        if not positive.any():
            positive[:1] = True  # a mixture has a table
        if positive.all():
            return self, parameters, ()
        names = tuple(np.array(self.names)[positive])
        tables = np.ascontiguousarray(self.table[..., positive])
        omission = Omission(
            "basis BRDFs",
            int((~positive).sum()),
            positive.size,
            "their weight is zero everywhere",
        )
        fewer = replace(self, table=tables, names=names)
        return fewer, parameters[:, positive], (omission,)

    def resample(self, parameters: Array) -> tuple[Table, Array]:
        """The tables and the weights as they are."""
        return self.table, parameters


def basis_rows(
    table: Table,
    grid: TableGrid,
    normal: Array,
    to_light: Array,
    to_camera: Array,
    usable: Mask,
) -> tuple[Table, Index, Index32]:
    """Rows cos(theta_i) b_j(w_i, w_o) of all usable samples, in the order of surfels.

    Parameters
    ----------
    table, grid
        (nh, nd, np, m) sr^-1 on the nodes of `grid`.
    normal
        (n, 3) unit normals.
    to_light, to_camera
        (n, l, 3) and (n, c, 3) unit directions that point away from the surfel.
    usable
        (n, l, c) samples to use; those below the horizon or with NaN are excluded.

    Returns
    -------
    rows, offsets, index
        (total, m) float32 [sr^-1]; (n + 1,) index of each surfel's first row; (total,
        2) light and camera of each row.
    """
    if table.shape[:3] != (grid.n_theta_h, grid.n_theta_d, grid.n_phi_d):
        raise ValueError(
            f"the table must have the shape of the grid {grid}, found {table.shape}"
        )
    normal, to_light, to_camera = (contiguous(a) for a in (normal, to_light, to_camera))
    lit = _above_horizon(normal, to_light)
    seen = _above_horizon(normal, to_camera)
    use = np.ascontiguousarray(usable & lit[:, :, None] & seen[:, None, :])
    offsets = np.concatenate([[0], np.cumsum(use.sum((1, 2)))]).astype(np.int64)
    padded = pad_to_lanes(table)
    rows = np.empty((offsets[-1], padded.shape[3]), np.float32)
    index = np.empty((offsets[-1], 2), np.int32)
    _row_kernels.fill_rows(
        padded, normal, to_light, to_camera, use, offsets, rows, index
    )
    return rows[:, : table.shape[3]], offsets, index


def _above_horizon(normal: Array, away: Array) -> Mask:
    """(n, d) mask of directions above the horizon; false for NaN and infinite ones."""
    cosine = np.einsum("sc,sdc->sd", normal, away)
    return np.isfinite(cosine) & (cosine > 0)


def _read_only(array: AnyArray) -> AnyArray:
    """A view that cannot be written: memory-mapped arrays are read-only, and kernels would
    be compiled for both kinds otherwise.
    """
    view = array.view()
    view.flags.writeable = False
    return view
