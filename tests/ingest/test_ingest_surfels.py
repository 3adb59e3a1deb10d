from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from sphere import RADIUS, look_at

from skindb.errors import InputError
from skindb.geometry.camera import camera_centre, pixel_rays, project
from skindb.geometry.clean import clean_mesh
from skindb.geometry.mesh import morton_order, subdivide, vertex_normals
from skindb.geometry.rays import RayScene
from skindb.ingest.surfels import (
    BLEND_NODES,
    BLENDED,
    SurfelSet,
    blended_lobes,
    build_surfels,
    camera_visibility,
    disc_points,
    light_visibility,
    subdivision,
)
from skindb.virtual.face import FaceShape
from skindb.virtual.head import parametric_head
from skindb.virtual.person import cohort_people, face_shape


def plate_with_wall(spacing=1.0):
    """A plate of 41 x 41 points, `spacing` mm apart in x, 1 mm in y, and a wall of 5 mm
    height on it at x = 5.5.
    """
    y, x = np.mgrid[-20:21, -20:21] * np.array([1, spacing])[:, None, None]
    plate = np.stack([x.ravel(), y.ravel(), np.zeros(41 * 41)], axis=1)
    cell = np.arange(40)[:, None] * 41 + np.arange(40)
    a, b, c, d = (v.ravel() for v in (cell, cell + 1, cell + 41, cell + 42))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    wall = np.array([[5.5, -30, 0.01], [5.5, 30, 0.01], [5.5, -30, 5], [5.5, 30, 5]])
    n = len(plate)
    all_faces = np.concatenate([faces, [[n, n + 1, n + 2], [n + 1, n + 3, n + 2]]])
    normal = np.tile([0.0, 0, 1], (n, 1))
    one = np.ones(n)
    return SurfelSet(
        plate,
        normal,
        one,
        plate[:, :2],
        faces,
        (),
        np.zeros((n, 0), bool),
    ), RayScene(np.concatenate([plate, wall]), all_faces)


def test_disc_points__have_the_moments_of_the_disc(capture):
    """Second moment of a disc about a diameter: r^2 / 4."""
    light = replace(capture.dome.lights[2], disc_radius=12.0)
    points = disc_points(light) - light.position
    np.testing.assert_allclose(points @ light.axis, 0, atol=1e-9)
    np.testing.assert_allclose(points.mean(axis=0), 0, atol=1e-9)
    values = np.linalg.eigvalsh(points.T @ points / 5)
    np.testing.assert_allclose(values, [0, 36 * 0.96, 36 * 0.96], rtol=1e-6, atol=1e-9)


def test_light_visibility__shadow_and_penumbra_of_a_wall(capture):
    """The wall's shadow ends where the line from the light over its edge meets the
    plate: 5 mm tan(angle).
    """
    surfels, scene = plate_with_wall()
    light = replace(
        capture.dome.lights[0], position=np.array([400.0, 0, 400]), disc_radius=40.0
    )
    light = replace(light, axis=-light.position / np.linalg.norm(light.position))
    with ThreadPoolExecutor(1) as pool:
        share = (
            light_visibility(surfels, [light], scene, pool)[:, 0]
            .reshape(41, 41)[20]
            .astype(float)
        )
    x = np.arange(-20, 21)
    # towards (400, 0, 400) the light over the edge (5.5, 5) leaves the plate at x = 0.4
    assert (share[(x > 2) & (x <= 5)] == 0).all()
    assert (share[(x > 6) | (x < -2)] == 1).all()
    point = replace(light, disc_radius=0.0)
    with ThreadPoolExecutor(1) as pool:
        hard = light_visibility(surfels, [point], scene, pool)[:, 0].reshape(41, 41)[20]
    assert set(np.unique(hard)) == {0, 1}
    assert ((hard == 0) == ((x > 0.4) & (x <= 5))).all()


def disc_above(edge, point, light):
    """Fraction of a light's disc beyond the plane through a point and the line (x, .,
    z): a segment of the circle.
    """
    normal = np.cross(np.array([edge[0], 0, edge[1]]) - point, [0, 1, 0])
    normal *= np.sign(normal[2])
    in_plane = normal - (normal @ light.axis) * light.axis
    h = np.clip(
        normal
        @ (light.position - point)
        / np.linalg.norm(in_plane)
        / light.disc_radius,
        -1,
        1,
    )
    return 1 - (np.arccos(h) - h * np.sqrt(1 - h * h)) / np.pi


def test_light_visibility__share_of_the_disc_beside_a_wall(capture):
    """Five points of equal weight: off by 0.3 where three of them meet the edge at
    once, by 0.1 in the mean.
    """
    surfels, scene = plate_with_wall(0.1)
    direction = np.array([np.sqrt(0.5), 0, np.sqrt(0.5)])
    light = replace(
        capture.dome.lights[0],
        position=560 * direction,
        disc_radius=40.0,
        axis=-direction,
    )
    with ThreadPoolExecutor(1) as pool:
        share = light_visibility(surfels, [light], scene, pool)[:, 0].astype(float)
    at = np.flatnonzero(np.abs(surfels.position[:, 1]) < 10)
    exact = np.array([disc_above((5.5, 5.0), surfels.position[i], light) for i in at])
    soft = (exact > 0) & (exact < 1)
    assert 5 * 19 < soft.sum() < 30 * 19
    np.testing.assert_array_equal(share[at][~soft], exact[~soft])
    error = np.abs(share[at] - exact)[soft]
    assert error.max() < 0.31
    assert error.mean() < 0.12


def head_and_places(count):
    """A head of 1.5 mm spacing with its nose, lids and lips, and places of lights round it."""
    head = parametric_head(FaceShape(), spacing_mm=3.0)
    vertices, faces, _ = subdivide(head.vertices, head.faces, 1)
    order = morton_order(vertices)
    position = vertices[order]
    faces = np.argsort(order)[faces]
    one = np.ones(len(order))
    normal = vertex_normals(position, faces)
    surfels = SurfelSet(
        position,
        normal,
        one,
        position[:, :2],
        faces,
        (),
        np.zeros((len(order), 0), bool),
    )
    direction = np.random.default_rng(5).normal(size=(count, 3)) + np.array([0, 0, 1])
    return (
        surfels,
        RayScene(position, faces),
        700 * direction / np.linalg.norm(direction, axis=1)[:, None],
    )


def test_light_visibility__asks_all_points_of_the_disc_wherever_they_differ(capture):
    """At most 1 share in 10,000 differs from the mean of all five points at every surfel."""
    surfels, scene, places = head_and_places(8)
    lights = [
        replace(capture.dome.lights[0], position=p, axis=-p / 700, disc_radius=20.0)
        for p in places
    ]
    with ThreadPoolExecutor(2) as pool:
        share = light_visibility(surfels, lights, scene, pool)
    facing = np.stack(
        [((p - surfels.position) * surfels.normal).sum(axis=1) > 0 for p in places],
        axis=1,
    )
    seen = [
        [
            ~scene.occluded(surfels.position, point[None], normal=surfels.normal)
            for point in disc_points(light)
        ]
        for light in lights
    ]
    expected = np.where(facing, np.mean(seen, axis=1).T, 0).astype(np.float16)
    assert ((expected > 0) & (expected < 1)).sum() > 1000
    assert (share != expected).sum() < 1e-4 * share.size


def test_light_visibility__finds_a_penumbra_with_no_shadow_of_the_centre_beside_it(
    capture,
):
    """A roof whose shadow by the disc's centre misses the plate, and by one point of
    its rim does not.
    """
    surfels, _ = plate_with_wall()
    roof = np.array([[22, -10, 280], [30, -10, 280], [22, 10, 280], [30, 10, 280.0]])
    faces = np.concatenate(
        [surfels.faces, len(surfels.position) + np.array([[0, 1, 2], [1, 3, 2]])]
    )
    scene = RayScene(np.concatenate([surfels.position, roof]), faces)
    light = replace(
        capture.dome.lights[0], position=np.array([0, 0, 560.0]), disc_radius=40.0
    )
    light = replace(light, axis=np.array([0, 0, -1.0]))
    with ThreadPoolExecutor(1) as pool:
        share = light_visibility(surfels, [light], scene, pool)[:, 0].reshape(41, 41)
    # the point sqrt 0.6 of 40 mm to the right throws the roof's edge at 22 mm to 2 * 22
    # - 31 = 13.02 mm
    expected = np.where(np.arange(-20, 21) > 13.02, 0.8, 1).astype(np.float16)
    np.testing.assert_array_equal(share[1:-1], np.tile(expected, (39, 1)))


def test_light_visibility__half_sphere_sees_by_its_normal(surfels, capture):
    scene = RayScene(surfels.position, surfels.faces)
    with ThreadPoolExecutor(2) as pool:
        share = light_visibility(surfels, capture.dome.lights, scene, pool)
    for j, light in enumerate(capture.dome.lights):
        way = light.position - surfels.position
        cosine = (way * surfels.normal).sum(1) / np.linalg.norm(way, axis=1)
        assert (share[cosine > 0.1, j] == 1).all()
        assert (share[cosine <= 0, j] == 0).all()


def test_camera_visibility__keeps_off_silhouettes_and_the_border(surfels, capture):
    scene = RayScene(surfels.position, surfels.faces)
    camera = capture.dome.cameras[0]
    with ThreadPoolExecutor(2) as pool:
        visible, clear, pixels = camera_visibility(surfels, [camera], scene, pool)
        narrow = replace(camera, width=40)
        within, _, _ = camera_visibility(surfels, [narrow], scene, pool)
    assert not (clear & (visible < 1)).any()
    assert pixels[within[:, 0] == 1, 0, 0].max() <= 39.5
    # the outline of the sphere is where the line of sight is a tangent
    eye = np.array([0, 30.0, 400])
    way = surfels.position - eye
    sine = np.linalg.norm(
        np.cross(way / np.linalg.norm(way, axis=1)[:, None], eye / np.linalg.norm(eye)),
        axis=1,
    )
    rim_px = (
        np.tan(np.arcsin(RADIUS / np.linalg.norm(eye))) - np.tan(np.arcsin(sine))
    ) * camera.K[0, 0]
    # a circle of 1.5 px cut 0.4 px off its middle always holds a pixel centre
    assert not clear[(rim_px < 0.4) & (pixels[:, 0, 1] > 3), 0].any()
    inner = (rim_px > 4) & (visible[:, 0] == 1) & (surfels.position[:, 2] > 10)
    assert clear[inner, 0].all()


def test_camera_visibility__keeps_off_a_step_in_depth(capture):
    """Beyond the top edge of the wall the camera sees plate and wall in neighbouring pixels."""
    surfels, scene = plate_with_wall()
    R, t = look_at([-60, 0, 80])
    camera = replace(capture.dome.cameras[0], R=R, t=t)
    with ThreadPoolExecutor(1) as pool:
        visible, clear, _ = camera_visibility(surfels, [camera], scene, pool)
    row = np.flatnonzero(surfels.position[:, 1] == 0)
    visible = visible[row, 0] == 1
    clear = clear[row, 0]
    x = np.arange(-20, 21)
    # the line over the edge (5.5, 5) meets the plate at 5.5 + 5 * 65.5 / 75 = 9.87; a
    # pixel is 0.6 mm wide
    np.testing.assert_array_equal(visible, (x < 5.5) | (x > 9.87))
    assert not clear[x == 10].any()
    assert clear[((x > -18) & (x < 3)) | ((x > 11) & (x < 18))].all()


def clear_twin(camera, scene, points, normals, pixels):
    """Pixels round each point, one offset at a time, against depths that are exact."""
    row, column = np.indices((camera.height, camera.width))
    rays = pixel_rays(
        np.stack([column, row], axis=-1) + 0.5, camera.K, camera.R, camera.distortion
    )
    eye = camera_centre(camera.R, camera.t)
    distance = scene.first_hit(
        np.broadcast_to(eye, (row.size, 3)), rays.reshape(-1, 3)
    )[2].reshape(row.shape)
    own = np.linalg.norm(points - eye, axis=1)
    level = ((points - eye) * normals).sum(axis=1)
    first = np.floor(pixels - 0.5).astype(int)
    clear = np.ones(len(points), bool)
    for dx, dy in product(range(-1, 3), range(-1, 3)):
        x = first[:, 0] + dx
        y = first[:, 1] + dy
        near = np.hypot(x + 0.5 - pixels[:, 0], y + 0.5 - pixels[:, 1]) <= 1.5
        at = np.flatnonzero(
            near & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        )
        foretold = level[at] / (rays[y[at], x[at]] * normals[at]).sum(axis=1)
        found = distance[y[at], x[at]]
        width = own[at] / np.sqrt(camera.K[0, 0] * camera.K[1, 1])
        smooth = np.abs(found - foretold) <= 2 + np.abs(foretold - own[at])
        clear[at] &= smooth & (np.abs(found - own[at]) <= 2 + 15 * width)
    return clear


@pytest.mark.parametrize(
    "distortion", [(0, 0, 0, 0, 0), (-0.1, 0.07, -5e-4, -3e-3, -0.05)]
)
def test_camera_visibility__clear_pixels_by_a_twin(surfels, capture, distortion):
    with_wall, wall_scene = plate_with_wall()
    R, t = look_at([-60, 0, 80])
    scene = RayScene(surfels.position, surfels.faces)
    for what, where, camera in (
        (surfels, scene, capture.dome.cameras[1]),
        (with_wall, wall_scene, replace(capture.dome.cameras[0], R=R, t=t)),
    ):
        camera = replace(camera, distortion=np.array(distortion, float))
        with ThreadPoolExecutor(1) as pool:
            visible, clear, _ = camera_visibility(what, [camera], where, pool)
        at = np.flatnonzero(visible[:, 0])
        pixels, _ = project(
            what.position[at], camera.K, camera.R, camera.t, camera.distortion
        )
        expected = clear_twin(camera, where, what.position[at], what.normal[at], pixels)
        np.testing.assert_array_equal(clear[at, 0], expected)
        assert 0.1 < expected.mean() < 0.99


def test_visibility__from_inside_the_head_nothing_is_seen(surfels, capture):
    scene = RayScene(surfels.position, surfels.faces)
    camera = replace(
        capture.dome.cameras[0], t=-capture.dome.cameras[0].R @ np.array([0, 5.0, 20])
    )
    light = replace(capture.dome.lights[0], position=np.array([0, 5.0, 20]))
    with ThreadPoolExecutor(1) as pool:
        visible, clear, _ = camera_visibility(surfels, [camera], scene, pool)
        share = light_visibility(surfels, [light], scene, pool)
    assert not visible.any()
    assert not clear.any()
    assert not share.any()


def test_visibility__one_triangle(capture):
    position = np.array([[-30.0, -30, 0], [30, -30, 0], [0, 40, 0]])
    one = np.ones(3)
    normal = np.array([[0, 0, 1.0], [0, 0, 1], [np.nan, 0, 1]])
    faces = np.array([[0, 1, 2]])
    surfels = SurfelSet(
        position,
        normal,
        one,
        position[:, :2],
        faces,
        (),
        np.zeros((3, 0), bool),
    )
    scene = RayScene(position, faces)
    with ThreadPoolExecutor(1) as pool:
        visible, _, _ = camera_visibility(
            surfels, capture.dome.cameras[:1], scene, pool
        )
        share = light_visibility(surfels, capture.dome.lights[:1], scene, pool)
    assert visible[:, 0].tolist() == [1, 1, 0]
    assert share[:, 0].tolist() == [1, 1, 0]


def test_build_surfels__are_as_far_apart_as_requested_on_every_face(capture):
    """Three shapes, whose scans have points 7 to 8 mm apart."""
    shapes = [face_shape(person) for person in cohort_people(3)]
    for shape, spacing in product(shapes, (3.0, 5.0)):
        head = parametric_head(shape, spacing_mm=8.0)
        scan = clean_mesh(head.vertices, head.faces)
        surfels = build_surfels(
            replace(capture, surface=scan, scan=scan, regions={}), spacing_mm=spacing
        )
        # 1.5 %, as smoothing makes the surface smaller
        assert surfels.spacing() == pytest.approx(spacing, rel=0.015)


def test_build_surfels__a_finer_scan_stays(capture):
    surfels = build_surfels(capture, spacing_mm=20.0)
    assert len(surfels.position) == len(capture.surface.vertices)


def test_subdivision__says_what_is_too_fine(capture):
    with pytest.raises(
        InputError,
        match=r"at most 2,500,000 surfels; found 0\.01 mm.*choose (0\.\d+) mm",
    ) as caught:
        subdivision(capture.surface, 0.01)
    finest = float(str(caught.value).split("choose ")[1].split(" mm")[0])
    subdivision(capture.surface, finest)
    with pytest.raises(InputError, match="at most 2,500,000 surfels"):
        subdivision(capture.surface, 0.9 * finest)


def test_subdivision__the_scan_alone_may_be_too_fine(capture, monkeypatch):
    count = len(capture.surface.vertices)
    monkeypatch.setattr("skindb.ingest.surfels.MAX_SURFELS", count)
    assert subdivision(capture.surface, 20.0) == (0, 0)
    monkeypatch.setattr("skindb.ingest.surfels.MAX_SURFELS", count - 1)
    with pytest.raises(
        InputError, match=rf"found {count:,} vertices of the scan.*decimate the scan"
    ):
        subdivision(capture.surface, 20.0)


def test_subdivision__refuses_zero(capture):
    with pytest.raises(ValueError, match="must be positive"):
        subdivision(capture.surface, 0.0)


def test_blended_lobes__change_evenly_over_the_borders_of_regions():
    """Surfels on a line, 0.01 mm apart, and the means over 13 nodes by hand; the lips are
    within the nose, which begins at 10 mm.
    """
    x = np.linspace(0, 30, 3001)
    position = np.stack([x, 0 * x, 0 * x], axis=1)
    regions = {"lips": x > 20, "nose": x > 10, "unknown": x > 15}
    lobes = {"face": (1.0, 0.0), "nose": (3.0, 4.0), "lips": (5.0, 6.0)}
    blended = blended_lobes(position, regions, lobes)
    nodes = np.linspace(0, 3000, BLEND_NODES).astype(int)
    for place in (0.0, 9.98, 10.0, 10.02, 15.0, 25.0):
        near = np.argsort(np.abs(x[nodes] - place), kind="stable")[:BLENDED]
        by_hand = np.mean(
            [
                lobes["lips" if v > 20 else "nose" if v > 10 else "face"]
                for v in x[nodes[near]]
            ],
            axis=0,
        )
        # nodes at the same distance on both sides
        np.testing.assert_allclose(
            blended[np.abs(x - place).argmin()], by_hand, atol=4.0 / BLENDED + 1e-9
        )
    # a border would be a step of 4
    assert np.abs(np.diff(blended, axis=0)).max() < 1.0
    for nothing in ({}, {"unknown": x > 15}):
        even = blended_lobes(position, nothing, lobes)
        np.testing.assert_allclose(even, np.tile([1.0, 0.0], (len(x), 1)))
    # surfels farther apart than nodes keep the lobes of their region
    few = blended_lobes(position[::500], {"nose": x[::500] > 10}, lobes)
    np.testing.assert_allclose(few[:, 0], np.where(x[::500] > 10, 3.0, 1.0))
