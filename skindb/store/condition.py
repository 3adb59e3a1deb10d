"""Conditions on the columns of the catalogue, in a small language that evaluates no code.

A condition is parsed by `ast`, and every node must be one of this language: comparisons
of columns with literals or other columns, which may be chained, ``and``, ``or``,
``not``, ``in``, and ``is missing``. As in SQL, a comparison with a missing value is
neither true nor false.
"""

import ast
import operator
import re
import unicodedata
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from itertools import pairwise
from typing import Any

from skindb.errors import InputError, choices, input_error

MAX_CHARACTERS = 1_000
MAX_DEPTH = 16  # of nested conditions
EXAMPLE = "write, for example: condition == 'lotion' and age > 40"
# text in quotes, a name in backticks, or the start of a comment
TOKEN = re.compile(r"""('(?:[^'\\\n]|\\.)*'|"(?:[^"\\\n]|\\.)*")|`([^`\n]*)`|(\#)""")
COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.In: lambda part, text: part in text,
}
TEXT = "text"
NUMBER = "a number"
TRUTH = "true or false"
DATE = "a date"
Column = Sequence[Any]  # a value for each row; None, NaN or NaT where it is missing
Truth = list[bool | None]  # for each row; None where it depends on a missing value


def evaluate(text: str, columns: Mapping[str, Column]) -> tuple[Truth, list[str]]:
    """Evaluate a condition for each row of a table.

    Parameters
    ----------
    text
        The condition, for example ``condition == 'lotion' and age > 40``.
    columns
        Name -> values of all rows, with the column take.

    Returns
    -------
    truth
        Whether each row fulfils the condition; None where that depends on a missing value.
    operands
        Columns that the condition names.

    Raises
    ------
    InputError
        If the text is no condition, names an unknown column, or compares values of different kinds.
    """
    plain, tree, quoted = _parsed(text)
    # as `ast` normalises names
    names = {unicodedata.normalize("NFKC", name): name for name in columns} | quoted
    evaluation = _Evaluation(text, plain, columns, names)
    truth = evaluation.truth(tree, 1)
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.Name)]
    operands = [names[node.id] for node in nodes if node.id in names]
    if not operands:
        raise evaluation.fault("must name a column of the catalogue", "values alone")
    return truth, list(dict.fromkeys(operands))


def is_missing(value: Any) -> bool:
    """Whether a value is missing: None, NaN or NaT."""
    return value is None or value != value


@dataclass(frozen=True)
class _Evaluation:
    """Evaluation of the parts of one condition, which refuses every part that is not of
    the language.
    """

    text: str
    plain: str  # with names in place of those in backticks
    columns: Mapping[str, Column]
    names: Mapping[str, str]  # name in the tree -> column

    def truth(self, node: ast.expr, depth: int) -> Truth:
        """Whether each row fulfils a part of the condition."""
        if depth > MAX_DEPTH:
            rule = f"may be nested {MAX_DEPTH} times"
            raise self.fault(rule, "more levels", "write a simpler condition")
        match node:
            case ast.BoolOp(op=op, values=parts):
                rows = [self.truth(part, depth + 1) for part in parts]
                return _combined(rows, decisive=isinstance(op, ast.Or))
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return _negated(self.truth(operand, depth + 1))
            case ast.Compare(left=left, ops=ops, comparators=rest):
                pairs = zip(ops, pairwise([left, *rest]), strict=True)
                links = [self.comparison(op, *pair) for op, pair in pairs]
                return _combined(links, decisive=False)
            case ast.Name():
                return self.comparison(ast.Eq(), node, ast.Constant(value=True))
        raise self.refused(node)

    def comparison(self, op: ast.cmpop, left: ast.expr, right: ast.expr) -> Truth:
        """Whether each row fulfils one comparison of a chain, such as ``20 < age <= 40``."""
        values = self.values(left)
        match op, right:
            case ast.Is() | ast.IsNot(), ast.Name(id="missing"):
                truth: Truth = [is_missing(value) for value in values]
            case ast.In() | ast.NotIn(), ast.List(elts) | ast.Tuple(elts) | ast.Set(
                elts
            ) if elts:
                links = [self.compared(ast.Eq, values, self.values(x)) for x in elts]
                truth = _combined(links, decisive=True)
            case ast.In() | ast.NotIn(), ast.Name() if _kinds(self.values(right)) <= {
                TEXT
            }:
                truth = self.compared(ast.In, values, self.values(right))
            case ast.Is() | ast.IsNot() | ast.In() | ast.NotIn(), _:
                rule = "must use 'is' as in 'age is missing', and 'in' before values or a text"
                raise self.fault(rule, "another use")
            case _:
                truth = self.compared(type(op), values, self.values(right))
        return _negated(truth) if isinstance(op, ast.IsNot | ast.NotIn) else truth

    def values(self, node: ast.expr) -> Column:
        """Values of a column or of a literal for each row."""
        if isinstance(node, ast.Name):
            return self.columns[self.column(node.id)]
        rows = len(next(iter(self.columns.values())))
        return [self.literal(node)] * rows

    def column(self, name: str) -> str:
        """The column with this name."""
        name = self.names.get(name, name)
        if name in self.columns:
            return name
        text = name
        if not name.isascii():
            text += f" ({name.encode('ascii', 'backslashreplace').decode()})"
        raise self.fault(
            "must name columns of the catalogue",
            f"the name {text}",
            f"{choices(name, [*self.columns, 'True', 'False'])}; text needs quotes",
        )

    def literal(self, node: ast.expr) -> Any:
        """The text, number or truth value of a literal."""
        try:
            value = ast.literal_eval(node)
        except (ValueError, TypeError):
            raise self.refused(node) from None
        if value is None:
            rule = "must write 'is missing' for a missing value"
            raise self.fault(rule, "None", "write, for example: age is missing")
        if not isinstance(value, str | int | float):
            raise self.refused(node)
        return value

    def compared(self, op: type[ast.cmpop], left: Column, right: Column) -> Truth:
        """Whether each row fulfils one comparison of a chain."""
        if DATE in _kinds(left):
            right = self.dates(right)
        elif DATE in _kinds(right):
            left = self.dates(left)
        kinds = _kinds(left), _kinds(right)
        # a column of several kinds has no order
        has_no_order = op not in (ast.Eq, ast.NotEq) and len(set.union(*kinds)) > 1
        if has_no_order:
            self.require_one_kind(left, kinds[1])
            self.require_one_kind(right, kinds[0])
        if has_no_order or (all(kinds) and not set.intersection(*kinds)):
            raise self.fault(
                "must compare text with text and numbers with numbers",
                " beside ".join(" and ".join(sorted(side)) for side in kinds),
                "put text in quotes, and write numbers without them",
            )
        return [_compared(op, *pair) for pair in zip(left, right, strict=True)]

    def require_one_kind(self, values: Column, others: set[str]) -> None:
        """Require one kind of values if one of them is the kind of the `others`."""
        (expected,) = others if len(others) == 1 else {NUMBER}
        if expected not in _kinds(values):
            return
        for row, value in enumerate(values):
            if not is_missing(value) and _kind(value) != expected:
                raise self.fault(
                    f"must compare {expected} with {expected} in all takes",
                    f"{value!r} of {self.columns['take'][row]}",
                    "correct it in capture.json of this take, and ingest it again",
                )

    def dates(self, values: Column) -> Column:
        """Values with dates in place of texts."""
        return [self.date(one) if isinstance(one, str) else one for one in values]

    def date(self, text: str) -> datetime:
        """Date from a text, in UTC without a time zone as those of the catalogue."""
        try:
            moment = datetime.fromisoformat(text)
            if moment.tzinfo:
                moment = moment.astimezone(UTC).replace(tzinfo=None)
        except (ValueError, OverflowError):
            rule = "must compare a date with a date"
            raise self.fault(rule, repr(text), "write it like '2026-11-01'") from None
        return moment

    def refused(self, node: ast.expr) -> InputError:
        """Error for a part that is not of the language."""
        finding = str(ast.get_source_segment(self.plain, node))
        return self.fault("must compare columns of the catalogue with values", finding)

    def fault(self, rule: str, finding: str, cure: str = EXAMPLE) -> InputError:
        """Error of this condition."""
        return _error(rule, f"{finding} in {self.text!r}", cure)


def _error(rule: str, finding: str, cure: str) -> InputError:
    return input_error("where", f"a condition {rule}", finding, cure)


def _parsed(text: str) -> tuple[str, ast.expr, dict[str, str]]:
    """A condition with names in place of those in backticks, its tree, and the columns of
    these names.
    """
    if len(text) > MAX_CHARACTERS:
        rule = f"must have at most {MAX_CHARACTERS:,} characters"
        raise _error(rule, f"{len(text):,}", "select the takes in several steps")
    quoted = dict[str, str]()

    def name(token: re.Match[str]) -> str:
        if token[3]:
            raise _error("must have no comment", "the character #", "remove it")
        if token[2] is None:
            return token[0]
        quoted[f"_quoted_{len(quoted)}"] = token[2]
        return f" {[*quoted][-1]} "

    plain = TOKEN.sub(name, text.replace("\n", " ")).strip()
    try:
        with warnings.catch_warnings():  # of doubtful literals, such as 1if
            warnings.simplefilter("error")
            return plain, ast.parse(plain, mode="eval").body, quoted
    except (SyntaxError, ValueError, MemoryError, RecursionError) as error:
        reason = error.msg if isinstance(error, SyntaxError) else error
        raise _error(
            "must follow the grammar", f"{text!r} ({reason})", EXAMPLE
        ) from None


def _compared(op: type[ast.cmpop], left: Any, right: Any) -> bool | None:
    if is_missing(left) or is_missing(right):
        return None
    if _kind(left) != _kind(right):  # in a column of text and numbers
        return op is ast.NotEq
    return bool(COMPARISONS[op](left, right))


def _negated(truth: Truth) -> Truth:
    return [None if value is None else not value for value in truth]


def _combined(parts: Sequence[Truth], *, decisive: bool) -> Truth:
    """Rows of conditions that are combined by `or` (`decisive` is True) or `and` (False)."""
    combined = Truth()
    for row in zip(*parts, strict=True):
        undecided = None if None in row else not decisive
        combined.append(decisive if decisive in row else undecided)
    return combined


def _kinds(values: Column) -> set[str]:
    return {_kind(value) for value in values if not is_missing(value)}


def _kind(value: Any) -> str:
    if isinstance(value, bool):
        return TRUTH
    if isinstance(value, str):
        return TEXT
    return DATE if isinstance(value, date) else NUMBER
