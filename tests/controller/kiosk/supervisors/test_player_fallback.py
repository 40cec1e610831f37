"""A bundle that is damaged while it plays, before a real player: the previous one plays, and that is said."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from nacl.signing import SigningKey

from controller.bundle.format import FIRST_BLOB
from controller.bundle.install import CURRENT, current, install
from controller.bundle.signing import Trust, write_public_key
from controller.core.storage import runtime_folder
from controller.kiosk.decide.interfaces import Showing
from controller.kiosk.store.bundle_store import BundleStore, BundleWatch
from controller.kiosk.supervisors.player_supervisor import PlayerSupervisor
from controller.play.control.launch import PlayerSettings
from hal.notices import Notice
from tests.controller.play.conftest import OUTPUTS, write_noise
from tests.waiting import wait_for


def damage(file: Path, how: str) -> None:
    data = file.read_bytes()
    file.chmod(0o600)
    if how == "frames":
        begin, end = FIRST_BLOB, len(data) * 8 // 10
        file.write_bytes(data[:begin] + os.urandom(end - begin) + data[end:])
    elif how == "cut":
        file.write_bytes(data[: len(data) // 2])
    else:
        file.unlink()


@pytest.mark.parametrize("how", ["frames", "cut", "gone"])
def test_a_player_that_dies_soon_after_its_start_on_a_damaged_bundle_comes_back_with_the_older_one(
    tmp_path: Path, how: str
) -> None:
    key = SigningKey(bytes(range(32)))
    public, slots = bytes(key.verify_key), tmp_path / "bundles"
    write_public_key(tmp_path / "ours.pub", public)
    for revision in (1, 2):
        install(write_noise(tmp_path / "b.vel", key=key, revision=revision), slots, trusted=[public])
    newest = current(slots)
    assert newest is not None
    store, told = BundleStore(tmp_path, Trust((public,))), list[Notice]()
    watch = BundleWatch(store, told.append)

    def settings(with_bundle: bool) -> PlayerSettings:
        bundle = slots / CURRENT if with_bundle else None
        return PlayerSettings(OUTPUTS, tmp_path / "f", bundle=bundle, trusted=[tmp_path / "ours.pub"])

    supervisor = PlayerSupervisor(runtime_folder(tmp_path), settings, told.append)

    def shows(bundle: Path | None) -> bool:
        supervisor.want = Showing(store.bundle(), "1")
        supervisor.step()
        watch.step()
        shown = supervisor.view.shown
        return bundle is not None and shown is not None and shown == Showing(bundle, "1")

    try:
        wait_for(lambda: shows(newest))
        assert watch.warning is None
        damage(newest, how)
        assert supervisor._process is not None
        os.kill(supervisor._process.pid, signal.SIGKILL)
        began_s = time.monotonic()
        wait_for(lambda: shows(store.bundle()) and store.bundle() not in (None, newest), within_s=60)
        wait_for(lambda: supervisor.view.problem is None and shows(store.bundle()))
        assert time.monotonic() - began_s < 40
        assert watch.warning is not None
        assert "the previous one" in watch.warning.text
        assert [one.code for one in told].count("bundle-older-plays") == 1
        install(write_noise(tmp_path / "b.vel", key=key, revision=3), slots, trusted=[public])
        watch.step()
        assert watch.warning is None
    finally:
        supervisor.close()


def test_an_only_bundle_that_can_not_be_read_is_a_problem_as_long_as_it_is_so(tmp_path: Path) -> None:
    key = SigningKey(bytes(range(32)))
    public, slots, told = bytes(key.verify_key), tmp_path / "bundles", list[Notice]()
    install(write_noise(tmp_path / "b.vel", key=key, revision=1), slots, trusted=[public])
    only = current(slots)
    assert only is not None
    only.write_bytes(b"no bundle")
    watch = BundleWatch(BundleStore(tmp_path, Trust((public,))), told.append)
    watch.step()
    watch.step()
    assert watch.warning is not None
    install(write_noise(tmp_path / "b.vel", key=key, revision=2), slots, trusted=[public])
    watch.step()
    assert watch.warning is None
    assert [(one.code, one.level) for one in told] == [("bundle-bad", "error"), ("bundle-newest", "info")]
