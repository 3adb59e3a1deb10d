"""Hostile conditions on the catalogue, and what becomes of them."""

from __future__ import annotations

import random
from collections.abc import Iterator
from datetime import datetime

from skindb.errors import InputError
from skindb.store.condition import evaluate

COLUMNS = {
    "condition": ["normal", "lotion", None],
    "age": [34, float("nan"), 60],
    "outdated": [True, False, None],
    "model_created": [datetime(2026, 1, 5), None, datetime(2026, 2, 5)],
}
REFUSED = "refused in one line with a cure"
HARMLESS = "truth values, as of a harmless condition"
# of messages of libraries
WORDS = ("pandas", "numpy", "Traceback", "<ast", "object at")
PARTS = (
    "age",
    "condition",
    "'lotion'",
    "40",
    "3.5",
    "True",
    "None",
    "missing",
    "nan",
    "age.__class__",
    "age.values",
    "1j",
    "condition.to_pickle('/tmp/x')",
    "age.plot(backend='this')",
    "__import__('os')",
    "open('x', 'w')",
    "@age",
    "b'x'",
    "f'{age}'",
    "f'{open(1)}'",
    "lambda: 0",
    "[age for age in condition]",
    "(age := 3)",
    "9**9**9**9",
    "1 << 10**9",
    "age[0]",
    "age if age else 3",
    "{'a': age}",
    "{age}",
    "*age",
    "(yield)",
    "await age",
    "print",
    "exec('1')",
    "...",
    "`age`",
    "`age`.plot()",
    "`a\u0300ge`",
    "\u0430ge",
    "\uff41\uff47\uff45",
    "age\u200b",
    "\u2028",
    "\x00",
    "\x1b[31m",
    "#",
    "\\",
    "'",
    '"',
    "'''",
    ";",
    "import os",
    "=",
    "==",
    "(",
    ")",
    "[",
    "]",
    "age\n",
    "1e999",
    "0x",
    "1_0",
    "9" * 400,
    "-" * 90 + "1",
    "'\\x1b'",
    "u'x'",
    "r'\\d'",
    "'a' 'b'",
    "$",
    "!",
    "?",
    "~age",
    "age @ age",
    "-condition",
)
JOINTS = (
    " ",
    " and ",
    " or ",
    " not ",
    " == ",
    " < ",
    " <= ",
    " in ",
    " not in ",
    " is ",
    " is not ",
    " + ",
    "**",
    ".",
    ",",
    "(",
    ")",
    "[",
    "]",
    " if ",
    " for ",
    ":=",
    "\uff1d",
    "\u2264",
    "\t",
    "\n",
)


SIGNS = ("==", "!=", "<", "<=", ">", ">=", "in", "not in", "is", "is not")
OPERANDS = (  # of one kind, or of a column and what may follow it
    ("age", "40", "-1.5", "`age`"),
    ("condition", "'lotion'", "'a'"),
    ("model_created", "'2026-01-01'"),
    ("outdated", "True"),
    ("age", "(30, 40)", "missing"),
    ("condition", "['lotion', 'tan']", "missing"),
)


def comparison(rng: random.Random) -> str:
    """A chain of comparisons, whose operands are mostly of one kind."""
    alike = rng.choice(OPERANDS)
    operands = [
        rng.choice(alike if rng.random() < 0.9 else PARTS)
        for _ in range(rng.choice([2, 2, 2, 3]))
    ]
    return operands[0] + "".join(
        f" {rng.choice(SIGNS)} {operand}" for operand in operands[1:]
    )


def hostile(rng: random.Random) -> str:
    """A combination of comparisons, or a random sequence of parts of Python; some are
    nested deeply.
    """
    count = rng.randrange(1, 6)
    if rng.random() < 0.5:
        parts = [
            f"{rng.choice(['', '', 'not '])}{comparison(rng)}" for _ in range(count)
        ]
        text = parts[0] + "".join(
            f" {rng.choice(['and', 'or'])} {part}" for part in parts[1:]
        )
    else:
        text = "".join(
            rng.choice(PARTS) + rng.choice(JOINTS) for _ in range(count)
        ) + rng.choice(PARTS)
    if rng.random() < 0.1:
        text = "not " * rng.randrange(400) + text
    if rng.random() < 0.1:
        text = "(" * (depth := rng.randrange(700)) + text + ")" * depth
    return text


def hostile_conditions(count: int, *, seed: int) -> Iterator[str]:
    """Random conditions."""
    rng = random.Random(seed)
    return (hostile(rng) for _ in range(count))


def outcome(text: str) -> str:
    """What becomes of a condition: `REFUSED`, `HARMLESS`, or a fault of the language of
    conditions.
    """
    try:
        truth, _ = evaluate(text, COLUMNS)
    except InputError as error:
        line = str(error)
        good = (
            line.isprintable()
            and "; found " in line
            and not any(word in line for word in WORDS)
        )
        return REFUSED if good and len(error.faults) == 1 else f"a bad message: {line}"
    except Exception as error:  # noqa: BLE001  any other one is an outcome
        return f"{type(error).__name__} of {text!r}"
    good = len(truth) == len(COLUMNS["age"]) and {*map(type, truth)} <= {
        bool,
        type(None),
    }
    return HARMLESS if good else f"other values of {text!r}"
