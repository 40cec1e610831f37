"""Bad input, each through the real command line: what happened, what to do, the exit code, and nothing half-written."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.end_to_end.program import REPOSITORY, Bench, Command, strikes, velatura, wrong_code

pytestmark = pytest.mark.timeout(600)


@dataclass(frozen=True, slots=True)
class Mistake:
    """``old`` of stage.toml replaced by ``new``; what the error then says, and the text on the line that it names."""

    old: str
    new: str
    code: str
    says: str
    line: str | None
    remedy: str = ""


MISTAKES = {
    "unknown key": Mistake(
        'driver = "ptp"', 'driver = "ptp"\naperture = 8', "stage-key-unknown", "did you mean 'aperture_f'", "aperture"
    ),
    "misspelt key": Mistake("iso = 100", "isso = 100", "stage-key-missing", "line 34 has 'isso'", "[camera]", "'iso'"),
    "missing key": Mistake("iso = 100\n", "", "stage-key-missing", "'iso' is missing", "[camera]", "whole number"),
    "wrong type": Mistake("iso = 100", 'iso = "high"', "stage-key-type", "'high' is not a whole number", "iso"),
    "unknown table": Mistake(
        "[camera]\ndriver", "[light]\n[camera]\ndriver", "stage-key-unknown", "no key 'light'", "[light]"
    ),
    "not TOML": Mistake("iso = 100", "iso = ", "stage-syntax", "is not valid TOML: Invalid value.", "iso"),
    "unknown driver": Mistake(
        'driver = "ptp"',
        'driver = "pttp"',
        "stage-key-value",
        "'pttp' is not a camera driver",
        "driver",
        "one of genicam, gphoto2, ptp, v4l2.",
    ),
    "misspelt setting": Mistake(
        'port = "run/tty-left"', 'prt = "x"', "stage-key-unknown", "did you mean 'port'", "prt"
    ),
    "unknown profile": Mistake(
        'profile = "bench/optoma-fast.toml"',
        'profile = "optoma-latter"',
        "profile-missing",
        "'optoma-latter'",
        "profile",
        "optoma-later",
    ),
    "no such profile file": Mistake(
        'profile = "bench/optoma-fast.toml"', 'profile = "mine.toml"', "profile-missing", "mine.toml", None
    ),
    "setting of a wrong type": Mistake('port = "run/tty-left"', "port = 5", "setting-wrong", "'port' is 5", "port"),
    "unknown output": Mistake('output = "P1"', 'output = "P9"', "stage-key-value", "'P9' is not an output", "output"),
}


def tree(folder: Path) -> dict[str, bytes]:
    """Every file and its bytes; the lock is no content."""
    files = (path for path in folder.rglob("*") if path.is_file() and path != folder / "run" / "lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_in_stage_toml_is_named_with_its_line_and_changes_nothing(prepared: Path, name: str) -> None:
    mistake = MISTAKES[name]
    file = prepared / "stage.toml"
    assert mistake.old in file.read_text()
    file.write_text(file.read_text().replace(mistake.old, mistake.new, 1))
    before = tree(prepared)
    outcome = velatura("calibrate", prepared)
    assert wrong_code(outcome) == mistake.code
    found = re.match(r"stage\.toml, line (\d+):? ", outcome.error["what"])
    assert found
    assert mistake.says in outcome.error["what"]
    assert mistake.remedy in outcome.error["remedy"]
    if mistake.line is not None:
        assert file.read_text().splitlines()[int(found[1]) - 1].startswith(mistake.line)
    assert tree(prepared) == before


@pytest.mark.parametrize("command", ["calibrate", "appearance", "play", "emulate"])
def test_a_stage_that_is_not_there_is_told_by_every_command(tmp_path: Path, command: str) -> None:
    further = ["gloss"] if command == "play" else []
    assert wrong_code(velatura(command, tmp_path / "nowhere", *further)) == "stage-missing"
    assert list(tmp_path.iterdir()) == []


def test_people_read_two_lines_where_machines_read_json(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "controller", "calibrate", str(tmp_path)]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY, check=False)
    assert (ended.returncode, ended.stdout) == (2, "")
    what, remedy = ended.stderr.splitlines()
    assert what == f"velatura: There is no {tmp_path}/stage.toml."
    assert remedy.startswith("Give the stage's folder")


def test_work_that_needs_other_work_first_says_which(prepared: Path) -> None:
    before = tree(prepared)
    appearance = velatura("appearance", prepared)
    assert wrong_code(appearance) == "not-calibrated"
    assert "velatura calibrate" in appearance.error["remedy"]
    play = velatura("play", prepared, "gloss")
    assert wrong_code(play) == "nothing-installed"
    assert "velatura appearance" in play.error["remedy"]
    assert tree(prepared) == before


MESHES = {
    "no faces": ("cloud.obj", b"v 0 0 0\nv 1 1 1\n", "object-no-faces"),
    "not a mesh": ("letter.ply", b"Dear reader,\n", "object-unreadable"),
    "faces without points": ("broken.obj", b"v 0 0 0\nf 1 2 3\n", "object-unreadable"),
    "empty": ("empty.obj", b"", "object-no-faces"),
}


@pytest.mark.parametrize("name", MESHES)
def test_a_mesh_that_is_none_is_refused_before_anything_is_written(tmp_path: Path, name: str) -> None:
    file, content, code = MESHES[name]
    (tmp_path / file).write_bytes(content)
    assert wrong_code(velatura("demo", "--object", tmp_path / file, "--out", tmp_path / "out")) in (
        code,
        "object-unreadable",
    )
    assert [path.name for path in tmp_path.iterdir()] == [file]


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--object", "nowhere.obj"], "object-missing"),
        (["--size", "huge"], "wrong-use"),
        (["--room", "cellar"], "wrong-use"),
        (["--seed", "many"], "wrong-use"),
        (["--seed", "-1"], "wrong-use"),
        (["--seed", "99999999999999999999"], "wrong-use"),
        (["--sise", "small"], "wrong-use"),
    ],
)
def test_a_wrong_option_of_the_demo_writes_nothing(tmp_path: Path, words: list[str], code: str) -> None:
    assert wrong_code(velatura("demo", "--out", tmp_path / "out", *words)) == code
    assert list(tmp_path.iterdir()) == []


def test_a_demo_never_touches_a_folder_that_is_not_its_own(tmp_path: Path, prepared_once: Path) -> None:
    (tmp_path / "stage").mkdir()
    (tmp_path / "stage" / "letter.txt").write_text("mine")
    assert wrong_code(velatura("demo", "--out", tmp_path)) == "demo-folder-taken"
    assert tree(tmp_path) == {"stage/letter.txt": b"mine"}
    before = tree(prepared_once)
    assert wrong_code(velatura("demo", "--out", prepared_once, "--seed", "2")) == "demo-folder-taken"
    assert tree(prepared_once) == before


def test_an_output_folder_that_can_not_be_made_is_failed_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    outcome = velatura("demo", "--prepare-only", "--out", tmp_path / "file" / "out")
    assert wrong_code(outcome, code=1) == "stage-not-written"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_demo_without_a_disk_to_write_on_leaves_nothing(tmp_path: Path) -> None:
    with Command("demo", "--prepare-only", "--out", tmp_path / "out") as demo:
        demo.limit_files_to(100_000)
        outcome = demo.outcome()
    assert wrong_code(outcome, code=1) in ("no-space", "stage-not-written")
    assert list(tmp_path.iterdir()) == []


def test_a_lens_file_of_other_pictures_is_refused_before_a_lamp_is_struck(prepared: Path) -> None:
    file = prepared / "camera-intrinsics.toml"
    text = re.sub(r"width_px = .*", "width_px = 640", file.read_text())
    file.write_text(re.sub(r"height_px = .*", "height_px = 480", text))
    with Bench(prepared):
        outcome = velatura("calibrate", prepared)
    assert wrong_code(outcome) == "camera-intrinsics-wrong-size"
    assert "640 x 480" in outcome.error["what"]
    assert strikes(prepared) == {}


def test_a_byte_order_mark_does_not_matter(prepared: Path) -> None:
    file = prepared / "stage.toml"
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert velatura("kiosk", "status", prepared).code == 0


def test_projectors_that_are_not_there_are_named_and_no_run_is_begun(prepared: Path) -> None:
    before = tree(prepared)
    outcome = velatura("calibrate", prepared)
    assert wrong_code(outcome, code=3) == "port-missing"
    assert str(prepared / "run" / "tty-left") in outcome.error["what"]
    assert tree(prepared) == before
