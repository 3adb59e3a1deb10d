"""Elements of a scene: a reflecting surface, cameras, lights and environments, as frozen
records of arrays; subdivision of a surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates, spline_filter
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from skindb.errors import input_error, require
from skindb.geometry.camera import Pinhole
from skindb.geometry.interreflection import bounce_transfer
from skindb.geometry.mesh import vertex_normals
from skindb.limits import MAX_PICTURE_PIXELS
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.kinds import even_diffuse, surface_model
from skindb.reflectance.model import ReflectanceModel
from skindb.render.image import read_exr
from skindb.schema import FitStatus, check, fitted_of, variables
from skindb.types import (
    AnyArray,
    Array,
    Faces,
    Index,
    Mask,
    dots,
    finite_rows,
    float64,
    lengths,
    unit,
)

NEEDED = (
    variables.SURFEL_POSITION,
    variables.SHADING_NORMAL,
    variables.DIFFUSE_REFLECTANCE,
    variables.DIPOLE_S,
    variables.FIT_STATUS,
)
FOLD_MM = 10.0  # largest distance of a wall of a fold from fitted surfels
MAX_LEVELS = 6  # of subdivision of a triangle into four
MAX_VERTICES = 2_000_000  # of the finer mesh: about 1 GB with the octree
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear Rec. 709


@dataclass(frozen=True)
class Surface:
    """Triangles with reflectance at their vertices; values are interpolated over the triangles."""

    vertices: Array  # (v, 3) mm
    faces: Faces  # (f, 3)
    normals: Array  # (v, 3) unit shading normals
    diffuse: Array  # (v, 3) R_d and the even reflection of the surface
    parameters: Array  # (v, p) of the surface model
    model: ReflectanceModel
    s: Array | None = None  # (v, 3) dipole s, for subsurface transport
    sigma_tr: Array | None = None  # (v, 3) mm^-1, for subsurface transport
    eta: float = 1.3
    # whether light that other parts reflect with one diffuse bounce is added
    inter_reflection: bool = False
    uv: Array | None = None  # (v, 2) texture coordinates, for the detail
    # (size, size, 6) relative difference of R_d, and difference of the unit normal, of the
    # texels from the interpolated vertices
    detail: Array | None = None

    @cached_property
    def _detail_spline(self) -> Array:
        """(6, size, size) coefficients of the cubic spline through the texels of the detail."""
        return np.stack(
            [
                spline_filter(plane, 3, output=np.float32, mode="nearest")
                for plane in np.moveaxis(np.asarray(self.detail, np.float32), 2, 0)
            ]
        )

    def detail_at(self, uv: Array) -> Array:
        """Detail (n, 6) at texture coordinates (n, 2).

        A cubic spline keeps waves of four texels, of which straight lines between the texels
        lose a fifth (Unser 1999).
        """
        place = np.asarray(uv.T[::-1] * self._detail_spline.shape[1] - 0.5, np.float32)
        values = np.empty((6, len(uv)), np.float32)
        for plane, out in zip(self._detail_spline, values, strict=True):
            map_coordinates(
                plane, place, order=3, prefilter=False, mode="nearest", output=out
            )
        return values.T

    @cached_property
    def transfer(self) -> csr_array:
        """(v, v) `bounce_transfer` between the vertices, with the normals of the mesh, as in
        the fit.
        """
        return bounce_transfer(
            self.vertices,
            vertex_normals(self.vertices, self.faces),
            self.faces,
            partial(fresnel_transmittance, eta=self.eta),
            receivers=np.arange(len(self.vertices)),
        )


@dataclass(frozen=True)
class Camera(Pinhole):
    """Pinhole camera with OpenCV distortion; pixel centres at integer + 0.5."""

    width: int
    height: int

    def scaled(self, factor: float) -> Camera:
        """The same view with `factor` times the pixels along each side.

        Raises
        ------
        InputError
            For a picture that would not fit into memory.
        """
        width = round(self.width * factor)
        height = round(self.height * factor)
        require(
            1 <= width * height <= MAX_PICTURE_PIXELS,
            "size",
            f"a picture must have 1 to {MAX_PICTURE_PIXELS:,} pixels",
            f"{width} x {height}",
            "choose another size",
        )
        K = np.diag([factor, factor, 1.0]) @ self.K
        return replace(self, K=K, width=width, height=height)

    def rows(self, low: int, high: int) -> Camera:
        """The part of the picture from row `low` to `high`."""
        K = self.K - np.array([[0.0, 0, 0], [0, 0, low], [0, 0, 0]])
        return replace(self, K=K, height=high - low)


@dataclass(frozen=True)
class Lights:
    """Disc lights; each row of the arrays describes one light."""

    position: Array  # (l, 3) mm
    intensity: Array  # (l, 3) radiant intensity, radiance mm2
    disc_radius: Array  # (l,) mm
    axis: Array  # (l, 3) unit direction each shines along
    falloff: Array  # (l,) exponent n of cos^n

    def __len__(self) -> int:
        return len(self.position)

    def select(self, index: ArrayLike) -> Lights:
        """The lights at `index` (integers or booleans), in this order."""
        i = np.atleast_1d(np.asarray(index))
        parts = (
            self.position,
            self.intensity,
            self.disc_radius,
            self.axis,
            self.falloff,
        )
        return Lights(*(part[i] for part in parts))


def cameras_from_dome(dome: xr.Dataset) -> list[Camera]:
    """Cameras of a stored dome, in its order."""
    names = (
        variables.CAMERA_MATRIX,
        variables.CAMERA_ROTATION,
        variables.CAMERA_TRANSLATION,
        variables.CAMERA_DISTORTION,
        variables.CAMERA_SIZE,
    )
    check(dome, names, where="dome")
    K, R, t, distortion, size = (dome[name].values for name in names)
    return [
        Camera(K[i], R[i], t[i], distortion[i], int(size[i, 0]), int(size[i, 1]))
        for i in range(len(K))
    ]


def lights_from_dome(dome: xr.Dataset) -> Lights:
    """Lights of a stored dome, in its order."""
    names = (
        variables.LIGHT_POSITION,
        variables.LIGHT_INTENSITY,
        variables.LIGHT_DISC_RADIUS,
        variables.LIGHT_AXIS,
        variables.LIGHT_FALLOFF,
    )
    check(dome, names, where="dome")
    return Lights(*(dome[name].values.astype(np.float64) for name in names))


def from_model(model: xr.DataTree) -> Surface:
    """Surface of a fitted model, with the tables of its reduced basis. Surfels without a fit
    take the reflectance of the nearest fitted one, so that pictures have no holes, and
    those without a normal that of the mesh. They are black in folds, whose walls look into
    the head: away from a fitted surfel nearby.

    Parameters
    ----------
    model
        Version of kind "model": groups fitted, mesh and basis.

    Returns
    -------
    Surface
        The surface; it has `sigma_tr` only if the model has translucency.
    """
    fitted = fitted_of(model)
    basis = model["basis"].to_dataset()
    reflectance = surface_model(basis)
    names = (*NEEDED, *reflectance.parameter_variables, variables.REFRACTIVE_INDEX)
    check(fitted, names, where="fitted")
    values = {name: np.asarray(fitted[name].values) for name in NEEDED}
    values[variables.DIFFUSE_REFLECTANCE] = even_diffuse(fitted)
    values["parameters"] = reflectance.parameters_of(fitted)
    matt = values[variables.FIT_STATUS] == FitStatus.LAMBERT
    values["parameters"] = np.where(matt[:, None], 0.0, values["parameters"])
    if variables.SIGMA_TR in fitted:
        values[variables.SIGMA_TR] = np.asarray(fitted[variables.SIGMA_TR].values)
    position = values.pop(variables.SURFEL_POSITION)
    faces = model["mesh"].dataset[variables.TRIANGLE].values
    usable = usable_surfels(values)
    require(
        usable.any(),
        "fitted[fit_status]",
        "at least one surfel must be fitted for a picture",
        "none",
        "see the report of the fit",
    )
    del values[variables.FIT_STATUS]
    values = _filled(values, usable, position, faces)
    sigma_tr = values.get(variables.SIGMA_TR)
    detail = None
    if "detail" in model.children:
        maps = model["detail"].dataset
        names = (variables.DIFFUSE_DETAIL, variables.NORMAL_DETAIL)
        detail = np.concatenate([maps[name].values for name in names], axis=2)
    return Surface(
        vertices=position.astype(np.float64),
        faces=faces,
        normals=values[variables.SHADING_NORMAL],
        diffuse=values[variables.DIFFUSE_REFLECTANCE],
        parameters=values["parameters"],
        model=reflectance,
        s=values[variables.DIPOLE_S],
        sigma_tr=sigma_tr
        if sigma_tr is not None and np.isfinite(sigma_tr).any()
        else None,
        eta=float(fitted[variables.REFRACTIVE_INDEX]),
        inter_reflection=bool(fitted.get(variables.INTER_REFLECTION, False)),
        uv=None if detail is None else fitted[variables.SURFEL_UV].values,
        detail=detail,
    )


def _filled(
    values: dict[str, AnyArray], usable: Mask, position: Array, faces: Faces
) -> dict[str, AnyArray]:
    """Values with those of surfels that are not usable, see `from_model`."""
    apart, near = cKDTree(position[usable]).query(position)
    nearest = np.flatnonzero(usable)[near]
    filled = {name: value[nearest] for name, value in values.items()}
    fitted = filled[variables.SHADING_NORMAL]
    normals = fitted
    for better in (vertex_normals(position, faces), values[variables.SHADING_NORMAL]):
        normals = np.where(finite_rows(better)[:, None], better, normals)
    # scans of faces are open at the back, where light would come in
    in_fold = ((dots(normals, fitted) < 0) & (apart < FOLD_MM))[:, None]
    for name in (variables.DIFFUSE_REFLECTANCE, "parameters"):
        filled[name] = np.where(in_fold, 0.0, filled[name])
    return filled | {variables.SHADING_NORMAL: normals}


def usable_surfels(values: dict[str, AnyArray]) -> Mask:
    """(n,) whether a surfel can be rendered: it is fitted, even if doubtfully, and its
    values are finite.
    """
    status = values[variables.FIT_STATUS]
    good = np.isin(
        status,
        [
            FitStatus.FITTED,
            FitStatus.DIFFUSE_CLAMPED,
            FitStatus.NOT_CONVERGED,
            FitStatus.OBSTRUCTED,
            FitStatus.LAMBERT,
        ],
    )
    for name in (variables.SHADING_NORMAL, variables.DIFFUSE_REFLECTANCE, "parameters"):
        good &= finite_rows(values[name])
    return good


def subdivide_surface(surface: Surface, spacing: float, values: Array) -> Surface:
    """Subdivide triangles until interpolated values differ by at most 1 between their corners,
    or their edges have at most a given length, or there are `MAX_VERTICES`.

    Positions and reflectances of new vertices are means of those at both ends of their
    edge, so that pictures without subsurface light stay the same.

    Parameters
    ----------
    surface
        Surface.
    spacing
        Maximum length of edges [mm].
    values
        (v, c) values of the vertices; triangles with NaN are not divided.
    """
    # takes longer to import than most commands run
    from trimesh.remesh import subdivide

    names = [
        name
        for name in ("normals", "diffuse", "parameters", "s", "sigma_tr", "uv")
        if getattr(surface, name) is not None
    ]
    attributes = {name: float64(getattr(surface, name)) for name in names}
    attributes["values"] = float64(values)
    vertices = float64(surface.vertices)
    faces = np.asarray(surface.faces, np.int64)
    for _ in range(MAX_LEVELS):
        corners = vertices[faces]
        longest = lengths(corners - np.roll(corners, 1, axis=1)).max(axis=1)
        apart = np.ptp(attributes["values"][faces], axis=1).max(axis=1)
        chosen = np.flatnonzero((apart > 1) & (longest > spacing))
        if not len(chosen) or len(vertices) + 3 * len(chosen) > MAX_VERTICES:
            break
        vertices, faces, attributes = subdivide(
            vertices, faces, chosen, vertex_attributes=attributes
        )
    attributes.pop("values")
    attributes["normals"] = unit(attributes["normals"])
    arrays: dict[str, Any] = attributes
    return replace(surface, vertices=vertices, faces=faces, **arrays)


@dataclass(frozen=True)
class Environment:
    """Radiance (h, w, 3) of distant surroundings as an equirectangular image, constant
    in each texel.

    Row 0 is above the head (+y). The middle column is in front of the face (+z), and
    columns to the right of it are at the subject's left (+x).
    """

    radiance: Array

    @classmethod
    def read(cls, path: str | Path) -> Environment:
        """Read an environment from an OpenEXR file.

        Raises
        ------
        InputError
            If the file cannot be read, has no channels R, G and B, is not twice as wide
            as it is high, has values that are negative or not finite, or is zero
            everywhere.
        """
        pixels, names = read_exr(path)
        if names[:3] != ("R", "G", "B"):
            rule = "an environment must have the channels R, G and B"
            cure = "write it as an RGB image"
            raise input_error(str(path), rule, ", ".join(names), cure)
        values = pixels[..., :3].astype(np.float64)
        finite = np.isfinite(values)
        height, width = values.shape[:2]
        if width != 2 * height:
            rule = (
                "a latitude-longitude image of all directions must be twice as wide as "
                "it is high"
            )
            raise input_error(
                str(path), rule, f"{width} x {height} pixels", "convert the image"
            )
        if not finite.all() or values.min() < 0 or values.max() == 0:
            rule = "radiance must be finite, not negative, and not zero everywhere"
            cure = "correct the image"
            fault = (
                f"{int((~finite).sum())} values that are not finite, "
                f"{int((values < 0).sum())} negative ones"
            )
            fault = "zero everywhere" if finite.all() and not values.any() else fault
            raise input_error(str(path), rule, fault, cure)
        return cls(values)

    def texels(self) -> tuple[Array, Array]:
        """Unit directions (n, 3) of the centres of the texels, and radiance times solid angle
        (n, 3).
        """
        height, width, _ = self.radiance.shape
        polar = np.pi * (np.arange(height)[:, None] + 0.5) / height
        azimuth = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
        x = np.sin(polar) * np.sin(azimuth)
        z = np.sin(polar) * np.cos(azimuth)
        y = np.broadcast_to(np.cos(polar), x.shape)
        direction = np.stack([x, y, z], axis=-1).reshape(-1, 3)
        return direction, self.radiance.reshape(-1, 3) * self._solid_angle[:, None]

    def along(self, direction: Array) -> Array:
        """Radiance (n, 3) from unit directions (n, 3)."""
        return self.radiance.reshape(-1, 3)[self._texel(direction)]

    def pdf(self, direction: Array) -> Array:
        """Probability density (n,) per steradian with which `sample` draws unit
        directions (n, 3).
        """
        texel = self._texel(direction)
        return self._probability[texel] / self._solid_angle[texel]

    def sample(self, draw: Array) -> Array:
        """Unit directions (n, 3) drawn in proportion to luminance, from uniform numbers
        (n, 2) in [0, 1).

        The first runs through the texels from the brightest to the darkest, so that
        stratified numbers share out the rays between a sun and the sky.
        """
        height, width, _ = self.radiance.shape
        order, rising = self._rising
        place, across = _inverted(rising, draw[:, 0])
        row, column = np.divmod(order[place], width)
        down = draw[:, 1]
        top = np.cos(np.pi * row / height)
        bottom = np.cos(np.pi * (row + 1) / height)
        cosine = top + down * (bottom - top)
        turn = 2 * np.pi * ((column + across) / width - 0.5)
        sine = np.sqrt(np.maximum(1 - cosine**2, 0.0))
        return np.stack([sine * np.sin(turn), cosine, sine * np.cos(turn)], axis=1)

    def _texel(self, direction: Array) -> Index:
        height, width, _ = self.radiance.shape
        row = np.arccos(np.clip(direction[:, 1], -1, 1)) / np.pi * height
        column = (
            np.arctan2(direction[:, 0], direction[:, 2]) / (2 * np.pi) + 0.5
        ) * width
        row_start = np.minimum(row.astype(np.int64), height - 1) * width
        return row_start + np.minimum(column.astype(np.int64), width - 1)

    @cached_property
    def _solid_angle(self) -> Array:
        height, width, _ = self.radiance.shape
        edge = np.cos(np.pi * np.arange(height + 1) / height)
        return np.repeat((edge[:-1] - edge[1:]) * 2 * np.pi / width, width)

    @cached_property
    def _probability(self) -> Array:
        power = self.radiance.reshape(-1, 3) @ LUMINANCE * self._solid_angle
        return power / power.sum()

    @cached_property
    def _rising(self) -> tuple[Index, Array]:
        """Texels (h w,) from the brightest, and their cumulative probability."""
        brightness = self._probability / self._solid_angle
        order = np.argsort(-brightness, kind="stable")
        rising = np.cumsum(self._probability[order])
        return order, rising / rising[-1]


@dataclass(frozen=True)
class Lighting:
    """Lights of a dome, an environment, or both."""

    lights: Lights | None = None
    environment: Environment | None = None


def _inverted(rising: Array, level: Array) -> tuple[Index, Array]:
    """Indices (n,) of the steps of a cumulative sum that contain levels (n,), and the
    fractions of these steps below them.
    """
    last = len(rising) - 1
    index = np.minimum(np.searchsorted(rising, level, side="right"), last)
    below = np.where(index > 0, rising[index - 1], 0.0)
    step = np.maximum(rising[index] - below, 1e-300)
    return index, np.clip((level - below) / step, 0.0, 1.0)
