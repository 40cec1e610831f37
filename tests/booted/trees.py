"""Debian as it is after its installation, with the Debian packages that Velatura needs: made once, kept in its cache.

Where a Debian can be booted, ``python -m tests.booted.trees`` (`make test-setup`) makes what is missing, loads what
Velatura's package is made of, and compiles its kernels.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

from controller.kiosk.install.steps import DEBIAN, PACKAGES, PYTHON
from hal.runtime.caches import cache_folder
from hal.runtime.compute import digest_of
from hal.runtime.kernels import TABLES
from tests.booted.control_groups import ControlGroups
from tests.end_to_end.kernel_copy import kernels_of_the_tables

ROOT: Final = Path(__file__).parents[2]
BOOTED: Final = (
    "systemd", "systemd-sysv", "dbus", "udev", "kmod", "iproute2", "python3", "chrony",
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


def put_kernels(suite: str, to: Path) -> None:
    """Put the kernels' machine code for this Debian's Python, which a kiosk compiles in minutes, into the new folder
    ``to``. Raises CalledProcessError.
    """
    to.parent.mkdir(parents=True)
    if PYTHON[suite] == f"{sys.version_info.major}.{sys.version_info.minor}":
        to.mkdir()
        kernels_of_the_tables(to, shutil.copy)
    else:
        shutil.copytree(_compiled(suite), to)


def _compiled(suite: str) -> Path:
    """The kernels, compiled by this Debian's Python; made if the sources are others."""
    digest = hashlib.sha256((ROOT / "requirements-kiosk.lock").read_bytes())
    for table in TABLES:
        digest.update(table.read_bytes())
        for module in sorted(json.loads(table.read_text())):
            digest.update(digest_of(ROOT.joinpath(*module.split(".")).with_suffix(".py")).encode())
    folder = cache_folder() / "tests" / f"compiled-{suite}-{digest.hexdigest()[:12]}"
    if not folder.exists():
        (packages,) = (cache_folder() / "packages").glob(f"{suite}-*")
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as part:
            _compile(tree(suite), packages, Path(part))
            with contextlib.suppress(OSError):  # another checkout was faster
                Path(part, "kernels").rename(folder)
    return folder


def _compile(debian: Path, packages: Path, to: Path) -> None:
    groups = ControlGroups(f"velatura-compiling-{os.getpid()}")
    container = [
        "systemd-nspawn", "--quiet", "--register=no", "--keep-unit", "--console=pipe", "--volatile=overlay",
        f"--directory={debian}", f"--machine=velatura-{os.getpid()}", f"--bind-ro={ROOT}:/source",
        f"--bind-ro={packages}:/packages", f"--bind={to}:/kept", "--setenv=VELATURA_CACHE=/kept",
        "--setenv=PYTHONPATH=/source:/packages", "python3", "-m", "hal.runtime.kernels", "compile",
    ]  # fmt: skip
    try:
        subprocess.run(groups.entered(container), check=True, stdin=subprocess.DEVNULL)
    finally:
        groups.remove()


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
            with tempfile.TemporaryDirectory() as scratch:
                put_kernels(name, Path(scratch, "kept", "kernels"))
    else:
        print(f"The tests that boot a Debian are skipped: {why}.")
