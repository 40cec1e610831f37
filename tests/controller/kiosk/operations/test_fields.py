"""What a caller may send: whatever it is, it is either a value within the field's words or refused in words."""

from __future__ import annotations

import json
import math
import re
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel
from pydantic import Field as Limits

from controller.core.errors import UsageError
from controller.kiosk.operations.arguments import Hours
from controller.kiosk.operations.fields import INTEGER, NAME, NUMBER, TEXT, Field, object_schema, parse
from controller.kiosk.operations.table import OPERATIONS


class Row(BaseModel, extra="forbid"):
    count: Annotated[int, Limits(ge=1, le=20, description="a whole number from 1 to 20"), INTEGER]
    level: Annotated[Literal["high", "low"], Limits(description="high or low")] = "high"


WORDS = Field("text", Annotated[str, Limits(max_length=40, description="a text of any letters"), TEXT], True)
FRACTION = Field(
    "number",
    Annotated[float, Limits(ge=-1, le=2.5, allow_inf_nan=False, description="a number from -1 to 2.5"), NUMBER], True,
)  # fmt: skip
COUNT = Field("count", Annotated[int, Limits(ge=1, le=20, description="a whole number from 1 to 20"), INTEGER], True)
TICK = Field("tick", Annotated[bool, Limits(description="yes or no")], True)
LEVEL = Field("level", Annotated[Literal["high", "low"], Limits(description="high or low")], False)
CALLED = Field("name", Annotated[str, Limits(pattern=NAME, description="a name"), TEXT], True)
ROWS = Field("rows", Annotated[list[Row], Limits(max_length=2, description="at most two rows")], True)
ALL = (WORDS, FRACTION, COUNT, TICK, LEVEL, CALLED, ROWS)
GOOD: dict[str, Any] = {
    "text": "a\nb", "number": 0.5, "count": 3, "tick": True, "name": "Köpfe 1", "rows": [{"count": 2, "level": "low"}],
}  # fmt: skip


def code_of(fields: tuple[Field, ...], sent: dict[str, Any], *, strings: bool = False) -> str:
    with pytest.raises(UsageError) as caught:
        parse(fields, sent, strings=strings)
    json.dumps(caught.value.what + caught.value.remedy, ensure_ascii=False).encode()
    return caught.value.code


def test_what_fits_comes_back_as_it_was_sent() -> None:
    assert parse(ALL, GOOD, strings=False) == GOOD | {"rows": [Row(count=2, level="low")]}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("number", 10**400), ("number", -(10**400)), ("number", math.nan), ("number", math.inf), ("number", True),
        ("number", "1"), ("number", 2.500001), ("count", 10**400), ("count", 2.5), ("count", 0), ("count", 21),
        ("count", math.inf), ("count", None), ("count", False),
        ("text", "\ud800"), ("text", "half \udfff of it"), ("text", "\x00"), ("text", "x" * 41), ("text", 3),
        ("text", ["x"]), ("name", "a\n"), ("name", "\ud800"), ("name", "../etc"), ("name", ""), ("name", " a"),
        ("name", "a/b"), ("name", "<b>"), ("name", "x" * 65),
        ("tick", "on"), ("tick", 1), ("tick", None), ("level", "High"), ("level", ""),
        ("rows", {}), ("rows", [3]), ("rows", [{"count": 1}] * 3), ("rows", [{"count": 1, "other": 2}]),
        ("rows", [{"count": 10**400}]), ("rows", [{"count": 1, "level": "\ud800"}]), ("rows", [{}]),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(name: str, value: object) -> None:
    wanted = ("field-wrong", "field-missing", "field-unknown") if name == "rows" else ("field-wrong",)
    assert code_of(ALL, GOOD | {name: value}) in wanted


def test_what_is_missing_or_unknown_is_refused_without_saying_it_back() -> None:
    assert code_of(ALL, {name: value for name, value in GOOD.items() if name != "count"}) == "field-missing"
    assert code_of((), {"<script>": 1}) == "field-unknown"
    with pytest.raises(UsageError, match=r"^(?!.*script).*$"):
        parse(ALL, GOOD | {"<script>": 1}, strings=False)


def test_a_form_says_everything_as_text() -> None:
    fields = (WORDS, FRACTION, COUNT, TICK, LEVEL, CALLED)
    sent = {"text": "a\r\nb", "number": "-0.5", "count": "7", "tick": "on", "level": "", "name": "x"}
    assert parse(fields, sent, strings=True) == {
        "text": "a\nb", "number": -0.5, "count": 7, "tick": True, "name": "x",
    }  # fmt: skip
    unticked = parse(fields, {name: text for name, text in sent.items() if name != "tick"} | {"text": ""}, strings=True)
    assert (unticked["tick"], unticked["text"]) == (False, "")
    for number in ("", " 7", "7 ", "+7", "1e1", "0x7", "\u0667", "7.", "7\n", "--7", "9" * 400, "nan", "7.5"):
        assert code_of(fields, sent | {"count": number}, strings=True) in ("field-wrong", "field-missing"), number
    assert code_of(fields, sent | {"name": ""}, strings=True) == "field-missing"
    assert code_of(fields, sent | {"tick": "perhaps"}, strings=True) == "field-wrong"


ANYTHING = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(st.characters(), max_size=12),
              st.sampled_from((10**400, "\ud800", "mon", "10:00"))),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3), max_leaves=5,
)  # fmt: skip


@given(st.data(), st.booleans())
@settings(max_examples=150, deadline=None)
def test_whatever_is_sent_to_any_operation_is_within_its_document_or_refused(
    data: st.DataObject, strings: bool
) -> None:
    operation = data.draw(st.sampled_from(OPERATIONS))
    fields = tuple(field for field in operation.fields if field.sent is None)
    sent = data.draw(st.fixed_dictionaries({}, optional={field.name: ANYTHING for field in fields}))
    try:
        values = parse(fields, sent, strings=strings)
    except UsageError:
        return
    for field in fields:
        if field.name in values:
            _fits(field, values[field.name])
    json.dumps(values, ensure_ascii=False, allow_nan=False, default=lambda row: row.model_dump()).encode()


def _fits(field: Field, value: Any) -> None:
    schema = field.schema
    if schema["type"] == "string":
        assert len(value) <= schema.get("maxLength", len(value))
        assert re.search(schema.get("pattern", ""), value)
        assert value in schema.get("enum", (value,))
    elif schema["type"] in ("integer", "number"):
        assert schema["minimum"] <= value <= schema["maximum"]
    elif schema["type"] == "array":
        assert len(value) <= schema["maxItems"]
        assert all(row.day for row in value)


def test_the_document_of_rows_forbids_what_is_refused() -> None:
    schema = object_schema([Field("rows", Hours, True)])["$defs"]["HoursRow"]
    assert schema["required"] == ["day"]
    assert schema["additionalProperties"] is False
