"""Serial lines behind device servers by other authors: pyserial's RFC 2217 server, and Debian's ser2net."""

from __future__ import annotations

import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import pytest
import serial
from serial import rfc2217

from hal.deadline import Cancelled, in_seconds
from hal.errors import DeviceError, DeviceGone, DeviceTimeout, PluginError
from hal.registry import OpenContext
from hal.values import Power
from lab.emulated.projectors.boards import BOARDS, baud_of
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming, quick_profile
from plugins.emulated.projectors.serial import EmulatedSerialProjector
from plugins.projectors.network.device_server import parse_url
from plugins.projectors.serial import DRIVER, SerialProjector, open_serial_projector
from tests.plugins.conftest import wait_for_power
from tests.waiting import wait_for

SOON = 30.0
LAMP: Final = LampTiming(0.2, 0.3)
FAMILIES = ("optoma-later", "nec", "hitachi", "epson-escvp21")


class Line(serial.Serial):  # type: ignore[misc]
    """A serial port without modem lines, such as a pty."""

    cts = dsr = ri = cd = False

    def _update_rts_state(self) -> None:
        """There is none."""

    def _update_dtr_state(self) -> None:
        """There is none."""


class PySerialServer:
    """pyserial's ``PortManager`` on a socket, as in pyserial's own example server."""

    def __init__(self, tty: Path) -> None:
        self._tty = tty
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._stop = threading.Event()
        self._client: socket.socket | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def hang_up(self) -> None:
        if self._client is not None:
            self._client.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._stop.set()
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join(5.0)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._client, _ = self._listener.accept()
            except OSError:
                return
            line = Line(str(self._tty), timeout=0.02)
            self._serve(self._client, line)
            line.close()
            self._client.close()

    def _serve(self, client: socket.socket, line: Any) -> None:
        lock = threading.Lock()

        class Writer:
            def write(self, data: bytes) -> None:
                with lock:
                    client.sendall(data)

        manager = rfc2217.PortManager(line, Writer())
        ended = threading.Event()

        def from_line() -> None:
            while not ended.is_set():
                data = line.read(line.in_waiting or 1)
                if data:
                    try:
                        with lock:
                            client.sendall(b"".join(manager.escape(data)))
                    except OSError:
                        return

        reader = threading.Thread(target=from_line, daemon=True)
        reader.start()
        while not self._stop.is_set():
            try:
                data = client.recv(1024)
            except OSError:
                break
            if not data:
                break
            line.write(b"".join(manager.filter(data)))
        ended.set()
        reader.join(2.0)


class Ser2Net:
    """Debian's ser2net, in its own process."""

    def __init__(self, tty: Path, accepter: str, folder: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        file = folder / "ser2net.yaml"
        file.write_text(
            f"connection: &con1\n  accepter: {accepter},127.0.0.1,{self.port}\n"
            f"  connector: serialdev,{tty},9600n81,local\n  options:\n    kickolduser: true\n"
        )
        program = shutil.which("ser2net", path="/usr/sbin:/usr/bin")
        assert program is not None
        self._process = subprocess.Popen([program, "-n", "-u", "-c", str(file)], stderr=subprocess.DEVNULL)
        wait_for(self._listens)

    def _listens(self) -> bool:
        """Without connecting: it serves one client, and would be busy with this one."""
        sockets = Path("/proc/net/tcp").read_text().splitlines()
        return any(f":{self.port:04X} 00000000:0000 0A" in line for line in sockets)

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(10)


Server = PySerialServer | Ser2Net
Opened = tuple[SerialProjector, EmulatedSerialProjector, Any]


@pytest.fixture
def behind(tmp_path: Path) -> Iterator[Callable[..., Opened]]:
    """A projector of a family on a pty, a device server that has the pty, and the driver at the server's socket."""
    made: list[Any] = []

    def make(serve: Callable[[Path], Server], scheme: str, family: str = "optoma-later", baud: int = 0) -> Opened:
        lamp = EmulatedLamp(LAMP)
        wire = EmulatedSerialProjector(tmp_path / "tty", lamp, baud=baud or baud_of(family), board=BOARDS[family](lamp))
        wire.start()
        server = serve(tmp_path / "tty")
        (tmp_path / "quick.toml").write_text(quick_profile(LAMP, base=family))
        table = {"profile": "quick.toml", "port": f"{scheme}://127.0.0.1:{server.port}"}
        driver = open_serial_projector(table, OpenContext(tmp_path), in_seconds(SOON))
        made.append((driver, server, wire))
        return driver, wire, server

    yield make
    for driver, server, wire in made:
        driver.close()
        server.close()
        wire.stop()


def burns_and_goes_off(driver: SerialProjector, lamp: EmulatedLamp) -> None:
    driver.switch_on(deadline=in_seconds(SOON))
    wait_for_power(driver, Power.ON)
    assert driver.status(deadline=in_seconds(SOON)).lamp_hours == 1200
    driver.switch_off(deadline=in_seconds(SOON))
    wait_for_power(driver, Power.OFF)
    assert lamp.strikes == 1


@pytest.mark.parametrize("family", FAMILIES)
def test_pyserials_server_sets_the_rate_and_carries_every_byte(behind: Any, family: str) -> None:
    driver, wire, _ = behind(PySerialServer, "rfc2217", family)
    burns_and_goes_off(driver, wire.lamp)


def test_a_connection_that_pyserials_server_ends_is_opened_again(behind: Any) -> None:
    driver, _, server = behind(PySerialServer, "rfc2217")
    assert driver.status(deadline=in_seconds(SOON)).power is Power.OFF
    server.hang_up()
    assert driver.status(deadline=in_seconds(SOON)).power is Power.OFF


needs_ser2net = pytest.mark.skipif(
    shutil.which("ser2net", path="/usr/sbin:/usr/bin") is None, reason="ser2net is not installed"
)


@needs_ser2net
@pytest.mark.parametrize(
    ("accepter", "scheme", "family"),
    [
        ("telnet(rfc2217),tcp", "rfc2217", "nec"),
        ("telnet(rfc2217),tcp", "rfc2217", "hitachi"),
        ("tcp", "socket", "optoma-later"),
    ],
)
def test_ser2net_carries_a_projector(behind: Any, tmp_path: Path, accepter: str, scheme: str, family: str) -> None:
    driver, wire, _ = behind(lambda tty: Ser2Net(tty, accepter, tmp_path), scheme, family)
    burns_and_goes_off(driver, wire.lamp)


def test_a_server_that_is_not_there_is_told_soon(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    for scheme in ("socket", "rfc2217"):
        table = {"profile": "benq", "port": f"{scheme}://127.0.0.1:{port}"}
        with pytest.raises(DeviceGone) as caught:
            open_serial_projector(table, OpenContext(tmp_path), in_seconds(10))
        assert f"127.0.0.1:{port}" in caught.value.what


def test_a_server_without_rfc_2217_is_left_at_the_deadline(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        table = {"profile": "benq", "port": f"rfc2217://127.0.0.1:{mute.getsockname()[1]}"}
        started = time.monotonic()
        with pytest.raises((DeviceTimeout, DeviceGone)):
            open_serial_projector(table, OpenContext(tmp_path), in_seconds(0.5))
        assert time.monotonic() - started < 5.0
        stop = threading.Event()
        threading.Timer(0.2, stop.set).start()
        with pytest.raises((Cancelled, DeviceGone)):
            open_serial_projector(table, OpenContext(tmp_path), in_seconds(SOON, stop))


@pytest.mark.parametrize(
    "port", ["http://host:23", "socket://host", "socket://:23", "rfc2217://host:99999", "socket://host:23/path", "x://"]
)
def test_a_url_that_is_none_is_refused_without_a_device(tmp_path: Path, port: str) -> None:
    with pytest.raises(PluginError, match=r"socket://192"):
        parse_url(port)
    assert DRIVER.check is not None
    with pytest.raises(DeviceError):
        DRIVER.check({"profile": "benq", "port": port}, OpenContext(tmp_path))
