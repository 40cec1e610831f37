"""Debian as it is after its installation, with what Velatura needs of others: made once, kept in Velatura's cache.

``python -m tests.booted.trees`` makes what is missing (`make test-setup`), where a Debian can be booted.
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

from packaging.requirements import Requirement

from controller.kiosk.install.steps import PACKAGES
from hal.runtime.caches import cache_folder

ROOT: Final = Path(__file__).parents[2]
LOCK: Final = ROOT / "requirements-demo.lock"
SUITES: Final = {"bookworm": "3.11", "trixie": "3.13"}
"""With the version of their Python."""
BOOTED: Final = (
    "systemd", "systemd-sysv", "dbus", "udev", "kmod", "iproute2", "python3", "python3-venv",
    "xserver-xorg-video-dummy",
)  # fmt: skip
"""What a Debian on a computer has without us, and outputs without graphics hardware."""
_LEFT_OUT: Final = ("/usr/share/doc/*", "/usr/share/man/*", "/usr/share/locale/*")
_GLIBC: Final = (17, 24, 27, 28, 31, 34)
"""Of the wheels that either Debian runs (manylinux_2_N)."""


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
    digest = hashlib.sha256(repr((BOOTED, PACKAGES, _LEFT_OUT)).encode() + LOCK.read_bytes())
    folder = cache_folder() / "tests" / f"{suite}-{digest.hexdigest()[:12]}"
    if not folder.exists():
        part = folder.with_name(f".{folder.name}.part")
        for cut_off in folder.parent.glob(f".{suite}-*.part"):
            shutil.rmtree(cut_off)
        part.mkdir(parents=True)
        _bootstrap(suite, part)
        _environment(suite, part)
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


def _environment(suite: str, folder: Path) -> None:
    """/opt/velatura with the pinned packages, without Velatura itself. Their wheels are loaded with this Python's pip,
    which has the network's certificates.
    """
    wheels = folder / "wheels"
    wheels.mkdir()
    wanted = wheels / "lock"
    wanted.write_text(_lock_for(SUITES[suite]))
    platforms = [f"--platform=manylinux_2_{number}_x86_64" for number in _GLIBC]
    subprocess.run(
        [
            sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--require-hashes",
            "--only-binary=:all:", "--implementation=cp", f"--python-version={SUITES[suite]}",
            *platforms, "--platform=manylinux2014_x86_64", "--platform=manylinux1_x86_64",
            f"--requirement={wanted}", f"--dest={wheels}",
        ],
        check=True,
    )  # fmt: skip
    pip = "/opt/velatura/bin/pip install --quiet --disable-pip-version-check --no-index --find-links /wheels"
    script = f"python3 -m venv /opt/velatura && {pip} --require-hashes -r /wheels/lock"
    inside = ["chroot", str(folder), "env", "-i", "PATH=/usr/bin:/bin", "sh", "-c", script]
    subprocess.run(inside, check=True)
    shutil.rmtree(wheels)


def _lock_for(version: str) -> str:
    """The lock's lines for another Python: pip asks the markers about the Python that it runs on."""
    environment = {"python_version": version, "python_full_version": f"{version}.0"}
    lines = []
    for line in LOCK.read_text().replace("\\\n", " ").splitlines():
        what, *hashes = line.split("--hash=")
        if what.strip() and not what.lstrip().startswith("#"):
            requirement = Requirement(what)
            if requirement.marker is None or requirement.marker.evaluate(environment):
                lines.append(
                    " ".join([f"{requirement.name}{requirement.specifier}", *(f"--hash={one}" for one in hashes)])
                )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    if (why := obstacle()) is None:
        for name in SUITES:
            tree(name)
    else:
        print(f"The tests that boot a Debian are skipped: {why}.")
