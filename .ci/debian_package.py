"""Builds the Debian package of a kiosk: /opt/velatura with every pinned package, to be installed without a network.

    python .ci/debian_package.py bookworm --out build            # the Python that runs this is 3.11, as Debian 12's
    python .ci/debian_package.py trixie --out build --debian DIR # DIR: the root folder of a Debian 13

The byte code is made here, so that a kiosk has nothing to compile; --debian has the Python for it where ours is
another. The pinned packages are kept unpacked in Velatura's cache.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from packaging.requirements import Requirement

ROOT: Final = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from controller.kiosk.install.steps import DEBIAN, PACKAGES, PYTHON  # noqa: E402 - from this checkout
from controller.kiosk.install.update import CHANGELOG  # noqa: E402
from hal.runtime.caches import cache_folder  # noqa: E402

LOCK: Final = ROOT / "requirements-kiosk.lock"
PREFIX: Final = Path("opt/velatura")
_GLIBC: Final = (17, 24, 27, 28, 31, 34)
"""Of the wheels that either Debian runs (manylinux_2_N)."""
_PLATFORMS: Final = [*(f"manylinux_2_{n}_x86_64" for n in _GLIBC), "manylinux2014_x86_64", "manylinux1_x86_64"]
_COMMAND: Final = f"""#!/{PREFIX}/bin/python
import sys
from controller.__main__ import main
sys.exit(main())
"""
_CONTROL: Final = """Package: velatura
Version: {version}
Architecture: amd64
Maintainer: The Velatura authors <velatura@localhost>
Installed-Size: {kibibytes}
Depends: python3 (>= {python}), python3 (<< {python}.99), {packages}
Section: graphics
Priority: optional
Description: gives a physical object a new appearance with light
 Several projectors shine superimposed on one object; a camera measures them, and images are computed that make
 the object look like a chosen target. `velatura kiosk install` makes this computer a kiosk.
"""
_POSTINST: Final = f"""#!/bin/sh
set -e
[ "$1" = configure ] || exit 0
if [ -e /etc/systemd/system/velatura.target ] && [ -d /run/systemd/system ]; then
  /{PREFIX}/bin/velatura kiosk install --restart
else
  echo 'To make this computer a kiosk, type: velatura kiosk install'
fi
"""
_PREINST: Final = f"""#!/bin/sh
set -e
# The program that an update has put there is of another package: none of its files may stay among those of this one.
if [ "$1" = upgrade ] && [ -e /{PREFIX}/.update ]; then rm -rf /{PREFIX}/lib /{PREFIX}/.update; fi
[ ! -d /run/systemd/system ] || systemctl stop velatura-update.service 2> /dev/null || true
if [ -e /{PREFIX}.trial ]; then
  sed -i 's/"state": "trial", "why": ""/"state": "failed", "why": "Another version was installed."/' /{PREFIX}.update
fi
rm -f /{PREFIX}.package /{PREFIX}.trial /var/lib/velatura/stage/keys/players/update.deb
"""
_PRERM: Final = f"""#!/bin/sh
set -e
[ "$1" = remove ] || exit 0
if [ -e /etc/systemd/system/velatura.target ]; then
  /{PREFIX}/bin/velatura kiosk uninstall
fi
"""
_POSTRM: Final = f"""#!/bin/sh
set -e
# Byte code that a program of root made beside ours.
if [ "$1" = remove ] || [ "$1" = purge ]; then rm -rf /{PREFIX} /{PREFIX}.*; fi
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", choices=PYTHON)
    parser.add_argument("--out", type=Path, help="the folder for the package; without it, only the cache is filled")
    parser.add_argument("--debian", type=Path, help="the root folder of a Debian of this release, for its Python")
    parser.add_argument(
        "--version",
        action="append",
        default=[],
        help="instead of that in pyproject.toml; can be repeated: for tests",
    )
    parser.add_argument("--fast", action="store_true", help="do not compress: for tests")
    asked = parser.parse_args()
    compiling = _compiler(asked.suite, asked.debian)
    pinned = _pinned(asked.suite, compiling)
    if asked.out is not None:
        for made in build(asked.suite, asked.out, compiling, pinned, versions=asked.version, fast=asked.fast):
            print(made)


def build(
    suite: str, out: Path, compiling: list[str], pinned: Path, *, versions: Sequence[str], fast: bool
) -> list[Path]:
    """The package's files, of the ``pinned`` packages and Velatura; of its own version where none is named.

    Raises CalledProcessError.
    """
    with tempfile.TemporaryDirectory(dir=pinned.parent) as scratch:
        tree = Path(scratch) / "tree"
        site = tree / PREFIX / "lib" / f"python{PYTHON[suite]}" / "site-packages"
        site.parent.mkdir(parents=True)
        # Links cost neither time nor space; nothing below writes into what is there.
        subprocess.run(["cp", "--archive", "--link", str(pinned), str(site)], check=True)
        wheel = _wheel(Path(scratch) / "wheel")
        _install(site, [str(wheel), "--no-deps"], suite)
        for name in ("controller", "hal", "plugins", "firmware_configs"):
            subprocess.run([*compiling, "-s", str(tree), "-p", "/", str(site / name)], check=True)
        _programs(tree / PREFIX, PYTHON[suite])
        out.mkdir(parents=True, exist_ok=True)
        compressed = ["-Znone"] if fast else ["-Zzstd", "-z9"]
        made = []
        for version in versions or (wheel.name.split("-")[1],):
            _control(tree, suite, version)
            named = ["dpkg-deb", "--root-owner-group", *compressed, "--build", str(tree), str(out)]
            told = subprocess.run(named, check=True, capture_output=True, text=True).stdout
            made.append(Path(told.rsplit(" in '", 1)[1].split("'", 1)[0]))
        return made


def _compiler(suite: str, debian: Path | None) -> list[str]:
    """The words that compile a folder's Python files, to be followed by -s, -p and the folder."""
    python = PYTHON[suite]
    # Checked by what a file holds: a package may bring other files of the same date and size.
    words = ["-m", "compileall", "-q", "--invalidation-mode", "checked-hash"]
    if python == f"{sys.version_info.major}.{sys.version_info.minor}":
        return [sys.executable, *words, "-j", "0"]
    if debian is None:
        raise SystemExit(f"Debian's {suite} has Python {python}, this is another. Name a {suite}'s root with --debian.")
    # Through its own loader, so that it finds its own C library; so it can start no others like it (-j).
    loader = [
        str(debian / "usr/lib64/ld-linux-x86-64.so.2"),
        "--library-path",
        str(debian / "usr/lib/x86_64-linux-gnu"),
    ]
    return ["env", f"PYTHONHOME={debian}/usr", *loader, str(debian / f"usr/bin/python{python}"), *words]


def _pinned(suite: str, compiling: list[str]) -> Path:
    """The folder with every pinned package and its byte code; made when the lock is a new one."""
    digest = hashlib.sha256(LOCK.read_bytes() + Path(__file__).read_bytes()).hexdigest()[:12]
    folder = cache_folder() / "packages" / f"{suite}-{digest}"
    if not folder.exists():
        part = folder.with_name(f".{folder.name}.part")
        shutil.rmtree(part, ignore_errors=True)
        (part / "wheels").mkdir(parents=True)
        (part / "lock").write_text(lock_for(PYTHON[suite]))
        wheels, site = part / "wheels", part / "site"
        _pip(
            "download",
            "--require-hashes",
            "--no-deps",
            *_of(suite),
            f"--requirement={part / 'lock'}",
            f"--dest={wheels}",
        )
        # The lock has everything, and the download looked what fits. Pip would ask the Python that it runs on.
        complete = ["--no-deps", "--ignore-requires-python", "--no-index", f"--find-links={wheels}", "--require-hashes"]
        _install(site, [*complete, f"--requirement={part / 'lock'}"], suite)
        subprocess.run([*compiling, "-s", str(site), "-p", _site(suite), str(site)], check=True)
        for old in folder.parent.glob(f"{suite}-*"):
            shutil.rmtree(old)
        site.rename(folder)
        shutil.rmtree(part)
    return folder


def _site(suite: str) -> str:
    return f"/{PREFIX}/lib/python{PYTHON[suite]}/site-packages"


def _of(suite: str) -> list[str]:
    chosen = [f"--platform={name}" for name in _PLATFORMS]
    return ["--only-binary=:all:", "--implementation=cp", f"--python-version={PYTHON[suite]}", *chosen]


def _install(site: Path, what: list[str], suite: str) -> None:
    _pip("install", "--no-compile", *_of(suite), f"--target={site}", *what)
    # Programs of other packages, and ours with a path that is true only here.
    shutil.rmtree(site / "bin", ignore_errors=True)


def _pip(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "pip", *words, "--quiet", "--disable-pip-version-check"], check=True)


def lock_for(version: str) -> str:
    """The lock's lines for another Python: pip asks the markers about the Python that it runs on."""
    environment = {"python_version": version, "python_full_version": f"{version}.0"}
    lines = []
    for line in LOCK.read_text().replace("\\\n", " ").splitlines():
        what, *hashes = line.split("--hash=")
        if what.strip() and not what.lstrip().startswith("#"):
            requirement = Requirement(what)
            if requirement.marker is None or requirement.marker.evaluate(environment):
                pinned = f"{requirement.name}{requirement.specifier}"
                lines.append(" ".join([pinned, *(f"--hash={one.strip()}" for one in hashes)]))
    return "\n".join(lines) + "\n"


def _wheel(folder: Path) -> Path:
    """Velatura as it is released, built from a copy."""
    source, out = folder / "source", folder / "out"
    for name in ("controller", "hal", "plugins", "firmware_configs"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    _pip("wheel", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", str(out), str(source))
    (found,) = out.glob("*.whl")
    return found


def _programs(prefix: Path, python: str) -> None:
    """What makes a folder an environment of Debian's Python, and our command in it."""
    (prefix / "pyvenv.cfg").write_text(f"home = /usr/bin\ninclude-system-site-packages = false\nversion = {python}\n")
    (prefix / "bin").mkdir()
    (prefix / "bin" / "python3").symlink_to("/usr/bin/python3")
    (prefix / "bin" / "python").symlink_to("python3")
    command = prefix / "bin" / "velatura"
    command.write_text(_COMMAND)
    command.chmod(0o755)
    links = prefix.parents[1] / "usr" / "bin"
    links.mkdir(parents=True)
    (links / "velatura").symlink_to(f"/{PREFIX}/bin/velatura")


def _control(tree: Path, suite: str, version: str) -> None:
    folder = tree / "DEBIAN"
    shutil.rmtree(folder, ignore_errors=True)
    size = sum(file.lstat().st_size for file in tree.rglob("*") if not file.is_dir())
    folder.mkdir()
    fields = _CONTROL.format(
        version=f"{version}-1~deb{DEBIAN[suite]}", kibibytes=size // 1024, python=PYTHON[suite],
        packages=", ".join(PACKAGES),
    )  # fmt: skip
    (folder / "control").write_text(fields)
    shutil.copy(ROOT / "CHANGELOG.md", folder / CHANGELOG)
    for name, text in (("preinst", _PREINST), ("postinst", _POSTINST), ("prerm", _PRERM), ("postrm", _POSTRM)):
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    for place, folders, files in os.walk(tree):
        for one in (*folders, *files):
            path = Path(place, one)
            if not path.is_symlink() and folder not in path.parents and path != folder:
                wanted = 0o755 if path.is_dir() or path.parent.name == "bin" else 0o644
                if path.stat().st_mode & 0o777 != wanted:
                    path.chmod(wanted)


if __name__ == "__main__":
    main()
