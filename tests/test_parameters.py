"""Parameter records: limits, and the options that are generated from them."""

from __future__ import annotations

from dataclasses import MISSING, fields

import click
import pytest
from click.testing import CliRunner

from skindb.cli import cli
from skindb.cli.options import options_of
from skindb.errors import InputError
from skindb.parameters import (
    CalibrationParameters,
    ComparisonParameters,
    DemoParameters,
    EditParameters,
    ExportParameters,
    FitParameters,
    ImportParameters,
    IngestParameters,
    QuickParameters,
    RenderParameters,
    SessionParameters,
    SimulationParameters,
    ViewParameters,
    option_of,
)

RECORDS = {
    "calibrate": CalibrationParameters,
    "capture": SessionParameters,
    "compare": ComparisonParameters,
    "demo": DemoParameters,
    "edit": EditParameters,
    "export": ExportParameters,
    "fit": FitParameters,
    "import": ImportParameters,
    "ingest": IngestParameters,
    "quick": QuickParameters,
    "render": RenderParameters,
    "simulate": SimulationParameters,
    "view": ViewParameters,
}


def test_parameters__every_fault_is_reported_at_once():
    with pytest.raises(InputError) as caught:
        FitParameters(k=0, mode="loud", eta=float("nan"), hold_out_lights=1.5, seed=-1)
    assert [str(fault) for fault in caught.value.faults] == [
        "k: must be at least 1; found 0; give another value",
        "mode: must be one of perceptual, linear; found 'loud'; give another value",
        "eta: must lie in [1, 2]; found nan; give another value",
        "hold_out_lights: must lie in [0, 0.9]; found 1.5; give another value",
        "seed: must lie in [0, 1e9]; found -1; give another value",
    ]


@pytest.mark.parametrize(
    ("name", "value"), [("k", "two"), ("k", 2.5), ("eta", "glass")]
)
def test_parameters__a_value_that_is_no_number(name, value):
    with pytest.raises(InputError, match=rf"{name}: must be a (whole )?number; found "):
        FitParameters(**{name: value})


@pytest.mark.parametrize("name", RECORDS)
def test_options_of__every_field_is_an_option_with_its_default(name):
    options = {option.name: option for option in cli.commands[name].params}
    for spec in fields(RECORDS[name]):
        assert options[spec.name].help.startswith(
            option_of(RECORDS[name], spec.name).help
        )
        if spec.default is MISSING:
            assert options[spec.name].required
        else:
            default = None if name == "fit" else spec.default
            assert options[spec.name].default == default


def test_options_of__calls_with_the_record_or_with_what_was_given():
    calls = []

    @click.command()
    @options_of(SimulationParameters)
    def record(parameters):
        calls.append(parameters)

    @click.command()
    @options_of(FitParameters, only_set=True)
    def changed(changes):
        calls.append(changes)

    assert CliRunner().invoke(record, ["--lights", "20", "--subsurface"]).exit_code == 0
    assert (
        CliRunner().invoke(changed, ["--eta", "1.4", "--light-gains", "on"]).exit_code
        == 0
    )
    assert CliRunner().invoke(changed, ["--eta", "2.5"]).exit_code == 2
    assert calls == [
        SimulationParameters(lights=20, subsurface=True),
        {"eta": 1.4, "light_gains": True},
    ]


@pytest.mark.parametrize(
    ("record", "options", "rule"),
    [
        (RenderParameters, {"samples": 4}, r"samples: must lie in \[8, 4096\]"),
        (
            RenderParameters,
            {"exposure": 0.0},
            "exposure: must be fixed, auto, or a number from 1e-9 to 1e9",
        ),
        (RenderParameters, {"exposure": "bright"}, "must be fixed, auto, or a number"),
        (ComparisonParameters, {"samples": 9}, r"samples: must lie in \[1, 8\]"),
        (ExportParameters, {"size": 8}, r"size: must lie in \[16, 8192\]"),
        (
            CalibrationParameters,
            {"name": "a", "position_error": -1.0},
            r"position_error: must lie in \[0, 100\]",
        ),
        (DemoParameters, {"takes": 9}, r"takes: must lie in \[1, 8\]"),
        (IngestParameters, {"calibration": "guess"}, "must be one of refuse, note"),
        (SimulationParameters, {"width": 8}, r"width: must lie in \[16, 32768\]"),
    ],
)
def test_parameters__limits_hold_for_callers_in_python(record, options, rule):
    with pytest.raises(InputError, match=rule):
        record(**options)


def test_parameters__an_exposure_is_a_word_or_a_number():
    for exposure in ("fixed", "auto", 1e-9, 2.5, 1e9):
        assert RenderParameters(exposure=exposure).exposure == exposure


def test_fit_parameters__mixtures_alone_have_components_and_rank():
    FitParameters(surface="mixture", k=8, rank=59)
    FitParameters(surface="ggx", seed=1)
    with pytest.raises(InputError) as error:
        FitParameters(surface="ggx", k=8, rank=59)
    lines = str(error.value).splitlines()
    assert [line.partition(":")[0] for line in lines] == ["k", "rank"]
