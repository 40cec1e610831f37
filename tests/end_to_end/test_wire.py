"""What Wireshark sees of a house with a stage, and of a stage with players on other computers: nothing secret."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import subprocess
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from PIL import Image

from controller.kiosk.operations.dispatch import CALLER
from controller.kiosk.store import archive
from hal.deadline import in_seconds
from plugins.display.player import PlayerDisplay
from tests.controller.kiosk.house import test_house
from tests.controller.kiosk.install.test_update import debian_package
from tests.controller.play.conftest import write_noise
from tests.controller.play.wire import noise
from tests.controller.stage.hosts import computers as several
from tests.ports import free_port
from tests.waiting import eventually, wait_for

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.geteuid() != 0, reason="only root may hear a network; CI is root"),
]
PASSWORD: Final = "swordfish of the mains"
PART_BYTES: Final = 24
"""Of a secret; by chance so many bytes are nowhere."""
_HEX: Final = re.compile("([0-9a-f]{2})+")


class Heard:
    """All that passed at these ports of the loopback, in a file that ``tshark`` writes and reads."""

    def __init__(self, file: Path, ports: Sequence[int]) -> None:
        self._file, self._ports = file, ports

    def read(self, *words: str) -> list[str]:
        """Lines of tshark about it. The ports are named to it as those of TLS, because they are no usual ones."""
        tls = [word for port in self._ports for word in ("-d", f"tcp.port=={port},tls")]
        done = subprocess.run(["tshark", "-r", self._file, *tls, *words], capture_output=True, text=True, check=True)
        return done.stdout.splitlines()

    def streams(self) -> list[bytes]:
        """The bytes of each connection, in both directions in the order in which they came."""
        numbers = sorted(set(self.read("-Y", "tcp.len>0", "-T", "fields", "-e", "tcp.stream")), key=int)
        return [self._stream(number) for number in numbers]

    def _stream(self, number: str) -> bytes:
        rows = self.read("-q", "-z", f"follow,tcp,raw,{number}")
        assert not [row for row in rows if "missing in capture" in row]
        return b"".join(bytes.fromhex(row.strip()) for row in rows if _HEX.fullmatch(row.strip()))


@contextlib.contextmanager
def listening(file: Path, ports: Sequence[int]) -> Iterator[Heard]:
    """While this is open tshark hears these ports; afterwards it can be asked. Nothing is missing in between: it has
    written what was sent before and after that.
    """
    marks = free_port()
    heard = " or ".join((*(f"tcp port {port}" for port in ports), f"udp port {marks}"))
    words = ["tshark", "-i", "lo", "-B", "64", "-f", heard, "-w", str(file)]
    with socket.socket(type=socket.SOCK_DGRAM) as sender, subprocess.Popen(words, stderr=subprocess.DEVNULL) as tshark:

        def marked(mark: bytes) -> bool:
            sender.sendto(mark, ("127.0.0.1", marks))
            return file.exists() and mark in file.read_bytes()

        try:
            wait_for(lambda: marked(b"the begin of it all"))
            yield Heard(file, ports)
            wait_for(lambda: marked(b"the end of it all"))
        finally:
            tshark.terminate()


def test_nothing_secret_passes_between_a_house_and_its_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ports = [free_port(), free_port()]
    monkeypatch.setattr(test_house, "free_port", iter(ports).__next__)
    CALLER.set("vera the operator")
    with listening(tmp_path / "house.pcapng", ports) as heard:
        museum = test_house.Museum(tmp_path, {}, ("vase",))
        with museum.stack:
            stage, kiosk = tmp_path / "vase" / "stage", museum.kiosks["vase"]
            with (stage / "stage.toml").open("a") as settings:
                settings.write(f"\n# {PASSWORD}\n")
            monkeypatch.setattr(kiosk, "backup", lambda **_: archive.backup(stage))
            backup = museum.house.fetch_backup("vase")
            museum.house.do("vase", "play", name="warm wood")
            target = tmp_path / "target.png"
            Image.fromarray(np.random.default_rng(1).integers(0, 256, (30, 40, 3), np.uint8)).save(target)
            museum.house.do("vase", "compute", target=target, name="autumn", fit="fit")
            package = debian_package(tmp_path, "2-1").rename(tmp_path / "house/update.deb")
            museum.house.update("vase")
            wait_for(lambda: museum.recorded and "No key that this computer trusts" in museum.recorded[-1][1])
            wait_for(lambda: museum.house.picture("vase"))
            picture = museum.house.picture("vase")
    assert picture is not None
    streams = heard.streams()
    secrets = {path.name: path.read_bytes() for path in (backup, target, package)} | {"picture": picture}
    assert _size(*streams) > sum(map(_size, secrets.values())), "they have passed"
    secrets |= {path.name: path.read_bytes() for path in (tmp_path / "house/keys").rglob("*.pem")}
    secrets |= {path.name: path.read_bytes() for path in (stage / "keys").rglob("*.pem")}
    assert len(secrets) > 6, "certificates and keys of both are looked for"
    said = [PASSWORD, "warm wood", "marble", "vera the operator", "PRIVATE KEY", "member/vase"]
    assert _found(streams, secrets, said) == []
    assert any(b"join/hello" in stream for stream in streams), "the join begins in the clear, by SPAKE2"
    _only_tls_13(heard, ports[0])


def test_nothing_secret_passes_between_a_stage_and_its_players(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ports = [free_port(), free_port()]
    monkeypatch.setattr(several, "free_port", iter(ports).__next__)
    computers = several.Computers(tmp_path, ["left"], None)
    computers.bundle = write_noise(tmp_path / "b.vel", outputs=computers.outputs)
    pictures = noise(computers.outputs, 11)
    with listening(tmp_path / "players.pcapng", ports) as heard, several.running(computers):
        display = PlayerDisplay(computers.socket, None)
        try:
            display.show(pictures, deadline=in_seconds(10))
            assert eventually(lambda: list((computers.place("left") / "bundles").glob("*.whole")))
        finally:
            display.close()
    streams = heard.streams()
    secrets = {"bundle": computers.bundle.read_bytes(), "pattern": pictures["left"].tobytes()}
    assert _size(*streams) > sum(map(_size, secrets.values())), "they have passed"
    secrets |= {path.name: path.read_bytes() for path in tmp_path.glob("keys*/**/*.pem")}
    assert len(secrets) > 4
    assert _found(streams, secrets, ["PRIVATE KEY", "appearance"]) == []
    _only_tls_13(heard, ports[0])


def _size(*data: bytes) -> int:
    """Without what a link would save by compressing it."""
    return sum(len(zlib.compress(one, 9)) for one in data)


def _found(streams: Sequence[bytes], secrets: dict[str, bytes], said: Sequence[str]) -> list[str]:
    """Those of which a part, or the words, passed in the clear."""
    parts = {name: [data[at : at + PART_BYTES] for at in range(0, len(data), 997)] for name, data in secrets.items()}
    parts |= {words: [words.encode()] for words in said}
    whole = b"\0".join(streams)
    return [name for name, its in parts.items() if any(len(part) > 6 and part in whole for part in its)]


def _only_tls_13(heard: Heard, port: int) -> None:
    """Every connection at this port is TLS 1.3 from its first byte, and tshark can read no certificate of it."""
    at_port = f"tcp.port=={port}"
    connections = set(
        heard.read("-Y", f"{at_port} && tcp.len>0 && tcp.srcport=={port}", "-T", "fields", "-e", "tcp.stream")
    )
    chosen = heard.read("-Y", f"{at_port} && tls.handshake.type==2", "-T", "fields", "-e", "tcp.stream", "-e",
                        "tls.handshake.extensions.supported_version")  # fmt: skip
    assert {tuple(row.split("\t")) for row in chosen} == {(stream, "0x0304") for stream in connections}
    assert heard.read("-Y", f"{at_port} && tls.handshake.certificate") == []
