"""What is hard to do to a computer without doing it to this one, too: a full disk, and a clock that no one set; and a
damaged file.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np

from controller.bundle.format import FIRST_BLOB
from tests.booted.machine import STAGE, Machine

DAY_S: Final = 86_400
_WRITTEN: Final = STAGE.parent
_ROOMY: Final = "20G"
_DISK: Final = "/opt/disk"
_LIBRARY: Final = Path("/opt/clock.so")
_OFFSET: Final = Path("/opt/clock")
_DROP_IN: Final = Path("/etc/systemd/system/velatura-controller.service.d/clock.conf")
_CLOCK: Final = f"""
#include <fcntl.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>
int clock_gettime(clockid_t which, struct timespec *at)
{{
    int failed = syscall(SYS_clock_gettime, which, at), file = open("{_OFFSET}", O_RDONLY | O_CLOEXEC);
    long offset_s;
    if (!failed && which == CLOCK_REALTIME && read(file, &offset_s, sizeof offset_s) == sizeof offset_s)
        at->tv_sec += offset_s;
    close(file);
    return failed;
}}
"""
"""The computer's clock is this computer's, too, so one service alone reads another. libfaketime breaks its sleep."""


def spoil(bundle: Path) -> None:
    """Damage the frames of a bundle, and nothing else of it; that needs no space."""
    most = bundle.stat().st_size * 8 // 10
    with bundle.open("r+b") as file:
        file.seek(FIRST_BLOB)
        file.write(np.random.default_rng(3).bytes(most - FIRST_BLOB))


class Disk:
    """In the machine's memory, as large as somebody says."""

    def __init__(self, machine: Machine) -> None:
        self._machine = machine

    def fill(self) -> None:
        """Nothing more can be written. What is removed later makes room again, until this is called again."""
        used, free = self._space()
        while free:
            # Refused where something was written meanwhile.
            self._machine.called("mount", "--options", f"remount,size={used}", _DISK)
            used, free = self._space()

    def clear(self) -> None:
        self._machine.call("mount", "--options", f"remount,size={_ROOMY}", _DISK)

    def _space(self) -> tuple[int, int]:
        """Bytes that are used, and free."""
        told = self._machine.call("stat", "--file-system", "--format=%b %f %S", _DISK)
        blocks, free, block = map(int, told.split())
        return (blocks - free) * block, free * block


@contextmanager
def disk_of_its_own(machine: Machine) -> Iterator[Disk]:
    """Meanwhile, what the kiosk writes lies on a disk of its own. The services are restarted before and after it."""
    machine.call("mkdir", "--parents", _DISK)
    machine.call("mount", "--types", "tmpfs", "--options", f"size={_ROOMY}", "tmpfs", _DISK)
    machine.call("cp", "--archive", f"{_WRITTEN}/.", _DISK)
    # The devices continue, and what they made is theirs.
    machine.call("mount", "--bind", STAGE / "run", Path(_DISK) / STAGE.name / "run")
    machine.call("mount", "--rbind", _DISK, _WRITTEN)
    machine.call("systemctl", "restart", "velatura.target")
    try:
        yield Disk(machine)
    finally:
        for place in (_WRITTEN, _DISK):
            machine.call("umount", "--lazy", place)
        machine.call("systemctl", "restart", "velatura.target")


class Clock:
    """Of the controller alone."""

    def __init__(self, machine: Machine) -> None:
        self._machine = machine

    def lose(self) -> None:
        """As after an empty battery: the second of January 1970, twelve hours off the true time of day."""
        now_s = int(time.time())
        self._set(DAY_S + (now_s + DAY_S // 2) % DAY_S - now_s)

    def find(self) -> None:
        self._set(0)

    def _set(self, offset_s: int) -> None:
        new = _OFFSET.with_suffix(".new")
        self._machine.at(new).write_bytes(offset_s.to_bytes(8, sys.byteorder, signed=True))
        self._machine.call("mv", new, _OFFSET)


@contextmanager
def clock_of_its_own(machine: Machine) -> Iterator[Clock]:
    """Meanwhile, the controller has a clock that can be set. It is restarted before and after it."""
    clock = Clock(machine)
    building = ["cc", "-shared", "-fPIC", "-O", "-x", "c", "-", "-o", str(machine.at(_LIBRARY))]
    subprocess.run(building, input=_CLOCK, text=True, check=True)
    clock.find()
    machine.write(_DROP_IN, f"[Service]\nEnvironment=LD_PRELOAD={_LIBRARY}\n")
    _restart(machine)
    try:
        yield clock
    finally:
        machine.call("rm", "--recursive", _DROP_IN.parent)
        _restart(machine)


def _restart(machine: Machine) -> None:
    machine.call("systemctl", "daemon-reload")
    machine.call("systemctl", "restart", "velatura-controller")
