from __future__ import annotations

from skindb.errors import Fault, grouped


def test_grouped__many_faults_of_one_place_and_rule_are_one_line():
    one = [Fault("a", "rule", f"{i}", "cure") for i in range(5)]
    other = [Fault("b", "rule", f"{i}", "cure") for i in range(3)]
    assert grouped([*one, *other, *one]) == [
        Fault("a", "rule", "0, and 4 more", "cure"),
        *other,
    ]
    assert grouped([]) == []
