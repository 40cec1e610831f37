"""An emulated still camera on the emulated USB bus: the same bodies as on PTP/IP, behind bulk and interrupt pipes.

Written from the specification (PIMA 15740, annex D) and not from ``hal``: see ``cameras.wire``.

The stage's camera asks the bench for its pictures, since the bus is a process of its own. Over a unix socket, one
message each: the settings of an exposure as JSON; then its raw file and its JPEG, either of them empty where it was not
wanted.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import queue
import struct
import threading
import time
from collections import Counter
from dataclasses import dataclass
from multiprocessing.connection import Client, Connection, Listener
from typing import Any, Final, Self

from lab.emulated.cameras.camera import BODIES, Flavour
from lab.emulated.usb.device import BULK, INTERRUPT, EmulatedUsbDevice, Endpoint, SetupPacket, Stall, UsbNames
from plugins.emulated.cameras.body import CameraNames, EmulatedBody
from plugins.emulated.cameras.wire import BUSY, OK, Gone, PtpOutcome
from plugins.emulated.core.faults import FaultCounts
from plugins.emulated.core.shot import Expose, ShotFiles, ShotSettings
from plugins.emulated.core.truth import CameraTruth

IN, OUT, EVENTS = 0x81, 0x02, 0x83
_PACKET: Final = 512
_HEADER: Final = struct.Struct("<IHHI")
_COMMAND, _DATA, _RESPONSE, _EVENT = 1, 2, 3, 4
_UNKNOWN: Final = 0xFFFF_FFFF
_LARGEST_OUT: Final = 1 << 20
_VENDORS: Final = {
    "generic": (0x1209, 0x5645),
    "eos-new": (0x04A9, 0x32B4),
    "eos-old": (0x04A9, 0x3110),
    "nikon": (0x04B0, 0x0430),
    "sony": (0x054C, 0x0D18),
}
"""USB numbers: of a test vendor, the EOS 1300D, the EOS 400D, the D7100 and the ILCE-7RM4."""


@dataclass(slots=True)
class UsbCameraFaults(FaultCounts):
    """Knobs of the pipes; ``CameraFaults`` has the others. Counts go down as they are used.

    ``stall_in``, ``stall_out``: that many transfers end with a halted pipe; ``split_headers``: the header of data
    comes in a packet of its own; ``zero_packets``: transfers of whole packets end with an empty one, as they should;
    ``unready``: its status is busy until it is reset; ``unknown_lengths``: data containers say 0xFFFFFFFF;
    ``lost_interrupts``: that many events never come; ``away_s``: how long it stays away when a fault drops it.
    """

    stall_in: int = 0
    stall_out: int = 0
    split_headers: bool = False
    zero_packets: bool = True
    unknown_lengths: bool = False
    lost_interrupts: int = 0
    unready: bool = False
    away_s: float = 0.05


@dataclass(frozen=True, slots=True)
class _Request:
    """One operation, and in which life of the connection it was asked."""

    number: int
    life: int
    code: int
    transaction: int
    parameters: tuple[int, ...]
    data: bytes


class EmulatedUsbCamera(EmulatedUsbDevice):
    """See ``EmulatedUsbDevice``; arguments as for ``lab.emulated.cameras.camera.EmulatedPtpCamera``.

    ``usb_serial`` False: the USB descriptor tells no serial number, as on older bodies.
    """

    interface_class = (6, 1, 1)
    endpoints = (Endpoint(IN, BULK, _PACKET), Endpoint(OUT, BULK, _PACKET), Endpoint(EVENTS, INTERRUPT, 64))

    def __init__(
        self,
        expose: Expose,
        *,
        flavour: Flavour = "generic",
        names: CameraNames | None = None,
        time_scale: float = 1.0,
        raw: bool = True,
        usb_serial: bool = True,
    ) -> None:
        says = names or BODIES[flavour].usual_names
        super().__init__(UsbNames(*_VENDORS[flavour], says.maker, says.model, says.serial if usb_serial else ""))
        self.body: EmulatedBody = BODIES[flavour](expose, names=names, time_scale=time_scale, raw=raw)
        self.camera_faults = self.body.faults
        self.pipe_faults = UsbCameraFaults()
        self.body.on_event = self._event
        self.body.on_drop = self.drop
        self._work: queue.SimpleQueue[_Request | None] = queue.SimpleQueue()
        self._life = 0
        self._requests: Counter[int] = Counter()
        self._count = self._cancelled = 0
        self._asked: tuple[int, int, tuple[int, ...]] | None = None
        self._received = bytearray()
        threading.Thread(target=self._serve, daemon=True).start()

    def last_exposure_s(self) -> float:
        """How long the shutter was open for the last picture."""
        return self.body.last_exposure_s

    def camera_off_and_on(self) -> None:
        """Its switch: settings are as after that, the card keeps its pictures."""
        self.body.power_on()

    def plugged(self) -> None:
        """Power of the bus, or a reset: a new life, but the card and the shutter stay as they are."""
        super().plugged()
        self._life += 1
        self._asked = None
        self._received.clear()
        self._work.put(None)

    def drop(self) -> None:
        """Leave the bus as a loose cable does, and come back at another address."""

        def away() -> None:
            self.pull()
            time.sleep(self.pipe_faults.away_s)
            self.push()

        threading.Thread(target=away, daemon=True).start()

    def asked(self, request: int) -> int:
        """How often a class request has come."""
        return self._requests[request]

    def class_request(self, setup: SetupPacket, data: bytes) -> bytes:
        self._requests[setup.request] += 1
        match setup.request_type, setup.request:
            case 0x21, 0x64:
                self._cancelled = self._count  # all that was asked so far; its transaction numbers will come again
                self.pipes[IN].clear()
                return b""
            case 0x21, 0x66:
                self.pipe_faults.unready = False
                self.plugged()
                return b""
            case 0xA1, 0x67:
                return struct.pack("<HH", 4, BUSY if self.pipe_faults.unready else OK)
            case _:
                raise Stall

    def out(self, endpoint: int, data: bytes) -> None:
        if self.pipe_faults.take("stall_out"):
            raise Stall
        self._received += data
        if len(self._received) > _LARGEST_OUT:
            raise Stall
        while len(self._received) >= _HEADER.size:
            length, kind, code, transaction = _HEADER.unpack_from(self._received)
            if length < _HEADER.size or len(self._received) < length:
                return
            body = bytes(self._received[_HEADER.size : length])
            del self._received[:length]
            self._container(kind, code, transaction, body)

    def _container(self, kind: int, code: int, transaction: int, body: bytes) -> None:
        if kind == _COMMAND:
            parameters = struct.unpack(f"<{len(body) // 4}I", body)
            self._asked = (code, transaction, parameters)
            if code not in self.body.with_data:
                self._put(b"")
        elif kind == _DATA and self._asked and self._asked[0] in self.body.with_data and self._asked[1] == transaction:
            self._put(body)
        else:
            raise Stall

    def _put(self, data: bytes) -> None:
        assert self._asked is not None
        code, transaction, parameters = self._asked
        self._count += 1
        self._work.put(_Request(self._count, self._life, code, transaction, parameters, data))

    def _serve(self) -> None:
        """The camera's processor: one request after another, away from the bus' own threads."""
        while True:
            request = self._work.get()
            if request is None:
                self.body.disconnected()
            elif request.life == self._life:
                self._hold_back(request.life)
                try:
                    self._reply(request, self.body.answer(request.code, request.parameters, request.data))
                except Gone:
                    self.drop()

    def _hold_back(self, life: int) -> None:
        if self.camera_faults.slow_s:
            time.sleep(self.camera_faults.slow_s)
        while self.camera_faults.silent and life == self._life:
            time.sleep(0.01)

    def _reply(self, request: _Request, outcome: PtpOutcome) -> None:
        if self.camera_faults.take("garbage"):
            self._offer(request, bytes(range(7, 71)))
            return
        if outcome.data is not None:
            large = len(outcome.data) > 1000
            if large and self.camera_faults.take("drop_in_transfer"):
                self._data(request, outcome.data[: len(outcome.data) // 2], announce=len(outcome.data))
                raise Gone
            wrong = 7 if large and self.camera_faults.take("wrong_lengths") else 0
            self._data(request, outcome.data, announce=len(outcome.data) + wrong)
        count = len(outcome.parameters)
        answer = _HEADER.pack(12 + 4 * count, _RESPONSE, outcome.code, request.transaction)
        self._offer(request, answer + struct.pack(f"<{count}I", *outcome.parameters))

    def _data(self, request: _Request, data: bytes | memoryview, *, announce: int) -> None:
        length = _UNKNOWN if self.pipe_faults.unknown_lengths else 12 + announce
        header = _HEADER.pack(length, _DATA, request.code, request.transaction)
        if self.pipe_faults.split_headers:
            self._offer(request, header)
            self._offer(request, data)
            return
        first = header + bytes(data[: _PACKET - 12])
        rest = memoryview(data)[_PACKET - 12 :]
        self._offer(request, first, whole=not rest)
        if rest:
            self._offer(request, rest)

    def _offer(self, request: _Request, data: bytes | memoryview, *, whole: bool = True) -> None:
        with self.lock:
            if request.life != self._life or request.number <= self._cancelled:
                return
            if self.pipe_faults.take("stall_in"):
                self.pipes[IN].halted = True
            self.send(IN, data, whole=whole and self.pipe_faults.zero_packets)

    def _event(self, code: int, parameters: tuple[int, ...]) -> None:
        if not self.pipe_faults.take("lost_interrupts"):
            count = len(parameters)
            self.send(EVENTS, _HEADER.pack(12 + 4 * count, _EVENT, code, 0) + struct.pack(f"<{count}I", *parameters))


def numbered_camera(size: int = 300_000, serial: str = "", **settings: object) -> EmulatedUsbCamera:
    """A camera whose n-th picture is ``picture(n, size)``, for tests that know what to expect."""
    made: list[EmulatedUsbCamera] = []

    def expose(shot: ShotSettings) -> ShotFiles:
        return numbered_files(made[0].body.exposures, size, shot)

    flavour = settings.get("flavour", "generic")
    if serial:
        shown = BODIES[flavour].usual_names  # type: ignore[index]
        settings["names"] = CameraNames(shown.maker, shown.model, serial, shown.firmware)
    made.append(EmulatedUsbCamera(expose, **settings))  # type: ignore[arg-type]
    return made[0]


def numbered_files(number: int, size: int, shot: ShotSettings) -> ShotFiles:
    """The files of a picture whose content is its number, over and over."""
    stamp = b"%08d" % number
    content = stamp * (size // len(stamp))
    return ShotFiles(
        raw=b"II*\0" + content if shot.raw else None,
        jpeg=b"\xff\xd8" + content + b"\xff\xd9" if shot.jpeg else None,
    )


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
        # A camera that never asked: only a connection ends the wait for one.
        with contextlib.suppress(OSError):
            Client(str(self._listener.address), "AF_UNIX").close()
        self._thread.join()
        self._listener.close()


def stage_camera(exposures: str, serial: str, *, raw: bool = True) -> EmulatedUsbCamera:
    """A camera whose pictures are those of the stage; its arguments are what ``ExposureServer.camera`` tells."""
    turn = threading.Lock()
    bench: list[Connection] = []

    def expose(settings: ShotSettings) -> ShotFiles:
        with turn:
            if not bench:
                bench.append(Client(exposures, "AF_UNIX"))
            bench[0].send_bytes(json.dumps(dataclasses.asdict(settings)).encode())
            found, shown = bench[0].recv_bytes(), bench[0].recv_bytes()
        return ShotFiles(raw=found or None, jpeg=shown or None)

    # The world behind it spends the exposure time itself, since it must know what is visible meanwhile.
    return EmulatedUsbCamera(expose, names=CameraNames(serial=serial), time_scale=0.0, raw=raw)
