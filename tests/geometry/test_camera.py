"""Cameras compared with the formulas of OpenCV for one point, and round trips."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from skindb.geometry.camera import camera_centre, pixel_rays, project, undistort

K = np.array([[2000.0, 1.5, 651.0], [0.0, 2010.0, 514.0], [0.0, 0.0, 1.0]])
R = Rotation.from_euler("xyz", [170, 12, -8], degrees=True).as_matrix()
T = np.array([4.0, -7.0, 900.0])
LENS = np.array([-0.21, 0.09, 0.0011, -0.0023, 0.012])
ROUND_TRIP = 1e-7  # px or rad: Newton ends at 1e-10 of the focal length
ONE_POINT = 1e-9  # px: two orders of the same sums


def project_one(
    point: np.ndarray, distortion: np.ndarray
) -> tuple[float, float, float]:
    """cv2.projectPoints for one point, scalar by scalar."""
    x, y, z = (sum(R[i, j] * point[j] for j in range(3)) + T[i] for i in range(3))
    a = x / z
    b = y / z
    k1, k2, p1, p2, k3 = distortion
    r2 = a**2 + b**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a**2)
    v = b * radial + p1 * (r2 + 2 * b**2) + 2 * p2 * a * b
    return K[0, 0] * u + K[0, 1] * v + K[0, 2], K[1, 1] * v + K[1, 2], z


def face_points(n: int = 200) -> np.ndarray:
    return np.random.default_rng(1).uniform(-130, 130, (n, 3))


def test_project__follows_opencv_written_out():
    points = face_points(50)
    pixels, depth = project(points, K, R, T, LENS)
    expected = np.array([project_one(p, LENS) for p in points])
    np.testing.assert_allclose(pixels, expected[:, :2], atol=ONE_POINT)
    np.testing.assert_allclose(depth, expected[:, 2], atol=ONE_POINT)


def test_project__keeps_the_shape_of_a_grid():
    points = face_points(24).reshape(2, 3, 4, 3)
    pixels, depth = project(points, K, R, T, LENS)
    assert pixels.shape == (2, 3, 4, 2)
    assert depth.shape == (2, 3, 4)
    np.testing.assert_array_equal(
        pixels[1, 2, 3], project(points[1, 2, 3], K, R, T, LENS)[0]
    )


def test_project__optical_axis_meets_the_principal_point():
    ahead = camera_centre(R, T) + 500 * R[2]
    pixels, depth = project(ahead, K, R, T, LENS)
    np.testing.assert_allclose(pixels, K[:2, 2], atol=ONE_POINT)
    assert depth == pytest.approx(500)


def test_project__nan_behind_the_camera():
    pixels, depth = project(camera_centre(R, T) - 500 * R[2], K, R, T, LENS)
    assert np.isnan(pixels).all()
    assert depth == pytest.approx(-500)


def test_project__nan_where_the_polynomial_folds_back():
    barrel = np.array([-0.3, 0, 0, 0, 0])  # r (1 - 0.3 r^2) grows up to r = 1.054
    inside, outside = (
        camera_centre(R, T) + 500 * (R[2] + r * R[0]) for r in (1.0, 1.1)
    )
    assert np.isfinite(project(inside, K, R, T, barrel)[0]).all()
    assert np.isnan(project(outside, K, R, T, barrel)[0]).all()


@pytest.mark.parametrize(
    "lens", [np.zeros(5), LENS, [0.4, 0.2, 0, 0, 0.1], [-0.3, 0, 0, 0, 0]]
)
def test_pixel_rays__pass_through_the_projected_points(lens):
    points = face_points()
    pixels, _ = project(points, K, R, T, lens)
    towards = points - camera_centre(R, T)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    np.testing.assert_allclose(pixel_rays(pixels, K, R, lens), towards, atol=ROUND_TRIP)


@settings(max_examples=50)
@example(0.0, 5e-324, 0.0, 0.0, 0.0)
@given(
    st.floats(-0.4, 0.4),
    st.floats(-0.1, 0.1),
    st.floats(-0.01, 0.01),
    st.floats(0, 2 * math.pi),
    st.floats(0, 0.5),
)
def test_undistort__inverts_whatever_lens(k1, k2, p, angle, radius):
    lens = np.array([k1, k2, p, -p, 0.0])
    plane = np.array([radius * math.cos(angle), radius * math.sin(angle), 1.0])
    pixels, _ = project(plane, K, np.eye(3), np.zeros(3), lens)
    np.testing.assert_allclose(undistort(pixels, K, lens), plane[:2], atol=ROUND_TRIP)


def test_undistort__nan_at_pixels_no_point_maps_to():
    barrel = np.array([-0.3, 0, 0, 0, 0])  # the rim appears at 0.703 focal lengths
    pixels = K[:2, 2] + 2000 * np.array([[0.6, 0.0], [0.8, 0.0], [np.nan, 0.0]])
    assert np.isfinite(undistort(pixels, K, barrel)).all(axis=1).tolist() == [
        True,
        False,
        False,
    ]


def test_camera_centre__projects_to_depth_zero():
    assert project(camera_centre(R, T), K, R, T, LENS)[1] == pytest.approx(
        0, abs=ONE_POINT
    )
