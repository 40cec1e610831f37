"""A backup on a blank computer below another root; with a real X server and player it is in tests/booted."""

from __future__ import annotations

import io
import json
import re
import tarfile
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from controller.core.errors import UsageError, WorkError
from controller.core.kiosk_places import STAGE
from controller.kiosk.install import restored
from controller.kiosk.install.restored import Wanted, matched
from controller.kiosk.outputs import Connected, connected
from controller.kiosk.store import archive
from tests.controller.kiosk.install.test_steps import FRESH, PREFIX, Recorded, debian
from tests.controller.kiosk.vase import TEXT, graded_run, vase
from tests.controller.play.display.xorg import edid

__all__ = ["debian"]
NAMES = ("left", "middle", "right")
KEY = "a" * 64


def stage_text(*where: str) -> str:
    """Three projectors, each output with its place."""
    head, _, rest = TEXT.partition("[[projectors]]")
    camera = rest[rest.index("[camera]") : rest.index("[[display.outputs]]")]
    projectors = "".join(
        f'[[projectors]]\nname = "{name}"\noutput = "P{n}"\ndriver = "serial"\nport = "/dev/ttyUSB{n}"\n'
        'profile = "optoma-later"\n\n'
        for n, name in enumerate(NAMES)
    )
    outputs = "".join(
        f'[[display.outputs]]\nname = "P{n}"\nwidth_px = 1024\nheight_px = 768\nwhere = "{place}"\n\n'
        for n, place in enumerate(where)
    )
    return f'{head}{projectors}{camera}{outputs}[bundle]\ntrusted_keys = ["{KEY}"]\n'


def told_by_x(*plugged: tuple[str, bytes]) -> str:
    """What xrandr says of these displays, side by side."""
    blocks = []
    for n, (connector, block) in enumerate(plugged):
        rows = "".join(f"\t\t{block[at : at + 16].hex()}\n" for at in range(0, len(block), 16))
        blocks.append(
            f"{connector} connected 1400x1050+{1400 * n}+0 (0x4a) normal\n\tEDID:\n{rows}"
            "  1400x1050 (0x4a) 121.750MHz -HSync +VSync *current +preferred\n"
            "        h: width  1400 start 1488 end 1632 total 1864 skew    0 clock  65.32KHz\n"
            "        v: height 1050 start 1053 end 1057 total 1089           clock  59.98Hz\n"
            "  1024x768 (0x4b) 65.000MHz -HSync -VSync\n"
            "        h: width  1024 start 1048 end 1184 total 1344 skew    0 clock  48.36KHz\n"
            "        v: height  768 start  771 end  777 total  806           clock  60.00Hz\n"
        )
    return "".join(blocks)


def backup(folder: Path, text: str, displays: dict[str, list[str]] | None = None) -> Path:
    """A backup of such a stage, made on a computer whose connectors showed these displays."""
    stage = vase(folder / "of before")
    (stage / "stage.toml").write_text(text)
    graded_run(stage, "20260501-100000-calibrate", {"left": 0.01})
    made = archive.backup(stage)
    file = folder / "velatura-20260504.tar.gz"
    with tarfile.open(made) as old, tarfile.open(file, "w:gz") as new:
        for member in old:
            content = old.extractfile(member)
            data = b"" if content is None else content.read()
            if member.name == archive.MARK and displays is not None:
                data = json.dumps({**json.loads(data), "displays": displays}).encode()
                member.size = len(data)
            new.addfile(member, io.BytesIO(data))
    return file


def never(question: str) -> str:
    raise AssertionError(f"asked: {question}")


def restored_on(
    root: Path, file: Path, xrandr: str, ask: Callable[[str], str] = never
) -> tuple[Recorded, dict[str, str]]:
    system = Recorded(root, {**FRESH, "xrandr": xrandr})
    restored.restore(system, file, ask=ask, say=system.told.append, prefix=PREFIX)
    content = tomllib.loads((root / STAGE.relative_to("/") / "stage.toml").read_text())
    return system, {one["name"]: one["where"] for one in content["display"]["outputs"]}


def test_cables_in_another_order_are_found_by_serial_number_without_a_question(debian: Path, tmp_path: Path) -> None:
    before = {"DP-1": ["A1"], "DP-2": ["B2"], "DP-3": ["C3"]}
    file = backup(tmp_path, stage_text("DP-1", "DP-2", "C3"), before)
    now = told_by_x(("HDMI-1", edid("C3", 3)), ("HDMI-2", edid("A1", 1)), ("HDMI-3", edid("B2", 2)))
    system, where = restored_on(debian, file, now)
    assert where == {"P0": "A1", "P1": "B2", "P2": "C3"}
    assert [line for line in system.told if line.startswith("Projector ")] == [
        "Projector left is at HDMI-2.", "Projector middle is at HDMI-3.", "Projector right is at HDMI-1.",
    ]  # fmt: skip
    place = debian / STAGE.relative_to("/")
    assert (place / "runs/20260501-100000-calibrate/verification.json").exists()
    assert (place / "appearances/glass.png").read_text() == "a picture"
    assert system.ran[-2:] == [f"chown --recursive velatura:velatura {STAGE}", "systemctl start velatura-controller"]
    assert system.ran.index("systemctl stop velatura-controller") < len(system.ran) - 2


def test_the_x_settings_have_the_size_of_the_stage_and_a_new_key_is_trusted(debian: Path, tmp_path: Path) -> None:
    file = backup(tmp_path, stage_text("A1", "B2", "C3"))
    restored_on(debian, file, told_by_x(*((f"DP-{n}", edid(one, n)) for n, one in enumerate(("A1", "B2", "C3"), 1))))
    settings = (debian / "etc/X11/xorg.conf.d/20-velatura-outputs.conf").read_text()
    assert re.findall(r'PreferredMode" "([^_]*)_', settings) == ["1024x768"] * 3
    place = debian / STAGE.relative_to("/")
    trusted = tomllib.loads((place / "stage.toml").read_text())["bundle"]["trusted_keys"]
    assert trusted[0] == KEY
    assert len(trusted) == 2
    assert (place / "keys/stage.key").stat().st_mode & 0o077 == 0


def test_displays_that_nothing_tells_apart_are_asked_for_at_once(debian: Path, tmp_path: Path) -> None:
    asked: list[str] = []
    answers = ["3 3", "", "3 1"]

    def ask(question: str) -> str:
        asked.append(question)
        return answers[len(asked) - 1]

    file = backup(tmp_path, stage_text("DP-1", "B2", "DP-3"), {"DP-1": ["SAME"], "DP-2": ["B2"], "DP-3": ["SAME"]})
    now = told_by_x(("HDMI-1", edid("SAME")), ("HDMI-2", edid("B2", 2)), ("HDMI-3", edid("SAME")))
    _, where = restored_on(debian, file, now, ask)
    assert len(asked) == restored.MOST_QUESTIONS
    assert "left, right" in asked[0]
    assert "1 is at HDMI-1, 3 is at HDMI-3" in asked[0]
    assert where == {"P0": "HDMI-3", "P1": "B2", "P2": "HDMI-1"}


def test_after_three_wrong_answers_nothing_is_there_and_it_can_be_repeated(debian: Path, tmp_path: Path) -> None:
    file = backup(tmp_path, stage_text("DP-1", "DP-2", "DP-3"))
    now = told_by_x(*((f"HDMI-{n}", edid("SAME")) for n in (1, 2, 3)))
    with pytest.raises(WorkError, match="still unknown"):
        restored_on(debian, file, now, lambda _: "7")
    assert not (debian / STAGE.relative_to("/") / "stage.toml").exists()
    assert not list((debian / STAGE.parent.relative_to("/")).glob("restore-*"))
    _, where = restored_on(debian, file, now, lambda _: "2 1 -")
    assert where == {"P0": "HDMI-2", "P1": "HDMI-1", "P2": "DP-3"}


def test_a_kiosk_with_a_stage_and_a_file_that_is_no_backup_are_refused(debian: Path, tmp_path: Path) -> None:
    (tmp_path / "b.tar.gz").write_bytes(b"nothing")
    with pytest.raises(UsageError, match="not a backup"):
        restored_on(debian, tmp_path / "b.tar.gz", "")
    file = backup(tmp_path, stage_text("A1", "B2", "C3"))
    now = told_by_x(*((f"DP-{n}", edid(one, n)) for n, one in enumerate(("A1", "B2", "C3"), 1)))
    restored_on(debian, file, now)
    with pytest.raises(UsageError, match="has a stage already"):
        restored_on(debian, file, now)


def test_secrets_that_are_in_no_backup_are_named_and_what_a_kill_left_is_gone(debian: Path, tmp_path: Path) -> None:
    text = stage_text("A1", "B2", "C3") + '[alerts]\nmail_password_file = "keys/mail"\n'
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures/clouds.png").write_text("clouds")
    text += f'[[appearances]]\nname = "c"\nkind = "picture"\nfile = "{tmp_path}/pictures/clouds.png"\n'
    file = backup(tmp_path, text)
    (tmp_path / "pictures/clouds.png").unlink()
    place = debian / STAGE.relative_to("/")
    for left in (place.parent / "restore-abc/fresh", place / "appearances"):
        left.mkdir(parents=True)
        (left / "old.png").write_text("half of another restore")
    now = told_by_x(*((f"DP-{n}", edid(one, n)) for n, one in enumerate(("A1", "B2", "C3"), 1)))
    system, _ = restored_on(debian, file, now)
    assert [line for line in system.told if "keys/mail" in line] == [
        "stage.toml names keys/mail, which is not a file. It holds a secret, so it is in no backup: copy it there."
    ]
    assert (place / "backup-files/clouds.png").read_text() == "clouds"
    assert "backup-files/clouds.png" in (place / "stage.toml").read_text()
    assert not (place / "appearances/old.png").exists()
    assert not list(place.parent.glob("restore-*"))


def test_a_backup_of_which_no_kiosk_could_start_is_refused_before_the_installation(
    debian: Path, tmp_path: Path
) -> None:
    file = backup(tmp_path, stage_text("A1", "B2", "C3").replace('driver = "player"', 'driver = "gone"'))
    with pytest.raises(UsageError, match="gone"):
        restored_on(debian, file, "")
    assert not (debian / "etc/systemd/system/velatura.target").exists()


def test_the_last_one_left_needs_no_number() -> None:
    wanted = [Wanted("P0", "left", ("A1",)), Wanted("P1", "right", ("DP-2",))]
    there = [Connected("HDMI-1", []), Connected("HDMI-2", [], edid=edid("A1", 1))]
    assert matched(wanted, there) == {"P0": "HDMI-2", "P1": "HDMI-1"}
    assert connected("") == []
