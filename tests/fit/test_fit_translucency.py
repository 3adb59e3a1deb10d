"""Probe fits: exact profiles, photons instead of diffusion, what is not determined; the map over the face."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.fit import fit_probe, translucency_map
from skindb.fit._probe_kernels import burley_profile
from skindb.optics.dipole import dipole_profile, effective_transport
from skindb.schema import ProbeStatus, dataset

DISTANCE = 1 + 0.5 * np.arange(28)
SIGMA_A = np.array([[0.05, 0.17, 0.36], [0.03, 0.1, 0.2]])
SIGMA_S = np.array([[2.4, 2.3, 2.9], [1.8, 1.9, 2.1]])


def _probe(profile, error=None, **attrs):
    """Profile (site, fibre, channel) as ingest stores it."""
    return dataset(
        {
            "fibre_distance": DISTANCE[: profile.shape[1]],
            "fibre_profile": profile,
            "fibre_profile_error": 0.004 * profile if error is None else error,
        },
        coords={"site": [f"site{i}" for i in range(len(profile))], "channel": ["R", "G", "B"]},
        attrs=attrs,
    )


def _exact(model=dipole_profile):
    args = SIGMA_A[..., None], SIGMA_S[..., None]
    if model is dipole_profile:
        return np.moveaxis(dipole_profile(DISTANCE, *args, eta=1.3), -1, 1)
    curves = [
        [model(DISTANCE, a, s, eta=1.3) for a, s in zip(x, y, strict=True)]
        for x, y in zip(SIGMA_A, SIGMA_S, strict=True)
    ]
    return np.moveaxis(np.array(curves), -1, 1)


@pytest.mark.parametrize("known", [True, False])
def test_fit_probe__recovers_dipole_profiles(known):
    scale = 1.0 if known else 37.0
    found = fit_probe(_probe(scale * _exact(), gain_known=known))
    assert (found["site_status"] == ProbeStatus.FITTED).all()
    np.testing.assert_allclose(found["site_effective_transport"], effective_transport(SIGMA_A, SIGMA_S), rtol=1e-3)
    np.testing.assert_allclose(found["site_absorption"], SIGMA_A, rtol=1e-2)
    np.testing.assert_allclose(found["site_reduced_scattering"], SIGMA_S, rtol=1e-2)
    np.testing.assert_allclose(found["site_gain"], scale, rtol=2e-2)
    assert (found["site_residual"] < 1e-3).all()


def test_fit_probe__burley_recovers_its_own_profiles():
    found = fit_probe(_probe(_exact(burley_profile)), profile="burley")
    np.testing.assert_allclose(found["site_effective_transport"], effective_transport(SIGMA_A, SIGMA_S), rtol=5e-3)


def test_burley_profile__integrates_to_the_albedo():
    from scipy.integrate import quad

    from skindb.optics.diffuse import diffuse_reflectance

    a, s = 0.1, 2.0
    total = quad(lambda r: 2 * np.pi * r * burley_profile(np.array(r), a, s, eta=1.3), 0, np.inf)[0]
    np.testing.assert_allclose(total, diffuse_reflectance(np.sqrt(3 * a / (a + s)), eta=1.3), rtol=1e-6)


def test_fit_probe__photons_within_15_percent():
    from skindb.optics.random_walk import radial_profile, random_walk

    walk = random_walk(40_000, eta=1.3, rng=np.random.default_rng(3))
    edges = np.concatenate([DISTANCE[:16] - 0.25, [DISTANCE[15] + 0.25]])
    profile, error = np.empty((1, 16, 3)), np.empty((1, 16, 3))
    for c in range(3):
        profile[0, :, c], error[0, :, c] = radial_profile(walk, SIGMA_A[0, c], SIGMA_S[0, c], edges)
    found = fit_probe(_probe(profile, error))
    true = effective_transport(SIGMA_A[:1], SIGMA_S[:1])
    assert np.abs(found["site_effective_transport"].values / true - 1).max() < 0.15


def test_fit_probe__far_fibres_below_the_noise_are_left_out():
    profile = _exact()
    error = np.full_like(profile, profile[0, 12, 0] / 3.5)
    noisy = profile + error * np.random.default_rng(2).normal(size=profile.shape)
    found = fit_probe(_probe(noisy, error))
    assert found["site_fibres_used"].values.max() < 20
    true = effective_transport(SIGMA_A, SIGMA_S)
    assert np.abs(found["site_effective_transport"].values / true - 1).max() < 0.3
    deviation = np.abs(found["site_effective_transport"].values - true) / found["site_effective_transport_error"].values
    assert np.median(deviation) < 2


def test_fit_probe__too_few_fibres_and_nan():
    profile = _exact()
    profile[0, 2:] = np.nan
    profile[1, :, 1] = 0
    found = fit_probe(_probe(profile, np.full_like(profile, 1e-9)))
    assert (found["site_status"][0] == ProbeStatus.TOO_FEW_FIBRES).all()
    assert found["site_fibres_used"].values[0].tolist() == [2, 2, 2]
    assert found["site_status"].values[1].tolist() == [0, ProbeStatus.TOO_FEW_FIBRES, 0]
    assert np.isnan(found["site_effective_transport"].values[0]).all()


@pytest.mark.parametrize(("a", "s"), [(1e-6, 2.0), (0.1, 1e-4), (20.0, 1.0)])
def test_fit_probe__extremes_are_flagged_or_right(a, s):
    profile = dipole_profile(DISTANCE, a, s, eta=1.3)
    one = np.repeat(profile[None, :, None], 3, axis=2)
    found = fit_probe(_probe(one, 0.02 * one + 1e-30)).isel(site=0, channel=0)
    true = float(effective_transport(a, s))
    close = abs(float(found["site_effective_transport"]) / true - 1) < 0.1
    within = abs(float(found["site_effective_transport"]) - true) < 3 * float(found["site_effective_transport_error"])
    assert close or within or int(found["site_status"]) != ProbeStatus.FITTED


def test_fit_probe__says_what_is_determined():
    found = fit_probe(_probe(_exact()))
    assert found.attrs["best_determined"][0][0].startswith("sigma_tr^1.00 sigma_s'^")
    assert all(-1 <= r <= 1 for row in found.attrs["correlation"] for r in row)
    with pytest.raises(ValueError, match="profile must be one of"):
        fit_probe(_probe(_exact()), profile="guess")


def _sites(transport, position, status=None):
    transport = np.asarray(transport, float)
    return dataset(
        {
            "site_effective_transport": transport,
            "site_status": np.zeros(transport.shape) if status is None else status,
            "site_position": position,
        },
    )


def _surfels(position):
    return dataset({"surfel_position": np.asarray(position, float)})


def test_translucency_map__is_near_the_site_at_the_site_and_mirrored():
    sites = _sites([[0.5] * 3, [1.0] * 3], [[50, 0, 80], [0, -120, 20]])
    found = translucency_map(_surfels([[50, 0, 80], [-50, 0, 80], [0, -120, 20], [0, 0, 90]]), sites)
    value = found["effective_transport"].values[:, 0]
    np.testing.assert_allclose(value[0], value[1], rtol=1e-6)
    assert abs(value[0] - 0.5) < 0.02
    assert abs(value[2] - 1.0) < 0.02
    assert 0.5 < value[3] < 1.0


def test_translucency_map__one_site_is_everywhere_its_value():
    found = translucency_map(
        _surfels(np.random.default_rng(0).normal(size=(9, 3))), _sites([[0.7, 1.1, 1.9]], [[30, 0, 0]])
    )
    np.testing.assert_allclose(found["effective_transport"], np.tile([0.7, 1.1, 1.9], (9, 1)), rtol=1e-6)


def test_translucency_map__failed_and_placeless_sites():
    status = [[0, ProbeStatus.UNIDENTIFIED, ProbeStatus.TOO_FEW_FIBRES], [0, 0, ProbeStatus.AT_BOUND]]
    sites = _sites([[0.5, 9.0, np.nan], [1.0, 1.0, 1.0]], [[np.nan] * 3, [0, 0, 0]], status)
    value = translucency_map(_surfels([[0.0, 0, 0], [0, 100, 0]]), sites)["effective_transport"].values
    # the placeless site counts as much as the placed one: mean of the paths 2 and 1
    np.testing.assert_allclose(value[:, 0], 1 / 1.5, rtol=1e-6)
    np.testing.assert_allclose(value[:, 1], 1.0, rtol=1e-6)
    assert np.isnan(value[:, 2]).all()
