"""Corrections that a fit chooses by trials: planted errors are corrected, others are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planted_skin import capture_of

from skindb.fit import FitParameters
from skindb.fit import choice as choice_module
from skindb.fit.choice import Change, choose_corrections
from skindb.fit.corrections import without_bounce
from skindb.fit.lumitexels import lumitexels
from skindb.fit.model import first_pass
from skindb.fit.plan import hold_out, plan_fit
from skindb.schema import label

LIGHTS = 40


@pytest.fixture(scope="module")
def large(new_skin):
    """A skin with enough lights, cameras and surfels for a choice."""
    return new_skin(surfels=400, lights=LIGHTS, cameras=6, gloss=0.02)


def _choose(skin, parameters=None):
    parameters = parameters or FitParameters()
    capture = capture_of(skin, probe=False)
    held_out = hold_out(capture, plan_fit(capture, parameters), parameters)
    return choose_corrections(capture, lumitexels(capture), held_out, parameters)


def _with_samples(skin, values):
    sample = label("reflectance_sample", np.asarray(values, np.float16))
    return replace(skin, lumitexels=skin.lumitexels.assign(reflectance_sample=sample))


def _with_gains(skin, spread):
    """The skin under lights whose intensity is wrong by random gains."""
    noise = np.random.default_rng(3).normal(size=LIGHTS).clip(-2, 2)
    gain = (1 + spread * noise)[:, None, None]
    return _with_samples(skin, skin.lumitexels["reflectance_sample"].values * gain)


@pytest.mark.parametrize("spread", [0.0, 0.1])
def test_choose_corrections__gains_of_wrong_lights_alone(large, spread):
    parameters, reasons = _choose(_with_gains(large, spread))
    assert parameters.light_gains is (spread > 0)
    word = "on" if spread else "off"
    assert reasons["light_gains"].startswith(f"{word}: they differ by")
    assert parameters.inter_reflection is False
    assert "no part of the face" in reasons["inter_reflection"]


@pytest.mark.parametrize("planted", [True, False])
def test_choose_corrections__inter_reflection_if_samples_contain_it(
    large, planted, monkeypatch
):
    """The trace returns light of a tenth of the direct one to every third surfel, which
    the samples contain or not.
    """
    bounced = np.zeros((400, LIGHTS, 3), np.float32)
    bounced[::3] = 0.3 * np.random.default_rng(1).uniform(size=(LIGHTS, 1))
    monkeypatch.setattr(
        choice_module,
        "bounced_light",
        lambda samples, diffuse, visible, triangles, *, eta, receivers: bounced[
            receivers
        ],
    )
    skin = large
    if planted:
        darker = without_bounce(large.lumitexels, bounced, large.diffuse)
        direct = large.lumitexels["reflectance_sample"].values.astype(np.float32)
        removed = direct - darker["reflectance_sample"].values
        skin = _with_samples(large, direct + removed)
    parameters, reasons = _choose(skin)
    assert parameters.inter_reflection is planted, reasons


def test_choose_corrections__small_captures_support_none(new_skin):
    for size in ({"lights": 12}, {"cameras": 3}, {"surfels": 100}):
        skin = new_skin(**({"surfels": 400, "lights": LIGHTS, "cameras": 6} | size))
        parameters, reasons = _choose(skin)
        assert (parameters.light_gains, parameters.inter_reflection) == (False, False)
        assert all("needs 16 lights" in reason for reason in reasons.values())


def test_choose_corrections__options_force_either_way(large):
    forced = FitParameters(light_gains=True, inter_reflection=False)
    assert _choose(large, forced) == (forced, {})


def test_first_pass__states_and_uses_the_choice(large, small_dictionary):
    capture = capture_of(_with_gains(large, 0.1), probe=False)
    parameters = FitParameters(rank=6, k=2)
    first = first_pass(capture, parameters, dictionary=small_dictionary)
    assert first.attrs["parameters"]["light_gains"] is True
    assert first.attrs["parameters"]["inter_reflection"] is False
    assert "light_gains" in first.children
    assert first.attrs["corrections"].keys() == {"light_gains", "inter_reflection"}


def test_change__improves_by_more_than_its_error_and_the_margin():
    assert Change(-0.03, 0.02).improves
    assert not Change(-0.03, 0.04).improves
    assert not Change(-0.005, 0.001).improves
    assert not Change(0.03, 0.001).improves
    assert str(Change(-0.034, 0.011)) == "-3.4 +- 1.1 %"
