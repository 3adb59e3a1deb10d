"""Formulas of linear and mixed models: their parts, columns of a design, and contrasts."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import click
import numpy as np
import pandas as pd

from skindb.analysis.quantities import COLOUR_DIFFERENCE, QUANTITIES
from skindb.analysis.subjects import CONDITION, NORMAL
from skindb.errors import input_error, require
from skindb.types import Array

SUBJECT = "subject"
MODELLED = (*QUANTITIES, COLOUR_DIFFERENCE)
EXAMPLE = "write, for example: ITA ~ treatment * visit + age + (1 | subject)"
# what a formula may consist of: formulaic would evaluate any Python expression
NAME = r"[A-Za-z_]\w*|`[^`]+`"
TERMS = re.compile(
    rf"(?:\s|C\(\s*(?:{NAME})\s*\)|(?:{NAME})(?!\s*\()|[01]\b|[-+*:/()])*"
)
RANDOM = re.compile(r"(?:^|\+)\s*\(([^()|]*)\|([^()|]*)\)\s*(?=\+|$)")
FACTOR = re.compile(rf"\bC\(\s*({NAME})\s*\)")


@dataclass(frozen=True)
class MixedModel:
    """A formula in parts."""

    quantity: str
    is_log: bool
    fixed: str  # terms, as of formulaic, with NAME for C(NAME)
    factors: tuple[str, ...] = ()  # numbers that count as words
    slopes: tuple[str, ...] = ()  # numbers whose slopes differ between subjects
    is_mixed: bool = False  # whether subjects have intercepts of their own
    nested: str = ""  # column whose values have intercepts of their own in each subject

    @classmethod
    def of(cls, formula: str) -> MixedModel:
        """Parse a formula; `InputError` for one that has other parts."""
        left, separator, right = formula.partition("~")
        logarithm = re.fullmatch(r"log\((.*)\)", left.strip())
        quantity = (logarithm[1] if logarithm else left).strip()
        random = RANDOM.findall(right)
        fixed = RANDOM.sub("", right).strip().removeprefix("+").strip() or "1"
        faults = {
            "must have one ~ between a quantity and terms": not separator
            or "~" in right,
            f"must begin with one of {', '.join(MODELLED)}": quantity not in MODELLED,
            "has at most one random part, (1 | subject), (1 + NAME | subject) or "
            "(1 | subject/NAME)": len(random) > 1,
            "has the terms NAME, C(NAME), 0 and 1, joined by + - * : / ( )": not TERMS.fullmatch(
                fixed
            ),
        }
        slopes = []
        nested = ""
        for effects, group in random:
            # a + in backticks is part of a name
            slopes = re.findall(r"(?:`[^`]+`|[^+`])+", effects)
            slopes = [part.strip() for part in slopes if part.strip() != "1"]
            outer, is_nested, nested = (part.strip() for part in group.partition("/"))
            faults["has random effects of subjects, or of NAME within subjects"] = (
                outer != SUBJECT or bool(is_nested and not re.fullmatch(NAME, nested))
            )
            faults["has random effects 1 and NAME"] = not all(
                re.fullmatch(NAME, part) for part in slopes
            )
            faults["has slopes or nested effects, not both"] = bool(slopes and nested)
        if broken := [rule for rule, is_broken in faults.items() if is_broken]:
            raise input_error(f"formula {formula}", broken[0], "another form", EXAMPLE)
        return cls(
            quantity,
            logarithm is not None,
            FACTOR.sub(r"\1", fixed),
            tuple(part.strip("`") for part in FACTOR.findall(fixed)),
            tuple(part.strip("`") for part in slopes),
            bool(random),
            nested.strip("`"),
        )

    @property
    def names(self) -> set[str]:
        """Names in the fixed terms."""
        return {word.strip("`") for word in re.findall(NAME, self.fixed)}


def names_of(model: MixedModel, known: Sequence[str]) -> list[str]:
    """Columns that a model uses; `InputError` if one is not known."""
    names = sorted({*model.names, *model.slopes, SUBJECT, model.nested or SUBJECT})
    if unknown := [name for name in names if name not in known]:
        raise input_error(
            f"formula: {', '.join(unknown)}",
            "must be columns of the takes",
            "unknown names",
            f"choose from: {', '.join(known)}",
        )
    return names


def with_levels(model: MixedModel, frame: pd.DataFrame) -> pd.DataFrame:
    """The rows, with words and C(NAME) as categories, so that terms mean the same in
    all regions; `InputError` for a word that does not differ.
    """
    frame = frame.copy()
    for name in model.names:
        values = frame[name]
        is_number = pd.api.types.is_numeric_dtype(values)
        if is_number and name not in model.factors:
            continue
        if is_number and (values % 1 == 0).all():
            values = values.astype(int)  # level 2 is "2", not "2.0"
        kinds = sorted({type(value).__name__ for value in values})
        require(
            len(kinds) < 2,
            f"formula: {name}",
            "must be all numbers or all words",
            f"values of {' and '.join(kinds)}",
            "correct the attribute in capture.json, and ingest again",
        )
        levels = sorted(set(values), key=None if is_number else _numbers_in_order)
        if name == CONDITION:
            levels.sort(key=NORMAL.__ne__)
        require(
            len(levels) != 1,
            f"formula: {name}",
            "must differ between takes",
            f"{name} is {', '.join(map(str, levels))} in all of them",
            "omit it",
        )
        frame[name] = pd.Categorical(values, levels)
    return frame


def _numbers_in_order(level: object) -> list[tuple[float, str]]:
    """Key that sorts week 2 before week 10."""
    parts = re.split(r"(\d+)", f"{level}")
    return [(float(part), "") if part.isdecimal() else (-1.0, part) for part in parts]


def design_of(
    model: MixedModel, rows: pd.DataFrame
) -> tuple[Array, list[str], list[str]]:
    """Columns (n, p) of the fixed terms that are not 0 everywhere, the names of these
    terms, and of those that contain a random slope.
    """
    # takes longer to import than most commands to run
    from formulaic import model_matrix
    from formulaic.errors import FormulaicError

    try:
        design = model_matrix(model.fixed, rows, na_action="raise")
    except (FormulaicError, ValueError, TypeError, SyntaxError) as broken:
        raise input_error(
            "formula", "must fit the data", click.unstyle(f"{broken}")[:200]
        ) from None
    x = np.asarray(design, float)
    is_present = x.any(axis=0)  # levels that this region has
    terms = [str(name) for name in design.columns[is_present]]
    require(terms, "formula", "must have fixed terms", "no fixed term", EXAMPLE)
    of_slopes = [
        str(design.columns[column])
        for term, columns in design.model_spec.term_indices.items()
        if not {
            str(name) for name in design.model_spec.term_variables[term]
        }.isdisjoint(model.slopes)
        for column in columns
    ]
    return x[:, is_present], terms, of_slopes


def sum_of(contrast: str, terms: Sequence[str]) -> Array:
    """Factors (terms,) of the terms in a contrast."""
    from patsy import DesignInfo, PatsyError

    try:
        plain = FACTOR.sub(r"\1", contrast).replace("`", "")
        found = DesignInfo(terms).linear_constraint(plain)
    except (PatsyError, IndexError):  # the latter for an empty text
        found = None
    require(
        found is not None and len(found.coefs) == 1 and not found.constants.any(),
        f"contrast {contrast}",
        "must be a sum of multiples of terms",
        f"contrast {contrast} is not a sum of multiples of {', '.join(terms)}",
        "write, for example: NAME - 2 * NAME",
    )
    return np.asarray(found.coefs[0], float)
