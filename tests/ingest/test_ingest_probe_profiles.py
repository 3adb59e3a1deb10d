"""Fibre profiles of the contact probe, and their statistics."""

from __future__ import annotations

import re
from dataclasses import replace

import imagecodecs
import numpy as np
import pytest
from scipy import stats
from sphere import WHITE

from skindb.calibration.fibres import fibre_pixels
from skindb.format.folder import read_capture
from skindb.ingest.probe_profiles import (
    Profiles,
    decay_p_values,
    fibre_profiles,
    isotropy_p_values,
    probe_notes,
)

ROW_DISTANCE = 1 + 0.5 * np.arange(28)
ROW_AZIMUTH = 2 * np.pi * np.arange(16) / 16


def profiles(rng, *, stretch=0.0, direction=0.7, noise=0.01, tilt=0.0):
    """Profiles whose decay varies by `stretch` along two opposite azimuths; contact
    differs by 10 %.
    """
    decay = 0.9 * (
        1 - stretch * np.cos(2 * (ROW_AZIMUTH - direction)) + tilt * np.cos(ROW_AZIMUTH)
    )
    value = np.exp(-decay[:, None] * ROW_DISTANCE) / ROW_DISTANCE**2
    value = value[..., None] * np.exp(0.1 * rng.standard_normal((16, 1, 3)))
    return value * (1 + noise * rng.standard_normal(value.shape)), noise * value


def test_decay_p_values__of_isotropic_tissue_has_even_p_values():
    p = [
        decay_p_values(*profiles(np.random.default_rng(s)), ROW_DISTANCE)
        for s in range(100)
    ]
    # 300 draws; refused once in 1000 by chance
    assert stats.kstest(np.ravel(p), "uniform").pvalue > 0.001


def test_decay_p_values__are_small_for_anisotropic_tissue_and_tilted_probes():
    for change in ({"stretch": 0.05}, {"tilt": 0.05}):
        value, error = profiles(np.random.default_rng(5), **change)
        assert (decay_p_values(value, error, ROW_DISTANCE) < 1e-6).all()


def test_decay_p_values__of_too_little_light_are_unknown():
    value, error = profiles(np.random.default_rng(6))
    for bad in (np.zeros_like(value), np.full_like(value, np.nan)):
        assert np.isnan(decay_p_values(bad, error, ROW_DISTANCE)).all()


def _spoil(probe, fibre, count, channel):
    """Put the first `count` pixels of a fibre of the first site at the white level in
    every bracket.
    """
    for e in probe.exposures:
        path = probe.frame(probe.sites[0], e)
        frame = imagecodecs.png_decode(path.read_bytes()).copy()
        rows, columns = np.divmod(
            fibre_pixels(probe, frame.shape[:2])[fibre], frame.shape[1]
        )
        frame[rows[:count], columns[:count], channel] = WHITE
        path.write_bytes(imagecodecs.png_encode(frame))


@pytest.mark.parametrize("count", [1, 12])
def test_fibre_profiles__a_partly_saturated_fibre_is_unknown(capture_folder, count):
    """One of its 36 pixels is more than 1 %: the rest of the face would be read instead
    of all of it.
    """
    probe = read_capture(capture_folder).probe
    _spoil(probe, 0, count, 0)
    profiles = fibre_profiles(probe)
    unknown = np.zeros_like(profiles.value, bool)
    unknown[0, 0, 0] = True  # other channels, fibres and sites keep their value
    np.testing.assert_array_equal(np.isnan(profiles.value), unknown)
    np.testing.assert_array_equal(np.isnan(profiles.error), unknown)


def test_fibre_profiles__a_stuck_pixel_of_a_large_fibre_does_not_count(capture_folder):
    probe = read_capture(capture_folder).probe
    probe.radius[:] = 5.75  # 104 pixels, the rim dark
    before = fibre_profiles(probe)
    _spoil(probe, 0, 1, 0)
    after = fibre_profiles(probe)
    # the pixel taken away was of the dark rim: the mean rises by its share
    assert after.value[0, 0, 0] / before.value[0, 0, 0] - 1 == pytest.approx(
        1 / 104, rel=0.1
    )


ROWS = 16
FIBRES = 8
DISTANCE = np.tile(np.linspace(1, 8, FIBRES), ROWS)
AZIMUTH = np.repeat(np.arange(ROWS) * 22.5, FIBRES)


@pytest.fixture(scope="module")
def probe(pristine):
    """A probe of 16 rows of fibres that touched three sites."""
    one = read_capture(pristine).probe
    return replace(one, distance=DISTANCE, azimuth=AZIMUTH, pressure={})


def _profiles(probe, rng, anisotropy=0.0):
    decay = 0.6 * (1 + anisotropy * np.cos(2 * np.radians(AZIMUTH)))
    truth = (np.exp(-decay * DISTANCE) / DISTANCE**2)[:, None] * np.ones(3)
    error = 0.01 * truth
    value = np.stack(
        [truth + error * rng.standard_normal(truth.shape) for _ in probe.sites]
    )
    shape = (len(probe.sites), *error.shape)
    return Profiles(
        value,
        np.broadcast_to(error, shape),
        False,
        np.full((len(probe.sites), 3), np.nan),
    )


def test_isotropy_p_values__uniform_for_isotropic_tissue(probe):
    rng = np.random.default_rng(1)
    found = np.concatenate(
        [isotropy_p_values(probe, _profiles(probe, rng)).ravel() for _ in range(60)]
    )
    # 540 p values: the share below a tenth is known to 0.013; four of these
    assert abs((found < 0.1).mean() - 0.1) < 0.052
    assert abs((found < 0.5).mean() - 0.5) < 0.09


def test_isotropy_p_values__find_anisotropic_tissue(probe):
    profiles = _profiles(probe, np.random.default_rng(2), anisotropy=0.05)
    found = isotropy_p_values(probe, profiles)
    assert (found < 1e-6).all()
    assert len(probe_notes(probe, profiles, found)) == len(probe.sites)
    # fibres may be listed in any order
    order = np.random.default_rng(3).permutation(ROWS * FIBRES)
    mixed = replace(probe, distance=DISTANCE[order], azimuth=AZIMUTH[order] - 360)
    again = replace(
        profiles, value=profiles.value[:, order], error=profiles.error[:, order]
    )
    np.testing.assert_allclose(isotropy_p_values(mixed, again), found, rtol=1e-6)


def test_isotropy_p_values__only_of_several_complete_rows(probe):
    profiles = _profiles(probe, np.random.default_rng(4))
    assert (
        isotropy_p_values(
            replace(probe, azimuth=np.full(ROWS * FIBRES, np.nan)), profiles
        )
        is None
    )
    assert (
        isotropy_p_values(
            replace(probe, azimuth=np.where(AZIMUTH > 60, 0.0, AZIMUTH)), profiles
        )
        is None
    )
    assert (
        isotropy_p_values(replace(probe, distance=DISTANCE + 1e-4 * AZIMUTH), profiles)
        is None
    )
    silent = replace(profiles, value=np.zeros_like(profiles.value))
    assert np.isnan(isotropy_p_values(probe, silent)).all()


def test_probe_notes__pressure_and_repeatability(probe):
    profiles = _profiles(probe, np.random.default_rng(5))
    assert probe_notes(probe, profiles, None) == []
    steady = np.array([[0.0, -5.0], [1.0, -5.2]])
    sinking = np.array([[0.0, -5.0], [1.0, -2.5]])
    touched = replace(probe, pressure={("cheek", ""): steady, ("neck", "b"): sinking})
    spread = np.array([[0.01, 0.02, 0.01], [0.01, 0.08, 0.01], [np.nan] * 3])
    notes = probe_notes(touched, replace(profiles, repeatability=spread), None)
    assert notes == [
        "probe at neck, placement b: the pressure drifted by 2.5 kPa",
        f"probe at {probe.sites[1]}: placements differ by 8%",
    ]


@pytest.mark.parametrize("pressure", [96.0, 2.0, -60.0])
def test_probe_notes__a_pressure_that_no_suction_has(probe, pressure):
    profiles = _profiles(probe, np.random.default_rng(5))
    log = np.array([[np.nan, pressure]])
    (note,) = probe_notes(replace(probe, pressure={("neck", ""): log}), profiles, None)
    assert note.startswith(
        f"probe at neck: a pressure of {pressure:g} kPa is outside -40 to 1 kPa; "
        "give that of a gauge"
    )


def _skin(probe, decay=(0.5, 0.8, 1.2), gain=1.0, distance=DISTANCE):
    """A probe of this gain and the profiles of three sites, which decay differently in
    the three channels.
    """
    truth = (
        np.exp(-np.asarray(decay) * DISTANCE[:, None])
        / DISTANCE[:, None] ** 2
        * np.reshape(gain, (-1, 1))
    )
    shape = (len(probe.sites), *truth.shape)
    value = np.broadcast_to(truth, shape)
    named = replace(
        probe, distance=distance, fibres=tuple(f"f{i}" for i in range(len(DISTANCE)))
    )
    return named, Profiles(
        value, 0.01 * value, False, np.full((len(probe.sites), 3), np.nan)
    )


def test_probe_notes__profiles_of_skin_have_none(probe):
    assert probe_notes(*_skin(probe), None) == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"decay": (1.2, 0.8, 0.5)},
            "red light decays by 1.2 and blue light by 0.5 per mm, .* order of the channels",
        ),
        (
            {"distance": DISTANCE / 10},
            "red light decays by 5 per mm, and by 0.03 to 3 in skin; check the distances",
        ),
    ],
)
def test_probe_notes__profiles_of_no_skin(probe, change, said):
    (note,) = probe_notes(*_skin(probe, **change), None)
    assert re.fullmatch(f"probe: {said}", note)


@pytest.mark.parametrize(
    ("factor", "notes"), [(1.1, 0), (1.3, 1), (3.0, 1), (1 / 3, 1)]
)
def test_probe_notes__a_fibre_with_another_gain(probe, factor, notes):
    # a probe of one row, whose neighbours are at other distances
    first = slice(0, FIBRES)
    one_row = {
        "distance": DISTANCE[first],
        "azimuth": AZIMUTH[first],
        "fibres": tuple("abcdefgh"),
    }
    gain = np.ones(len(DISTANCE))
    gain[3] = factor
    named, profiles = _skin(probe, gain=gain)
    row = replace(
        profiles, value=profiles.value[:, first], error=profiles.error[:, first]
    )
    found = probe_notes(replace(named, **one_row), row, None)
    assert len(found) == notes
    assert all(
        f"fibre d is {factor:.2f} times as bright as its neighbours; check its gain"
        in note
        for note in found
    )
