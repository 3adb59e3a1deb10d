"""Parameter records: limits, and the options that are generated from them."""

from __future__ import annotations

from dataclasses import fields

import click
import pytest
from click.testing import CliRunner

from skindb.cli import cli
from skindb.cli.options import options_of
from skindb.errors import InputError
from skindb.parameters import (
    FitParameters,
    IngestParameters,
    SessionParameters,
    SimulationParameters,
    option_of,
)

RECORDS = {
    "fit": FitParameters,
    "ingest": IngestParameters,
    "simulate": SimulationParameters,
    "capture": SessionParameters,
}


def test_parameters__every_fault_is_reported_at_once():
    with pytest.raises(InputError) as caught:
        FitParameters(k=0, mode="loud", eta=float("nan"), hold_out_lights=1.5, seed=-1)
    assert [str(fault) for fault in caught.value.faults] == [
        "k: must be at least 1; found 0; give another value",
        "mode: must be one of perceptual, linear, paper; found 'loud'; give another value",
        "eta: must lie in [1, 2]; found nan; give another value",
        "hold_out_lights: must lie in [0, 0.9]; found 1.5; give another value",
        "seed: must be at least 0; found -1; give another value",
    ]


@pytest.mark.parametrize("name", RECORDS)
def test_options_of__every_field_is_an_option_with_its_default(name):
    options = {option.name: option for option in cli.commands[name].params}
    for spec in fields(RECORDS[name]):
        assert options[spec.name].help.startswith(
            option_of(RECORDS[name], spec.name).help
        )
        assert options[spec.name].default == (None if name == "fit" else spec.default)


def test_options_of__calls_with_the_record_or_with_what_was_given():
    calls = []

    @click.command()
    @options_of(SimulationParameters)
    def record(parameters):
        calls.append(parameters)

    @click.command()
    @options_of(FitParameters, only_given=True)
    def given(given):
        calls.append(given)

    assert CliRunner().invoke(record, ["--lights", "20", "--subsurface"]).exit_code == 0
    assert CliRunner().invoke(given, ["--eta", "1.4", "--light-gains"]).exit_code == 0
    assert CliRunner().invoke(given, ["--eta", "2.5"]).exit_code == 2
    assert calls == [
        SimulationParameters(lights=20, subsurface=True),
        {"eta": 1.4, "light_gains": True},
    ]
