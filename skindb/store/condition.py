"""Conditions on the columns of the catalogue, in a small language that evaluates no code.

A condition is parsed by `ast`, and every node must be one of this language: comparisons
of columns with literals or other columns, which may be chained, ``and``, ``or``,
``not``, ``in``, and ``is missing``. As in SQL, a comparison with a missing value is
neither true nor false.
"""

import ast
import difflib
import operator
import re
import unicodedata
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from itertools import pairwise
from typing import Any

from skindb.errors import InputError, input_error

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
}
TEXT = "text"
NUMBER = "a number"
TRUTH = "true or false"
DATE = "a date"
REFUSED = {  # the most likely expressions that are not part of the language
    ast.Attribute: "a dot after a name",
    ast.BinOp: "arithmetic",
    ast.Call: "a function call",
    ast.Constant: "a value that is not compared",
    ast.IfExp: "if and else",
    ast.JoinedStr: "a formatted text",
    ast.Lambda: "a function",
    ast.Subscript: "an index",
}
Column = Sequence[Any]  # a value for each row; None, NaN or NaT where it is missing
Truth = list[bool | None]  # for each row; None where it depends on a missing value


def evaluate(text: str, columns: Mapping[str, Column]) -> tuple[Truth, list[str]]:
    """Evaluate a condition for each row of a table.

    Parameters
    ----------
    text
        The condition, for example ``condition == 'lotion' and age > 40``.
    columns
        Name -> values of all rows; at least one column.

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
    tree, quoted = _parsed(text)
    # as `ast` normalises names
    names = {unicodedata.normalize("NFKC", name): name for name in columns}
    names |= {name: name for name in columns} | quoted
    evaluation = _Evaluation(text, columns, names)
    truth = evaluation.truth(tree, 1)
    operands = [
        names[node.id]
        for node in ast.walk(tree)
        if isinstance(node, ast.Name) and node.id in names
    ]
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
            case ast.Compare(left=left, ops=[op], comparators=[ast.Name(id="missing")]):
                if isinstance(op, ast.Is | ast.IsNot):
                    missing: Truth = [is_missing(value) for value in self.values(left)]
                    return _negated(missing) if isinstance(op, ast.IsNot) else missing
            case ast.Compare(left=left, ops=[ast.In()], comparators=[right]):
                return self.contained(left, right)
            case ast.Compare(left=left, ops=[ast.NotIn()], comparators=[right]):
                return _negated(self.contained(left, right))
            case ast.Name():
                return self.truth_of_column(node)
        if not isinstance(node, ast.Compare):
            raise self.refused(node)
        return self.comparison(node)

    def comparison(self, node: ast.Compare) -> Truth:
        """Whether each row fulfils a comparison, such as ``20 < age <= 40``."""
        if not {*map(type, node.ops)} <= COMPARISONS.keys():
            raise self.fault(
                "must use 'is' as in 'age is missing', and 'in' without other "
                "comparisons beside it",
                "another use",
            )
        sides = map(self.values, (node.left, *node.comparators))
        links = [
            self.compared(type(op), *pair)
            for op, pair in zip(node.ops, pairwise(sides), strict=True)
        ]
        return _combined(links, decisive=False)

    def truth_of_column(self, node: ast.Name) -> Truth:
        """Values of a column of truth values."""
        values = self.values(node)
        if _kinds(values) - {TRUTH}:
            raise self.fault(
                "must compare a column of text or numbers",
                f"{self.column(node.id)} alone",
            )
        return [None if is_missing(value) else bool(value) for value in values]

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
        near = difflib.get_close_matches(
            name.lower(), [*self.columns, "True", "False"], n=1
        )
        hint = f"did you mean {near[0]}? " if near else ""
        raise self.fault(
            "must name columns of the catalogue",
            f"the name {text}",
            f"{hint}Text needs quotes; columns: {', '.join(self.columns)}",
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
        if has_no_order or (all(kinds) and not set.intersection(*kinds)):
            raise self.fault(
                "must compare text with text and numbers with numbers",
                " beside ".join(" and ".join(sorted(side)) for side in kinds),
                "put text in quotes, and write numbers without them",
            )
        return [_compared(op, *pair) for pair in zip(left, right, strict=True)]

    def contained(self, left: ast.expr, right: ast.expr) -> Truth:
        """Whether the value of each row is in a list of literals, or its text is a part
        of another text.
        """
        values = self.values(left)
        if isinstance(right, ast.List | ast.Tuple | ast.Set):
            if not right.elts:
                rule = "must have at least one value after 'in'"
                raise self.fault(rule, "an empty list")
            links = [
                self.compared(ast.Eq, values, [self.literal(element)] * len(values))
                for element in right.elts
            ]
            return _combined(links, decisive=True)
        texts = self.values(right)
        if not _kinds(values) | _kinds(texts) <= {TEXT}:
            raise self.fault(
                "must have a list or a text after 'in', and a text before a text",
                "other values",
                "write, for example: condition in ['lotion', 'normal']",
            )
        return [
            None if is_missing(a) or is_missing(b) else a in b
            for a, b in zip(values, texts, strict=True)
        ]

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

    def refused(self, node: ast.AST) -> InputError:
        """Error for a part that is not of the language."""
        finding = REFUSED.get(type(node), "another expression")
        return self.fault("must compare columns of the catalogue with values", finding)

    def fault(self, rule: str, finding: str, cure: str = EXAMPLE) -> InputError:
        """Error of this condition."""
        return _error(rule, f"{finding} in {self.text!r}", cure)


def _error(rule: str, finding: str, cure: str) -> InputError:
    return input_error("where", f"a condition {rule}", finding, cure)


def _parsed(text: str) -> tuple[ast.expr, dict[str, str]]:
    """The tree of a condition, and the column by each name that stands for one in backticks."""
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
            return ast.parse(plain, mode="eval").body, quoted
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
