"""Profiles: what ships is sound, and whatever is wrong is named with its line."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.errors import ProtocolError
from hal.profiles import parse_profile
from hal.values import Power

FOLDER = Path(__file__).parents[2] / "firmware_configs" / "projectors"
OPTOMA = (FOLDER / "optoma-later.toml").read_text()


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_profile_is_sound_and_bears_its_file_name(path: Path) -> None:
    profile = parse_profile(path.read_text(), file=path.name)
    assert profile.name == path.stem
    assert profile.source


def test_the_optoma_table_says_what_the_manual_says() -> None:
    table = parse_profile(OPTOMA).serial
    assert table is not None
    assert table.baud == 9600
    assert table.commands["power_on"] == "~{address}00 1\r"
    assert table.queries["power"].send == "~{address}124 1\r"
    assert table.queries["lamp_hours"].send == "~{address}108 1\r"
    assert table.notices.power == {"0": Power.OFF, "1": Power.WARMING, "2": Power.COOLING}
    assert table.notices.trouble["4"] == "lamp-failed"


WRONG = [
    ('protocol = "serial"', 'protocol = "telepathy"', "profile.protocol"),
    ("baud = 9600", "baud = 96000000", "serial.baud"),
    ("baud = 9600", 'baud = "fast"', "serial.baud"),
    ("baud = 9600", "baud = true", "serial.baud"),
    ("baud = 9600", "bauds = 9600", "serial.baud"),
    ("answer_s = 1.0 ", "answer_s = -1.0 ", "timing.answer_s"),
    ("answer_s = 1.0 ", "answer_s = nan ", "timing.answer_s"),
    ("late_s = 3.0", "late_s = 0.5", "timing.late_s"),
    ("boot_interval_s = 1.0", "boot_interval_s = 0.01", "timing.boot_interval_s"),
    ("stable_s = 900.0", "stable_s = 1.0", "lamp.stable_s"),
    ("minimum_off_s = 180.0", "minimum_off_s = 5.0", "lamp.minimum_off_s"),
    ('0 = "off", 1 = "on"', '0 = "off", 1 = "lit"', "queries.power.values"),
    ('0 = "off", 1 = "on"', '1 = "on"', "queries.power.values"),
    ("~{address}02 1\\r", "~{adress}02 1\\r", "commands.shutter_close"),
    ("~{address}02 1\\r", "~{address}02 \\u20ac\\r", "commands.shutter_close"),
    ('shutter_open = "~', 'shutter_opened = "~', "commands.shutter_close"),
    ('prefix = "INFO"', "", "notices.prefix"),
    ('4 = "lamp-failed"', '4 = "Lamp failed"', "notices.trouble"),
    ('4 = "lamp-failed"', '2 = "lamp-failed"', "notices.trouble"),
    ('accepted = ["P"]', "accepted = []", "replies.accepted"),
    ('terminator = "\\r"', 'terminator = ""', "serial.terminator"),
    ('address = "00" ', 'address = "0{}" ', "serial.address"),
    ('family = "later', 'colour = "red"\nfamily = "later', "profile.colour"),
]


@pytest.mark.parametrize(("right", "wrong", "key"), WRONG)
def test_a_wrong_key_is_named_with_its_line(right: str, wrong: str, key: str) -> None:
    assert OPTOMA.count(right) >= 1
    with pytest.raises(ProtocolError) as caught:
        parse_profile(OPTOMA.replace(right, wrong, 1), file="mine.toml")
    assert caught.value.code == "profile-wrong"
    assert caught.value.theirs is False
    assert key in caught.value.what
    assert "mine.toml, line " in caught.value.what


def test_the_line_is_the_right_one() -> None:
    text = OPTOMA.replace("late_s = 3.0", "late_s = 0.5")
    line = text.splitlines().index("late_s = 0.5") + 1
    with pytest.raises(ProtocolError, match=f"line {line} is wrong"):
        parse_profile(text)


def test_a_missing_command_names_the_table_that_lacks_it() -> None:
    text = "\n".join(line for line in OPTOMA.splitlines() if not line.startswith("power_on"))
    line = text.splitlines().index("[commands]") + 1
    with pytest.raises(ProtocolError, match=rf"line {line} is wrong: commands.power_on: it is missing"):
        parse_profile(text)


def test_a_syntax_error_is_a_profile_error_with_its_line() -> None:
    with pytest.raises(ProtocolError, match="line 2"):
        parse_profile("[profile]\nname = \n")


@given(st.text(max_size=300))
def test_no_text_ends_in_anything_but_a_protocol_error(text: str) -> None:
    with pytest.raises(ProtocolError):
        parse_profile(text)


SCALARS = st.one_of(st.booleans(), st.integers(), st.floats(), st.text(max_size=8))


@given(st.data())
def test_a_profile_with_any_line_changed_is_sound_or_a_protocol_error(data: st.DataObject) -> None:
    lines = OPTOMA.splitlines()
    index = data.draw(st.integers(0, len(lines) - 1))
    change = data.draw(st.sampled_from(["drop", "twice", "value", "text"]))
    if change == "drop":
        del lines[index]
    elif change == "twice":
        lines.insert(index, lines[index])
    elif change == "text":
        lines[index] = data.draw(st.text(max_size=40))
    else:
        value = data.draw(SCALARS)
        lines[index] = f"{lines[index].partition('=')[0]}= {str(value).lower() if value in (True, False) else value!r}"
    try:
        profile = parse_profile("\n".join(lines))
    except ProtocolError:
        return
    assert profile.timing.answer_s > 0
    assert profile.lamp.minimum_off_s >= profile.lamp.cool_down_s
