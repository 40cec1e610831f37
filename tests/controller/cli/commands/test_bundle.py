"""``velatura bundle key`` and ``velatura bundle``, by what they print, return and leave on disk."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller import __main__ as shell
from controller.bundle.reader import Bundle
from controller.bundle.signing import ANY_SIGNER, generate_key
from controller.config import load_stage
from controller.play.cache import check_fits
from controller.play.frames import OutputSize
from controller.run.journal import Journal
from controller.stage.artefacts.kinds import CALIBRATED
from controller.stage.artefacts.solved import Solved

STAGE = """\
[stage]
name = "museum"
[[projectors]]
name = "left"
output = "P1"
driver = "serial"
profile = "optoma-later"
port = "run/tty-left"
[[projectors]]
name = "right"
output = "P2"
driver = "serial"
profile = "optoma-later"
port = "run/tty-right"
[camera]
driver = "ptp"
address = "ptpip:127.0.0.1:1:2"
iso = 100
focal_length_px = 5200
focal_length_rel_sigma = 0.01
[display]
driver = "player"
frames = "run/outputs.frame"
[[display.outputs]]
name = "P2"
width_px = 12
height_px = 9
[[display.outputs]]
name = "P1"
width_px = 10
height_px = 8
[[appearances]]
name = "marble"
kind = "gloss"
[[appearances]]
name = "gold"
kind = "gloss"
"""
FRAMES = {"left": np.full((8, 10, 3), 7, np.uint8), "right": np.full((9, 12, 3), 9, np.uint8)}


@pytest.fixture
def stage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """A stage with a key that it trusts, calibrated, and the appearances "gold" and "old" solved."""
    folder = tmp_path / "stage"
    folder.mkdir()
    (folder / "stage.toml").write_text(STAGE)
    shell.run(["bundle", "key", str(folder)])
    lines = capsys.readouterr().out.splitlines()[-2:]
    (folder / "stage.toml").write_text("\n".join([*lines, STAGE]))
    run = folder / "runs" / "20260101-000000-calibrate"
    run.mkdir(parents=True)
    with Journal(run) as journal, journal.run("calibrate"):
        journal.complete(CALIBRATED, {}, [], began_at_s=0)
    for name in ("gold", "old"):
        target, reachable = np.zeros((2, 2, 3), np.float32), np.ones((2, 2), np.bool_)
        linear = {projector: (frame / 255).astype(np.float32) for projector, frame in FRAMES.items()}
        figures: dict[str, object] = {"name": name, "exposure": 2.0, "title": name}
        Solved(FRAMES, linear, target, reachable, figures).write(run, name)
    return folder


def told(capsys: pytest.CaptureFixture[str], *arguments: object, code: int = 0) -> Any:
    """The last JSON line's result, or error, of a command with this exit code."""
    capsys.readouterr()
    assert shell.run([*map(str, arguments), "--json"]) == code
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    return last["error" if code else "result"]


def test_a_key_is_private_and_the_shown_lines_make_the_stage_trust_it(
    stage: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key = stage / "keys" / "stage.key"
    assert key.stat().st_mode & 0o777 == 0o600
    assert key.with_name("stage.key.pub").exists()
    before = key.read_bytes()
    assert told(capsys, "bundle", "key", stage, code=2)["code"] == "key-exists"
    assert key.read_bytes() == before
    second = told(capsys, "bundle", "key", stage, "--name", "second")
    assert len(second["trusted_keys"]) == 2, "the key that is trusted already stays so"
    assert told(capsys, "bundle", "key", stage / "nowhere", code=2)["code"] == "stage-missing"
    assert told(capsys, "bundle", "key", stage, "--name", "../x", code=2)["code"] == "key-name"


def test_the_lines_for_a_further_key_take_the_place_of_the_first(
    stage: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = stage / "stage.toml"
    shell.run(["bundle", "key", str(stage), "--name", "second"])
    said = capsys.readouterr().out
    assert "[bundle]" not in said
    number = int(re.search(r"replace trusted_keys in line (\d+)", said)[1])  # type: ignore[index]
    lines = file.read_text().splitlines()
    assert lines[number - 1].startswith("trusted_keys")
    lines[number - 1] = said.splitlines()[-1]
    file.write_text("\n".join(lines))
    assert len(load_stage(stage).tables.bundle.trusted_keys) == 2
    file.write_text(file.read_text().replace(lines[number - 1], "allow_unsigned = false"))
    shell.run(["bundle", "key", str(stage), "--name", "third"])
    said = capsys.readouterr().out
    assert "[bundle]\n" not in said
    number = int(re.search(r"add to \[bundle\] in line (\d+)", said)[1])  # type: ignore[index]
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:number], said.splitlines()[-1], *lines[number:]]))
    assert len(load_stage(stage).tables.bundle.trusted_keys) == 1


def test_what_can_not_be_played_is_refused_before_a_lamp_is_struck(
    stage: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told(capsys, "bundle", "build", stage)
    told(capsys, "bundle", "install", stage / "bundle.vel", stage)
    wrong = told(capsys, "play", stage, "gold", "marble", code=2)
    assert wrong["code"] == "appearance-unknown"
    assert "'marble'" in wrong["what"]
    assert "gold" in wrong["remedy"]
    (stage / "evening.toml").write_text('[[item]]\nappearance = "silver"\n')
    assert told(capsys, "play", stage, "--sequence", stage / "evening.toml", code=2)["code"] == "appearance-unknown"
    file = stage / "stage.toml"
    file.write_text(file.read_text().replace("width_px = 10", "width_px = 11"))
    assert told(capsys, "play", stage, "gold", code=1)["code"] == "bundle-outputs-differ"
    assert not (stage / "lamps.json").exists()
    assert not list((stage / "runs").glob("*-play"))


def test_what_is_solved_is_built_signed_and_fits_the_player(stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    built = told(capsys, "bundle", "build", stage)
    assert built["file"] == str(stage / "bundle.vel")
    assert built["appearances"] == "gold", "those of stage.toml that are solved"
    assert not (stage / "bundles").exists()
    assert told(capsys, "bundle", "verify", built["file"], "--stage", stage)["trusted"] is True
    with Bundle.open_trusted(stage / "bundle.vel", ANY_SIGNER) as bundle:
        check_fits(bundle, [OutputSize("P2", 12, 9), OutputSize("P1", 10, 8)])
        np.testing.assert_array_equal(bundle.decode("gold", "P1"), FRAMES["left"])
    named = told(capsys, "bundle", "build", stage, "old", "gold", "old", "--out", stage / "x.vel")
    assert named["appearances"] == "old, gold"
    assert told(capsys, "bundle", "build", stage, "marble", code=1)["code"] == "appearance-not-solved"


def test_every_build_has_a_revision_above_the_installed(stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for revision, name in ((0, "gold"), (1, "old"), (2, "gold")):
        assert told(capsys, "bundle", "build", stage, name)["revision"] == revision
        (stage / f"{revision}.vel").write_bytes((stage / "bundle.vel").read_bytes())
        assert told(capsys, "bundle", "install", stage / "bundle.vel", stage)["revision"] == revision
    assert told(capsys, "bundle", "install", stage / "0.vel", stage, code=1)["code"] == "bundle-older"
    assert told(capsys, "bundle", "rollback", stage)["revision"] == 1
    assert told(capsys, "bundle", "build", stage, "old", "gold")["revision"] == 3, "also after going back"
    assert told(capsys, "bundle", "rollback", stage)["revision"] == 2


def test_building_what_is_installed_gives_its_very_bytes(stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told(capsys, "bundle", "build", stage)
    first = (stage / "bundle.vel").read_bytes()
    told(capsys, "bundle", "install", stage / "bundle.vel", stage)
    assert told(capsys, "bundle", "build", stage, "--out", stage / "again.vel")["revision"] == 0
    assert (stage / "again.vel").read_bytes() == first
    assert told(capsys, "bundle", "build", stage, "--live", code=1)["code"] == "base-not-solved"


def test_a_revoked_key_is_refused_everywhere(stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("old", "gold"):
        told(capsys, "bundle", "build", stage, name)
        told(capsys, "bundle", "install", stage / "bundle.vel", stage)
    public = (stage / "keys" / "stage.key.pub").read_text().split()[1]
    text = (stage / "stage.toml").read_text()
    (stage / "stage.toml").write_text(text.replace("[bundle]", f'[bundle]\nrevoked_keys = ["{public}"]'))
    for arguments in (("install", stage / "bundle.vel", stage), ("rollback", stage),
                      ("verify", stage / "bundle.vel", "--stage", stage)):  # fmt: skip
        assert told(capsys, "bundle", *arguments, code=1)["code"] == "bundle-revoked"
    refused = told(capsys, "bundle", "build", stage, code=2)
    assert (refused["code"], "revoked" in refused["what"]) == ("signing-key-refused", True)


def test_a_key_that_the_stage_does_not_trust_is_told_before_any_work(
    stage: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (stage / "stage.toml").write_text(STAGE)
    for command in (("bundle", "build", stage), ("appearance", stage, "gold")):
        refused = told(capsys, *command, code=2)
        assert refused["code"] == "signing-key-refused"
        assert (stage / "keys" / "stage.key.pub").read_text().split()[1] in refused["remedy"]
    (stage / "keys" / "stage.key").unlink()
    assert told(capsys, "bundle", "build", stage, code=2)["code"] == "no-signing-key"


def test_a_bundle_of_another_stage_or_for_other_outputs_is_not_installed(
    stage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told(capsys, "bundle", "build", stage)
    for old, new, code in (
        ('"museum"', '"theatre"', "bundle-other-stage"),
        ("width_px = 12", "width_px = 14", "bundle-outputs-differ"),
    ):
        other = tmp_path / code
        shutil.copytree(stage, other)
        (other / "stage.toml").write_text((stage / "stage.toml").read_text().replace(old, new))
        assert told(capsys, "bundle", "install", stage / "bundle.vel", other, code=1)["code"] == code
        assert not list((other / "bundles").glob("*.vel"))


def test_without_calibration_or_solution_it_is_said_what_to_do(stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for file in (stage / "runs").rglob("appearance-*"):
        file.unlink()
    assert told(capsys, "bundle", "build", stage, code=2)["code"] == "nothing-solved"
    shutil.rmtree(stage / "runs")
    assert told(capsys, "bundle", "build", stage, code=2)["code"] == "not-calibrated"
    assert told(capsys, "bundle", "rollback", stage, code=1)["code"] == "bundle-no-previous"


def test_a_bundle_is_looked_at_compared_signed_and_exported(
    stage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, other = stage / "bundle.vel", stage / "other.vel"
    told(capsys, "bundle", "build", stage)
    told(capsys, "bundle", "build", stage, "old", "--out", other)
    assert told(capsys, "bundle", "inspect", one)["appearances"][0]["metadata"]["exposure"] == 2.0
    assert told(capsys, "bundle", "diff", one, one)["same"] is True
    assert told(capsys, "bundle", "diff", one, other)["appearances"]["added"] == ["old"]
    public = generate_key(tmp_path / "k")
    assert told(capsys, "bundle", "sign", one, "--key", tmp_path / "k")["signed_by"] == public.hex()
    assert told(capsys, "bundle", "verify", one)["trusted"] == "not checked"
    assert told(capsys, "bundle", "verify", one, "--trusted", tmp_path / "k.pub")["trusted"] is True
    assert (
        told(capsys, "bundle", "verify", other, "--trusted", tmp_path / "k.pub", code=1)["code"] == "bundle-untrusted"
    )
    assert told(capsys, "bundle", "verify", one, "--stage", stage, code=1)["code"] == "bundle-untrusted"
    both = ("--stage", stage, "--trusted", tmp_path / "k.pub")
    assert told(capsys, "bundle", "verify", one, *both, code=2)["code"] == "trust-twice"
    assert told(capsys, "bundle", "export", one, "--out", tmp_path / "png")["pictures"] == 2
    assert (tmp_path / "png" / "frames" / "gold" / "P1.png").exists()
    for command in ("inspect", "verify"):
        assert told(capsys, "bundle", command, tmp_path / "none.vel", code=1)["code"] == "bundle-unreadable"


def test_people_read_lines(stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told(capsys, "bundle", "build", stage)
    assert shell.run(["bundle", "inspect", str(stage / "bundle.vel")]) == 0
    shown = capsys.readouterr().out
    assert "stage        museum\n" in shown
    assert "outputs      P2 12x9, P1 10x8\n" in shown
    assert shell.run(["bundle", "diff", *[str(stage / "bundle.vel")] * 2]) == 0
    assert capsys.readouterr().out == "The bundles have the same content.\n"


@pytest.mark.parametrize(
    "arguments", [["bundle"], ["bundle", "paint"], ["bundle", "sign", "x.vel"], ["bundle", "diff"]]
)
def test_wrong_use_of_the_group_is_told(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert shell.run(arguments) == 2
    assert "--help" in capsys.readouterr().err


def test_the_groups_help_names_its_commands_and_loads_nothing_heavy() -> None:
    code = """
import sys
from controller.__main__ import run
assert run(["bundle", "--help"]) == 0
print(sorted({"numpy", "nacl", "cv2", "controller.config", "controller.stage.sessions.run"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    for name in ("build", "inspect", "verify", "diff", "sign", "install", "rollback", "export"):
        assert f"\n  {name} " in done.stdout


def test_what_anyone_may_have_made_is_refused_or_allowed_loudly(
    stage: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(stage / "keys")
    assert told(capsys, "bundle", "build", stage, code=2)["code"] == "no-signing-key"
    text = (stage / "stage.toml").read_text()
    open_stage = "\n".join(["[bundle]", "allow_unsigned = true", STAGE])
    (stage / "stage.toml").write_text(open_stage)
    assert shell.run(["bundle", "build", str(stage)]) == 0
    assert "origin is unknown" in capsys.readouterr().err
    (stage / "stage.toml").write_text(text)
    assert told(capsys, "bundle", "install", stage / "bundle.vel", stage, code=1)["code"] == "bundle-unsigned"
    (stage / "stage.toml").write_text(open_stage)
    assert "origin is unknown" in told(capsys, "bundle", "install", stage / "bundle.vel", stage)["warning"]
    assert shell.run(["bundle", "install", str(stage / "bundle.vel"), str(stage)]) == 0
    shown = capsys.readouterr()
    assert shown.err.startswith("WARNING: The bundle has no signature")
    assert "warning" not in shown.out
    assert "origin is unknown" in told(capsys, "bundle", "verify", stage / "bundle.vel", "--stage", stage)["warning"]
