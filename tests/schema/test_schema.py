"""schema: labels, the check of inputs, and the declarations themselves."""

from __future__ import annotations

import pickle
import re
from functools import partial

import numpy as np
import pytest
from planted_cohort import EVERYTHING, PEOPLE, capture

import skindb
from skindb.errors import InputError
from skindb.render.scene import from_model
from skindb.schema import (
    GROUPS,
    VARIABLES,
    FitStatus,
    ProbeStatus,
    TexelStatus,
    Use,
    check,
    dataset,
    names_of,
    variables,
)
from skindb.schema.cohort import take_name, visit_of
from skindb.schema.declaration import DECLARED, declare
from skindb.store import subject_of
from skindb.store.place import TAKE

DIMS = set(
    "surfel face light camera channel site fibre dictionary parameter "
    "lobe v u component region xyz uv "
    "corner landmark row col coefficient axis theta_h theta_d phi_d photograph image_row image_col "
    "group k take edge bin trait side level status samples space statistic "
    "contrast quantity term effect attribute mode mode_count block subject "
    "part cell chromophore pair take_2 component_2 placement pressure_sample step "
    "response_level exposure correction".split()
)


def test_variables__declared_once_with_known_dims():
    assert sum(map(len, GROUPS.values())) == len(VARIABLES)
    assert {dim for v in VARIABLES.values() for dim in v.dims} <= DIMS
    assert all(v.doc and v.units and np.dtype(v.dtype) for v in VARIABLES.values())
    for name in VARIABLES:  # each has its constant
        assert getattr(variables, name.upper()) == name


@pytest.mark.parametrize(
    ("header", "rule"),
    [
        ("float32 fitted/gloss(surfel)", "is declared as"),
        ("float32 gloss(surfel) [1]", "is declared as"),
        ("float32 fitted/fit_status(surfel) [1]", "declared twice"),
    ],
)
def test_declare__header(header, rule):
    with pytest.raises(ValueError, match=rule):
        declare(header, "gloss of a surfel")


def test_declare__returns_the_name():
    header = "float32 fitted/gloss(surfel, channel) [sr-1]"
    try:
        assert declare(header, "gloss of a surfel", uses=Use.MAPPED) == "gloss"
        assert DECLARED["gloss"].dims == ("surfel", "channel")
        assert DECLARED["gloss"].units == "sr-1"
        assert names_of(Use.MAPPED)[-1] == "gloss"
    finally:
        del DECLARED["gloss"]


def test_names_of__maps_of_registered_takes_are_declared():
    for name in names_of(Use.MAPPED):
        assert VARIABLES[f"texel_{name}"].dims[:2] == ("v", "u")


def test_check__every_fault_at_once():
    ds = dataset({"surfel_area": np.ones(3), "surfel_position": np.ones((3, 3))})
    check(ds, ["surfel_area", "surfel_position"])
    ds["surfel_area"].attrs["units"] = "m2"
    ds["surfel_position"] = ds["surfel_position"].transpose()
    with pytest.raises(InputError, match="mm2") as caught:
        check(ds, ["surfel_area", "surfel_position", "surfel_normal"], where="take X")
    assert len(caught.value.faults) == 3
    assert "take X[surfel_normal]" in str(caught.value)


def test_dataset__names_a_variable_that_is_not_declared():
    with pytest.raises(ValueError, match="'pore_density' is not declared"):
        dataset({"pore_density": np.zeros(3)})


def test_dataset__text_labels_and_flags():
    ds = dataset({"fit_status": [0, 1]}, coords={"surfel": [0, 1]})
    assert ds["fit_status"].attrs["flag_meanings"].split()[1] == "unseen"
    named = dataset({"light_disc_radius": [1.0, 2.0]}, coords={"light": ["l0", "l1"]})
    assert named["light"].dtype == np.dtypes.StringDType()


def test_status__each_member_explains_itself():
    for member in [*FitStatus, *ProbeStatus, *TexelStatus]:
        assert len(member.explanation) > 10
        assert type(member)(int(member)) is member  # by the code that is stored
        assert pickle.loads(pickle.dumps(member)) is member  # as a report of a worker


@pytest.mark.parametrize("status", [FitStatus, ProbeStatus, TexelStatus])
def test_status__codes_index_tables(status):
    assert [int(member) for member in status] == list(range(len(status)))


@pytest.mark.parametrize(
    ("parts", "name"),
    [
        (("3", "normal", 1, 1), "3"),
        (("3", "lotion", 1, 1), "3.lotion"),
        (("3", "normal", 2, 1), "3.normal.2"),
        (("3", "lotion", 1, 12), "3.lotion.1.12"),
        (("normal", "1", 1, 1), "normal.1"),
        (("3", "2", 2, 1), "3.2.2"),
    ],
)
def test_take_name__drops_what_is_first_or_normal(parts, name):
    assert take_name(*parts) == name
    assert re.fullmatch(TAKE, name)
    assert (subject_of(name), *visit_of(name)) == (parts[0], *parts[2:])


def test_take__other_names_are_refused():
    for name in ("3.lotion.0", "3.lotion.02", "3.lotion.2.2.2", "3.lotion.b", "3..2"):
        assert not re.fullmatch(TAKE, name)


@pytest.mark.parametrize(
    "call",
    [
        from_model,
        skindb.export.texture_maps,
        skindb.analysis.summary_tables,
        partial(skindb.render.evaluate, surfel=0, wi=(0, 0, 1), wo=(0, 0, 1)),
    ],
)
def test_fitted_of__a_capture_is_no_model(call):
    with pytest.raises(InputError, match="S01: must be a model, which has the group"):
        call(capture("S01", PEOPLE["S01"] | {"scope": [*EVERYTHING]}, 0))
