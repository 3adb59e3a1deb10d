import tracemalloc

import numpy as np
import pytest

from skindb.errors import InputError
from skindb.virtual.dome import CENTRE, HEAD, Sensor, build_dome


def _dome(**sizes):
    return build_dome(**sizes, rng=np.random.default_rng(5))


@pytest.mark.parametrize(("lights", "cameras"), [(1, 1), (3, 2), (48, 8), (150, 16)])
def test_build_dome__any_size_frames_the_head_and_keeps_lights_in_front(
    lights, cameras
):
    dome = _dome(lights=lights, cameras=cameras)
    assert (len(dome.lights), len(dome.cameras)) == (lights, cameras)
    sphere = np.random.default_rng(0).standard_normal((500, 3))
    head = CENTRE + HEAD * sphere / np.linalg.norm(sphere, axis=1, keepdims=True) * [
        0.95,
        0.95,
        0.95,
    ]
    for camera in dome.cameras:
        np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(camera.R) > 0
        x = head @ camera.R.T + camera.t
        assert (x[:, 2] > 0).all()
        pixel = x[:, :2] / x[:, 2:] * np.diag(camera.K)[:2] + camera.K[:2, 2]
        assert (pixel > -4).all()  # lens distortion and the aim's deviation
        assert (pixel < np.array([camera.width, camera.height]) + 4).all()
    for light in dome.lights:
        assert (light.position - CENTRE)[2] > 100  # the white target faces it
        assert light.axis @ (CENTRE - light.position) > 0


def test_build_dome__up_in_the_world_is_up_in_the_image():
    for camera in _dome(lights=3, cameras=8).cameras:
        low, high = (
            camera.R @ (CENTRE + np.array([0, y, 0])) + camera.t for y in (-50, 50)
        )
        assert high[1] / high[2] < low[1] / low[2]


def test_build_dome__the_same_seed_is_the_same_device():
    first = _dome(lights=7, cameras=3)
    second = _dome(lights=7, cameras=3)
    for a, b in zip(first.lights, second.lights, strict=True):
        np.testing.assert_array_equal(a.position, b.position)
    for c, d in zip(first.cameras, second.cameras, strict=True):
        np.testing.assert_array_equal(c.K, d.K)


def test_build_dome__no_camera_looks_past_a_light_in_its_way():
    dome = _dome(lights=48, cameras=8)
    unit = [
        (p - CENTRE) / np.linalg.norm(p - CENTRE)
        for p in (x.position for x in dome.lights)
    ]
    for camera in dome.cameras:
        eye = (camera.centre - CENTRE) / np.linalg.norm(camera.centre - CENTRE)
        # a disc's radius is 0.8 degrees
        assert np.degrees(np.arccos(max(u @ eye for u in unit))) > 1.0


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        ({"lights": 0}, "lights must be 1 to 2,048; found 0"),
        (
            {"lights": 100_000_000},
            "lights must be 1 to 2,048; found 100,000,000; choose another number",
        ),
        ({"cameras": 257}, "cameras must be 1 to 256; found 257"),
        (
            {"lights": 2000, "cameras": 20},
            "lights x cameras must be 1 to 25,000; found 40,000",
        ),
        (
            {"width": 32_768, "height": 32_768},
            "width x height must be 1 to 8,000,000; found 1,073,741,824",
        ),
    ],
)
def test_build_dome__sizes_of_no_capture_are_refused_before_memory_is_allocated(
    sizes, said
):
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=said):
            _dome(**sizes)
        assert tracemalloc.get_traced_memory()[1] < 1e6
    finally:
        tracemalloc.stop()


def _frames(exposure, count, sensor, averaged=1):
    rng = np.random.default_rng(1)
    image = np.full((50, 40, 3), exposure, np.float32)
    pattern = np.zeros_like(image)
    return np.stack(
        [
            sensor.expose(image, pattern, averaged=averaged, rng=rng)
            for _ in range(count)
        ]
    )


@pytest.mark.parametrize("exposure", [0.0, 0.01, 0.3, 0.9])
def test_sensor__mean_and_variance_follow_the_photon_transfer_curve(exposure):
    sensor = Sensor()
    dn = _frames(exposure, 20, sensor).astype(float)
    electrons = exposure * sensor.full_well
    scale = sensor.electrons_per_dn
    variance = electrons + sensor.read_noise**2 + (sensor.step * scale) ** 2 / 12
    n = dn.size
    # 5 standard errors: one failure in 1.7 million
    assert abs((dn.mean() - sensor.black) * scale - electrons) < 5 * np.sqrt(
        variance / n
    )
    assert abs(dn.var() * scale**2 / variance - 1) < 5 * np.sqrt(2 / n)


def test_sensor__saturates_at_white_and_steps_by_the_converter():
    sensor = Sensor()
    assert (_frames(1.5, 1, sensor) == sensor.white).all()
    assert (_frames(0.4, 1, sensor) % sensor.step == 0).all()
    assert _frames(0.4, 1, sensor).dtype == np.uint16


def test_sensor__averaging_lowers_the_noise():
    sensor = Sensor()
    single = _frames(0.0, 10, sensor).std()
    many = _frames(0.0, 10, sensor, averaged=16).std()
    assert many == pytest.approx(
        sensor.read_noise / 4 / sensor.electrons_per_dn, rel=0.05
    )
    assert many < single / 3


def test_sensor__without_noise_is_exact_up_to_the_step():
    sensor = Sensor(noisy=False)
    dn = _frames(0.5, 1, sensor)
    assert (
        np.abs(dn - (sensor.black + 0.5 * (sensor.white - sensor.black))).max()
        <= sensor.step / 2
    )
