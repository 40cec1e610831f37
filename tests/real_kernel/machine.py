"""A small machine with Debian's own kernel, in qemu: real drivers of the kernel, without a hold on this computer's.

Its processor is emulated, so it needs no rights and is the same everywhere. It sees this computer's files, read-only,
and runs this Python. ``python -m tests.real_kernel.machine`` (`make test-setup`) loads the kernels.
"""

from __future__ import annotations

import lzma
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hal.runtime.caches import cache_folder

SUITES: Final = ("bookworm", "trixie")
"""Debian 12 with Linux 6.1, Debian 13 with Linux 6.12."""
LONGEST_S: Final = 570.0
_MEMORY_MIB: Final = 640
_BUSYBOX: Final = Path("/bin/busybox")
_DISK: Final = ("virtio_pci", "9pnet_virtio", "9p")
_KEPT: Final = (
    *_DISK, "vivid", "videobuf2_vmalloc", "uvcvideo", "vhci_hcd", "usbhid", "hid_cp2112", "hid_mcp2221",
)  # fmt: skip
"""The kernel's modules that tests use; those that they need come with them."""
_INIT: Final = """\
#!/bin/busybox sh
B=/bin/busybox
$B mount -t proc proc /proc
{modules}
$B mount -t 9p -o trans=virtio,version=9p2000.L,ro,cache=loose,msize=512000 root /new
$B mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000 out /out
$B mount -t proc proc /new/proc
$B mount -t sysfs sysfs /new/sys
$B mount -t devtmpfs devtmpfs /new/dev
$B mkdir /checkout
$B mount --bind "/new{folder}" /checkout
$B mount -t tmpfs tmpfs /new/tmp
# A checkout in /tmp would be hidden by that.
$B mkdir -p "/new{folder}"
$B mount --bind /checkout "/new{folder}"
$B mkdir /new/tmp/out
$B mount --bind /out /new/tmp/out
$B ip link set lo up
$B chroot /new /bin/sh -c 'cd {folder} && exec env HOME=/tmp PYTHONDONTWRITEBYTECODE=1 {command}' > /out/said 2>&1
echo $? > /out/code
$B dmesg | $B tail -n 60 > /out/kernel
$B poweroff -f
"""


def obstacle() -> str | None:
    """Why no such machine can be made here; None where it can."""
    for name in ("qemu-system-x86_64", "mmdebstrap"):
        if shutil.which(name) is None:
            return f"{name} is not installed"
    return None if _BUSYBOX.exists() else "busybox-static is not installed"


def kernel(suite: str) -> Path:
    """A folder with a Debian's ``vmlinuz`` and its modules, made if it is not there. Raises CalledProcessError."""
    folder = cache_folder() / "tests" / f"kernel-{suite}-{'-'.join(sorted(_KEPT))}"
    if not folder.exists():
        part = folder.parent / f".{suite}-kernel.part"
        shutil.rmtree(part, ignore_errors=True)
        part.parent.mkdir(parents=True, exist_ok=True)
        loading = ["mmdebstrap", "--quiet", "--variant=extract", "--include=linux-image-amd64", suite, str(part)]
        subprocess.run(loading, check=True)
        made = part / "made"
        made.mkdir()
        next((part / "boot").glob("vmlinuz-*")).rename(made / "vmlinuz")
        there = {_name(path): path for path in part.glob("**/modules/**/*.ko*")}
        for module in _with_needs(there, _KEPT):
            (made / f"{_name(module)}.ko").write_bytes(_content(module))
        made.rename(folder)
        shutil.rmtree(part)
    return folder


@dataclass(frozen=True)
class Outcome:
    """How a command on the machine ended, what it printed, and how long all of it took."""

    code: int
    said: str
    took_s: float


def run(command: Sequence[str | Path], modules: Mapping[str, str], folder: Path, out: Path, suite: str) -> Outcome:
    """Boot ``suite``'s kernel, load ``modules`` (name: parameters), run a command in ``folder`` as root, switch off.

    ``out`` is the machine's /tmp/out. Raises TimeoutExpired.
    """
    began_s = time.monotonic()
    shared, start = out / "shared", out / "initrd"
    shared.mkdir(parents=True)
    start.write_bytes(_initrd(command, modules, folder, kernel(suite)))
    with (out / "console").open("wb") as console:
        subprocess.run(
            [
                "qemu-system-x86_64", "-accel", "tcg", "-cpu", "max", "-m", str(_MEMORY_MIB), "-nodefaults",
                "-no-reboot", "-display", "none", "-serial", "stdio",
                "-kernel", str(kernel(suite) / "vmlinuz"), "-initrd", str(start),
                "-append", "console=ttyS0 panic=-1 quiet",
                "-virtfs", "local,path=/,mount_tag=root,security_model=none,readonly=on,multidevs=remap",
                "-virtfs", f"local,path={shared},mount_tag=out,security_model=none",
            ],
            stdin=subprocess.DEVNULL, stdout=console, stderr=console, timeout=LONGEST_S, check=False,
        )  # fmt: skip
    logs = [shared / "kernel", out / "console", shared / "said"]
    said = "\n".join(log.read_text("utf-8", "replace") for log in logs if log.exists())
    code = shared / "code"
    return Outcome(int(code.read_text()) if code.exists() else -1, said, time.monotonic() - began_s)


def _initrd(command: Sequence[str | Path], modules: Mapping[str, str], folder: Path, kept: Path) -> bytes:
    ours = {_name(path): path for path in kept.glob("*.ko")}
    wanted = _with_needs(ours, (*_DISK, *modules))
    loading = [f"$B insmod /modules/{path.name} {modules.get(_name(path), '')}" for path in wanted]
    script = _INIT.format(modules="\n".join(loading), folder=folder, command=" ".join(map(str, command)))
    return _cpio({
        **dict.fromkeys(("bin", "dev", "modules", "new", "out", "proc")),
        "bin/busybox": _BUSYBOX.read_bytes(),
        **{f"modules/{path.name}": path.read_bytes() for path in wanted},
        "init": script.encode(),
    })  # fmt: skip


def _with_needs(there: Mapping[str, Path], names: Sequence[str]) -> list[Path]:
    """Modules with those that they need before them; what is not there is built into the kernel."""
    found: dict[str, Path] = {}

    def add(name: str) -> None:
        if name in there and name not in found:
            for needs in re.findall(rb"\0depends=([^\0]*)\0", _content(there[name])):
                for other in filter(None, needs.decode().split(",")):
                    add(other.replace("-", "_"))
            found[name] = there[name]

    for name in names:
        add(name)
    return list(found.values())


def _name(module: Path) -> str:
    return module.name.split(".")[0].replace("-", "_")


def _content(module: Path) -> bytes:
    data = module.read_bytes()
    return lzma.decompress(data) if module.suffix == ".xz" else data


def _cpio(files: Mapping[str, bytes | None]) -> bytes:
    """An archive as the kernel reads it at its start (newc); None makes a folder."""
    made = bytearray()
    for number, (name, data) in enumerate([*files.items(), ("TRAILER!!!", b"")]):
        mode, content = (0o40755, b"") if data is None else (0o100755, data)
        path = name.encode() + b"\0"
        fields = (number, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(path), 0)
        for piece in (b"070701" + b"".join(b"%08x" % field for field in fields) + path, content):
            made += piece
            made += bytes(-len(made) % 4)
    return bytes(made)


if __name__ == "__main__":
    if (why := obstacle()) is None:
        for name in SUITES:
            kernel(name)
    else:
        sys.stderr.write(f"The tests on a real kernel can't run: {why}.\n")
