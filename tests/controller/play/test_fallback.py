"""The player and the installed bundle of a stage: revoked keys, and starts that show nothing."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.bundle.install import install
from controller.bundle.signing import generate_key, load_signing_key
from controller.bundle.writer import NewAppearance, NewBundle, sign_bundle, write_bundle
from controller.core.errors import WorkError
from controller.play.control.launch import PlayerProcess
from tests.controller.bundle.older import write_older
from tests.controller.play.conftest import OUTPUTS, write_noise
from tests.controller.play.wire import Frames, Wire, noise, same
from tests.waiting import wait_for

Start = Callable[..., PlayerProcess]


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """The link to the installed bundle, whose one output does not fit the player; the previous one is sound."""
    folder = tmp_path / "bundles"
    install(write_noise(tmp_path / "b.vel"), folder, allow_unsigned=True)
    write_bundle(
        tmp_path / "bad.vel",
        NewBundle(stage="s", calibration="c", created_unix_s=0, outputs=[("P1", 4, 4)]),
        appearances=[NewAppearance("0", noise([("P1", 4, 4)], 1))],
    )
    install(tmp_path / "bad.vel", folder, allow_unsigned=True)
    return folder / "current"


def starts(installed: Path) -> Any:
    return json.loads((installed.parent / "starts.json").read_text())


def failed_start(tmp_path: Path, bundle: Path) -> str:
    outputs = ",".join(f"{name}:{width}x{height}" for name, width, height in OUTPUTS)
    command = [sys.executable, "-m", "controller.play", "--socket", str(tmp_path / "player.sock"), "--outputs", outputs]
    command += ["--frames", str(tmp_path / "out.frame"), "--bundle", str(bundle), "--allow-unsigned"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    assert ended.returncode == 1
    return ended.stderr


def test_after_three_failed_starts_the_bundle_before_plays(start: Start, installed: Path, tmp_path: Path) -> None:
    for count in (1, 2, 3):
        assert "was made for" in failed_start(tmp_path, installed)
        assert starts(installed)["failed"] == count
    player = start(bundle=installed, allow_unsigned=True)
    assert "plays again" in player.log.read_text()
    with Wire(player.socket) as wire:
        assert starts(installed)["failed"] == 0, "it waits: its end would say nothing about the bundle"
        wire.ask("play", appearance="3")
        shown = Frames(tmp_path / "out.frame").read()
        assert all(np.array_equal(shown[name], frame) for name, frame in noise(OUTPUTS, 3).items())
    player.terminate()
    assert starts(installed)["failed"] == 0


def test_a_player_that_is_killed_is_counted_only_once_a_picture_was_asked_for(
    start: Start, installed: Path, tmp_path: Path
) -> None:
    install(write_noise(tmp_path / "b.vel"), installed.parent, allow_unsigned=True)
    player = start(bundle=installed, allow_unsigned=True)
    for operation in ("hello", "status", "stop"):
        with Wire(player.socket) as wire:
            wire.ask(operation)
        os.kill(player.pid, signal.SIGKILL)
        player.restart()
        assert starts(installed)["failed"] == 0, "as in power cuts while the stage is closed"
    with Wire(player.socket) as wire:
        wire.send(b'{"op": "play", "appearance": "1", "fade_s": 30.0}\n')
        wire.ask("status")
        assert starts(installed)["failed"] == 1
    player.restart()
    assert starts(installed)["failed"] == 0, "it was asked to end"
    with Wire(player.socket) as wire:
        wire.ask("play", appearance="none")
    os.kill(player.pid, signal.SIGKILL)
    player.terminate()
    assert starts(installed)["failed"] == 1


def test_a_bundle_that_is_no_stages_own_is_not_counted(start: Start, installed: Path, bundle: Path) -> None:
    start(bundle=bundle, allow_unsigned=True)
    assert not (bundle.parent / "starts.json").exists()


def test_a_bundle_by_a_revoked_key_is_not_played(start: Start, bundle: Path, tmp_path: Path) -> None:
    for name in ("old", "new"):
        generate_key(tmp_path / name)
    keys = {"trusted": [tmp_path / "old.pub", tmp_path / "new.pub"], "revoked": [tmp_path / "old.pub"]}
    sign_bundle(bundle, load_signing_key(tmp_path / "old"))
    with pytest.raises(WorkError, match="revoked"):
        start(bundle=bundle, **keys)
    player = start(**keys)
    with Wire(player.socket) as wire:
        assert wire.ask("load-bundle", path=str(bundle))["error"]["code"] == "bundle-revoked"
        sign_bundle(bundle, load_signing_key(tmp_path / "new"))
        assert wire.ask("load-bundle", path=str(bundle))["ok"]


def test_where_nothing_is_installed_yet_the_player_starts_all_the_same(start: Start, tmp_path: Path) -> None:
    player = start(bundle=tmp_path / "bundles" / "current")
    with Wire(player.socket) as wire:
        assert wire.ask("hello")["bundle"] is None


def test_where_all_bundles_have_a_newer_format_the_player_starts_all_the_same(start: Start, tmp_path: Path) -> None:
    """It would end at once otherwise, and with it the installation of an older package."""
    folder = tmp_path / "bundles"
    file = install(write_noise(tmp_path / "b.vel"), folder, allow_unsigned=True)
    data = bytearray(file.read_bytes())
    data[8:12] = (99).to_bytes(4, "little")
    file.write_bytes(data)
    player = start(bundle=folder / "current", allow_unsigned=True)
    with Wire(player.socket) as wire:
        assert wire.ask("hello")["bundle"] is None
        assert wire.ask("load-bundle", path=str(write_noise(tmp_path / "c.vel")))["ok"]


@pytest.mark.parametrize("version", [1, 2])
def test_the_first_start_after_an_upgrade_shows_the_picture_that_was_lit(
    start: Start, tmp_path: Path, version: int
) -> None:
    """The older version left its bundle, and what it played. Nothing is published again."""
    frames = {name: noise(OUTPUTS, int(name)) for name in ("3", "4")}
    folder = tmp_path / "bundles"
    install(write_older(tmp_path / "old.vel", version, frames, 8), folder, allow_unsigned=True)
    (tmp_path / "player.sock.playing").write_text('{"id": 1, "op": "play", "appearance": "4"}')
    start(bundle=folder / "current", allow_unsigned=True, resume=True)
    shown = Frames(tmp_path / "out.frame")
    wait_for(lambda: same(shown.read(), noise(OUTPUTS, 4)))
    wait_for(lambda: starts(folder / "current")["failed"] == 0)
