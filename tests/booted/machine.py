"""A Debian that systemd boots in a container, with its own disk: switched on, given commands, cut off and on again."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from tests.booted.control_groups import ControlGroups

STAGE: Final = Path("/var/lib/velatura/stage")
LONGEST_S: Final = 300.0
"""Far beyond what anything here takes, for machines that do much else meanwhile."""
ADDRESS: Final = "192.0.2.7"
"""Of the machine in a network where it is alone."""
_NUMBERS: Final = itertools.count()
_PATH: Final = "PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
_SCREEN: Final = """
Section "Device"
  Identifier "dummy"
  Driver "dummy"
  VideoRam 64000
EndSection
Section "Monitor"
  Identifier "every"
  HorizSync 1-1000
  VertRefresh 5-200
EndSection
Section "Screen"
  Identifier "dummy"
  Device "dummy"
  Monitor "every"
  DefaultDepth 24
EndSection
"""
"""Outputs without graphics hardware, of which one is connected."""
_BENCH: Final = """
[Service]
User=velatura
Environment=HOME=/var/lib/velatura
ExecStart=/opt/velatura/bin/velatura emulate /var/lib/velatura/stage
[Install]
WantedBy=multi-user.target
"""
_NETWORK: Final = f"""
[Unit]
Before=network.target
Wants=network.target
[Service]
Type=oneshot
ExecStart=/bin/sh -c "ip link add net0 type bridge; ip address add {ADDRESS}/24 dev net0; ip link set net0 up"
ExecStart=/bin/cp /proc/sys/kernel/random/boot_id /run/boot_id
[Install]
WantedBy=multi-user.target
"""
_BOOT: Final = """
[Service]
BindReadOnlyPaths=-/run/boot_id:/proc/sys/kernel/random/boot_id
"""
"""A service with a /proc of its own would see this computer's boot, not the machine's, and no power cut."""
_SEEING: Final = """
import ctypes, hashlib, select, sys, time
class Image(ctypes.Structure):
    _fields_ = [(name, ctypes.c_int) for name in ("width", "height", "offset", "format")] + [("data", ctypes.c_void_p)]
x = ctypes.CDLL("libX11.so.6")
x.XOpenDisplay.restype = x.XGetImage.restype = x.XGetSubImage.restype = ctypes.c_void_p
x.XDefaultRootWindow.restype = ctypes.c_ulong
display = x.XOpenDisplay(b":0")
if not display:
    sys.exit("X does not answer")
display = ctypes.c_void_p(display)
size = x.XDisplayWidth(display, 0), x.XDisplayHeight(display, 0)
part = 0, 0, *size, ctypes.c_ulong(0xFFFFFFFF), 2
root = ctypes.c_ulong(x.XDefaultRootWindow(display))
image = x.XGetImage(display, root, *part)
def pixels():
    return ctypes.string_at(Image.from_address(image).data, size[0] * size[1] * 4)
"""
_PHOTOGRAPH: Final = f"""{_SEEING}
with open("/tmp/screen", "wb") as file:
    file.write(pixels())
print(*size)
"""
"""What the X server shows, read without anything of ours."""
_WATCH: Final = f"""{_SEEING}
before = None
while not select.select([sys.stdin], [], [], 0.02)[0]:
    if not x.XGetSubImage(display, root, *part, ctypes.c_void_p(image), 0, 0):
        sys.exit("X does not answer any more")
    seen = pixels()
    if seen != before:
        at_s, before = time.monotonic(), seen
        now = "black" if not any(seen) else hashlib.sha256(seen).hexdigest()
        print(at_s, now, flush=True)
"""
_FETCH: Final = """
import ssl, sys, urllib.request
context = ssl._create_unverified_context()
print(urllib.request.urlopen(sys.argv[1], timeout=20, context=context).read().decode())
"""


class Machine:
    """``tree`` is not changed: what the machine writes goes to ``folder``. A context manager: ends it."""

    def __init__(self, tree: Path, folder: Path) -> None:
        self._root, self._folder = folder / "root", folder
        for name in ("root", "written", "work"):
            (folder / name).mkdir()
        layers = f"lowerdir={tree},upperdir={folder / 'written'},workdir={folder / 'work'}"
        subprocess.run(["mount", "-t", "overlay", "overlay", "-o", layers, str(self._root)], check=True)
        self.write(Path("/etc/hostname"), "kiosk\n")
        self.write(Path("/etc/X11/xorg.conf.d/00-dummy.conf"), _SCREEN)
        self.write(Path("/etc/systemd/system/bench.service"), _BENCH)
        self.write(Path("/etc/systemd/system/lonely-network.service"), _NETWORK)
        # Beside the settings that the tests look through. Debian 13's systemd has no /proc yet when it binds.
        if "bookworm" in (tree / "etc/os-release").read_text("utf-8"):
            self.write(Path("/usr/local/lib/systemd/system/velatura-controller.service.d/boot.conf"), _BOOT)
        self.write(Path("/opt/photograph.py"), _PHOTOGRAPH)
        self.write(Path("/opt/watch.py"), _WATCH)
        wants = self.at(Path("/etc/systemd/system/multi-user.target.wants"))
        wants.mkdir(parents=True, exist_ok=True)
        (wants / "lonely-network.service").symlink_to("/etc/systemd/system/lonely-network.service")
        self._container: subprocess.Popen[bytes] | None = None
        self._init = 0
        self._groups = ControlGroups(f"velatura-{os.getpid()}-{next(_NUMBERS)}")

    def at(self, path: Path) -> Path:
        """Where a path of the machine's disk lies here; /tmp and /run of a machine that runs are in its memory."""
        return self._root / path.relative_to("/")

    def write(self, path: Path, text: str) -> None:
        self.at(path).parent.mkdir(parents=True, exist_ok=True)
        self.at(path).write_text(text)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.cut_off()
        subprocess.run(["umount", str(self._root)], check=True)

    def install(self, package: Path) -> str:
        """Install a Debian package, or another version of it, as `apt install ./FILE` does; what that printed."""
        place = self.at(Path("/opt") / package.name)
        shutil.copy(package, place)
        try:
            # The disk of this machine is thrown away: nothing has to reach it for good.
            return self.call("dpkg", "--force-unsafe-io", "--install", f"/opt/{package.name}")
        finally:
            place.unlink()  # a gigabyte

    def switch_on(self, *, read_only: bool = False) -> None:
        """Boot, until the machine takes commands. ``read_only``: nothing can be written to its disk, and /tmp is on it;
        only the devices, which stand outside, write to copies of two folders.
        """
        options, settings = [], dict(os.environ)
        if read_only:
            for place in (STAGE / "run", STAGE.parent / ".cache"):
                outside = self._folder / f"devices-{place.name}"
                subprocess.run(["cp", "--archive", str(self.at(place)), str(outside)], check=True)
                options.append(f"--bind={outside}:{place}")
            options.append("--read-only")
            settings["SYSTEMD_NSPAWN_TMPFS_TMP"] = "0"
        with (self._folder / "console").open("ab") as console:
            self._container = subprocess.Popen(
                self._groups.entered([
                    "systemd-nspawn", "--quiet", "--boot", "--private-network", "--register=no", "--keep-unit",
                    "--console=pipe", f"--machine=velatura-{os.getpid()}", f"--directory={self._root}",
                    *options,
                ]),
                stdin=subprocess.DEVNULL, stdout=console, stderr=console, env=settings,
            )  # fmt: skip
        self.wait_for(lambda: self._find_init() != 0)
        self.wait_for(lambda: self.called("systemctl", "is-system-running").stdout.strip() != "")

    def _find_init(self) -> int:
        """The machine's first process; 0 while there is none. systemd-nspawn has another child before it."""
        assert self._container is not None
        children = Path(f"/proc/{self._container.pid}/task/{self._container.pid}/children").read_text().split()
        for child in children:
            with contextlib.suppress(OSError):  # it has ended since
                status = Path(f"/proc/{child}/status").read_text()
                if re.search(r"^NSpid:\t\d+\t1$", status, re.MULTILINE):
                    self._init = int(child)
        return self._init

    def cut_off(self) -> None:
        """As when the power fails: every process is gone at once, and nothing was reported."""
        if self._container is not None:
            os.kill(self._init or self._container.pid, signal.SIGKILL)
            self._container.wait()
            self._container, self._init = None, 0
            self._groups.remove()

    def called(self, *words: str | Path, user: str | None = None) -> subprocess.CompletedProcess[str]:
        """Run a program on the machine, as root if no other ``user`` is named."""
        identity = [] if user is None else ["runuser", "-u", user, "--"]
        return subprocess.run(
            [*self._there(), *identity, *map(str, words)], capture_output=True, text=True, timeout=300, check=False
        )

    def _there(self) -> list[str]:
        """What runs the words after it on the machine."""
        into = ["nsenter", f"--target={self._init}", "--mount", "--uts", "--ipc", "--net", "--pid"]
        return [*into, "env", "-i", _PATH, "LANG=C.UTF-8"]

    def call(self, *words: str | Path, user: str | None = None) -> str:
        """As ``called``, for what has to work; what it printed."""
        done = self.called(*words, user=user)
        assert done.returncode == 0, f"{' '.join(map(str, words))}: {done.stdout[-2000:]} {done.stderr[-2000:]}"
        return done.stdout

    def velatura(self, command: str, *words: str | Path) -> dict[str, Any]:
        """A command of ``velatura kiosk``, by the services' user."""
        told = self.call("velatura", "kiosk", command, STAGE, *words, "--json", user="velatura")
        return dict(json.loads(told.splitlines()[-1])["result"])

    def read(self, path: Path) -> bytes:
        """A file of the machine that runs."""
        return self.seen_here(path).read_bytes()

    def seen_here(self, path: Path) -> Path:
        """Where a path of the machine that runs lies here, with all that is mounted there."""
        return Path(f"/proc/{self._init}/root", path.relative_to("/"))

    def screen(self) -> npt.NDArray[np.uint8] | None:
        """What the X server shows, (rows, columns, 3) RGB; None while there is none."""
        done = self.called("env", "XAUTHORITY=/run/velatura-x11/cookie", "python3", "/opt/photograph.py")
        if done.returncode:
            return None
        width, height = map(int, done.stdout.split())
        data = np.frombuffer(self.read(Path("/tmp/screen")), np.uint8)
        return data.reshape(height, width, 4)[:, :, 2::-1]

    @contextlib.contextmanager
    def watched(self) -> Iterator[list[tuple[float, str]]]:
        """Meanwhile, look at the X server fifty times a second. Filled at the end: (monotonic seconds, what it showed
        from then on: "black" or the hash of the picture), and the end itself.
        """
        seen: list[tuple[float, str]] = []
        watching = subprocess.Popen(
            [*self._there(), "env", "XAUTHORITY=/run/velatura-x11/cookie", "python3", "/opt/watch.py"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert watching.stdout is not None
        first = watching.stdout.readline()
        try:
            yield seen
        finally:
            # It ends with its input. A signal would end only nsenter.
            rest, _ = watching.communicate()
        assert watching.returncode == 0, "the X server ended meanwhile"
        seen += [(float(at_s), what) for at_s, what in map(str.split, [first, *rest.splitlines()])]
        seen.append((time.monotonic(), "end"))

    def restarts(self, unit: str) -> int:
        return int(self.call("systemctl", "show", "--value", "--property=NRestarts", unit))

    def active_since_s(self, unit: str) -> float:
        """When systemd called this unit active, in the seconds of ``time.monotonic``, which the machine shares."""
        since = self.call("systemctl", "show", "--value", "--property=ActiveEnterTimestampMonotonic", unit)
        return int(since) / 1e6

    def fetched(self, url: str) -> str:
        """A page of the machine, asked for by a program outside it that is in its network."""
        asking = [sys.executable, "-c", _FETCH, url]
        done = subprocess.run(
            ["nsenter", f"--target={self._init}", "--net", *asking], capture_output=True, text=True, check=True
        )
        return done.stdout

    def wait_for(self, so: Callable[[], object], *, within_s: float = LONGEST_S) -> float:
        """Wait until it is so; the seconds that it took. What the services said is shown if it never is."""
        began_s = time.monotonic()
        while not so():
            if time.monotonic() > began_s + within_s:
                raise AssertionError(f"it did not happen within {within_s:g} s\n{self._told()}")
            time.sleep(0.2)
        return time.monotonic() - began_s

    def _told(self) -> str:
        """The kiosk's status, and the end of the journal without the sessions of this class's own commands."""
        services = "--facility=kern,user,daemon,syslog"
        journal = self.called("journalctl", "--boot", "--no-pager", "--lines=60", services).stdout
        return self.called("velatura", "kiosk", "status", STAGE, user="velatura").stdout + journal
