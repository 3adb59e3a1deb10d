"""Conditions: their values against pandas and Python, and hostile expressions."""

from __future__ import annotations

import random
import sys
from collections import Counter
from datetime import datetime

import numpy as np
import pandas as pd
import pytest
from hostile_conditions import HARMLESS, REFUSED, hostile_conditions, outcome

from skindb.errors import InputError
from skindb.store.condition import MAX_CHARACTERS, MAX_DEPTH, evaluate

ROWS = 40
EXPRESSIONS = 300  # of each kind


def table(rng, *, missing):
    """Columns of text, whole numbers, numbers, truth values and dates."""
    columns = {
        "condition": [rng.choice(["normal", "lotion", "tan"]) for _ in range(ROWS)],
        "age": [rng.randrange(20, 70) for _ in range(ROWS)],
        "albedo": [round(rng.random(), 2) for _ in range(ROWS)],
        "outdated": [rng.random() < 0.5 for _ in range(ROWS)],
        "model_created": [datetime(2026, rng.randrange(1, 13), 5) for _ in range(ROWS)],
    }
    if missing:
        for values in columns.values():
            for row in rng.sample(range(ROWS), 12):
                values[row] = rng.choice([None, float("nan")])
    return columns


def comparison(rng):
    """A comparison as text, and as a function of a column that returns nullable truth values."""
    name = rng.choice(["condition", "age", "albedo", "model_created"])
    sign = rng.choice(["==", "!=", "<", "<=", ">", ">="])
    value = {
        "condition": rng.choice(["normal", "lotion", "none"]),
        "age": rng.randrange(20, 70),
        "albedo": round(rng.random(), 2),
        "model_created": f"2026-{rng.randrange(1, 13):02d}-05",
    }[name]
    return f"{name} {sign} {value!r}", lambda columns: compared(
        columns[name], sign, value
    )


def compared(values, sign, value):
    operations = {
        "==": "__eq__",
        "!=": "__ne__",
        "<": "__lt__",
        "<=": "__le__",
        ">": "__gt__",
        ">=": "__ge__",
    }
    known = [v for v in values if v is not None and v == v]
    limit = datetime.fromisoformat(value) if isinstance(known[0], datetime) else value
    truth = [
        pd.NA if v is None or v != v else bool(getattr(v, operations[sign])(limit))
        for v in values
    ]
    return pd.array(
        [one if one is not NotImplemented else None for one in truth], "boolean"
    )


def condition(rng, depth=0):
    """A random condition as text, and as a function of the columns by the logic of pandas."""
    kind = rng.choice(
        ["comparison", "truth", "missing", "in", "and", "or", "not"]
        if depth < 4
        else ["comparison"]
    )
    if kind == "comparison":
        return comparison(rng)
    if kind == "truth":
        return "outdated", lambda c: pd.array(
            [None if v is None or v != v else v for v in c["outdated"]], "boolean"
        )
    if kind == "missing":
        name = rng.choice(["age", "condition", "model_created"])
        negated = rng.random() < 0.5
        text = f"{name} is {'not ' if negated else ''}missing"
        return text, lambda c: pd.array(
            pd.isna(pd.Series(c[name], dtype=object)) != negated, "boolean"
        )
    if kind == "in":
        chosen = rng.sample(["normal", "lotion", "tan", "none"], 2)
        return (
            f"condition in {chosen}",
            lambda c: (
                compared(c["condition"], "==", chosen[0])
                | compared(c["condition"], "==", chosen[1])
            ),
        )
    if kind == "not":
        text, expected = condition(rng, depth + 1)
        return f"not ({text})", lambda c: ~expected(c)
    (a, first), (b, second) = (condition(rng, depth + 1) for _ in range(2))
    if kind == "and":
        return f"({a}) and ({b})", lambda c: first(c) & second(c)
    return f"({a}) or ({b})", lambda c: first(c) | second(c)


def test_evaluate__is_the_logic_of_pandas_with_missing_values():
    rng = random.Random(28)
    for _ in range(EXPRESSIONS):
        columns = table(rng, missing=rng.random() < 0.7)
        text, expected = condition(rng)
        truth, _ = evaluate(text, columns)
        assert truth == [None if one is pd.NA else one for one in expected(columns)], (
            text
        )


def test_evaluate__chains_and_precedence_are_those_of_python():
    rng = random.Random(29)
    columns = table(rng, missing=False)
    for _ in range(EXPRESSIONS):
        low, high = sorted(rng.sample(range(20, 70), 2))
        parts = [
            f"{low} <= age < {high}",
            comparison(rng)[0],
            "not outdated",
            "-1 < albedo < +0.5",
        ]
        rng.shuffle(parts)
        text = parts[0] + "".join(
            f" {rng.choice(['and', 'or'])} {part}" for part in parts[1:]
        )
        if "model_created" in text:  # a date and a text, which Python does not compare
            continue
        rows = [
            {name: values[row] for name, values in columns.items()}
            for row in range(ROWS)
        ]
        assert evaluate(text, columns)[0] == [eval(text, {}, row) for row in rows], text


def test_evaluate__hostile_expressions_are_refused_in_one_line_or_harmless(
    tmp_path, monkeypatch
):
    """No expression writes a file, imports a module, or gives anything but truth values
    or one line.
    """
    monkeypatch.chdir(tmp_path)
    modules = {*sys.modules}
    outcomes = Counter(
        outcome(text) for text in hostile_conditions(5 * EXPRESSIONS, seed=2012)
    )
    assert outcomes[REFUSED] > 4 * EXPRESSIONS
    assert {*outcomes} == {REFUSED, HARMLESS}
    assert not [*tmp_path.iterdir()]
    assert {*sys.modules} == modules


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (
            "agee > 40",
            (
                r"name columns of the catalogue; found the name agee in 'agee > 40'; "
                r"did you mean age\?"
            ),
        ),
        (
            "\u0430ge > 40",
            r"found the name \u0430ge \(\\u0430ge\) in .*; did you mean age\?",
        ),
        ("condition == lotion", "text needs quotes"),
        (
            "age > '40'",
            (
                r"text with text and numbers with numbers; found a number beside text "
                r"in \"age > '40'\""
            ),
        ),
        (
            "'old' < age",
            "text with text and numbers with numbers; found text beside a number",
        ),
        ("age in [20, 'x']", "text with text and numbers with numbers"),
        ("outdated == 1", "found true or false beside a number"),
        (
            "mixed < 3",
            "a number with a number in all takes; found 'II' of T1 in 'mixed <",
        ),
        ("'I' < mixed", "text with text in all takes; found 1 of T0 in"),
        ("model_created > 'May'", "must compare a date with a date; found 'May'"),
        ("model_created > '0001-01-01T00:00+14:00'", "must compare a date with a date"),
        ("model_created > 3", "found a date beside a number"),
        ("age == None", "must write 'is missing' for a missing value"),
        ("age is None", "must use 'is' as in 'age is missing'"),
        ("age is 4", "must use 'is' as in 'age is missing'"),
        ("age in []", "'in' before values or a text"),
        ("3 in age", "'in' before values or a text"),
        ("3 in condition", "found a number beside text"),
        ("age", "found a number beside true or false in 'age'"),
        ("age and age > 3", "found a number beside true or false"),
        ("1 == 1", "must name a column"),
        ("'x'", "must compare columns of the catalogue with values; found 'x' in"),
        ("age + 1 > 3", r"found age \+ 1 in"),
        ("age = 4", "must follow the grammar; found 'age = 4'"),
        ("age >", "must follow the grammar"),
        ("", "must follow the grammar"),
        ("age > 3 # and outdated", "must have no comment"),
        ("age > 0" + " " * MAX_CHARACTERS, "at most 1,000 characters; found 1,007"),
        ("not " * MAX_DEPTH + "age > 3", "may be nested 16 times"),
    ],
)
def test_evaluate__says_what_is_wrong(text, line):
    columns = table(random.Random(0), missing=True) | {"mixed": [1, "II"] * (ROWS // 2)}
    columns["take"] = [f"T{row}" for row in range(ROWS)]
    with pytest.raises(InputError, match=f"^where: a condition .*{line}") as refused:
        evaluate(text, columns)
    assert len(refused.value.faults) == 1


def test_evaluate__reads_names_in_backticks_and_columns_of_two_kinds():
    columns = {
        "skin type": ["II", 2, np.nan],
        "größe": [1.0, 2.0, 3.0],
        "text": ["`x`", "# y", "z"],
    }
    assert evaluate("`skin type` == 'II'", columns) == (
        [True, False, None],
        ["skin type"],
    )
    assert evaluate("`skin type` != 2", columns)[0] == [True, False, None]
    assert evaluate("`skin type` in [2.0, 'III']", columns)[0] == [False, True, None]
    assert evaluate("größe > 1.5", columns)[0] == [False, True, True]
    assert evaluate("text == '`x`' or text == '# y'", columns)[0] == [True, True, False]
    with pytest.raises(
        InputError, match=r"found the name skin typ in .*did you mean skin type"
    ):
        evaluate("`skin typ` == 2", columns)


def test_evaluate__a_date_with_a_zone_is_compared_in_utc():
    columns = {"model_created": [pd.Timestamp("2026-01-01 11:30"), pd.NaT]}
    assert evaluate("model_created > '2026-01-01T13:00+02:00'", columns)[0] == [
        True,
        None,
    ]
    assert evaluate("model_created > '2026-01-01T13:00'", columns)[0] == [False, None]
    assert evaluate("model_created in ['2026-01-01T13:30+02:00']", columns)[0] == [
        True,
        None,
    ]


def test_evaluate__of_no_rows_is_empty():
    assert (
        evaluate(
            "take in ['A', 'B'] and age > 3 or 'A' in take", {"take": [], "age": []}
        )[0]
        == []
    )
