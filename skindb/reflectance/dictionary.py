"""The dictionary of BRDFs whose mixtures describe a surface: the 59 embedded materials and
eight GGX lobes of graded widths, or those of a file.

See `skindb.reflectance.brdf_files` for files.
"""

from __future__ import annotations

import hashlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache

import numpy as np
import xarray as xr

from skindb.cache import cached_arrays
from skindb.errors import input_error
from skindb.files import Json, package_json
from skindb.optics.angles import directions, half_difference
from skindb.optics.fresnel import fresnel_reflectance
from skindb.reflectance import _row_kernels
from skindb.reflectance.lobes import GRADED_NAMES, evaluate_graded
from skindb.reflectance.tables import (
    DEFAULT_GRID,
    Table,
    TableGrid,
    directional_albedo,
    lookup,
    tabulate,
)
from skindb.schema import dataset
from skindb.types import Array, Float64

Rule = tuple[int, int]  # rings and points per ring of a quadrature over a disc
# away from the mirror direction and near it; see `convolve_disc`
FAR_RULE = (4, 12)
NEAR_RULE = (12, 36)
EMBEDDED = "analytic fits to measured BRDFs (ABC parameters of Loew et al. 2012), and GGX lobes"
# modules that determine the tables; a change of their source invalidates the cache
SOURCES = (
    "skindb.reflectance.dictionary",
    "skindb.reflectance.lobes",
    "skindb.reflectance.reduction",
    "skindb.reflectance.tables",
    "skindb.reflectance._row_kernels",
    "skindb.optics.angles",
    "skindb.optics.fresnel",
    "skindb.jit",
)
# cosines are clamped to this, so that cells below the horizon continue the last value
# above it
MIN_COSINE_TABLE = 0.03
INCIDENCE = np.radians(np.arange(0, 86, 5))


@dataclass(frozen=True)
class Origin:
    """Provenance of the table of one material that was read from a file."""

    sha256: str
    # fraction of nodes above the horizon that were not measured and continue their
    # neighbours
    hole_fraction: float
    # relative rms error at the measured nodes, see `weighted_error`
    resampling_error: float


@dataclass(frozen=True, eq=False)
class Dictionary:
    """Monochrome (mean of RGB), non-negative BRDF tables (nh, nd, np, m) in sr^-1, one
    per material.

    Dictionaries compare by identity.
    """

    names: tuple[str, ...]
    table: Table
    grid: TableGrid
    source: str
    disc_angular_radius: float = 0.0  # rad; 0 where the tables are not convolved
    origins: tuple[Origin, ...] = ()  # one per material read from files
    # `digest` of the tables for point lights that were averaged over the disc
    point_digest: str = ""
    exact: int = 0  # number of materials, the last ones, that no reduction changes

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the tables, part of the cache key of results computed from them."""
        return hashlib.sha256(np.ascontiguousarray(self.table).data).hexdigest()

    @property
    def provenance(self) -> Json:
        """Source and digest, which is the same for lights of all sizes; for dictionaries
        from files also notes, and the digests of the files.
        """
        provenance: Json = {
            "dictionary": self.source,
            "dictionary_digest": self.point_digest or self.digest,
        }
        if self.origins:
            provenance["dictionary_notes"] = list(self.notes)
            provenance["dictionary_sha256"] = {
                name: origin.sha256
                for name, origin in zip(self.names, self.origins, strict=True)
            }
        return provenance

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks about the files for the user, one per line."""
        if not self.origins:
            return ()
        worst, name = max(
            (origin.hole_fraction, name)
            for name, origin in zip(self.names, self.origins, strict=True)
        )
        if not worst > 0:
            return ()
        count = sum(origin.hole_fraction > 0 for origin in self.origins)
        return (
            f"materials with unmeasured nodes above the horizon: {count}, "
            f"most in {name} ({worst:.2%} of its nodes)",
        )


@cache
def abc_parameters() -> dict[str, tuple[float, ...]]:
    """Parameters (9,) of 59 dielectrics of the MERL database by name: kd r g b, A r g b,
    B, C, index of refraction.

    These are the paints, fabrics, woods, plastics, rubbers and organic materials among
    its hundred, as Weyrich et al. 2005 do not name theirs. From Loew, Kronander,
    Ynnerman, Unger, "BRDF models for accurate and efficient rendering of glossy
    surfaces", ACM Transactions on Graphics 31(1), 2012.
    """
    table = package_json("skindb.reflectance", "abc_low2012.json")
    return {name: tuple(map(float, numbers)) for name, numbers in table.items()}


def evaluate_abc(parameters: Array, wi: Array, wo: Array) -> Array:
    """ABC microfacet BRDFs (..., m) for rows (m, 9) of `abc_parameters`, as mean of RGB
    (Loew et al. 2012).

    f = kd/pi + A F(theta_d) (1 + B (1 - cos theta_h))^-C G / (pi cos_i cos_o), with G
    for V grooves. Directions are in the local frame.
    """
    cos_i = np.maximum(wi[..., 2], MIN_COSINE_TABLE)
    cos_o = np.maximum(wo[..., 2], MIN_COSINE_TABLE)
    theta_h, theta_d, _ = half_difference(wi, wo)
    cos_h = np.maximum(np.cos(theta_h), 1e-6)
    cos_d = np.maximum(np.cos(theta_d), MIN_COSINE_TABLE)
    masking = np.minimum(1.0, 2 * cos_h * np.minimum(cos_i, cos_o) / cos_d) / (
        np.pi * cos_i * cos_o
    )
    out = np.empty((*cos_i.shape, len(parameters)))
    lean = 2.0 * np.sin(theta_h / 2) ** 2  # 1 - cos theta_h without cancellation
    for m, row in enumerate(parameters):
        kd = row[:3].mean()
        scale = row[3:6].mean()
        b, c, index = row[6:]
        lobe = np.exp(-c * np.log1p(b * lean))
        out[..., m] = (
            kd / np.pi
            + scale * fresnel_reflectance(cos_d, float(index)) * lobe * masking
        )
    return out


def evaluate_embedded(wi: Array, wo: Array) -> Array:
    """BRDFs (..., 67) of `embedded_dictionary` [sr^-1]."""
    rows = np.array(list(abc_parameters().values()))
    lobes = evaluate_graded(wi, wo)
    return np.concatenate([evaluate_abc(rows, wi, wo), lobes], axis=-1)


@cache
def embedded_dictionary() -> Dictionary:
    """The 59 materials of `abc_parameters` and the lobes of `GRADED_ROUGHNESS` on the
    default grid.
    """
    cached = cached_arrays(
        "embedded-dictionary",
        (DEFAULT_GRID, abc_parameters()),
        sources=SOURCES,
        make=lambda: {"table": tabulate(evaluate_embedded, DEFAULT_GRID)},
    )
    table = cached["table"]
    table.setflags(write=False)
    names = (*abc_parameters(), *GRADED_NAMES)
    return Dictionary(names, table, DEFAULT_GRID, EMBEDDED, exact=len(GRADED_NAMES))


def sample_pairs(count: int = 20_000) -> tuple[Array, Array]:
    """Fixed pairs of directions (n, 3), (n, 3), spread evenly over sqrt(theta_h),
    theta_d and phi_d.

    Both are more than 6 degrees above the horizon.
    """
    # Kronecker sequence of the root of x^4 = x + 1 (Roberts 2018)
    point = np.mod(
        np.arange(1, count + 1)[:, None] / 1.2207440846057596 ** np.arange(1, 4), 1.0
    )
    wi, wo = directions(
        point[:, 0] ** 2 * np.pi / 2, point[:, 1] * np.pi / 2, point[:, 2] * np.pi
    )
    up = np.minimum(wi[:, 2], wo[:, 2]) > 0.1
    return wi[up], wo[up]


def weighted_error(values: Array, exact: Array, wi: Array, wo: Array) -> Array:
    """Relative rms error (m,) of values (n, m), weighted by both cosines."""
    weight = (wi[:, 2] * wo[:, 2])[:, None]
    total = np.maximum((weight * exact**2).sum(axis=0), 1e-300)
    return np.sqrt((weight * (values - exact) ** 2).sum(axis=0) / total)


@cache
def _disc_rule(rings: int, spokes: int) -> tuple[Float64, Float64]:
    """Quadrature points (q, 2) of the unit disc and weights (q,), Gauss in the squared
    radius, uniform in angle.
    """
    x, w = np.polynomial.legendre.leggauss(rings)
    radius = np.sqrt((x + 1) / 2)
    angle = (
        2
        * np.pi
        * (np.arange(spokes)[None] + 0.5 * (np.arange(rings)[:, None] % 2))
        / spokes
    )
    points = np.stack(
        [radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)], axis=-1
    )
    return points.reshape(-1, 2), np.repeat(w / 2 / spokes, spokes)


def average_disc(
    dictionary: Dictionary,
    wi: Array,
    wo: Array,
    angular_radius: float,
    *,
    far: Rule = FAR_RULE,
    near: Rule = NEAR_RULE,
) -> Array:
    """Values (n, m) of the tables towards wo, averaged over the disc around each wi (n, 3) only.

    The rules are those of `convolve_disc`.
    """
    theta_h, theta_d, _ = half_difference(wi, wo)
    # of the half vectors, perpendicular to the plane of both directions
    reach = angular_radius / (2 * np.cos(theta_d))
    close = theta_h < reach + np.radians(0.5)
    out = np.zeros((len(wi), len(dictionary.names)), np.float32)
    for rule, pairs in ((far, ~close), (near, close)):
        points, weights = _disc_rule(*rule)
        values = np.zeros((int(pairs.sum()), out.shape[1]), np.float32)
        disc = points * np.tan(angular_radius)
        _row_kernels.average_disc(
            dictionary.table, wi[pairs], wo[pairs], disc, weights, values
        )
        out[pairs] = values
    return out


def disc_dictionary(dictionary: Dictionary | None, angular_radius: float) -> Dictionary:
    """The dictionary, by default the embedded one, averaged over lights with this
    angular radius [rad].

    The radius is rounded to a hundredth of a degree, so that the takes of a dome share the tables.
    """
    return convolve_disc(
        dictionary or embedded_dictionary(),
        float(np.radians(np.round(np.degrees(angular_radius), 2))),
    )


@lru_cache(maxsize=2)
def convolve_disc(
    dictionary: Dictionary,
    angular_radius: float,
    *,
    far: Rule = FAR_RULE,
    near: Rule = NEAR_RULE,
) -> Dictionary:
    """Tables averaged over the disc of the light (Weyrich et al. 2005, section 7).

    Parameters
    ----------
    dictionary
        Tables for point lights.
    angular_radius
        Angular radius of the disc as seen from the surface [rad].
    far, near
        Gauss points in the squared radius, and points per ring. `near` is used if half
        vectors over the disc come within half a degree of the normal, where lobes may
        be narrower than the disc. With `far` alone, the worst error of the 59 materials
        at 0.8 degrees is 13 % instead of 1.2 % rms above 6 degrees of elevation, in
        half the time.

    Raises
    ------
    InputError
        If the tables are already averaged over another disc.

    Notes
    -----
    The last two results are kept in memory and all of them on disk, as fits, studies
    and edits of one dome share them (46 MB, 3 s). Tables that are already averaged over
    this disc, to a hundredth of a degree, are returned as they are. An average over one
    direction is not reciprocal, while the tables must have period pi in phi_d. The mean
    of the averages around either direction is therefore used.
    """
    before = dictionary.disc_angular_radius
    # the fit rounds to a hundredth of a degree
    if before and abs(before - angular_radius) > np.radians(0.0101):
        raise input_error(
            dictionary.source,
            "tables must be for point lights or for the disc of these lights, "
            f"{np.degrees(angular_radius):.2f} degrees",
            f"a disc of {np.degrees(before):.2f} degrees",
            "provide tables for point lights",
        )
    if before or angular_radius <= 0:
        return dictionary
    arguments = (dictionary.digest, angular_radius, far, near)
    cached = cached_arrays(
        "disc-dictionary",
        arguments,
        sources=SOURCES,
        make=lambda: {"table": _convolve(dictionary, angular_radius, far, near)},
    )
    return replace(
        dictionary,
        table=cached["table"],
        disc_angular_radius=angular_radius,
        point_digest=dictionary.digest,
    )


def _convolve(
    dictionary: Dictionary, angular_radius: float, far: Rule, near: Rule
) -> Table:
    """Tables averaged over the discs around both directions."""
    grid = dictionary.grid
    out = np.zeros_like(dictionary.table)
    # at pi / 2 the directions are opposite and have no half vector; rounding would
    # choose an arbitrary one
    theta_d = np.minimum(grid.theta_d, np.pi / 2 - 1e-4)

    def fill(slab: int) -> None:
        th, td, pd = np.meshgrid(grid.theta_h[slab], theta_d, grid.phi_d, indexing="ij")
        wi, wo = directions(th.ravel(), td.ravel(), pd.ravel())
        sides = [
            average_disc(dictionary, *pair, angular_radius, far=far, near=near)
            for pair in ((wi, wo), (wo, wi))
        ]
        out[slab] = ((sides[0] + sides[1]) / 2).reshape(out[slab].shape)

    # plain threads, as the kernel releases the GIL and numba's own threads conflict
    # with those of dask and with forks
    with ThreadPoolExecutor() as pool:
        list(pool.map(fill, range(grid.n_theta_h)))
    return out


def dictionary_quality(
    dictionary: Dictionary, angular_radius: float, *, pairs: int = 6000
) -> dict[str, Array]:
    """Quality measures (m,) of every material; errors are relative, see `weighted_error`.

    Parameters
    ----------
    dictionary
        Tables for point lights, or already averaged over a disc.
    angular_radius
        Angular radius of the lights' disc [rad], for tables of point lights.
    pairs
        Number of pairs of directions to sample, see `sample_pairs`; two in three are
        above the horizon.

    Returns
    -------
    dict
        Measures by name, NaN where one does not apply:

        - normal_albedo, largest_albedo: fraction of light reflected at normal
          incidence, and its maximum up to 85 degrees.
        - energy_excess: largest albedo minus 1 (at least 0), before or after averaging
          over the disc.
        - reciprocity_error: difference of the fitted tables when both directions are exchanged.
        - interpolation_error: error of the tables before averaging against their source.
        - hole_fraction: fraction of unmeasured nodes above the horizon.
    """
    fitted = convolve_disc(dictionary, dictionary.disc_angular_radius or angular_radius)
    wi, wo = sample_pairs(pairs)
    forward, back = (
        lookup(fitted.table, *half_difference(a, b)) for a, b in ((wi, wo), (wo, wi))
    )
    albedo = directional_albedo(dictionary.table, np.cos(INCIDENCE))
    after = (
        albedo
        if fitted is dictionary
        else directional_albedo(fitted.table, np.cos(INCIDENCE))
    )
    figures = {
        "normal_albedo": albedo[0],
        "largest_albedo": albedo.max(axis=0),
        "energy_excess": np.maximum(np.maximum(albedo, after).max(axis=0) - 1, 0),
        "reciprocity_error": weighted_error(back, forward, wi, wo),
    }
    unknown = np.full(len(dictionary.names), np.nan)
    figures |= {"interpolation_error": unknown, "hole_fraction": unknown}
    if dictionary.origins:
        figures["interpolation_error"] = np.array(
            [origin.resampling_error for origin in dictionary.origins]
        )
        figures["hole_fraction"] = np.array(
            [origin.hole_fraction for origin in dictionary.origins]
        )
    elif dictionary.source == EMBEDDED and not dictionary.disc_angular_radius:
        exact = evaluate_embedded(wi, wo)
        values = lookup(dictionary.table, *half_difference(wi, wo))
        figures |= {
            "interpolation_error": weighted_error(values, exact, wi, wo),
            "hole_fraction": np.zeros(len(unknown)),
        }
    return figures


def dictionary_report(
    dictionary: Dictionary, *, disc_angular_radius: float
) -> xr.Dataset:
    """Energy, reciprocity, errors and holes of every material, see `dictionary_quality`.

    Parameters
    ----------
    dictionary
        `embedded_dictionary()` or `read_dictionary(path)`.
    disc_angular_radius
        Angular radius of the lights as seen from the surface [rad]; ignored if the
        tables are already averaged.

    Returns
    -------
    Dataset
        Group `dictionary_report` of the schema and `disc_angular_radius` [rad];
        attributes `source` and `notes`.
    """
    radius = dictionary.disc_angular_radius or disc_angular_radius
    attrs = {"source": dictionary.source, "notes": list(dictionary.notes)}
    figures = dictionary_quality(dictionary, radius) | {"disc_angular_radius": radius}
    return dataset(figures, coords={"dictionary": list(dictionary.names)}, attrs=attrs)
