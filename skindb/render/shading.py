"""Images of a surface under disc lights: traced views, ray-traced shadows, and subsurface
transport, by which light leaves the skin in another place than it enters.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from skindb.errors import input_error
from skindb.geometry.mesh import face_crosses, vertex_areas
from skindb.geometry.rays import RayScene
from skindb.optics.dipole_tree import subsurface_exitance
from skindb.optics.fresnel import circular_reversal, fresnel_transmittance
from skindb.reflectance.model import Lamp, Points
from skindb.reflectance.sampling import tangents
from skindb.render.scene import Camera, Lights, Surface
from skindb.types import (
    Array,
    Float32,
    Index,
    Mask,
    dots,
    finite_rows,
    float64,
    lengths,
    unit,
)

DEFAULT_OPENING = 0.1  # of the octree
# range of openings: below it, the tree takes longer than it saves; above it, pictures
# do not become faster
OPENINGS = (0.02, 0.4)
# maximum relative error of the exitance against all pairs (docs/performance.md)
ERROR_PER_OPENING = 0.015

Image = Float32
TERMS = ("diffuse", "surface")
# of shading normals: on triangles that are seen at a grazing angle they may face away, and the
# outline of a nose would be a black line
MIN_VIEW_COSINE = 0.05
GOLDEN_ANGLE = np.pi * (3 - 5**0.5)


def require_translucency(surface: Surface) -> None:
    """Raise `InputError` if there are channels in which no vertex has sigma_tr."""
    finite = np.isfinite(
        np.zeros((0, 3)) if surface.sigma_tr is None else surface.sigma_tr
    )
    if missing := [
        channel for c, channel in enumerate("RGB") if not finite[:, c].any()
    ]:
        raise input_error(
            "model",
            "must have sigma_tr in R, G and B for subsurface transport",
            f"no probe site with a valid fit in {', '.join(missing)}",
            "omit --subsurface, or repeat the probe measurement",
        )


def transmitted_irradiance(
    surface: Surface, lights: Lights, scene: RayScene
) -> Float32:
    """Irradiance (v, l) under the boundary per radiant intensity, F_t(w_i) cos(theta_i)
    / d^2 [mm-2].

    It is computed from the centre of each light, with its fall-off. It is zero if the
    vertex faces away from the light or is in its shadow.
    """
    points = surface.vertices
    out = np.empty((len(points), len(lights)), np.float32)
    for i in range(len(lights)):
        place = np.broadcast_to(lights.position[i], points.shape)
        out[:, i] = received_light(
            lights, i, place, points, surface.normals, scene, surface.eta
        )
    return out


def received_light(
    lights: Lights,
    i: int,
    place: Array,
    points: Array,
    normals: Array,
    scene: RayScene,
    eta: float,
) -> Array:
    """Irradiance (n,) under the boundary per radiant intensity of light i [mm-2] at points
    (n, 3), each lit from a place (n, 3) of the light; 0 in shadows and behind.
    """
    towards = place - points
    square = dots(towards, towards)
    cosine = dots(towards, normals) / np.sqrt(square)
    front = np.flatnonzero(cosine > 0)
    hidden = scene.occluded(points[front], place[front], normal=normals[front])
    lit = front[~hidden]
    out = np.zeros(len(points))
    along = np.maximum(-(towards[lit] @ lights.axis[i]) / np.sqrt(square[lit]), 0)
    passed = fresnel_transmittance(np.minimum(cosine[lit], 1), eta)
    out[lit] = cosine[lit] / square[lit] * along ** float(lights.falloff[i]) * passed
    return out


def exitances(
    surface: Surface,
    lights: Lights,
    scene: RayScene,
    *,
    receivers: Mask | None = None,
) -> Float32:
    """Radiant exitance under the boundary for each light, by the dipole octree (eq. 9;
    Jensen and Buhler 2002).

    Parameters
    ----------
    surface
        Surface with `s` and `sigma_tr`; vertices where these are unknown neither
        receive nor send light.
    lights
        Lights, which are all computed in one traversal of the octree.
    scene
        Ray tracer of the surface.
    receivers
        (v,) vertices whose exitance is needed; default all. It is 0 at the others.

    Returns
    -------
    ndarray
        (l, v, 3), valid for all cameras. The kernel is divided by its sum, so that
        uniform light gives exactly R_d.
    """
    if surface.s is None or surface.sigma_tr is None:
        raise ValueError(
            "the surface must have s and sigma_tr for subsurface transport, found None"
        )
    finite = finite_rows(surface.s) & finite_rows(surface.sigma_tr)
    irradiance = transmitted_irradiance(surface, lights, scene)
    out = np.zeros((len(lights), len(surface.vertices), 3), np.float32)
    out[:, finite] = subsurface_exitance(
        surface.vertices[finite],
        vertex_areas(surface.vertices, surface.faces)[finite],
        irradiance[finite],
        surface.s[finite],
        surface.sigma_tr[finite],
        eta=surface.eta,
        tolerance=DEFAULT_OPENING,
        receivers=None if receivers is None else receivers[finite],
    )
    out *= lights.intensity[:, None].astype(np.float32)
    return out


def bounced_exitance(surface: Surface, received: Array) -> Array:
    """Radiant exitance (v, 3) under the boundary, R_d E', by light E' that other parts of the
    surface reflect with one diffuse bounce.

    `received` (v, 3) or (v, 1) is the irradiance under the boundary by the lights.
    """
    diffuse = np.nan_to_num(surface.diffuse)
    return diffuse * (surface.transfer @ (diffuse * received))


def tree_opening(error: float | None) -> tuple[float, float]:
    """Opening of the octree for a picture with this relative error, and the bound on
    its own relative error.

    The octree may contribute a tenth of the target error. Without a target error, the
    opening is 0.1.
    """
    opening = (
        DEFAULT_OPENING
        if error is None
        else float(np.clip(error / 10 / ERROR_PER_OPENING, *OPENINGS))
    )
    return opening, ERROR_PER_OPENING * opening


@dataclass(frozen=True)
class View:
    """The visible points of one camera, traced once so that they can be shaded for any light."""

    camera: Camera
    samples: int  # rays per pixel and axis
    pixel: Index  # (n,) flat index
    ray: Index  # (n,) which of the pixel's samples**2 rays
    corners: Index  # (n, 3) vertices of the triangle hit
    barycentric: Array  # (n, 3)
    position: Array  # (n, 3) mm
    normal: Array  # (n, 3) unit
    towards: Array  # (n, 3) unit, to the camera
    tint: Array  # (n, 3) or (1, 1) factor of the detail on what is diffuse

    @property
    def coverage(self) -> Image:
        """(h, w) fraction of each pixel's rays that meet a surface facing the
        camera: the alpha of the image.
        """
        count = np.bincount(
            self.pixel, minlength=self.camera.height * self.camera.width
        )
        return (
            (count / self.samples**2)
            .astype(np.float32)
            .reshape(self.camera.height, self.camera.width)
        )

    def shown(self, vertices: int) -> Mask:
        """(vertices,) whether a vertex belongs to a triangle that is hit; the others do
        not affect the image.
        """
        mask = np.zeros(vertices, np.bool_)
        mask[self.corners] = True
        return mask

    def interpolate(self, values: Array) -> Array:
        """Values (v, c) of the vertices at the hits, (n, c)."""
        return np.einsum("nk,nkc->nc", self.barycentric, values[self.corners])

    def image(self, values: Array) -> Image:
        """(h, w, c) means over each pixel's rays of values (n, c) at the hits; rays
        that miss count as 0.
        """
        size = self.camera.height * self.camera.width
        planes = [
            np.bincount(self.pixel, weights=column, minlength=size)
            for column in values.T
        ]
        stacked = np.stack(planes, axis=-1) / self.samples**2
        return stacked.astype(np.float32).reshape(
            self.camera.height, self.camera.width, -1
        )


def trace_view(
    surface: Surface,
    camera: Camera,
    *,
    samples: int = 1,
    scene: RayScene | None = None,
    rng: np.random.Generator | None = None,
    pixels: Mask | None = None,
) -> View:
    """Trace camera rays through samples x samples sub-pixels.

    The rays go through the centres of the sub-pixels, or with `rng` through a random
    point of each. With `pixels` (h, w), only the rays of these pixels are traced; they
    do not depend on it.

    Hits are discarded if the triangle is seen from behind; there the surface occludes but
    reflects no light. A shading normal that faces away from the camera, or nearly so,
    although its triangle does not, is turned until its cosine is MIN_VIEW_COSINE.
    """
    rays = RayScene(surface.vertices, surface.faces) if scene is None else scene
    offset = (np.arange(samples) + 0.5) / samples
    traced = (
        np.arange(camera.height * camera.width)
        if pixels is None
        else np.flatnonzero(pixels)
    )
    y, x = np.divmod(traced[:, None], camera.width)
    # rays of a pixel are adjacent, which keeps the ray tracer and memory access coherent
    sy = np.repeat(offset, samples)
    sx = np.tile(offset, samples)
    place = np.stack([x + sx, y + sy], axis=-1)
    if rng is not None:
        drawn = rng.random((camera.height * camera.width, samples**2, 2))
        place += ((drawn if pixels is None else drawn[traced]) - 0.5) / samples
    direction = camera.rays(place.reshape(-1, 2))
    face, barycentric, _ = rays.first_hit(
        np.broadcast_to(camera.centre, direction.shape), direction
    )
    hit = np.flatnonzero(face >= 0)
    corners = np.asarray(surface.faces)[face[hit]].astype(np.int64)
    weight = barycentric[hit]
    position, normal, towards, tint, facing = _facing_points(
        surface, camera, corners, weight
    )
    pixel, ray = np.divmod(hit[facing], samples**2)
    return View(
        camera,
        samples,
        traced[pixel],
        ray,
        corners[facing],
        weight[facing],
        position[facing],
        normal[facing],
        towards[facing],
        tint if surface.detail is None else tint[facing],
    )


def _facing_points(
    surface: Surface, camera: Camera, corners: Index, weight: Array
) -> tuple[Array, Array, Array, Array, Mask]:
    """Positions, unit normals, directions to the camera and `View.tint` (n, 3) of hits, and
    whether the surface faces the camera.
    """
    tint: Array = np.ones((1, 1))
    normal = np.einsum("nk,nkc->nc", weight, surface.normals[corners])
    position = np.einsum("nk,nkc->nc", weight, surface.vertices[corners])
    if surface.detail is not None and surface.uv is not None:
        uv = np.einsum("nk,nkc->nc", weight, surface.uv[corners])
        detail = surface.detail_at(uv)
        tint = 1 + detail[:, :3]
        normal += detail[:, 3:]
    with np.errstate(invalid="ignore"):
        normal = unit(normal)
        towards = camera.centre - position
        towards = unit(towards)
        facet = face_crosses(surface.vertices, corners)
        facing = (dots(facet, towards) > 0) & finite_rows(normal)
        lacking = np.maximum(MIN_VIEW_COSINE - dots(normal, towards), 0)
        normal = unit(normal + lacking[:, None] * towards)
    return position, normal, towards, tint, facing


def shade_view(
    view: View,
    surface: Surface,
    lights: Lights,
    scene: RayScene,
    *,
    disc_samples: int = 4,
    subsurface: bool = False,
    terms: Collection[str] = TERMS,
    glow: Image | None = None,
) -> Image:
    """One linear image per light (Weyrich et al. 2005, eq. 1 to 4 and 8).

    Parameters
    ----------
    view, surface, lights, scene
        The traced view of a camera, the surface that it sees, the lights, and the ray tracer
        of the surface.
    disc_samples
        Points on each light's disc per ray. The rays of a pixel use different points; a
        single point is the centre.
    subsurface
        Whether diffuse light travels through the skin (dipole, eq. 9) instead of
        leaving where it enters.
    terms
        Terms of the BRDF to include: "diffuse", "surface" or both.
    glow
        (l, v, 3) `exitances` of these lights, if already computed; all cameras can share them.

    Returns
    -------
    ndarray
        (l, h, w, 3) float32 radiance; 0 where no surface is visible. `View.coverage` is the
        alpha.
    """
    if unknown := set(terms) - set(TERMS):
        raise ValueError(f"terms must be among {TERMS}, found {sorted(unknown)}")
    diffuse = view.interpolate(surface.diffuse) * float(
        "diffuse" in terms and not subsurface
    )
    points = seen_points(view, surface, diffuse, with_surface="surface" in terms)
    escape = None
    if (subsurface or surface.inter_reflection) and "diffuse" in terms:
        escape = escape_factor(view, surface.eta)
    if escape is not None and subsurface and glow is None:
        glow = exitances(
            surface, lights, scene, receivers=view.shown(len(surface.vertices))
        )
    received = np.zeros((len(surface.vertices), len(lights)), np.float32)
    if escape is not None and surface.inter_reflection:
        received = transmitted_irradiance(surface, lights, scene)
    images = np.empty(
        (len(lights), view.camera.height, view.camera.width, 3), np.float32
    )
    for i in range(len(lights)):
        # every ray of a pixel has its own points; together they cover the disc
        chosen = view.ray[:, None] * disc_samples + np.arange(disc_samples)
        place = _lamp_points(lights, i, disc_samples * view.samples**2)[chosen]
        lit = _lit(scene, view, place)
        if surface.model.disc_included:  # only the shadow of the disc is sampled
            place = np.broadcast_to(lights.position[i], (len(lit), 1, 3))
            lit = lit.mean(axis=1, keepdims=True)
        lamp = Lamp(place, lit, lights.axis[i], float(lights.falloff[i]))
        shaded = surface.model.shade(points, lamp, eta=surface.eta)
        values = shaded * lights.intensity[i]
        if escape is not None and glow is not None:
            values = values + escape * view.interpolate(glow[i])
        if escape is not None and surface.inter_reflection:
            bounced = bounced_exitance(surface, received[:, i, None])
            values += escape * view.interpolate(bounced) * lights.intensity[i]
        images[i] = view.image(values)
    return images


def seen_points(
    view: View, surface: Surface, diffuse: Array, *, with_surface: bool
) -> Points:
    """The hits of a view, with R_d (n, 3) and the parameters of the surface model."""
    parameters: Array = np.zeros((len(view.pixel), 0))
    if with_surface:
        parameters = view.interpolate(surface.parameters)
    diffuse = diffuse * view.tint
    return Points(view.position, view.normal, view.towards, diffuse, parameters)


def polariser_factor(
    view: View, light: Array, polarisation: float, eta: float
) -> Image:
    """Factor (h, w, 1) of the surface term by circular polarisers of a light at (3,) and of
    the camera, whose degrees of polarisation have this product.
    """
    towards = light - view.position
    towards = unit(towards)
    cosine = lengths(towards + view.towards) / 2  # of theta_d
    return view.image(1 - polarisation * circular_reversal(cosine, eta)[:, None])


def _lamp_points(lights: Lights, i: int, total: int) -> Array:
    """(total, 3) points on the disc of light i with equal areas, in a sunflower
    pattern; one point is the centre.
    """
    q = np.arange(total)
    radius = lights.disc_radius[i] * np.sqrt((q + 0.5) / total) * float(total > 1)
    axis = lights.axis[i]
    tangent = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])
    tangent = tangent / np.linalg.norm(tangent)
    second = np.cross(axis, tangent)
    across = (
        np.cos(q * GOLDEN_ANGLE)[:, None] * tangent
        + np.sin(q * GOLDEN_ANGLE)[:, None] * second
    )
    return lights.position[i] + radius[:, None] * across


def points_on_discs(lights: Lights, chosen: Index, rng: np.random.Generator) -> Array:
    """Points (n, 3) drawn uniformly on the discs of the chosen lights (n,)."""
    tangent, second = tangents(float64(lights.axis))
    radius = lights.disc_radius[chosen] * np.sqrt(rng.random(len(chosen)))
    turn = 2 * np.pi * rng.random(len(chosen))
    across = (
        np.cos(turn)[:, None] * tangent[chosen] + np.sin(turn)[:, None] * second[chosen]
    )
    return lights.position[chosen] + radius[:, None] * across


def _lit(scene: RayScene, view: View, lamp: Array) -> Float32:
    """(n, p) 1 where the lamp point is above the horizon of the shading normal and not
    occluded, else 0.
    """
    above = np.einsum("npc,nc->np", lamp - view.position[:, None], view.normal) > 0
    rows, column = np.nonzero(above)
    above[rows, column] = ~scene.occluded(
        view.position[rows], lamp[rows, column], normal=view.normal[rows]
    )
    return np.asarray(above, np.float32)


def escape_factor(view: View, eta: float) -> Array:
    """(n, 1) or (n, 3) F_t(w_o) / pi: radiance towards the camera per radiant exitance under
    the boundary (eq. 9), with the detail.
    """
    cosine = dots(view.normal, view.towards)
    return view.tint * (fresnel_transmittance(cosine, eta) / np.pi)[:, None]
