from __future__ import annotations

from skindb.errors import Fault, choices, counted, grouped


def test_grouped__many_faults_of_one_place_and_rule_are_one_line():
    one = [Fault("a", "rule", f"{i}", "cure") for i in range(5)]
    other = [Fault("b", "rule", f"{i}", "cure") for i in range(3)]
    assert grouped([*one, *other, *one]) == [
        Fault("a", "rule", "0, and 4 more", "cure"),
        *other,
    ]
    assert grouped([]) == []


def test_counted__one_and_many():
    texts = [counted(count, "take") for count in (0, 1, 2, 1_000)]
    assert texts == ["0 takes", "1 take", "2 takes", "1,000 takes"]


def test_choices__a_near_name_in_another_case():
    assert choices("v01", ["V001", "X2"]) == "did you mean V001? choose V001, X2"
