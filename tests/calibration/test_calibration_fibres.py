"""Fibres of the probe: spots, flat field, calibration."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from click.testing import CliRunner
from scipy import ndimage

import skindb
from skindb import workflow
from skindb.calibration.fibres import (
    Spots,
    calibrate_probe,
    calibrated_probe,
    fibre_gain,
    find_fibres,
    match_fibres,
)
from skindb.calibration.setup import read_flat_frames
from skindb.cli import cli
from skindb.errors import InputError
from skindb.format.contact_probe import read_probe
from skindb.format.fields import Fields

sys.path.append(str(Path(__file__).parent))
from sphere import FIBRES, PROBE_GAIN, PROBE_R, PROBE_SECONDS, write_capture


def fibre_picture(rng, noise=0.005):
    """28 discs, drawn at 8 times the resolution, of differing brightness on stray light."""
    centre = np.array(
        [[30 + 22.3 * (i % 7), 28 + 25.7 * (i // 7)] for i in range(28)]
    ) + rng.uniform(-2, 2, (28, 2))
    radius = rng.uniform(6.0, 7.0, 28)
    fine = 8
    row, column = (np.mgrid[: 140 * fine, : 200 * fine] + 0.5) / fine
    picture = np.zeros(row.shape)
    for (x, y), r in zip(centre, radius, strict=True):
        picture[(column - x) ** 2 + (row - y) ** 2 < r * r] = rng.uniform(0.6, 1.0)
    small = ndimage.gaussian_filter(
        picture.reshape(140, fine, 200, fine).mean(axis=(1, 3)), 0.5
    )
    order = np.lexsort(centre.T[::-1])
    return 0.3 + small + noise * rng.standard_normal(small.shape), Spots(
        centre[order], radius[order]
    )


def test_find_fibres__finds_centres_and_radii():
    picture, truth = fibre_picture(np.random.default_rng(1))
    found = find_fibres(picture, count=28)
    offset, _ = match_fibres(found, truth)
    # noise of 0.5 % over 130 px: 0.01 px of the centre and 0.05 % of the area; the
    # middle's percentile adds 0.5 %
    assert np.abs(offset).max() < 0.05


@pytest.mark.parametrize(
    ("picture", "match"),
    [
        (np.zeros((50, 50)), "28 separate spots; found 0"),
        (np.ones((50, 50)), "28 separate spots; found 0"),
    ],
)
def test_find_fibres__refuses_a_picture_without_fibres(picture, match):
    with pytest.raises(InputError, match=match):
        find_fibres(picture, count=28)


def test_match_fibres__finds_each_in_any_order_and_refuses_shifts():
    _, truth = fibre_picture(np.random.default_rng(2))
    order = np.random.default_rng(3).permutation(28)
    spots = Spots(truth.centre[order] + 0.5, truth.radius[order])
    offset, matched = match_fibres(spots, truth)
    np.testing.assert_allclose(offset, 0.5)
    assert (order[matched] == np.arange(28)).all()
    with pytest.raises(InputError, match="within its radius"):
        match_fibres(replace(truth, centre=truth.centre + 8), truth)


def test_fibre_gain__knows_its_error():
    rng = np.random.default_rng(4)
    truth = rng.uniform(0.8, 1.2, (28, 3))
    truth /= truth.mean(axis=0)
    z = []
    for _ in range(40):
        level = rng.uniform(0.5, 2.0, (12, 1, 1))
        gain, error = fibre_gain(
            level * truth * (1 + 0.004 * rng.standard_normal((12, 28, 3)))
        )
        z.append((gain - truth) / error)
    # Student's t of 11 degrees of freedom has a deviation of 1.106; the means of 28
    # fibres take 2 % off
    assert abs(np.std(z) - 1.09) < 0.05
    for bad in (np.zeros((5, 28, 3)), np.full((5, 28, 3), np.nan)):
        with pytest.raises(InputError, match="flat field of the fibres"):
            fibre_gain(bad)


# px
SPOT = 4.5
REPEATS = 6
MOVED = np.array([1.3, -0.8])
BLACK = 256.0
WHITE = 65535.0
ELECTRONS = 30000.0
# (fibre, 3), of which probe.json knows nothing
GAINS = (
    np.array([1.2, 0.9, 1.0, 0.9])[:, None] * [1.0, 1.02, 0.98]
    + np.array([0.0, 0.0, 0.05, -0.05])[:, None]
)


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    """The capture of the sphere, and flat-field frames of its probe, whose camera has slipped."""
    folder = tmp_path_factory.mktemp("probe") / "T001"
    write_capture(folder)
    write_flats(folder, np.random.default_rng(3))
    return folder


def write_flats(folder, rng, gains=GAINS, moved=MOVED):
    probe = json.loads((folder / "contact/probe.json").read_text())
    height, width = imagecodecs.png_decode(
        next((folder / "contact").rglob("*.png")).read_bytes()
    ).shape[:2]
    row, column = np.mgrid[:height, :width] + 0.5
    (folder / "contact/flat").mkdir(exist_ok=True)
    for repeat in range(1, REPEATS + 1):
        # the surface is 2 % uneven, differently after each move
        level = (
            0.3
            * (1 + 0.1 * rng.standard_normal())
            * (1 + 0.02 * rng.standard_normal(len(probe["fibres"])))
        )
        light = np.zeros((height, width, 3))
        for fibre, own, gain in zip(probe["fibres"], level, gains, strict=True):
            x, y = np.asarray(fibre["centre"]) + moved
            edge = np.clip(SPOT - np.hypot(column - x, row - y) + 0.5, 0, 1)
            light += edge[..., None] * own * gain
        for name, seconds in PROBE_SECONDS.items():
            electrons = light * seconds * ELECTRONS
            electrons = electrons + np.sqrt(electrons + 25.0) * rng.standard_normal(
                light.shape
            )
            value = np.clip(
                np.rint(BLACK + electrons / ELECTRONS * (WHITE - BLACK)), 0, WHITE
            )
            (folder / f"contact/flat/{repeat}_{name}.png").write_bytes(
                imagecodecs.png_encode(value.astype(np.uint16))
            )
    describe(folder)


def describe(folder, **changes):
    record = {
        "frames": "contact/flat/{repeat}_{exposure}.png",
        "repeats": REPEATS,
    } | changes
    (folder / "contact/calibration.json").write_text(json.dumps(record))


def test_calibrate_probe__finds_centres_and_gains(laboratory):
    found = calibrate_probe(read_flat_frames(laboratory))
    probe = json.loads((laboratory / "contact/probe.json").read_text())
    centre = np.array([fibre["centre"] for fibre in probe["fibres"]]) + MOVED
    # of spots of 64 pixels with noise of 1 %
    assert np.abs(found["calibrated_fibre_centre"] - centre).max() < 0.1
    assert np.abs(found["fibre_spot_radius"] - SPOT).max() < 0.1
    expected = GAINS / GAINS.mean(axis=0) * np.mean(PROBE_GAIN)
    z = (found["calibrated_fibre_gain"] - expected) / found[
        "calibrated_fibre_gain_error"
    ]
    assert np.abs(z).max() < 5  # Student's t of 5 degrees of freedom
    # 2 % of unevenness over the root of 6 frames
    np.testing.assert_allclose(
        (found["calibrated_fibre_gain_error"] / expected).mean(),
        0.02 / 6**0.5,
        rtol=0.5,
    )


def test_ingest__takes_the_gains_of_the_named_calibration(laboratory, tmp_path):
    db = skindb.open(str(tmp_path / "db"), create=True)
    meta = json.loads((laboratory / "capture.json").read_text()) | {
        "version": 2,
        "calibration": "lab",
    }
    (laboratory / "capture.json").write_text(json.dumps(meta))
    write_flats(laboratory, np.random.default_rng(4), moved=np.zeros(2))
    result = CliRunner().invoke(
        cli, ["calibrate", str(db.folder), str(laboratory), "--name", "lab"]
    )
    assert result.exit_code == 0, result.output
    assert f"gains of {FIBRES} fibres: known to" in result.output
    workflow.ingest_take(db, laboratory)
    stored = db.read("capture", "T001")["probe"]["fibre_profile"].values
    # the frames of the sites were made with the gains of probe.json
    gain = db.read("calibration", "lab")["probe_calibration"][
        "calibrated_fibre_gain"
    ].values
    expected = PROBE_R * np.array(PROBE_GAIN)[:, None] / gain
    # noise of the sites
    np.testing.assert_allclose(
        stored, np.broadcast_to(expected, stored.shape), rtol=0.02
    )
    # of the surface
    np.testing.assert_allclose(
        gain, GAINS / GAINS.mean(axis=0) * np.mean(PROBE_GAIN), rtol=0.05
    )


def test_calibrated_probe__keeps_fibres_apart(laboratory):
    found = calibrate_probe(read_flat_frames(laboratory))
    file = laboratory / "contact/probe.json"
    probe = read_probe(laboratory, Fields(json.loads(file.read_text()), str(file), []))
    shuffled = calibrated_probe(
        probe, found.isel(fibre=[2, 0, 3, 1]), where="calibration lab"
    )
    np.testing.assert_array_equal(shuffled.gain, found["calibrated_fibre_gain"].values)
    assert 0 < shuffled.gain_error < 0.05
    with pytest.raises(
        InputError, match="must have every fibre of the capture; found none of f3"
    ):
        calibrated_probe(probe, found.isel(fibre=[0, 1, 2]), where="calibration lab")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"frames": "contact/flat/{exposure}.png"},
            r"must name \{exposure\} and \{repeat\}",
        ),
        ({"frames": "contact/none/{repeat}_{exposure}.png"}, "none/1_b0.png"),
        ({"frames": "../{repeat}_{exposure}.png"}, "must stay inside"),
        ({"repeats": 2}, "must be at least 3"),
        ({"repeats": 900}, "must be at most 64"),
        ({"repeat": 4}, "repeat"),
        ({"frames": 5}, "frames"),
        # photographs of a site instead of a flat field show the far fibres in darkness
        ({"frames": "contact/{repeat}/{exposure}.png"}, "the file must exist"),
    ],
)
def test_read_flat_frames__faults_are_named(laboratory, change, said):
    describe(laboratory, **change)
    try:
        with pytest.raises(InputError, match=said):
            calibrate_probe(read_flat_frames(laboratory))
    finally:
        describe(laboratory)


def test_calibrate_probe__a_covered_fibre_is_named(laboratory):
    write_flats(
        laboratory, np.random.default_rng(5), gains=GAINS * [[1], [1], [0], [1]]
    )
    with pytest.raises(InputError, match="it must show 4 separate spots; found 3"):
        calibrate_probe(read_flat_frames(laboratory))
    write_flats(laboratory, np.random.default_rng(5), moved=np.array([5.0, 0.0]))
    with pytest.raises(
        InputError,
        match="every fibre must be found within its radius of the given centre",
    ):
        calibrate_probe(read_flat_frames(laboratory))
