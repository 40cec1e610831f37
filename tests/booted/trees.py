"""Debian as it is after its installation, with the Debian packages that Velatura needs: made once, kept in its cache.

``python -m tests.booted.trees`` (`make test-setup`) makes what is missing, and loads what Velatura's package is made
of, where a Debian can be booted.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

from controller.kiosk.install.steps import DEBIAN, PACKAGES
from hal.runtime.caches import cache_folder

ROOT: Final = Path(__file__).parents[2]
BOOTED: Final = (
    "systemd", "systemd-sysv", "dbus", "udev", "kmod", "iproute2", "python3",
    "xserver-xorg-video-dummy",
)  # fmt: skip
"""What a Debian on a computer has without us, and outputs without graphics hardware."""
_LEFT_OUT: Final = ("/usr/share/doc/*", "/usr/share/man/*", "/usr/share/locale/*")


def obstacle() -> str | None:
    """Why no Debian can be booted on this machine; None where one can."""
    if os.geteuid() != 0:
        return "booting a Debian needs root"
    if missing := [name for name in ("mmdebstrap", "systemd-nspawn") if shutil.which(name) is None]:
        return f"{missing[0]} is not installed"
    with tempfile.TemporaryDirectory() as folder:
        for name in ("lower", "upper", "work", "root"):
            Path(folder, name).mkdir()
        layers = f"lowerdir={folder}/lower,upperdir={folder}/upper,workdir={folder}/work"
        mounted = f"mount -t overlay overlay -o {layers} {folder}/root && mount -t proc proc {folder}/root"
        tried = subprocess.run(
            ["unshare", "--mount", "--pid", "--ipc", "--uts", "--net", "--fork", "sh", "-c", mounted],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
    return None if tried.returncode == 0 else f"this machine allows no containers: {tried.stderr.strip()}"


def tree(suite: str) -> Path:
    """The folder of this Debian, made if it is not there. Raises CalledProcessError."""
    digest = hashlib.sha256(repr((BOOTED, PACKAGES, _LEFT_OUT)).encode())
    folder = cache_folder() / "tests" / f"{suite}-{digest.hexdigest()[:12]}"
    if not folder.exists():
        part = folder.with_name(f".{folder.name}.part")
        for cut_off in folder.parent.glob(f".{suite}-*.part"):
            shutil.rmtree(cut_off)
        part.mkdir(parents=True)
        _bootstrap(suite, part)
        for old in folder.parent.glob(f"{suite}-*"):
            shutil.rmtree(old)
        part.rename(folder)
    return folder


def _bootstrap(suite: str, folder: Path) -> None:
    packages = ",".join((*BOOTED, *PACKAGES))
    left_out = [f"--dpkgopt=path-exclude={path}" for path in _LEFT_OUT]
    subprocess.run(
        ["mmdebstrap", "--quiet", "--variant=minbase", f"--include={packages}", *left_out, suite, str(folder)],
        check=True,
    )


def built_packages(suite: str, out: Path, *versions: str) -> list[Path]:
    """Velatura's Debian package, as it is released but not compressed, in each version. Raises CalledProcessError."""
    told = _package_script(suite, "--out", str(out), *(f"--version={one}" for one in versions), "--fast")
    return [Path(line) for line in told.splitlines()]


def _package_script(suite: str, *words: str) -> str:
    building = [sys.executable, str(ROOT / ".ci" / "debian_package.py"), suite, "--debian", str(tree(suite)), *words]
    return subprocess.run(building, check=True, stdout=subprocess.PIPE, text=True).stdout


if __name__ == "__main__":
    if (why := obstacle()) is None:
        for name in DEBIAN:
            _package_script(name)
    else:
        print(f"The tests that boot a Debian are skipped: {why}.")
