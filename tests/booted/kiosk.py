"""An installed kiosk on a booted machine, and the stage that is put on it."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from controller.bundle.reader import Bundle
from controller.bundle.signing import load_signing_key
from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.core.kiosk_places import RUNTIME
from controller.kiosk.api.control import NAME as SOCKET
from controller.kiosk.panel_address import FIRST_LOGIN
from controller.kiosk.schedule import WEEKDAYS
from tests.booted.machine import STAGE, Machine
from tests.booted.trees import ROOT, built_packages, put_kernels, tree
from tests.controller.play.wire import Frames, noise, same

OUTPUTS: Final = [(name, 280, 210) for name in ("P1", "P2", "P3")]
SERVICES: Final = ("velatura-x11", "velatura-player", "velatura-controller")
PICTURE_S: Final = 60.0
"""From the boot of a bare Debian with the package to a picture."""
APPEARANCE: Final = "1"
FIRST, SECOND, THIRD, FOURTH = _BUNDLES = ("first.vel", "second.vel", "third.vel", "fourth.vel")
_SEED, OTHER_SEED = 1, 2
"""Of the noise that the first bundle and the third show, and that of the second and the fourth."""
_HOURS: Final = STAGE / "schedule.toml"
_DEVICES_FIRST: Final = Path("/etc/systemd/system/bench.service.d/first.conf")
_UNTIL_THERE: Final = f"""
[Unit]
Before=velatura-x11.service
[Service]
ExecStartPost=/bin/sh -c 'until test -e {STAGE}/run/tty-above; do sleep 0.1; done'
"""


@dataclass(frozen=True)
class Kiosk:
    """``dry``, ``told``: what its installation printed that only would have been done, and that was.

    ``packages``: one of each version, of which the first is installed.
    """

    machine: Machine
    dry: str
    told: str
    packages: list[Path]

    @property
    def password(self) -> str:
        """Of the first log-in: the installation printed it, and each later start of the service keeps a new one."""
        kept = self.machine.called("cat", RUNTIME / FIRST_LOGIN)
        if kept.returncode == 0:
            return kept.stdout.split()[1]
        found = re.search(r"password (\S+) \(once\)", self.told)
        assert found is not None, self.told
        return found[1]

    @property
    def state(self) -> str:
        return str(self.status()["state"])

    def status(self) -> dict[str, Any]:
        """As `velatura kiosk status` tells it."""
        return dict(self._asked("status") or self.machine.velatura("status"))

    def _asked(self, operation: str) -> Any:
        """What the service answers at its socket, where its commands ask it, too: each takes a second to start. None
        where none answers.
        """
        place = self.machine.seen_here(RUNTIME / SOCKET)
        with contextlib.suppress(OSError, ValueError), socket.socket(socket.AF_UNIX) as channel:
            channel.settimeout(30.0)
            channel.connect(str(place))
            with channel.makefile("rwb") as lines:
                lines.write(json.dumps({"op": operation}).encode() + b"\n")
                lines.flush()
                answer = json.loads(lines.readline() or b"{}")
            return answer.get("result")
        return None

    def shows(self, seed: int = _SEED) -> bool:
        """Whether the X server shows the stage's appearance, to the byte, and nothing else. ``seed``: of
        its noise.
        """
        screen = self.machine.screen()
        if screen is None:
            return False
        wanted = np.zeros_like(screen)
        beside = np.concatenate(list(noise(OUTPUTS, seed).values()), axis=1)
        wanted[: beside.shape[0], : beside.shape[1]] = beside
        return bool(np.array_equal(screen, wanted))

    def shows_installed(self) -> bool:
        """Whether the projectors of a kiosk whose camera sees them (``calibrate``) show an appearance of the installed
        bundle, to the byte.
        """
        file = self.machine.at(STAGE / "run" / "outputs.frame")
        if not file.exists() or not self.answers():
            return False
        try:
            shown = Frames(file).read()
        except (AssertionError, ValueError):  # the player is just making it
            return False
        with Bundle.open(self.machine.at(STAGE / "bundles" / "current").resolve(), allow_unsigned=True) as bundle:
            names = [one.name for one in bundle.index.appearances]
            return any(same(shown, {output: bundle.decode(name, output) for output in shown}) for name in names)

    def let_the_camera_see(self) -> None:
        """Show the pictures where the emulated camera sees them, and be asked for the appearance ``board``."""
        machine = self.machine
        described = machine.at(STAGE / "stage.toml")
        text = re.sub(r'(driver = "player"\n)', r'\1frames = "run/outputs.frame"\n', described.read_text())
        first, _, _ = text.partition("\n[[appearances]]")
        new = f'{first}\n[[appearances]]\nname = "board"\nkind = "checkerboard"\n'
        (machine.at(STAGE) / "new.toml").write_text(new)
        machine.call("velatura", "kiosk", "settings", STAGE, "--save", STAGE / "new.toml", user="velatura")
        machine.wait_for(lambda: machine.at(STAGE / "run" / "outputs.frame").exists())
        machine.wait_for(self.answers)

    def calibrate(self, look: Callable[[dict[str, Any]], object] = lambda _: None) -> None:
        """Calibrate, and play what was made; after ``let_the_camera_see``. ``look`` gets the job again and again."""
        machine, number = self.machine, self.events()[-1]["number"]
        self.begin("calibrate")

        def made() -> bool:
            look(self.status()["job"] or {})
            return {"calibrated", "published"} <= set(self.codes(number))

        machine.wait_for(made)
        machine.wait_for(
            lambda: machine.called("velatura", "kiosk", "show", STAGE, "board", user="velatura").returncode == 0
        )
        machine.wait_for(lambda: self.status()["playing"] == "board")

    def begin(self, command: str, *words: str | Path) -> None:
        """Begin work, once what is still under way has ended."""
        asked = ("velatura", "kiosk", command, STAGE, *words, "--no-wait")
        self.machine.wait_for(lambda: self.machine.called(*asked, user="velatura").returncode == 0)

    def begin_appearance(self, name: str, seed: int) -> None:
        """Begin to compute an appearance from a picture that no one has computed yet."""
        picture = Path(f"/opt/{name}-{seed}.png")
        cv2.imwrite(str(self.machine.at(picture)), np.random.default_rng(seed).integers(0, 256, (48, 48, 3), np.uint8))
        self.begin("add", name, picture)

    def problems(self) -> dict[str, str]:
        """What the panel says of the devices that have one, by name."""
        return {row["name"]: row["problem"] for row in self.status()["devices"] if row["problem"]}

    def events(self) -> list[dict[str, Any]]:
        """Of the log, oldest first."""
        rows = self._asked("events") or self.machine.velatura("events")["events"]
        return sorted(rows, key=lambda row: int(row["number"]))

    def codes(self, after: int = 0) -> list[str]:
        """Of the events with a larger number."""
        return [row["code"] for row in self.events() if row["number"] > after]

    def put_hours(self, *, around_s: float, without_time: str) -> None:
        """Be open every day for two hours before and after this time of day, from the controller's next start on."""
        opens, closes = (time.strftime("%H:%M", time.gmtime(around_s + by_s)) for by_s in (-7200, 7200))
        rows = "".join(f'[[hours]]\nday = "{day}"\nopens = "{opens}"\ncloses = "{closes}"\n' for day in WEEKDAYS)
        self.machine.write(_HOURS, f'time_zone = "UTC"\nwithout_time = "{without_time}"\n{rows}')
        self.machine.call("chown", "velatura:velatura", _HOURS)

    def remove_hours(self) -> None:
        self.machine.call("rm", _HOURS)

    def install_bundle(self, name: str) -> None:
        """Install one of the stage's bundles."""
        self.machine.call("velatura", "bundle", "install", STAGE / name, STAGE, user="velatura")

    @property
    def bundle(self) -> Path:
        """Where the file of the installed bundle lies on this computer."""
        installed = self.machine.seen_here(STAGE / "bundles" / "current").readlink()
        return self.machine.at(STAGE / "bundles" / installed)

    def answers(self) -> bool:
        """Whether a command reaches the service, and not the folder alone."""
        return self._asked("status") is not None

    def read_code(self) -> str:
        """What a telephone reads from the projectors; empty without a QR code."""
        screen = self.machine.screen()
        return "" if screen is None else str(cv2.QRCodeDetector().detectAndDecode(np.ascontiguousarray(screen))[0])

    def boot(self, *, read_only: bool = False) -> float:
        """Cut the power and switch on again; when that was, in seconds of ``time.monotonic``."""
        self.machine.cut_off()
        began_s = time.monotonic()
        self.machine.switch_on(read_only=read_only)
        return began_s

    def boot_beside_devices(self) -> float:
        """Boot where the devices are on before X starts, as projectors are that stand around a real computer.

        Returns the seconds from an X server that listens to the appearance.
        """
        machine = self.machine
        machine.write(_DEVICES_FIRST, _UNTIL_THERE)
        self.boot()
        machine.wait_for(self.shows)
        now_s = time.monotonic()
        machine.at(_DEVICES_FIRST).unlink()
        return now_s - machine.active_since_s("velatura-x11")

    def put_stage(self, stage: Path) -> None:
        """Copy a stage of ``prepared_stage`` there, as somebody does; then it plays."""
        machine, described = self.machine, stage / "stage.toml"
        place = machine.at(STAGE)
        shutil.copytree(stage, place, dirs_exist_ok=True, ignore=shutil.ignore_patterns(described.name))
        machine.call("chown", "--recursive", "velatura:velatura", STAGE)
        machine.call("systemctl", "enable", "--now", "bench")
        machine.wait_for(lambda: os.path.lexists(place / "run" / "tty-left"))
        shutil.copy(described, place / "new.toml")
        machine.call("chown", "velatura:velatura", STAGE / "new.toml")
        machine.call("mv", STAGE / "new.toml", STAGE / described.name)
        machine.wait_for(self.answers)
        self.install_bundle(FIRST)
        showing = ("velatura", "kiosk", "show", STAGE, APPEARANCE)
        machine.wait_for(lambda: machine.called(*showing, user="velatura").returncode == 0)
        machine.wait_for(self.shows)
        machine.wait_for(lambda: self.state == "playing")


@contextmanager
def installed(suite: str, folder: Path, *, versions: Sequence[str] = ("1",)) -> Iterator[Kiosk]:
    """A kiosk without a stage, right after the installation of the first of these ``versions`` on a bare Debian."""
    debian = tree(suite)
    packages = built_packages(suite, folder / "package", *versions)
    with Machine(debian, folder) as machine:
        machine.switch_on()
        machine.install(packages[0])
        dry = machine.call("/opt/velatura/bin/velatura", "kiosk", "install", "--dry-run")
        assert not machine.at(STAGE).exists()
        told = machine.call("/opt/velatura/bin/velatura", "kiosk", "install")
        _put_kernels(machine, suite)
        yield Kiosk(machine, dry, told, packages)


def _put_kernels(machine: Machine, suite: str) -> None:
    cache = STAGE.parent / ".cache"
    put_kernels(suite, machine.at(cache / "velatura" / "kernels"))
    machine.call("chown", "--recursive", "velatura:velatura", cache)
    machine.call("chmod", "--recursive", "u+rwX,go=", cache)


def prepared_stage(folder: Path) -> Path:
    """The demo's stage for projectors at an X server, with four bundles beside it, the first for ``put_stage``."""
    words = ["demo", "--prepare-only", "--room", "dark", "--out", str(folder / "out")]
    subprocess.run([sys.executable, "-m", "controller", *words], check=True, cwd=ROOT, capture_output=True)
    stage = folder / "out" / "stage"
    described = stage / "stage.toml"
    described.write_text(re.sub(r"^frames = .*\n", "", described.read_text(), flags=re.MULTILINE))
    for revision, name in enumerate(_BUNDLES):
        write_bundle(
            stage / name,
            NewBundle(stage="demo small", calibration="c", created_unix_s=revision, outputs=OUTPUTS, revision=revision),
            appearances=[NewAppearance(APPEARANCE, noise(OUTPUTS, (_SEED, OTHER_SEED)[revision % 2]))],
            key=load_signing_key(stage / "keys" / "stage.key"),
        )
    return stage
