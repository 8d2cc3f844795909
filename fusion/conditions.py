"""Conditions on measures, such as ``b.posegraph.ate_m > 1.05 * a.posegraph.ate_m``: parsed, never run as code.

Numbers, names of measures, ``+ - * /``, comparisons, ``and``, ``or``, ``not`` and parentheses, with Python's meaning.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import pairwise

from fusion_io.errors import LogError, UsageError

Measures = Mapping[str, float | None]
"""Values by name (``a.raw.ate_m``); None where one could not be computed."""

_ARITHMETIC: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}
_COMPARISONS: dict[type[ast.cmpop], Callable[[float, float], bool]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
_SIGNS: dict[type[ast.unaryop], Callable[[float], float]] = {ast.USub: operator.neg, ast.UAdd: operator.pos}


@dataclass(frozen=True, slots=True)
class Condition:
    """A parsed condition; `parse` makes one."""

    text: str
    tree: ast.expr

    def check_names(self, known: Measures) -> None:
        """Raise UsageError, with the nearest valid name, for a name that does not exist."""
        for name in _names(self.tree):
            if name not in known:
                near = get_close_matches(name, known, n=1, cutoff=0.0)
                raise UsageError(
                    f"{self.text!r}: unknown name {name!r}" + (f"; did you mean {near[0]!r}?" if near else "")
                )

    def holds(self, measures: Measures) -> bool:
        """Whether the condition is true.

        Raises UsageError for a name that does not exist, and LogError for a measure that could not be computed and for
        a division by zero: neither is an answer.
        """
        self.check_names(measures)
        try:
            return self._truth(self.tree, measures)
        except ZeroDivisionError:
            raise LogError(f"{self.text!r}: division by zero") from None

    def _truth(self, node: ast.expr, measures: Measures) -> bool:
        match node:
            case ast.BoolOp(op=ast.And(), values=values):
                return all(self._truth(value, measures) for value in values)
            case ast.BoolOp(values=values):
                return any(self._truth(value, measures) for value in values)
            case ast.UnaryOp(operand=operand):
                return not self._truth(operand, measures)
            case ast.Compare(left=left, ops=ops, comparators=comparators):
                numbers = (self._number(each, measures) for each in (left, *comparators))  # lazily, as Python
                return all(_COMPARISONS[type(op)](*sides) for op, sides in zip(ops, pairwise(numbers), strict=False))
        raise AssertionError(ast.dump(node))

    def _number(self, node: ast.expr, measures: Measures) -> float:
        match node:
            case ast.Constant(value=value):
                return float(value)  # type: ignore[arg-type]  # `parse` lets only numbers pass
            case ast.UnaryOp(op=op, operand=operand):
                return _SIGNS[type(op)](self._number(operand, measures))
            case ast.BinOp(left=left, op=op, right=right):
                return _ARITHMETIC[type(op)](self._number(left, measures), self._number(right, measures))
        value = measures[ast.unparse(node)]
        if value is None:
            raise LogError(f"{self.text!r}: {ast.unparse(node)} could not be computed")
        return value


def parse(text: str) -> Condition:
    """Parse a condition; raises UsageError for what is none."""
    try:
        tree = ast.parse(text.strip(), mode="eval").body
        _check_truth(tree)
    except (SyntaxError, ValueError, OverflowError, RecursionError, MemoryError) as error:
        reason = error.msg if isinstance(error, SyntaxError) else str(error)
        example = "b.posegraph.ate_m > 1.05 * a.posegraph.ate_m"
        raise UsageError(f"{text!r} is not a condition such as {example!r}: {reason}") from None
    return Condition(text.strip(), tree)


def _check_truth(node: ast.expr) -> None:
    """Raise ValueError for what is neither true nor false."""
    match node:
        case ast.BoolOp(values=values):
            for value in values:
                _check_truth(value)
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            _check_truth(operand)
        case ast.Compare(left=left, ops=ops, comparators=comparators):
            for op in ops:
                if type(op) not in _COMPARISONS:
                    raise ValueError(f"{ast.unparse(node)!r} is no comparison of numbers")
            for each in (left, *comparators):
                _check_number(each)
        case _:
            raise ValueError(f"{ast.unparse(node)!r} is no comparison")


def _check_number(node: ast.expr) -> None:
    """Raise ValueError for what is no finite number."""
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool) and math.isfinite(value):
            return
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
            _check_number(operand)
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub() | ast.Mult() | ast.Div(), right=right):
            _check_number(left)
            _check_number(right)
        case ast.Attribute(value=ast.Attribute(value=ast.Name())):
            return
        case _:
            raise ValueError(f"{ast.unparse(node)!r} is no number and no name such as a.raw.ate_m")


def _names(tree: ast.expr) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute):
            yield ast.unparse(node)
