from __future__ import annotations

from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.config.problems import Place
from controller.config.table import allowed, checked_arguments
from controller.core.errors import UsageError
from hal.toml_lines import KeyLines

PLACE = Place("stage.toml", KeyLines("a = 0\nb = 0\n"))
Colour = tuple[float, float, float]
WANTED: dict[str, Any] = {
    "size": float | None,
    "count": int,
    "tint": Colour,
    "colours": tuple[Colour, Colour],
    "mapping": Literal["plane", "cylinder"],
    "flat": bool,
    "title": str,
}


def test_what_fits_is_passed_on_with_lists_as_tuples() -> None:
    written = {"size": 1, "count": 2, "tint": [1, 0.5, 0], "colours": [[0, 0, 0], [1, 1, 1]], "mapping": "plane"}
    assert checked_arguments(PLACE, written, WANTED) == {
        "size": 1.0,
        "count": 2,
        "tint": (1.0, 0.5, 0.0),
        "colours": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
        "mapping": "plane",
    }


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("size", "large", "'size' is a number."),
        ("size", float("nan"), "'size' is a number."),
        ("count", 1.5, "'count' is a whole number."),
        ("count", True, "'count' is a whole number."),
        ("tint", [1, 2], "'tint' is a list of 3, each a number."),
        ("tint", [1, 2, "x"], "'tint' is a list of 3, each a number."),
        ("tint", [1, 2, float("inf")], "'tint' is a list of 3, each a number."),
        ("colours", [1, 2], "'colours' is a list of 2, each a list of 3, each a number."),
        ("mapping", "ball", '\'mapping\' is one of "plane", "cylinder".'),
        ("flat", 1, "'flat' is true or false."),
        ("title", 5, "'title' is text in quotes."),
    ],
)
def test_what_does_not_fit_is_told_with_what_does(key: str, value: object, says: str) -> None:
    with pytest.raises(UsageError) as wrong:
        checked_arguments(PLACE, {key: value}, WANTED)
    assert wrong.value.code == "stage-key-type"
    assert wrong.value.what.startswith("stage.toml, line ")
    assert wrong.value.remedy == says


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4),
    max_leaves=8,
)


@given(key=st.sampled_from(sorted(WANTED)), value=values)
def test_anything_that_toml_can_hold_is_taken_or_refused_in_a_sentence(key: str, value: Any) -> None:
    refused = ""
    taken: dict[str, Any] = {}
    try:
        taken = checked_arguments(PLACE, {key: value}, WANTED)
    except UsageError as wrong:
        refused = wrong.remedy
    assert refused == f"'{key}' is {allowed(WANTED[key])}." or taken.keys() == {key}
