"""Another version on a booted kiosk that plays, and back: by an update that takes itself back, and by `dpkg`."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Final

from controller.kiosk.install.update import OTHER, PACKAGE, STARTS, TRIAL
from tests.booted.kiosk import SERVICES, Kiosk
from tests.booted.updates import a_day_later, offer, program, told
from tests.campaigns.power_cuts import kept, lost

BENCH: Final = f'[ "$1" != emulate ] || exec {OTHER}/bin/python -m controller "$@"'
"""The devices stand outside of the kiosk: they use the version that works."""


def broken(folder: Path, install: str) -> Path:
    """A package whose program only does this when it is installed."""
    programs, about = folder / "opt/velatura/bin", folder / "DEBIAN"
    programs.mkdir(parents=True)
    about.mkdir()
    for name, script in (("python", "exit 1"), ("velatura", f'{BENCH}\n[ "$2" != install ] || {install}')):
        (programs / name).write_text(f"#!/bin/sh\n{script}\n")
        (programs / name).chmod(0o755)
    fields = "Package: velatura\nVersion: 3-1\nArchitecture: all\nMaintainer: x\nDescription: x\n"
    (about / "control").write_text(fields)
    made = folder.with_suffix(".deb")
    subprocess.run(["dpkg-deb", "-Znone", "--build", folder, made], check=True, stdout=subprocess.DEVNULL)
    return made


def running(kiosk: Kiosk) -> list[str]:
    """The commands of all processes."""
    commands = "for one in /proc/[0-9]*/cmdline; do tr '\\0' ' ' < $one && echo; done"
    return kiosk.machine.called("sh", "-c", commands).stdout.splitlines()


def back_to(kiosk: Kiosk, name: str) -> None:
    """Wait until the update has ended as failed, and the program of this name plays."""
    machine = kiosk.machine
    machine.wait_for(lambda: not machine.at(TRIAL).exists() and told(kiosk)["state"] != "trial")
    machine.wait_for(kiosk.shows)
    machine.wait_for(lambda: kiosk.state == "playing")
    assert told(kiosk)["state"] == "failed"
    assert program(kiosk) == name
    assert not machine.at(PACKAGE).exists()


def on_trial(kiosk: Kiosk, folder: Path) -> None:
    """Exchange the program with one that seems to be installed well, and never answers."""
    restarting = "{ systemctl restart velatura-player velatura-controller; exit 0; }"
    name = offer(kiosk, broken(folder / "no", restarting))
    kiosk.machine.wait_for(lambda: program(kiosk) == name)


def test_an_update_proves_itself_and_the_picture_stays(playing: Kiosk) -> None:
    machine, before = playing.machine, kept(playing)
    with machine.watched() as seen:
        name = offer(playing, playing.packages[1])
        machine.wait_for(lambda: machine.at(TRIAL).exists() and program(playing) == name)
        exchanged_s = machine.at(TRIAL).stat().st_mtime
        machine.wait_for(
            lambda: machine.at(STARTS).read_text() == "0" and machine.at(STARTS).stat().st_mtime > exchanged_s
        )
        machine.wait_for(lambda: playing.answers() and playing.state == "playing")
    assert {what for _, what in seen[:-1]} == {seen[0][1]} != {"black"}, "it was never black, nor anything else"
    judges = [line for line in running(playing) if "--carry-out" in line]
    assert [line.split()[0] for line in judges] == [f"{OTHER}/bin/python"], "it is the former version that judges"
    assert "trial" in machine.call("velatura", "kiosk", "update"), "who only asks gets an answer at once"
    assert [line for line in running(playing) if "--carry-out" in line] == judges
    # The power fails, and is back a day later.
    machine.cut_off()
    a_day_later(playing)
    machine.switch_on()
    machine.wait_for(playing.shows)
    machine.wait_for(lambda: told(playing)["state"] != "trial")
    assert (told(playing)["state"], told(playing)["why"], program(playing)) == ("done", "", name)
    assert lost(playing, before) == []


def test_a_version_that_does_not_start_is_taken_back_and_the_picture_stays(playing: Kiosk, tmp_path: Path) -> None:
    before, former = kept(playing), program(playing)
    with playing.machine.watched() as seen:
        offer(playing, broken(tmp_path / "no", "exec systemctl restart velatura-player velatura-controller"))
        back_to(playing, former)
    assert len({what for _, what in seen[:-1]}) == 1
    assert "systemctl status velatura-controller.service" in told(playing)["why"]
    assert lost(playing, before) == []


def test_a_version_with_which_the_kiosk_never_answers_is_taken_back_after_some_power_cuts(
    playing: Kiosk, tmp_path: Path
) -> None:
    machine, before, former = playing.machine, kept(playing), program(playing)
    on_trial(playing, tmp_path)
    for starts in ("1", "2", "3"):
        machine.wait_for(lambda starts=starts: machine.at(STARTS).read_text() == starts)  # type: ignore[misc]
        # Once it waits: a program that ends because systemd ends is a failure only here, where the machine lives on.
        machine.wait_for(lambda: not any("kiosk install" in line for line in running(playing)))
        machine.cut_off()
        machine.switch_on()
    machine.wait_for(lambda: not machine.at(TRIAL).exists())
    machine.call("systemctl", "restart", "bench")  # the folder of its program is another one now
    back_to(playing, former)
    assert "started 3 times" in told(playing)["why"]
    assert lost(playing, before) == []


def test_another_version_is_installed_while_it_plays_and_taken_back(playing: Kiosk) -> None:
    machine = playing.machine
    version = ("dpkg-query", "--show", "--showformat=${Version}", "velatura")
    first, second = playing.packages
    before = kept(playing)
    for package, wanted in ((second, "2-1~deb"), (first, "1-1~deb")):
        with machine.watched() as seen:
            machine.install(package)
            assert machine.call(*version).startswith(wanted)
            machine.wait_for(playing.shows)
            machine.wait_for(lambda: playing.state == "playing")
        shown = [what for _, what in seen[:-1]]
        assert shown == [shown[0]], "it was never black, and never showed anything else"
        assert shown != ["black"]
        assert lost(playing, before) == []
        assert {machine.restarts(name) for name in SERVICES[1:]} == {0}


def test_a_version_on_trial_gives_way_to_a_package_and_blocks_no_other(playing: Kiosk, tmp_path: Path) -> None:
    machine = playing.machine
    on_trial(playing, tmp_path)
    machine.install(playing.packages[0])
    machine.wait_for(playing.shows)
    machine.wait_for(lambda: playing.state == "playing")
    assert (told(playing)["state"], told(playing)["why"]) == ("failed", "Another version was installed.")
    assert program(playing) == ""
    # its outcome is written, and it may be about to end
    machine.wait_for(lambda: not any("--carry-out" in line for line in running(playing)))
