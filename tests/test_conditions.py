"""Conditions are read as Python would read them, and nothing but conditions is read at all."""

import ast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.conditions import parse
from fusion_io.errors import LogError, UsageError

MEASURES = {"a.raw.ate_m": 2.0, "b.raw.ate_m": 3.0, "b.ekf.t_rel_percent": 0.5, "a.ekf.ate_m": None}
KNOWN = [name for name, value in MEASURES.items() if value is not None]

numbers = st.one_of(
    st.sampled_from(KNOWN),
    st.integers(0, 20).map(str),
    st.floats(0.0, 20.0, allow_nan=False).map(repr),
)
arithmetic = st.recursive(
    numbers,
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from("+-*/"), inner).map(lambda parts: f"({' '.join(parts)})"),
        inner.map(lambda each: f"-{each}"),
    ),
    max_leaves=6,
)
comparisons = st.lists(arithmetic, min_size=2, max_size=3).flatmap(
    lambda sides: st.sampled_from(["<", "<=", ">", ">=", "==", "!="]).map(lambda sign: f" {sign} ".join(sides))
)
conditions = st.recursive(
    comparisons,
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from(["and", "or"]), inner).map(lambda parts: f"({' '.join(parts)})"),
        inner.map(lambda each: f"not ({each})"),
    ),
    max_leaves=4,
)


class _Measures:
    """Python's own reading of a.raw.ate_m, for the oracle."""

    def __init__(self, prefix: str) -> None:
        self._prefix = prefix

    def __getattr__(self, name: str) -> object:
        path = f"{self._prefix}.{name}"
        return MEASURES[path] if path in MEASURES else _Measures(path)


@given(conditions)
def test_a_condition_means_what_it_means_in_python(text: str) -> None:
    try:
        expected = eval(text, {}, {"a": _Measures("a"), "b": _Measures("b")})
    except ZeroDivisionError:
        with pytest.raises(LogError, match="division by zero"):
            parse(text).holds(MEASURES)
    else:
        assert parse(text).holds(MEASURES) == expected


@given(st.text(max_size=40))
def test_any_text_is_a_condition_or_refused_in_one_line(text: str) -> None:
    message, condition = "", None
    try:
        condition = parse(text)
    except UsageError as error:
        message = str(error).replace(repr(text), "")
    assert "\n" not in message
    assert condition is None or isinstance(condition.tree, ast.Compare | ast.BoolOp | ast.UnaryOp)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a.raw.ate_m",
        "1",
        "True",
        "a.raw.ate_m >",
        "a.raw.ate_m > 'x'",
        "a.raw.ate_m > 1e999",
        "a.raw.ate_m > True",
        "a.raw.ate_m > 2 ** 8",
        "a.raw.ate_m > a.raw",
        "a.raw.ate_m > a.b.c.d",
        "a.raw.ate_m > abs(1)",
        "a.raw.ate_m in [1]",
        "a.raw.ate_m is 1",
        "(a.raw.ate_m > 1) + 1 > 0",
        "__import__('os').system('true') > 0",
        "a.raw.ate_m > (lambda: 1)()",
        "(b := 1) > 0",
        "not " * 3000 + "1 > 0",
        "(" * 500 + "1" + ")" * 500 + " > 0",
        "a.raw.ate_m > \0",
    ],
)
def test_what_is_no_condition_is_a_usage_error(text: str) -> None:
    with pytest.raises(UsageError, match="is not a condition"):
        parse(text)


@pytest.mark.parametrize(
    ("text", "nearest"),
    [
        ("a.raw.ate > 1", "a.raw.ate_m"),
        ("b.efk.t_rel_percent > 1", "b.ekf.t_rel_percent"),
        ("1 > 2 and c.raw.ate_m > 1", "b.raw.ate_m"),
    ],
)
def test_an_unknown_name_is_refused_with_the_nearest_even_where_it_would_not_count(text: str, nearest: str) -> None:
    with pytest.raises(UsageError, match=f"unknown name .*did you mean '{nearest}'"):
        parse(text).holds(MEASURES)


def test_a_measure_that_could_not_be_computed_is_no_answer() -> None:
    with pytest.raises(LogError, match=r"a\.ekf\.ate_m could not be computed"):
        parse("a.ekf.ate_m > 1").holds(MEASURES)
    assert parse("a.raw.ate_m > 1 or a.ekf.ate_m > 1").holds(MEASURES)
