"""Noise and checks of the samples."""

from __future__ import annotations

import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

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

import skindb
from skindb import workflow
from skindb.calibration.radiance import frame_merger, merge_exposures, radiance_noise
from skindb.fit.lumitexels import lumitexels, noise_inputs, sample_variance
from skindb.format.dome import CameraRecord
from skindb.format.folder import read_capture
from skindb.format.frames import FrameKind
from skindb.format.sensor import UNKNOWN_ELECTRONS, SensorRecord
from skindb.geometry.rays import RayScene
from skindb.ingest.consistency import CalibrationCheck
from skindb.ingest.groups import dome_group, sample_group, surfel_group
from skindb.ingest.lumitexels import Sampler
from skindb.ingest.spool import Spool
from skindb.ingest.surfels import build_surfels, camera_visibility

sys.path.append(str(Path(__file__).parent))
from sphere import expose, write_capture
from spoil import D, edit

from skindb.errors import InputError
from skindb.format.frames import write_frame
from skindb.store import Database
from skindb.workflow import ingest_take

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


def lumitexels_of(dome, surfels, folder):
    """What a fit reads of the frames that lie there."""
    n = len(surfels.position)
    intensity = np.tile(INTENSITY, (len(dome.lights), 1))
    mergers = {camera.id: frame_merger(dome, camera) for camera in dome.cameras}
    shape = (len(dome.lights), len(dome.cameras), n)
    with ThreadPoolExecutor(2) as pool, Spool(folder, shape) as spool:
        share, clear, pixels = camera_visibility(
            surfels, dome.cameras, RayScene(surfels.position, surfels.faces), pool
        )
        light = np.ones((n, shape[0]), np.float16)
        check = CalibrationCheck(dome, surfels, light, clear, pixels, intensity)
        sampler = Sampler(check, light > 0, mergers, spool, pool)
        found = sampler.lumitexels(check=False)
        groups = {
            "samples": sample_group(dome, found).compute(),
            "surfels": surfel_group(
                surfels, dome, np.ones((n, shape[0]), np.float16), share
            ),
            "dome": dome_group(dome, intensity),
        }
    return lumitexels(xr.DataTree.from_dict(groups))


@pytest.mark.slow
def test_sample_variance__z_scores_of_repeated_frames_have_unit_variance(
    capture_folder, tmp_path
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
    take_frames(capture_folder, dome, None)
    true = lumitexels_of(dome, surfels, tmp_path / "true")
    expected = np.nan_to_num(true["reflectance_sample"].values.astype(np.float64))
    scores = []
    for i in range(REPEATS):
        take_frames(capture_folder, dome, rng)
        noisy = lumitexels_of(dome, surfels, tmp_path / str(i))
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
    for part in (white, wide & dark, ~wide & dark):
        some = z[:, part]
        some = some[np.isfinite(some)]
        assert some.size > 4000
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
    # a camera that is more sensitive than stated has more photons in the same radiance
    sensitive = radiance_noise(replace(camera, gain=(2.0, 2.0, 2.0)), [1.0], 1.0)
    for found, times in zip(sensitive, (limit / 2, read / 4, shot / 2), strict=True):
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
    )
    assert noise_inputs(found) == ()


def _samples(tmp_path, name, folder):
    db = skindb.open(str(tmp_path / name), create=True)
    workflow.ingest_take(db, folder)
    return lumitexels(db.read("capture", "T001")).load()


@pytest.mark.slow
def test_ingest__differences_of_repeated_photographs_are_as_large_as_the_stated_noise(
    tmp_path,
):
    first = tmp_path / "first"
    write_capture(first)
    second = Path(shutil.copytree(first, tmp_path / "second"))
    rng = np.random.default_rng(2)
    for camera, eye in CAMERAS.items():
        for exposure, seconds in SECONDS.items():
            for light, place in LIGHTS.items():
                frame = expose(face_radiance(eye, place), seconds, rng)
                save(second / f"dome/frames/{exposure}/{light}_{camera}.png", frame)
    one = _samples(tmp_path, "db1", first)
    two = _samples(tmp_path, "db2", second)
    a, b = (
        samples["reflectance_sample"].values.astype(np.float64)
        for samples in (one, two)
    )
    level = (a + b) / 2
    stated = np.sqrt(sample_variance(one, level).values)
    z = ((a - b) / np.sqrt(2) / stated)[np.isfinite(level) & (level > 0.02)]
    assert z.size > 10_000
    # half floats round to 0.05 %
    assert 0.8 < 1.4826 * np.median(np.abs(z)) < 1.25


def given(*factors):
    """Intensities in place of the white target, each times a factor of its own."""

    def change(dome):
        dome["white"] = None
        for light, factor in zip(dome["lights"], factors, strict=True):
            light["intensity"] = (INTENSITY * factor).tolist()

    return lambda folder: edit(folder / D, change)


def linear(light, factor, *factors):
    """OpenEXR frames; those of one light times a factor."""

    def write(folder):
        for camera, eye in CAMERAS.items():
            for name, place in LIGHTS.items():
                image = np.asarray(face_radiance(eye, place), np.float32) * (
                    factor if name == light else 1
                )
                write_frame(
                    folder / f"dome/frames/{name}_{camera}.exr",
                    np.asarray(image, np.float32),
                )
        given(*(factors or (1, 1, 1, 1)))(folder)
        record = {
            "frames": "dome/frames/{light}_{camera}.exr",
            "exposures": [{"id": "one", "seconds": 1}],
        }
        edit(folder / D, lambda dome: dome.update(record))

    return write


HOSTILE = {
    "one light 1e6 times brighter": (
        given(1, 1e6, 1, 1),
        (
            r"\[lights\]\[1\]\[intensity\]: .* 1,000 times .*; found 1e\+06 times, of "
            r"light l1; correct it"
        ),
    ),
    "one light 1e6 times darker": (
        given(1, 1, 1e-6, 1),
        r"\[lights\]\[2\]\[intensity\]: .* found 1e-06 times, of",
    ),
    "one channel of a light": (
        given(1, 1, np.array([1, 1, 1e5]), 1),
        r"\[2\]\[intensity\]: .* found 1e\+05 times",
    ),
    "all samples overflow": (
        given(*[1e-9] * 4),
        (
            r"dome\.json\[lights\]: the median reflectance sample of a face must be "
            r".*; found samples beyond 65504"
        ),
    ),
    "all samples vanish": (
        given(*[1e9] * 4),
        r"dome\.json\[lights\]: the median reflectance sample .*; found 0;",
    ),
    "intensities of another unit": (
        given(*[1e3] * 4),
        r"the median .* must be 0\.0003 to 3 sr\^-1; found [\d.e-]+;",
    ),
    "intensity of another unit": (
        given(1, 1, 1, 100),
        (
            r"\[lights\]\[3\]: the median sample of a light must be at most 50 times "
            r".*; found 0\.0\d* times, of light l3"
        ),
    ),
    "frames of a light of 1e6": (
        linear("l1", 1e6),
        r"\[lights\], light l1: its photographs must be as bright",
    ),
    "black frames of a light": (
        linear("l1", 0),
        (
            r"\[frames\], camera c0, light l1: a frame must be bright where .*; found "
            r"none at \d+ surfels; copy the frame"
        ),
    ),
}


def ingested(folder, root, **options):
    record = ingest_take(
        Database(root), folder, spacing_mm=8.0, photographs=0, **options
    )
    return record.provenance["summary"]["notes"]


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE)
def test_ingest_capture__intensities_and_samples_of_no_dome_are_refused(
    capture_folder, tmp_path, name
):
    spoil, message = HOSTILE[name]
    spoil(capture_folder)
    with pytest.raises(InputError, match=message) as caught:
        ingested(capture_folder, tmp_path / "db")
    assert all(fault.cure for fault in caught.value.faults)
    assert Database(tmp_path / "db").takes() == []


LEGAL = {
    "as they are": (given(1, 1, 1, 1), []),
    "lights of two kinds": (linear("l3", 5, 1, 1, 1, 5), []),
    "a sitter too dark for skin": (
        given(*[30] * 4),
        ["the face reflects 2% of red light, and skin 10% to 90%"],
    ),
    "one light that may be wrong": (
        given(1, 1, 1, 1.7),
        ["light l3: the face is 0.59 times as bright under it as"],
    ),
    "frames of a light that may be wrong": (
        linear("l1", 1.7),
        ["light l1: the face is 1.7 times as bright under it"],
    ),
}
NOTED = {
    "one light": (
        given(1, 1, 1, 30),
        ["light l3: its intensity is 30 times", "light l3: its samples are 0.03"],
    ),
    "frames of a light": (linear("l1", 12), ["light l1: its samples are 1"]),
}


@pytest.mark.parametrize("name", NOTED)
def test_ingest_capture__lights_that_are_wrong_are_noted_on_request(
    capture_folder, tmp_path, name
):
    spoil, expected = NOTED[name]
    spoil(capture_folder)
    notes = ingested(capture_folder, tmp_path / "db", calibration="note")
    assert [
        note.startswith(start) for note, start in zip(notes, expected, strict=False)
    ] == [True] * len(expected)
    assert any(
        "its photographs must be as bright as those of the others" in note
        for note in notes
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", LEGAL)
def test_ingest_capture__unusual_lights_pass_and_are_noted(
    capture_folder, tmp_path, name
):
    spoil, expected = LEGAL[name]
    spoil(capture_folder)
    notes = ingested(capture_folder, tmp_path / "db")
    assert [
        note.startswith(start) for note, start in zip(notes, expected, strict=True)
    ] == [True] * len(expected)
