"""Profiles: what ships is sound, and whatever is wrong is named with its line."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.codecs.projectors.profiles import parse_profile
from hal.errors import ProtocolError
from hal.values import Power

FOLDER = Path(__file__).parents[4] / "firmware_configs" / "projectors"
OPTOMA = (FOLDER / "optoma-later.toml").read_text()


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_profile_is_sound_and_bears_its_file_name(path: Path) -> None:
    profile = parse_profile(path.read_text(), file=path.name)
    assert profile.name == path.stem
    assert profile.source


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.toml")), ids=lambda path: path.stem)
def test_a_profile_is_all_that_a_family_needs_and_short(path: Path) -> None:
    assert len(path.read_text().splitlines()) < 60


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.toml")), ids=lambda path: path.stem)
def test_a_switch_whose_acknowledgement_is_lost_is_confirmed_within_ten_seconds(path: Path) -> None:
    profile = parse_profile(path.read_text())
    timing = profile.timing
    if profile.serial is not None:
        assert max(timing.late_s, timing.command_s) + timing.boot_interval_s + timing.answer_s <= 10


def test_codes_that_nobody_knows_may_be_left_out_only_when_it_is_said() -> None:
    text = (FOLDER / "optoma-ep910.toml").read_text()
    profile = parse_profile(text)
    assert profile.unknown == ("power_on", "power_off", "power", "lamp_hours")
    silent = "\n".join(line for line in text.splitlines() if not line.startswith("unknown"))
    with pytest.raises(ProtocolError, match=r"commands.power_on: it is missing"):
        parse_profile(silent)


FAMILY_WRONG = [
    ("nec", 'count = "byte"', 'count = "word"', "frame.count"),
    ("nec", "overhead = 6", "overhead = 3", "frame.overhead"),
    ("nec", 'checksum = "sum"', 'checksum = "crc"', "frame.checksum"),
    ("nec", '"02 00 00 00 00 02"', '"02 00 00 00 00 0"', "commands.power_on"),
    ("nec", '"02 00 00 00 00 02"', '"02 00 00 ? 00 02"', "commands.power_on"),
    ("nec", 'unit = "seconds"', 'unit = "fortnights"', "queries.lamp_hours.unit"),
    ("nec", 'notation = "hex"', 'notation = "octal"', "serial.notation"),
    ("nec", '"22 00 ?*3"', '"22 00 ?*0"', "replies.accepted"),
    ("optoma-ep910", '"power_on", ', '"model", ', "profile.unknown"),
    ("optoma-ep910", "shutter_close =", 'power_on = "IR03001"\nshutter_close =', "commands.power_on"),
    ("benq", "echo = true", 'echo = "yes"', "quirks.echo"),
    ("benq", 'prompt = ">"', 'promt = ">"', "quirks.promt"),
    ("panasonic", "[queries.lamp_hours]", '[queries.lamp_hours]\nreads = "big-endian"', "queries.lamp_hours.reads"),
    ("christie", '"(PWR{any}"', '"(PWR{all}"', "replies.accepted"),
    ("epson-escvp21", 'terminator = ":"', "", "serial.terminator"),
]


@pytest.mark.parametrize(("name", "right", "wrong", "key"), FAMILY_WRONG)
def test_a_wrong_key_of_a_family_is_named_with_its_line(name: str, right: str, wrong: str, key: str) -> None:
    text = (FOLDER / f"{name}.toml").read_text()
    assert right in text
    with pytest.raises(ProtocolError) as caught:
        parse_profile(text.replace(right, wrong, 1), file="mine.toml")
    assert caught.value.code == "profile-wrong"
    assert key in caught.value.what
    assert "mine.toml, line " in caught.value.what


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


TEXTS = [path.read_text() for path in sorted(FOLDER.glob("*.toml"))]
SCALARS = st.one_of(st.booleans(), st.integers(), st.floats(), st.text(max_size=8))


@given(st.data())
def test_a_profile_with_any_line_changed_is_sound_or_a_protocol_error(data: st.DataObject) -> None:
    lines = data.draw(st.sampled_from(TEXTS)).splitlines()
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
