"""Oracles: closed forms of ray-plane and ray-sphere intersection, Lambert's law, the
irradiance of a disc.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from skindb.geometry.mesh import vertex_normals
from skindb.geometry.rays import RayScene
from skindb.optics.diffusion import dipole_s
from skindb.reflectance.mixture import Mixture
from skindb.render.scene import Camera, Lights, Surface
from skindb.render.shading import (
    exitances,
    shade_view,
    trace_view,
    transmitted_irradiance,
)
from skindb.virtual.head import FaceShape, parametric_head
from tests.pictures import render_view

FLOAT32 = 2e-6
LAMBERT = 1.0  # index at which Fresnel lets everything pass


def surface(
    vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, eta: float = LAMBERT
) -> Surface:
    n = len(vertices)
    return Surface(
        np.asarray(vertices, float),
        faces,
        normals,
        np.full((n, 3), [0.6, 0.4, 0.3]),
        np.full((n, 1), 0.0),
        Mixture(np.ones((4, 3, 2, 1), np.float32)),
        eta=eta,
    )


def plane(half: float = 100.0, cells: int = 1) -> Surface:
    grid = np.linspace(-half, half, cells + 1)
    x, y = np.meshgrid(grid, grid)
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    i = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    faces = np.concatenate(
        [
            np.stack([i, i + 1, i + cells + 2], 1),
            np.stack([i, i + cells + 2, i + cells + 1], 1),
        ]
    )
    return surface(vertices, faces, np.tile([0.0, 0.0, 1.0], (len(vertices), 1)))


def camera(width: int = 24, height: int = 18, distance: float = 300.0) -> Camera:
    focal = width * 2.0
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    R = np.diag([1.0, -1.0, -1.0])  # looks along -z, image rows run down
    return Camera(K, R, -R @ np.array([0, 0, distance]), np.zeros(5), width, height)


def lights(
    *positions: tuple[float, float, float], radius: float = 0.0, falloff: float = 0.0
) -> Lights:
    position = np.array(positions, float)
    axis = -position / np.linalg.norm(position, axis=1, keepdims=True)
    n = len(position)
    return Lights(
        position,
        np.full((n, 3), [1e5, 2e5, 3e5]),
        np.full(n, radius),
        axis,
        np.full(n, falloff),
    )


def plane_points(view: Camera) -> np.ndarray:
    """Where the rays of the pixel centres meet z = 0."""
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    scale = view.centre[2] / view.K[0, 0]
    return np.stack(
        [(x - view.K[0, 2]) * scale, -(y - view.K[1, 2]) * scale, np.zeros_like(x)],
        axis=-1,
    )


def test_render_view__lambertian_plane() -> None:
    view = camera()
    lamps = lights((200, 100, 400), (-50, 300, 250), falloff=2.0)
    images = render_view(plane(), view, lamps)
    for image, position, axis in zip(images, lamps.position, lamps.axis, strict=True):
        towards = position - plane_points(view)
        d = np.linalg.norm(towards, axis=-1)
        irradiance = towards[..., 2] / d**3 * np.maximum(-(towards @ axis) / d, 0) ** 2
        expected = irradiance[..., None] * [0.6e5, 0.8e5, 0.9e5] / np.pi
        np.testing.assert_allclose(image, expected, rtol=FLOAT32)


def test_render_view__dielectric_plane_at_normal_incidence() -> None:
    # F_r = ((eta - 1)/(eta + 1))^2 at the centre of the picture, light and camera on the normal
    view = camera(width=25, height=25)
    image = render_view(replace(plane(), eta=1.4), view, lights((0.0, 0.0, 500.0)))[0]
    transmitted = 1 - (0.4 / 2.4) ** 2
    expected = np.array([0.6e5, 0.8e5, 0.9e5]) / 500**2 * transmitted**2 / np.pi
    np.testing.assert_allclose(image[12, 12], expected, rtol=1e-5)


def test_render_view__sphere() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=60.0)
    normals = mesh.vertices / 60.0
    view = camera(32, 32)
    lamps = lights((200, 150, 400))
    seen = trace_view(surface(mesh.vertices, mesh.faces, normals), view)
    image = render_view(surface(mesh.vertices, mesh.faces, normals), view, lamps)[0]
    # ray-sphere intersection
    y, x = np.mgrid[:32, :32] + 0.5
    d = np.stack([(x - 16) / 64, -(y - 16) / 64, -np.ones_like(x)], axis=-1)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    b = d @ view.centre
    root = b**2 - (300**2 - 60**2)
    hit = root > 0
    p = view.centre + (-b - np.sqrt(np.maximum(root, 0)))[..., None] * d
    towards = lamps.position[0] - p
    distance = np.linalg.norm(towards, axis=-1)
    cosine = np.maximum(
        np.einsum("hwc,hwc->hw", towards / distance[..., None], p / 60), 0
    )
    expected = (
        np.where(hit, cosine / distance**2, 0)[..., None]
        * [0.6e5, 0.8e5, 0.9e5]
        / np.pi
    )
    # the rim of a polygon
    assert (np.abs((seen.coverage > 0).astype(float) - hit) > 0).sum() <= 4
    inner = hit & (np.einsum("hwc,hwc->hw", -d, p / 60) > 0.2)
    # facets of 2 degrees: the point moves by 60 (1 - cos 1 deg) = 0.01 mm along the ray
    np.testing.assert_allclose(
        image[inner], expected[inner], atol=5e-3 * expected.max()
    )


def test_render_view__shadow_of_a_sphere_on_a_plane() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=15.0)
    flat = plane(200.0)
    vertices = np.concatenate([flat.vertices, ball.vertices + np.array([0, 0, 60])])
    both = surface(
        vertices,
        np.concatenate([flat.faces, ball.faces + 4]),
        np.concatenate([flat.normals, ball.vertices / 15]),
    )
    view = camera(60, 60)
    lamps = lights((250, 0, 300))
    lit = render_view(both, view, lamps)[0, ..., 0] > 0
    points = plane_points(view)
    towards = lamps.position[0] - points
    along = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    # of the ray to the ball's centre
    nearest = np.linalg.norm(np.cross([0, 0, 60] - points, along), axis=-1)
    camera_ray = points - view.centre
    camera_ray /= np.linalg.norm(camera_ray, axis=-1, keepdims=True)
    on_plane = (
        np.linalg.norm(np.cross([0, 0, 60] - view.centre, camera_ray), axis=-1) > 15.5
    )
    shadow = on_plane & (nearest < 14.8)
    bright = on_plane & (nearest > 15.2)
    assert shadow.sum() > 50
    assert not lit[shadow].any()
    assert lit[bright].all()


def test_render_view__disc_light_converges_to_its_irradiance() -> None:
    # isotropic points over a disc of radius R at height h: E = 2 I / R^2 (1 - h / sqrt(h^2 + R^2))
    view = camera(width=25, height=25)
    h = 100.0
    R = 60.0
    irradiance = 2 / R**2 * (1 - h / np.hypot(h, R)) * np.array([0.6e5, 0.8e5, 0.9e5])
    # midpoint rule in r^2: error falls with the square of the number of points; 16 give
    # 3e-4 on the axis
    image = render_view(
        plane(), view, lights((0.0, 0.0, h), radius=R), disc_samples=16
    )[0]
    np.testing.assert_allclose(image[12, 12] * np.pi, irradiance, rtol=5e-4)
    # the four rays of a pixel share the same points out among them
    image = render_view(
        plane(), view, lights((0.0, 0.0, h), radius=R), disc_samples=4, samples=2
    )[0]
    np.testing.assert_allclose(image[12, 12] * np.pi, irradiance, rtol=5e-3)


def test_render_view__tables_that_include_the_disc_are_read_at_its_centre() -> None:
    view = camera()
    small = lights((0.0, 0.0, 100.0))
    wide = lights((0.0, 0.0, 100.0), radius=60.0)
    expected = render_view(plane(), view, small)
    averaged = replace(plane().model, disc_angular_radius=0.1)
    found = render_view(replace(plane(), model=averaged), view, wide)
    np.testing.assert_allclose(found, expected, rtol=FLOAT32)


def test_render_view__terms_add_up() -> None:
    glossy = replace(plane(), parameters=np.full((4, 1), 0.7), eta=1.3)
    view = camera()
    lamps = lights((200, 100, 400))
    parts = [
        render_view(glossy, view, lamps, terms=(term,))
        for term in ("diffuse", "surface")
    ]
    np.testing.assert_allclose(
        render_view(glossy, view, lamps), parts[0] + parts[1], rtol=FLOAT32
    )
    # a table of ones is Lambertian with albedo pi
    lambert = render_view(plane(), view, lamps, terms=("diffuse",))
    np.testing.assert_allclose(
        parts[1] / np.pi, lambert / np.array([0.6, 0.4, 0.3]) * 0.7, rtol=2 * FLOAT32
    )
    with pytest.raises(ValueError, match="terms must be among"):
        render_view(glossy, view, lamps, terms=("specular",))


def test_trace_view__coverage_and_antialiasing() -> None:
    view = camera()
    # covers x > 0
    half = replace(plane(), vertices=plane().vertices + np.array([100.0, 0, 0]))
    traced = trace_view(half, view, samples=4)
    np.testing.assert_allclose(traced.coverage[:, :12], 0)
    np.testing.assert_allclose(traced.coverage[:, 12:], 1)
    # half a pixel more
    shifted = replace(half, vertices=half.vertices + np.array([300 / 48 / 2, 0, 0]))
    np.testing.assert_allclose(
        trace_view(shifted, view, samples=4).coverage[:, 12], 0.5
    )


def test_trace_view__backs_do_not_shine() -> None:
    flat = plane(cells=2)
    behind = replace(flat, faces=flat.faces[:, ::-1])
    assert trace_view(behind, camera()).coverage.max() == 0


def test_render_view__distorted_pixels_see_what_projects_there() -> None:
    from skindb.geometry.camera import project

    view = replace(camera(40, 30), distortion=np.array([-0.2, 0.1, 1e-3, -2e-3, 0.0]))
    traced = trace_view(plane(), view)
    pixels, _ = project(traced.position, view.K, view.R, view.t, view.distortion)
    expected = np.stack([traced.pixel % 40, traced.pixel // 40], axis=1) + 0.5
    np.testing.assert_allclose(pixels, expected, atol=1e-4)


def test_render_view__uniform_light_under_a_plane_gives_the_local_answer() -> None:
    # a light so far away that the plane receives the same everywhere: the dipole must
    # return R_d (eq. 5)
    flat = replace(plane(60.0, cells=60), eta=1.3)
    s, _ = dipole_s(flat.diffuse, eta=1.3)
    skin = replace(flat, s=s, sigma_tr=np.full(s.shape, [0.5, 0.8, 1.1]))
    view = camera(12, 9)
    lamps = lights((1e6, 0, 2e6))
    local = render_view(skin, view, lamps)
    spread = render_view(skin, view, lamps, subsurface=True)
    np.testing.assert_allclose(spread, local, rtol=1e-4)
    glow = exitances(skin, lamps, RayScene(skin.vertices, skin.faces))
    np.testing.assert_allclose(
        render_view(skin, view, lamps, subsurface=True, glow=glow), spread, rtol=FLOAT32
    )
    np.testing.assert_allclose(
        render_view(skin, view, lamps, subsurface=True, glow=glow * 2),
        2 * spread,
        rtol=FLOAT32,
    )


def test_render_view__subsurface_light_crosses_a_shadow_line() -> None:
    # a wall casts a hard shadow; under the skin red, of the longest way, reaches furthest into it
    flat = plane(30.0, cells=60)
    wall = np.array([[0.0, -40, 0.2], [0, 40, 0.2], [0, 40, 60], [0, -40, 60]])
    n = len(flat.vertices)
    scene = surface(
        np.concatenate([flat.vertices, wall]),
        np.concatenate([flat.faces, [[n, n + 1, n + 2], [n, n + 2, n + 3]]]),
        np.concatenate([flat.normals, np.tile([-1.0, 0, 0], (4, 1))]),
        eta=1.3,
    )
    s, _ = dipole_s(scene.diffuse, eta=1.3)
    skin = replace(scene, s=s, sigma_tr=np.full(s.shape, [0.3, 0.9, 1.5]))
    view = camera(48, 4)
    lamps = lights((400.0, 0, 400.0))
    near = Camera(view.K * [[8], [8], [1]], view.R, view.t, view.distortion, 384, 32)
    image = render_view(skin, near, lamps, subsurface=True)[0, 16]
    local = render_view(skin, near, lamps)[0, 16]
    received = transmitted_irradiance(skin, lamps, RayScene(skin.vertices, skin.faces))[
        :n
    ]
    shaded = (flat.vertices[:, 0] < -0.3) & (np.abs(flat.vertices[:, 1]) < 25)
    assert (received[shaded] == 0).all()
    assert (received[flat.vertices[:, 0] > 0.3] > 0).all()
    x = (np.arange(384) + 0.5 - 192) * 300 / near.K[0, 0]
    dark = (x < -1) & (x > -2)
    assert local[dark].max() == 0
    assert (image[dark].min(axis=0) > 0).all()
    level = image[dark].mean(axis=0) / image[(x > 15) & (x < 20)].mean(axis=0)
    assert level[0] > level[1] > level[2]


def test_render_view__subsurface_needs_its_parameters() -> None:
    with pytest.raises(ValueError, match="must have s and sigma_tr"):
        render_view(plane(), camera(), lights((0, 0, 400)), subsurface=True)


def test_trace_view__detail_of_texels() -> None:
    """Rationale: one tilt and one factor in the left half of the map are those of a surface
    with these normals and this R_d. Expected: the same picture there, and no change to the right.
    """
    flat = plane()
    x, y, _ = flat.vertices.T
    tilt = np.array([0.2, -0.1, 0.05])
    detail = np.zeros((64, 64, 6), np.float16)
    detail[:, :32] = [0.25, -0.5, 0.5, *tilt]
    uv = np.stack([x / 200 + 0.5, 0.5 - y / 200], axis=1)
    # exactly representable factors; the tilt is rounded as the map is
    tilted = replace(
        flat,
        normals=flat.normals + tilt.astype(np.float16),
        diffuse=flat.diffuse * [1.25, 0.5, 1.5],
    )
    shown, half, whole = (
        render_view(surface, camera(), lights((200, 100, 400)))
        for surface in (replace(flat, uv=uv, detail=detail), tilted, flat)
    )
    # columns near the middle mix both halves
    assert shown[..., :6, :3] == pytest.approx(half[..., :6, :3], rel=1e-5)
    assert shown[..., 18:, :3] == pytest.approx(whole[..., 18:, :3], rel=1e-5)


def test_trace_view__keeps_waves_of_four_texels() -> None:
    """Rationale: R_d is a wave of 10 % of four texels, of which bilinear interpolation keeps
    0.81. Expected: at least 0.97 of it at all rays.
    """
    flat = plane()
    x, y, _ = flat.vertices.T
    # rays do not meet the centres of texels
    uv = np.stack([x / 230 + 0.5, 0.5 - y / 230], axis=1)
    phases = np.pi / 2 * np.array([np.arange(256) + 0.5 + 0.3])
    detail = np.zeros((256, 256, 6), np.float32)
    detail[..., :3] = 0.1 * np.cos(phases)[..., None]
    view = trace_view(replace(flat, uv=uv, detail=detail), camera(48, 36), samples=4)
    phase = np.pi / 2 * ((view.position[:, 0] / 230 + 0.5) * 256 + 0.3)
    true = 0.1 * np.cos(phase)
    shown = view.tint[:, 1] - 1
    assert (shown * true).sum() / (true**2).sum() > 0.97
    assert shown == pytest.approx(true, abs=0.005)


def test_trace_view__the_outline_of_a_nose_is_not_black() -> None:
    """Every triangle that faces the camera reflects light, although at the outline, on triangles
    of 4 mm, shading normals face away.
    """
    head = parametric_head(FaceShape(), spacing_mm=4.0)
    n = len(head.vertices)
    nose = head.vertices[head.vertices[:, 2].argmax()]
    towards = np.array([np.sin(0.7), 0, np.cos(0.7)])
    R = np.stack([[np.cos(0.7), 0, -np.sin(0.7)], [0, -1, 0], -towards])
    K = np.array([[600.0, 0, 40], [0, 600, 40], [0, 0, 1]])
    camera = Camera(K, R, -R @ (nose + 400 * towards), np.zeros(5), 80, 80)
    normals = vertex_normals(head.vertices, head.faces)
    surface = Surface(
        head.vertices,
        head.faces,
        normals,
        np.ones((n, 3)),
        np.zeros((n, 1)),
        Mixture(np.zeros((4, 4, 4, 1), np.float32)),
        eta=1.0,
    )
    scene = RayScene(surface.vertices, surface.faces)
    row, column = np.divmod(np.arange(80 * 80), 80)
    rays = camera.rays(np.stack([column, row], axis=1) + 0.5)
    face, weight, _ = scene.first_hit(np.broadcast_to(camera.centre, rays.shape), rays)
    corners = head.vertices[head.faces[face]]
    facet = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    front = (face >= 0) & (np.einsum("nc,nc->n", facet, rays) < 0)
    shading = np.einsum("nk,nkc->nc", weight, normals[head.faces[face]])
    away = front & (np.einsum("nc,nc->n", shading, rays) > 0)
    assert away.sum() > 5
    view = trace_view(surface, camera, scene=scene)
    np.testing.assert_array_equal(view.coverage.ravel() == 1, front)
    lamp = Lights(
        camera.centre[None],
        np.full((1, 3), 400.0**2),
        np.zeros(1),
        -towards[None],
        np.zeros(1),
    )
    picture = shade_view(view, surface, lamp, scene)[0]
    assert picture.reshape(-1, 3)[away].min() > 0
