"""A PTP camera driver on an emulated camera on loopback, for the tests here."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from hal.deadline import in_seconds
from hal.values import ExposureSettings
from lab.emulated.cameras.camera import EmulatedPtpCamera, Flavour
from plugins.emulated.core.shot import ShotFiles, ShotSettings
from plugins.ptp.body import PictureStorage
from plugins.ptp.ip import PtpIpAddress, PtpIpLink
from plugins.ptp.shot import Timing
from plugins.ptp.still import PtpCamera

FLAVOURS: tuple[Flavour, ...] = ("generic", "eos-new", "eos-old")
PATIENT = Timing(answer_s=20.0, busy_s=20.0, margin_s=20.0, grace_s=0.1, come_back_s=20.0, reconnect_s=20.0,
                 keep_alive_s=0.05)  # fmt: skip
"""Nothing but ``grace_s`` is waited for without success where a camera answers, however loaded the machine is."""
HASTY = replace(PATIENT, busy_s=1.0, margin_s=2.0, come_back_s=0.5)
"""For tests of what comes when the driver's patience ends."""
SHORT = ExposureSettings(0.125, 200, 8.0, raw=False)


class Studio:
    """Makes each exposure's files, all different, and remembers what was asked of it."""

    def __init__(self, size: int = 300_000) -> None:
        self.shots: list[ShotSettings] = []
        self.size = size

    def expose(self, settings: ShotSettings) -> ShotFiles:
        self.shots.append(settings)
        return ShotFiles(
            raw=b"II*\0" + self.content() if settings.raw else None,
            jpeg=b"\xff\xd8" + self.content() + b"\xff\xd9" if settings.jpeg else None,
        )

    def content(self) -> bytes:
        stamp = b"%08d" % len(self.shots)
        return stamp * (self.size // len(stamp))


class Rig:
    """A driver on an emulated camera."""

    def __init__(self, emulator: EmulatedPtpCamera, studio: Studio, driver: PtpCamera) -> None:
        self.emulator = emulator
        self.studio = studio
        self.driver = driver

    def capture(self, folder: Path, name: str = "shot", *, seconds: float = 60.0) -> bytes:
        files = self.driver.capture(folder / name, deadline=in_seconds(seconds))
        assert len(files) == 1
        return files[0].path.read_bytes()

    def latest(self) -> bytes:
        """The bytes of the last JPEG that was exposed."""
        return b"\xff\xd8" + self.studio.content() + b"\xff\xd9"


def connect(emulator: EmulatedPtpCamera, **options: object) -> PtpCamera:
    address = PtpIpAddress.parse(emulator.address)
    return PtpCamera(
        lambda until: PtpIpLink.connect(address, deadline=until),
        deadline=in_seconds(5),
        **{"timing": PATIENT, **options},  # type: ignore[arg-type]
    )


@contextlib.contextmanager
def running(flavour: Flavour, *, studio: Studio | None = None, **options: object) -> Iterator[Rig]:
    studio = studio or Studio()
    time_scale = float(str(options.pop("time_scale", 0.2)))
    with EmulatedPtpCamera(studio.expose, flavour=flavour, time_scale=time_scale) as emulator:
        driver = connect(emulator, **options)
        driver.configure(SHORT, deadline=in_seconds(5))
        try:
            yield Rig(emulator, studio, driver)
        finally:
            driver.close()


@pytest.fixture(params=FLAVOURS)
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    with running(request.param) as rig:
        yield rig


@pytest.fixture(params=["eos-new", "eos-old"])
def card_rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    with running(request.param, storage=PictureStorage(to_card=True)) as rig:
        yield rig


def when(so: Callable[[], bool], do: Callable[[], object]) -> None:
    """Does something as soon as something is so, on a thread of its own."""

    def watch() -> None:
        while not so():
            time.sleep(0.005)
        do()

    threading.Thread(target=watch, daemon=True).start()


def left_behind(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())
