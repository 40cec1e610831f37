"""stage.toml: what is right is read, what is wrong is named with its line and what is allowed."""

from __future__ import annotations

import random
import re
import tomllib
from pathlib import Path

import pytest

from controller.config import Stage, check_driver_settings, load_stage, write_stage
from controller.config.models import StageTables
from controller.core.errors import UsageError
from hal.registry import Driver

STAGE = """\
# a stage
[stage]
name = "demo"

[[projectors]]
name = "left"
output = "P1"
driver = "serial"
port = "run/tty-left"

[[projectors]]
name = "right"
output = "P2"
driver = "serial"
port = "run/tty-right"

[camera]
driver = "ptp"
iso = 100
focal_length_px = 5200
address = "ptpip:127.0.0.1"

[display]
driver = "player"
frames = "run/outputs.frame"
[[display.outputs]]
name = "P1"
width_px = 280
height_px = 210
[[display.outputs]]
name = "P2"
width_px = 280
height_px = 210
"""


def load(tmp_path: Path, text: str = STAGE) -> Stage:
    (tmp_path / "stage.toml").write_text(text)
    return load_stage(tmp_path)


def error_of(tmp_path: Path, text: str) -> UsageError:
    with pytest.raises(UsageError) as error:
        load(tmp_path, text)
    return error.value


def swapped(old: str, new: str) -> str:
    assert STAGE.count(old) >= 1, old
    return STAGE.replace(old, new, 1)


def test_a_right_stage_is_read_with_defaults(tmp_path: Path) -> None:
    stage = load(tmp_path)
    assert [projector.output for projector in stage.tables.projectors] == ["P1", "P2"]
    ((view, camera),) = stage.tables.views
    assert (view, camera.focal_length_px) == ("camera", 5200.0)
    assert stage.tables.bundle.allow_unsigned is False
    assert stage.tables.capture.longest_exposure_s > 0
    assert stage.path("run/tty-left") == tmp_path / "run" / "tty-left"
    assert load_stage(tmp_path / "stage.toml").tables.model_dump() == stage.tables.model_dump()


ONE_OUTPUT = STAGE[: STAGE.rindex("[[display")]
ONE_OUTPUT_TABLE = ONE_OUTPUT.replace("[[display.outputs]]", "[display.outputs]")
CAMERA_IS_A_NUMBER = "camera = 3\n" + STAGE[: STAGE.index("[camera]")] + STAGE[STAGE.index("[display]") :]
SHORT_POINT = "[object]\ndistances = [{from_px = [1.0], to_px = [1, 2], distance_m = 1}]\n"
BAD_APPEARANCE = '[[appearances]]\nname = "../x"\nkind = "k"\n'

CAMERA_KEYS = STAGE[STAGE.index("[camera]\n") + 9 : STAGE.index("[display]")].strip() + "\n"

WRONG = {
    "text for a number": (swapped("iso = 100", 'iso = "fast"'), "stage-key-type", 19, "iso", "whole number from 25"),
    "fraction for a whole number": (swapped("= 280", "= 280.5"), "stage-key-type", 28, "width_px", "1 to 16384"),
    "true for a number": (swapped("iso = 100", "iso = true"), "stage-key-type", 19, "iso", "whole number"),
    "number for text": (swapped('name = "demo"', "name = 3"), "stage-key-type", 3, "name", "1 to 64"),
    "too small": (swapped("iso = 100", "iso = 0"), "stage-key-value", 19, "iso", "from 25 to 819200"),
    "infinite": (swapped("5200", "inf"), "stage-key-value", 20, "focal_length_px", "above 0"),
    "not a number": (swapped("5200", "nan"), "stage-key-value", 20, "focal_length_px", "above 0"),
    "empty name": (swapped('name = "left"', 'name = ""'), "stage-key-value", 6, "name", "1 to 64"),
    "escape in a name": (swapped('"left"', '"\\u001b[31m"'), "stage-key-value", 6, "name", "printable"),
    "missing key": (swapped('output = "P2"\n', ""), "stage-key-missing", 11, "output", "display output"),
    "misspelt needed key": (swapped("iso =", "isoo ="), "stage-key-missing", 17, "line 19 has 'isoo'", "whole number"),
    "missing table": (STAGE[: STAGE.index("[display]")], "stage-key-missing", 1, "display", "[display]"),
    "misspelt table": (swapped("[camera]", "[cammera]"), "stage-key-unknown", 17, "mean 'camera'", "appearances"),
    "unknown key": (swapped('name = "demo"', 'name = "demo"\nsize = 3'), "stage-key-unknown", 4, "size", "name"),
    "misspelt key": (swapped("width_px", "width"), "stage-key-unknown", 28, "mean 'width_px'", "height_px"),
    "table for a list": (ONE_OUTPUT_TABLE, "stage-key-type", 26, "outputs", "[[display.outputs]]"),
    "value for a table": (CAMERA_IS_A_NUMBER, "stage-key-type", 1, "camera", "the table [camera]"),
    "wrong choice": (STAGE + '[solve]\nbase = "best"\n', "stage-key-value", 35, "base", '"white"'),
    "wrong flag": (STAGE + "[bundle]\nallow_unsigned = 1\n", "stage-key-type", 35, "allow_unsigned", "true or false"),
    "wrong item of a list": (STAGE + '[bundle]\ntrusted_keys = ["aa"]\n', "stage-key-value", 35, "trusted_keys", "64"),
    "short point": (STAGE + SHORT_POINT, "stage-key-value", 35, "from_px", "[x, y]"),
    "bad name of an appearance": (STAGE + BAD_APPEARANCE, "stage-key-value", 35, "name", "letters, digits"),
    "same name twice": (swapped('"right"', '"left"'), "stage-key-value", 12, "already used in line 6", "different"),
    "same output twice": (
        swapped('output = "P2"', 'output = "P1"'),
        "stage-key-value",
        13,
        "in line 7",
        "not used twice",
    ),
    "output that is not there": (swapped('output = "P2"', 'output = "P3"'), "stage-key-value", 13, "P3", "P1, P2"),
    "no camera": (swapped("[camera]", "[[relays]]"), "stage-key-missing", 17, "name", "relay board"),
    "one camera and several": (
        STAGE + f"[[cameras]]\nname = 'a'\n{CAMERA_KEYS}",
        "stage-key-value",
        17,
        "can't stand beside [[cameras]]",
        "Write [[cameras]] and a name",
    ),
    "several cameras without names": (
        swapped("[camera]", "[[cameras]]"),
        "stage-key-missing",
        17,
        "name",
        "different for every camera",
    ),
    "two cameras of one name": (
        swapped("[camera]", f"[[cameras]]\nname = 'a'\n{CAMERA_KEYS}[[cameras]]\nname = 'a'"),
        "stage-key-value",
        24,
        "already used in line 18",
        "different",
    ),
    "nine cameras": (
        swapped("[camera]", "".join(f"[[cameras]]\nname = 'a{n}'\n{CAMERA_KEYS}" for n in range(8)) + "[[cameras]]"),
        "stage-key-value",
        17,
        "cameras",
        "1 to 8",
    ),
    "more projectors than outputs": (ONE_OUTPUT, "stage-key-value", 13, "2 projectors and 1 outputs", "P1"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_key_is_named_with_its_line_and_what_is_allowed(tmp_path: Path, case: str) -> None:
    text, code, line, named, allowed = WRONG[case]
    error = error_of(tmp_path, text)
    assert error.code == code
    assert f"stage.toml, line {line}:" in error.what
    assert named in error.what
    assert allowed in error.remedy
    assert error.exit_code == 2


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (swapped("iso = 100", "iso = "), "line 19"),
        (swapped("iso = 100", "iso = 100\niso = 200"), "line 20"),
        (swapped("[camera]", "[camera"), "line 17"),
        (STAGE + 'name = "never ends', "at its end"),
    ],
)
def test_what_is_not_toml_is_told_with_its_line(tmp_path: Path, text: str, line: str) -> None:
    error = error_of(tmp_path, text)
    assert error.code == "stage-syntax"
    assert error.what.startswith(f"stage.toml, {line} is not valid TOML: ")


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b"\xff\xfe", "stage-unreadable"),
        (b"#" * (1 << 20) + b"\n", "stage-unreadable"),
        (b"a = " + b"[" * 10_000, "stage-syntax"),
        (b"a = " + b"9" * 10_000, "stage-syntax"),
        (b"a = " + b"[" * 300 + b"]" * 300, "stage-key-unknown"),
    ],
)
def test_hostile_files_get_a_sentence(tmp_path: Path, content: bytes, code: str) -> None:
    (tmp_path / "stage.toml").write_bytes(content)
    with pytest.raises(UsageError) as error:
        load_stage(tmp_path)
    assert error.value.code == code


def test_a_folder_without_a_stage_is_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no .*stage\.toml") as error:
        load_stage(tmp_path)
    assert error.value.code == "stage-missing"


PIECES = ["", "=", "[", "]", "{", "}", '"', "'", "\n", ".", "-1", "1e999", "9" * 400, "[[", "true", "nan", "é", "\x00"]
PIECES += ["1979-05-27", "x = 1\n", "[camera]\n", "[[projectors]]\n", "[]", "{}", '"""', '"text"', "0", "[1, {a = 2}]"]


def damaged(chance: random.Random) -> str:
    """The stage with some of its characters, or one whole value, replaced."""
    text = STAGE
    if chance.random() < 0.5:
        value = chance.choice(list(re.finditer(r"(?<== ).*", text)))
        return text[: value.start()] + chance.choice(PIECES) + text[value.end() :]
    for _ in range(chance.randint(1, 3)):
        at = chance.randrange(len(text))
        text = text[:at] + chance.choice(PIECES) + text[at + chance.choice([0, 1, 1, 8]) :]
    return text


def test_a_damaged_stage_never_gets_more_than_a_sentence(tmp_path: Path) -> None:
    chance = random.Random(5)
    codes = set()
    for _ in range(1500):
        told = told_about(tmp_path, damaged(chance))
        if told is not None:
            assert re.search(r"stage\.toml(, line \d+|, at its end)", told.what), told.what
            assert told.remedy
            codes.add(told.code)
    assert codes == {*("stage-syntax", "stage-key-unknown", "stage-key-missing", "stage-key-type", "stage-key-value")}


def told_about(tmp_path: Path, text: str) -> UsageError | None:
    try:
        load(tmp_path, text)
    except UsageError as error:
        return error
    return None


def a_driver(**settings: str) -> Driver:
    return Driver("projector", "serial", "", lambda *_: None, settings, required=tuple(settings)[:1])


def test_a_driver_gets_the_keys_that_it_understands_and_no_others(tmp_path: Path) -> None:
    tables = load(tmp_path).tables
    assert check_driver_settings(tables.projectors[0], a_driver(port="a tty", baud="a rate")) == {
        "port": "run/tty-left"
    }
    display = check_driver_settings(tables.display, a_driver(outputs="a list", frames="a file"))
    assert display["frames"] == "run/outputs.frame"
    assert display["outputs"][0] == {"name": "P1", "width_px": 280, "height_px": 210}


def test_a_key_that_neither_the_driver_nor_we_understand_is_named_with_its_line(tmp_path: Path) -> None:
    stage = load(tmp_path, swapped('port = "run/tty-right"', 'prot = "run/tty-right"'))
    with pytest.raises(UsageError, match=r"line 15.*'prot'; did you mean 'port'") as error:
        check_driver_settings(stage.tables.projectors[1], a_driver(port="a tty"))
    assert error.value.code == "stage-key-unknown"


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ('hst = "left"', "did you mean 'host'"),
        ('scren = ":0.1"', "did you mean 'screen'"),
        ("left_top = [0, 0]", "did you mean 'left_top_px'"),
        ("left_top_px = [-1, 0]", "-1 is below 0"),
        ("left_top_px = [0, 99999999999]", "is above 16384"),
        ('screen = "0.1"', "does not have the allowed form"),
        ('host = "a b"', "does not have the allowed form"),
    ],
)
def test_a_wrong_place_of_an_output_is_named(tmp_path: Path, line: str, says: str) -> None:
    with pytest.raises(UsageError, match=rf"\[\[display.outputs\]\] number 1.*{re.escape(says)}"):
        load(tmp_path, swapped('name = "P1"\n', f'name = "P1"\n{line}\n'))


def test_cameras_misspelt_are_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="'camras'; did you mean 'cameras'"):
        load(tmp_path, swapped("[camera]", "[[camras]]"))


def test_a_key_that_the_driver_needs_is_asked_for_with_its_explanation(tmp_path: Path) -> None:
    stage = load(tmp_path, swapped('port = "run/tty-right"\n', ""))
    with pytest.raises(UsageError, match=r"line 11.*'port' is missing.*the path of a tty") as error:
        check_driver_settings(stage.tables.projectors[1], a_driver(port="the path of a tty"))
    assert error.value.code == "stage-key-missing"


def test_safety_of_the_stage_only_adds(tmp_path: Path) -> None:
    rules = load(tmp_path, STAGE + "[safety]\nstable_s = 900\n").tables.safety.at_least()
    assert (rules.stable_s, rules.minimum_off_s) == (900.0, 0.0)


def test_a_written_stage_is_tidy_commented_and_loads(tmp_path: Path) -> None:
    content = tomllib.loads(STAGE) | {"bundle": {"allow_unsigned": True}}
    content["camera"]["distance_m"] = None
    write_stage(tmp_path / "stage.toml", content)
    text = (tmp_path / "stage.toml").read_text()
    assert "# the table [camera]\n[camera]\ndriver" in text
    assert "distance_m" not in text
    assert "\n\n\n" not in text
    written = load_stage(tmp_path).tables
    assert written.bundle.allow_unsigned
    assert written.projectors[1].settings({"port": "a tty"}) == {"port": "run/tty-right"}


@pytest.mark.parametrize("outline", ["[[[0.1, 0.2], [0.3, 0.4]]]", "[[[0.1, 0.2], [0.3, 0.4], [0.5, 1.2]]]", "[0.1]"])
def test_an_outline_has_regions_of_three_corners_inside_the_picture(tmp_path: Path, outline: str) -> None:
    error = error_of(tmp_path, f"{STAGE}\n[object]\noutline = {outline}\n")
    assert "outline" in error.what
    right = load(tmp_path, f"{STAGE}\n[object]\noutline = [[[0, 0.2], [1, 0.4], [0.5, 0.9]]]\n").tables.object.outline
    assert right == (((0, 0.2), (1, 0.4), (0.5, 0.9)),)


def test_the_numbers_that_are_taken_are_those_that_the_description_names() -> None:
    tables = StageTables.model_json_schema()["$defs"].values()
    for key, field in (row for table in tables for row in table.get("properties", {}).items()):
        taken = {name: value for one in (field, *field.get("anyOf", ())) for name, value in one.items()}
        named = re.search(r"([\d.]+)(?: \(none\))? to ([\d.]*\d)", field.get("description", ""))
        if named and "minimum" in taken:
            assert (key, taken["minimum"], taken["maximum"]) == (key, *map(float, named.groups()))
