"""The stage's camera on the emulated USB bus: the bus is a process of its own, and asks the bench for its pictures.

Over a unix socket, one message each: the settings of an exposure as JSON; then its raw file and its JPEG, either of
them empty where it was not wanted.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import threading
from multiprocessing.connection import Client, Connection, Listener
from typing import Any, Final, Self

from plugins.emulated.cameras.body import JPEG, CameraNames
from plugins.emulated.cameras.shot import Expose, ShotFiles, ShotSettings
from plugins.emulated.cameras.usb_camera import EmulatedUsbCamera
from plugins.emulated.optics.truth import CameraTruth

STAGE_CAMERA: Final = "stage-camera"
"""This kind of device, in bench/usb.toml and to the bus."""


class ExposureServer:
    """The bench's side: makes the files of every exposure that its one camera asks for.

    A context, and around that of the bus: the camera is gone before it ends.
    """

    def __init__(self, expose: Expose) -> None:
        self._expose = expose
        self._listener = Listener(None, "AF_UNIX")
        self._thread = threading.Thread(target=self._serve, name="exposures", daemon=True)

    def camera(self, truth: CameraTruth) -> dict[str, Any]:
        """The settings of the ``stage_camera`` that asks here."""
        return {"exposures": str(self._listener.address), "serial": truth.serial_number, "raw": truth.raw}

    def _serve(self) -> None:
        with contextlib.suppress(EOFError, OSError), self._listener.accept() as connection:
            while True:
                files = self._expose(ShotSettings(**json.loads(connection.recv_bytes())))
                connection.send_bytes(files.raw or b"")
                connection.send_bytes(files.jpeg or b"")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        # A camera that never asked: who waits for a connection hears of nothing but a connection.
        with contextlib.suppress(OSError):
            Client(str(self._listener.address), "AF_UNIX").close()
        self._thread.join()
        self._listener.close()


def stage_camera(exposures: str, serial: str, *, raw: bool = True) -> EmulatedUsbCamera:
    """A camera whose pictures are those of the stage; its arguments are what ``ExposureServer.camera`` tells."""
    turn = threading.Lock()
    asked: list[Connection] = []

    def expose(settings: ShotSettings) -> ShotFiles:
        with turn:
            if not asked:
                asked.append(Client(exposures, "AF_UNIX"))
            asked[0].send_bytes(json.dumps(dataclasses.asdict(settings)).encode())
            found, shown = asked[0].recv_bytes(), asked[0].recv_bytes()
        return ShotFiles(raw=found or None, jpeg=shown or None)

    # The world behind it spends the exposure time itself, since it must know what is visible meanwhile.
    camera = EmulatedUsbCamera(expose, names=CameraNames(serial=serial), time_scale=0.0)
    if not raw:
        camera.body.capture_formats = (JPEG,)
    return camera
