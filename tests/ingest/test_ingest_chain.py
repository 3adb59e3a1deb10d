"""The sphere through a camera that does everything the format knows, and as merged
OpenEXR: the same samples.
"""

from __future__ import annotations

import json

import numpy as np
import OpenEXR
import pytest
from sphere import (
    ALBEDO,
    CAMERAS,
    FOCAL,
    HEIGHT,
    INTENSITY,
    LIGHTS,
    RADIUS,
    SECONDS,
    WIDTH,
    face_radiance,
    save,
    target_radiance,
    write_json,
)

from skindb.store import Database
from skindb.workflow import ingest_take

LENS = (-1.2, 1.0, 0.03, -0.02, -0.5)  # a pixel and more at the rim of the sphere
CENTRE = (WIDTH / 2 - 3.0, HEIGHT / 2 + 2.0)
VIGNETTE = (-0.5, 0.1, -0.05)
COLOURS = np.array([[1.3, -0.2, -0.1], [-0.15, 1.25, -0.1], [0.05, -0.3, 1.25]])
BLACK = 10
WHITE = 250
ELECTRONS = 40_000.0
GAMMA = np.array([2.2, 2.0, 1.8])
LEVEL = np.linspace(0, 1, 241)
CHAIN = {
    "bit_depth": 8,
    "black_level": BLACK,
    "white_level": WHITE,
    "read_noise_e": 8.0,
    "electrons_per_dn": ELECTRONS / (WHITE - BLACK),
    "response": "dome/response.csv",
    "vignette": VIGNETTE,
    "colour_matrix": COLOURS.tolist(),
    "distortion": LENS,
    "K": [[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]],
}
RADIANCE = {"frames": face_radiance, "white": target_radiance}


def vignette():
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    r = np.hypot(column - CENTRE[0], row - CENTRE[1]) / (np.hypot(WIDTH, HEIGHT) / 2)
    a2, a4, a6 = VIGNETTE
    return (1 + a2 * r**2 + a4 * r**4 + a6 * r**6)[..., None]


def written(radiance, seconds, dark, rng):
    """What the camera writes: colours, lens, photons, response and fixed pattern, in 8 bits."""
    exposure = np.maximum(radiance @ np.linalg.inv(COLOURS).T * vignette() * seconds, 0)
    noise = np.sqrt(
        exposure / ELECTRONS + (8.0 / ELECTRONS) ** 2
    ) * rng.standard_normal(radiance.shape)
    level = np.maximum(exposure + noise, 0) ** (1 / GAMMA)
    return np.clip(np.rint(dark + level * (WHITE - BLACK)), 0, WHITE).astype(np.uint8)


def write_chain(folder, dome):
    rng = np.random.default_rng(7)
    table = np.column_stack([BLACK + LEVEL * (WHITE - BLACK), LEVEL[:, None] ** GAMMA])
    np.savetxt(
        folder / "dome/response.csv",
        table,
        delimiter=",",
        header="dn,r,g,b",
        comments="",
    )
    for name, eye in CAMERAS.items():
        for exposure, seconds in SECONDS.items():
            dark = (BLACK + rng.integers(-3, 4, (HEIGHT, WIDTH, 3))).astype(np.uint8)
            save(folder / f"dome/dark/{exposure}_{name}.png", dark)
            for light, place in LIGHTS.items():
                for part, radiance in RADIANCE.items():
                    frame = written(
                        radiance(eye, place, centre=CENTRE, lens=LENS),
                        seconds,
                        dark,
                        rng,
                    )
                    save(folder / f"dome/{part}/{exposure}/{light}_{name}.png", frame)
    dome["dark"] = "dome/dark/{exposure}_{camera}.png"


def write_merged(folder, dome):
    """Radiance behind the same lens; levels, response, vignette, colours and dark
    frames are done with.
    """
    for part, radiance in RADIANCE.items():
        for name, eye in CAMERAS.items():
            for light, place in LIGHTS.items():
                image = radiance(eye, place, centre=CENTRE, lens=LENS).astype(
                    np.float32
                )
                header = {
                    "compression": OpenEXR.ZIP_COMPRESSION,
                    "type": OpenEXR.scanlineimage,
                }
                OpenEXR.File(header, {"RGB": image}).write(
                    str(folder / f"dome/{part}/{light}_{name}.exr")
                )
    dome |= {
        "frames": "dome/frames/{light}_{camera}.exr",
        "exposures": [{"id": "one", "seconds": 1}],
    }
    dome["dark"] = "dome/dark/{exposure}_{camera}.png"
    dome["white"]["frames"] = "dome/white/{light}_{camera}.exr"


# of samples: median of the error and of its size, its 99th percentile; of intensities;
# of a photograph's pixels. A step of 8 bits is half a per cent in the middle of these
# responses. Merged files have neither steps nor noise: the scan's chords are left, 0.1
# mm below the sphere (0.05 % of the square distance), and half precision of the
# photograph
LIMITS = {
    write_chain: (0.002, 0.008, 0.04, 2e-3, 0.05),
    # 1.4 %: middles of edges lie below the sphere
    write_merged: (0.001, 0.002, 0.014, 1e-5, 6e-4),
}


@pytest.mark.slow
@pytest.mark.parametrize("write", LIMITS)
def test_ingest_capture__sees_the_sphere_through_all_that_a_camera_does(
    capture_folder, tmp_path, write
):
    """Rationale: rho = albedo / pi cos(theta_i) and I of the lights by hand, whatever
    the camera does.

    Measured with a part of the chain removed from dome.json: bias 2 % without the lens,
    5 % without the vignette, 3 % and more without the colours or the response; without
    the dark frames errors are three times as large.
    """
    dome = json.loads((capture_folder / "dome/dome.json").read_text())
    write(capture_folder, dome)
    for camera in dome["cameras"]:
        camera |= CHAIN
    write_json(capture_folder / "dome/dome.json", dome)
    db = Database(tmp_path / "db")
    ingest_take(db, capture_folder, spacing_mm=4.0, photographs=1)
    take = db.read("capture", "T001")
    bias, size, most, of_light, of_pixel = LIMITS[write]
    truth = sphere(take)
    for samples in np.moveaxis(
        take["samples"]["reflectance_sample"].values.astype(np.float64), 2, 0
    ):
        known = np.isfinite(samples).all(-1) & (truth > 0.3 * ALBEDO / np.pi).all(-1)
        error = samples[known] / truth[known] - 1
        assert len(error) > 4000
        assert (np.abs(np.median(error, axis=0)) < bias).all()
        assert np.median(np.abs(error)) < size
        assert np.quantile(np.abs(error), 0.99) < most
    np.testing.assert_allclose(
        take["dome"]["light_intensity"], np.tile(INTENSITY, (4, 1)), rtol=of_light
    )
    image, light = (
        take["photographs"][f"photograph_{name}"][0].values
        for name in ("radiance", "light")
    )
    whole = face_radiance(
        CAMERAS["c0"], list(LIGHTS.values())[light], centre=CENTRE, lens=LENS
    )
    lit = whole.min(-1) > 0.2
    assert np.quantile(np.abs(image[lit] / whole[lit] - 1), 0.99) < of_pixel


def sphere(take):
    """Reflectance (surfel, light, 3) of the true sphere, not of the chords of its scan."""
    place = take["surfels"]["surfel_position"].values.astype(np.float64)
    place *= RADIUS / np.linalg.norm(place, axis=1, keepdims=True)
    to_light = take["dome"]["light_position"].values - place[:, None]
    cosine = (
        (to_light * place[:, None]).sum(-1) / RADIUS / np.linalg.norm(to_light, axis=-1)
    )
    return cosine[..., None] * ALBEDO / np.pi
