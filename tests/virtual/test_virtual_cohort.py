"""A virtual population like that of the paper's table 1."""

from __future__ import annotations

import json
from collections import Counter

import numpy as np
import pytest

from skindb.errors import InputError
from skindb.parameters import SimulationParameters
from skindb.virtual.capture import capture_record, session_time
from skindb.virtual.person import VISIT_BLOOD, VISIT_MELANIN, cohort_people
from skindb.virtual.skin import DISTINCT
from skindb.workflow import simulate

SIZE = {"cameras": 2, "lights": 12, "width": 24, "height": 30}


def test_cohort_people__are_those_of_table_1():
    people = cohort_people()
    assert Counter(one.gender for one in people) == {"male": 70, "female": 17}
    assert (
        Counter((one.ancestry == "european", one.gender) for one in people)[
            True, "male"
        ]
        == 50
    )
    assert Counter(one.condition for one in people) == {
        "normal": 79,
        "lotion": 4,
        "makeup": 4,
    }
    ages = [
        one.age for one in people if one.ancestry == "european" and one.gender == "male"
    ]
    assert 13 <= min(ages) < 25 < 50 < max(ages) <= 59
    assert len({one.seed for one in people}) == 87


def test_cohort_people__the_first_are_the_same_whatever_the_number():
    assert cohort_people(100)[:20] == cohort_people(20)
    assert len({one.subject for one in cohort_people(200)}) == 200
    assert cohort_people(5, seed=1) != cohort_people(5)
    twice = cohort_people(6, conditions=["lotion"])
    assert [one for one in twice if one.condition == "normal"] == cohort_people(6)


def test_cohort_people__of_the_paper_begin_with_one_subject_in_seven_conditions():
    people = cohort_people(3, paper=True)
    assert people[7:] == cohort_people(3)
    assert {(one.subject, one.age, one.gender) for one in people[:7]} == {
        ("A001", 31, "male")
    }
    assert {one.condition for one in people[:7]} == {
        "normal",
        "cold",
        "hot",
        "sweat",
        "lotion",
        "makeup",
        "powder",
    }


def test_cohort_people__visits_vary_as_stated():
    """Standard deviations from 2 x 800 degrees of freedom are known to 2 %; 5 standard
    errors are allowed.
    """
    people = cohort_people(400, visits=3, conditions=["lotion"])
    normal = [one for one in people if one.condition == "normal"]
    first = normal[:3]
    assert [one.take for one in first] == ["P001", "P001.normal.2", "P001.normal.3"]
    assert len({session_time(one) for one in people if one.subject == "P001"}) == 6
    stated = [capture_record(one, contact=True, landmarks=True) for one in first]
    assert [record["visit"] for record in stated] == [1, 2, 3]
    alone = capture_record(cohort_people(1)[0], contact=True, landmarks=True)
    assert (alone["version"], "visit" in alone) == (1, False)
    of_day = {(one.subject, one.visit): one.melanin for one in normal}
    for one in people:
        if one.condition == "lotion" and (one.subject, one.visit) in of_day:
            assert one.melanin == of_day[one.subject, one.visit]
    for name, expected in (("melanin", VISIT_MELANIN), ("blood", VISIT_BLOOD)):
        values = np.array([getattr(one, name) for one in normal]).reshape(-1, 3)
        within = np.sqrt(values.var(axis=1, ddof=1).mean())
        assert within == pytest.approx(expected, rel=0.13)


@pytest.mark.slow
def test_simulate__continues_a_cohort(tmp_path):
    out = tmp_path / "c"
    first = simulate(out, cohort=2, **SIZE)
    times = [(folder / "capture.json").stat().st_mtime_ns for folder in first]
    whole = (first[1] / "capture.json").read_bytes()
    (first[1] / "capture.json").unlink()  # as a killed run leaves it
    again = simulate(out, cohort=3, **SIZE)
    assert [folder.name for folder in again] == ["P001", "P002", "P003"]
    assert (first[0] / "capture.json").stat().st_mtime_ns == times[0]
    assert (first[1] / "capture.json").read_bytes() == whole
    assert json.loads((out / "cohort.json").read_text())["width"] == 24
    with pytest.raises(
        InputError,
        match=r"cohort.json: a cohort is continued with the same options; found width 24",
    ):
        simulate(out, cohort=3, **SIZE | {"width": 32})


def test_simulate__spares_a_folder_that_holds_no_cohort(tmp_path):
    (tmp_path / "P001").mkdir()
    with pytest.raises(
        InputError, match="a new cohort needs an absent or empty folder"
    ):
        simulate(tmp_path, cohort=1, **SIZE)
    assert (tmp_path / "P001").is_dir()


def test_simulate__truth_has_each_planted_brdf_alone(tmp_path):
    simulate(tmp_path, takes=1, bases=2, **SIZE)
    with np.load(tmp_path / "V001.truth.npz") as truth:
        assert tuple(truth["surface_names"]) == DISTINCT[:2]
        assert ((truth["surface_weights"] > 0).sum(axis=1) == 1).all()


def test_simulate__can_plant_every_distinct_brdf():
    SimulationParameters(bases=len(DISTINCT))
    with pytest.raises(InputError, match="bases"):
        SimulationParameters(bases=len(DISTINCT) + 1)
