"""Messages count in plain English."""

import pytest

from fusion_io.words import counted, metres


@pytest.mark.parametrize(("count", "text"), [(0, "0 stretches"), (1, "1 stretch"), (2, "2 stretches")])
def test_one_of_a_thing_is_singular_and_any_other_number_plural(count: int, text: str) -> None:
    assert counted(count, "stretch", "stretches") == text
    assert counted(count, "frame") == text.replace("stretches", "frames").replace("stretch", "frame")


@pytest.mark.parametrize(("value", "text"), [(0.123, "0.12 m"), (12.34, "12.3 m"), (1260.4, "1260 m")])
def test_a_length_has_the_digits_that_matter(value: float, text: str) -> None:
    assert metres(value) == text
