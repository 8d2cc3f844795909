"""Results come in the order of their items, and no more of them are computed than were asked for and a few ahead."""

import time
from collections.abc import Iterator

import pytest

from fusion_io.ahead import computed_ahead


def test_results_come_in_the_order_of_their_items() -> None:
    def slow_at_first(item: int) -> int:
        time.sleep(0.02 if item == 0 else 0.0)
        return item * item

    assert list(computed_ahead(slow_at_first, range(20), 4)) == [item * item for item in range(20)]
    assert list(computed_ahead(slow_at_first, [], 4)) == []


def test_no_more_items_are_taken_than_a_few_ahead() -> None:
    taken: list[int] = []

    def items() -> Iterator[int]:
        for item in range(100):
            taken.append(item)
            yield item

    results = computed_ahead(lambda item: item, items(), 3)
    assert [next(results) for _ in range(5)] == [0, 1, 2, 3, 4]
    assert len(taken) == 8


def test_an_error_comes_where_its_result_would() -> None:
    results = computed_ahead(lambda item: 1 // item, [2, 1, 0, 3], 2)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ZeroDivisionError):
        next(results)
