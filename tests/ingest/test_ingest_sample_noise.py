"""Stated variances of samples against repeated frames of an own simulated sensor, and
against the merging itself.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from sphere import (
    BLACK,
    CAMERAS,
    INTENSITY,
    LIGHTS,
    SECONDS,
    WHITE,
    face_radiance,
    save,
)

from skindb.calibration.radiance import frame_merger, merge_exposures
from skindb.fit.lumitexels import lumitexels
from skindb.fit.sample_noise import noise_inputs, sample_variance
from skindb.format.dome import CameraRecord
from skindb.format.folder import read_capture
from skindb.format.frames import FrameKind
from skindb.format.sensor import UNKNOWN_ELECTRONS, SensorRecord
from skindb.geometry.rays import RayScene
from skindb.ingest.groups import dome_group, sample_group, surfel_group
from skindb.ingest.lumitexels import Views, sample_lumitexels
from skindb.ingest.sample_quality import radiance_noise
from skindb.ingest.spool import Spool
from skindb.ingest.surfels import build_surfels
from skindb.ingest.visibility import camera_visibility

# electrons; few, so that steps of the files do not matter
FULL = 2000.0
READ = 5.0
REPEATS = 4
VIGNETTE = np.array([-0.1, 0.0, 0.0])


def take_frames(folder, dome, rng):
    """Photographs of the sphere by Poisson and normal noise, or with neither."""
    for camera in dome.cameras:
        y, x = np.mgrid[: camera.height, : camera.width] + 0.5
        square = (x - camera.K[0, 2]) ** 2 + (y - camera.K[1, 2]) ** 2
        gain = 1 + VIGNETTE[0] * square[..., None] * 4 / (
            camera.width**2 + camera.height**2
        )
        for light, place in LIGHTS.items():
            for exposure, seconds in SECONDS.items():
                electrons = (
                    face_radiance(CAMERAS[camera.id], place) * seconds * gain * FULL
                )
                if rng is not None:
                    electrons = rng.poisson(electrons) + READ * rng.standard_normal(
                        electrons.shape
                    )
                value = np.rint(BLACK + electrons / FULL * (WHITE - BLACK))
                save(
                    folder / f"dome/frames/{exposure}/{light}_{camera.id}.png",
                    np.clip(value, 0, WHITE).astype("u2"),
                )


def lumitexels_of(dome, surfels, folder, *, footprint):
    """What a fit reads of the frames that lie there."""
    n = len(surfels.position)
    intensity = np.tile(INTENSITY, (len(dome.lights), 1))
    mergers = {camera.id: frame_merger(dome, camera) for camera in dome.cameras}
    shape = (len(dome.lights), len(dome.cameras), n)
    with ThreadPoolExecutor(2) as pool, Spool(folder, shape, {}, key="run") as spool:
        share, clear, pixels = camera_visibility(
            surfels, dome.cameras, RayScene(surfels.position, surfels.faces), pool
        )
        views = Views(
            surfels, np.ones((n, shape[0]), bool), clear, pixels, footprint=footprint
        )
        found = sample_lumitexels(dome, intensity, views, mergers, spool, pool=pool)
        groups = {
            "samples": sample_group(dome, found).compute(),
            "surfels": surfel_group(
                surfels, dome, np.ones((n, shape[0]), np.float16), share
            ),
            "dome": dome_group(dome, intensity),
        }
    return lumitexels(xr.DataTree.from_dict(groups))


@pytest.mark.parametrize("footprint", [False, True])
def test_sample_variance__z_scores_of_repeated_frames_have_unit_variance(
    capture_folder, tmp_path, footprint
):
    """Both exposures usable, the long one white, and lights at 350 to 500 mm, three of
    four off the axis.
    """
    capture = read_capture(capture_folder)
    per_dn = FULL / (WHITE - BLACK)
    cameras = tuple(
        replace(
            c,
            vignette=VIGNETTE,
            sensor=replace(c.sensor, read_noise=READ, electrons_per_dn=per_dn),
        )
        for c in capture.dome.cameras
    )
    lights = tuple(
        replace(
            light, falloff=1.0, axis=-light.position / np.linalg.norm(light.position)
        )
        for light in capture.dome.lights
    )
    dome = replace(capture.dome, cameras=cameras, lights=lights)
    surfels = build_surfels(capture, spacing_mm=4.0)
    rng = np.random.default_rng(11)
    if footprint:
        surfels = replace(surfels, radius=np.full(len(surfels.position), 6.0))
    take_frames(capture_folder, dome, None)
    true = lumitexels_of(dome, surfels, tmp_path / "true", footprint=footprint)
    expected = np.nan_to_num(true["reflectance_sample"].values.astype(np.float64))
    scores = []
    for i in range(REPEATS):
        take_frames(capture_folder, dome, rng)
        noisy = lumitexels_of(dome, surfels, tmp_path / str(i), footprint=footprint)
        variance = sample_variance(noisy, expected).values
        scores.append(
            (noisy["reflectance_sample"].values - expected) / np.sqrt(variance)
        )
    z = np.stack(scores)
    pixels = noisy["effective_pixels"].values.astype(np.float64)
    position = surfels.position
    place = np.array([light.position for light in dome.lights])
    square = ((position[:, None] - place) ** 2).sum(axis=2)[:, :, None, None]
    # in the long exposure, which lasts a second
    white = expected * INTENSITY / square > 1.15
    dark = (expected * INTENSITY / square < 0.85) & (
        expected * INTENSITY / square > 0.05
    )
    wide = np.broadcast_to((pixels > 2.5)[:, None, :, None], expected.shape)
    # neighbours share pixels: some 3,000 independent samples in the smallest part,
    # whose deviation is known to 1.3 %; the line of the variance may be 1.5 % off in
    # sigma, and the vignette is one for each camera
    for part in (white, dark) if footprint else (white, wide & dark, ~wide & dark):
        some = z[:, part]
        some = some[np.isfinite(some)]
        assert some.size > 5000
        assert abs(some.std() - 1) < 0.03
    # a hundredth of the noise is the rounding to half floats
    assert abs(np.nanmean(z[:, dark])) < 0.02


@pytest.mark.parametrize("seconds", [(0.04,), (0.04, 0.005), (0.08, 0.04, 0.02, 0.01)])
def test_radiance_noise__is_the_variance_of_merged_exposures(seconds):
    """Frames without noise on a ramp of radiance: the error that `merge_exposures`
    states is that of the line.
    """
    sensor = SensorRecord(
        FrameKind(400, 1, 16), 1024.0, 65520.0, 6.0, 20000.0 / 64496, 16.0
    )
    radiance = np.geomspace(0.01, 0.99, 400)[None, :, None] / seconds[-1] + np.zeros(3)
    frames = [
        np.minimum(np.rint(1024 + radiance * t * 64496), 65520).astype(np.uint16)
        for t in seconds
    ]
    _, error, _ = merge_exposures(frames, seconds, sensor)
    eye = np.eye(3)
    camera = CameraRecord(
        "c", 400, 1, eye, eye, np.zeros(3), np.zeros(5), sensor, eye, np.zeros(3)
    )
    limit, read, shot = radiance_noise(camera, seconds, 1.0)
    step = np.minimum(
        (radiance[0, :, 0, None] >= limit[0]).sum(axis=1), len(seconds) - 1
    )
    stated = read[0, step] + shot[0, step] * radiance[0, :, 0]
    clear = np.abs(radiance[0, :, 0, None] * np.array(seconds) - 1).min(axis=1) > 1e-3
    # steps of the files; that of the line, which is 4 % at most
    tolerance = 1e-3 if len(seconds) == 1 else 0.05
    np.testing.assert_allclose((stated / error[0, :, 0] ** 2)[clear], 1, atol=tolerance)


def test_radiance_noise__lens_and_colours():
    """Behind a lens that lets half through, twice the photons' variance; a matrix adds
    variances by its squares.
    """
    sensor = SensorRecord(FrameKind(4, 4, 16), 0.0, 65535.0, 6.0, 0.5)
    eye = np.eye(3)
    matrix = np.array([[1.4, -0.3, -0.1], [-0.2, 1.3, -0.1], [0.0, -0.4, 1.4]])
    camera = CameraRecord(
        "c", 4, 4, eye, eye, np.zeros(3), np.zeros(5), sensor, eye, np.zeros(3)
    )
    limit, read, shot = radiance_noise(camera, [1.0], 1.0)
    behind = radiance_noise(camera, [1.0], 0.5)
    for found, times in zip(behind, (limit * 2, read * 4, shot * 2), strict=True):
        np.testing.assert_allclose(found, times, rtol=1e-9)
    mixed = radiance_noise(replace(camera, colour_matrix=matrix), [1.0], 1.0)
    np.testing.assert_allclose(
        mixed[2][:, 0] / shot[:, 0], (matrix**2).sum(axis=1), rtol=1e-9
    )


def test_sample_noise__is_unknown_without_electrons(capture_folder, tmp_path):
    capture = read_capture(capture_folder)
    first, *others = capture.dome.cameras
    silent = replace(
        first, sensor=replace(first.sensor, electrons_per_dn=UNKNOWN_ELECTRONS)
    )
    found = lumitexels_of(
        replace(capture.dome, cameras=(silent, *others)),
        build_surfels(capture, spacing_mm=8.0),
        tmp_path / "a",
        footprint=False,
    )
    assert noise_inputs(found) == ()
