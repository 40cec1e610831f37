"""The player's socket and frame file as docs/reference/player-protocol.md has them, without looking at the player."""

from __future__ import annotations

import json
import mmap
import socket
import struct
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

Pictures = dict[str, npt.NDArray[np.uint8]]


class Wire:
    """One connection to a player."""

    def __init__(self, path: Path) -> None:
        self.channel = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.channel.settimeout(10)
        self.channel.connect(str(path))
        self._lines = self.channel.makefile("rb")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._lines.close()
        self.channel.close()

    def send(self, line: bytes) -> None:
        self.channel.sendall(line)

    def receive(self) -> dict[str, Any]:
        line = self._lines.readline()
        assert line.endswith(b"\n"), "the player closed the connection"
        answer = json.loads(line)
        assert isinstance(answer, dict)
        return answer

    def ask(self, operation: str, **values: Any) -> dict[str, Any]:
        self.send(json.dumps({"id": operation, "op": operation, **values}).encode() + b"\n")
        answer = self.receive()
        assert answer["id"] == operation
        return answer

    def ended(self) -> bool:
        return self._lines.readline() == b""


class Frames:
    """A frame file mapped by someone who is not the player."""

    def __init__(self, path: Path) -> None:
        with path.open("r+b") as file:
            self.map = mmap.mmap(file.fileno(), 0)
        magic, version, count, _, _, size = struct.unpack_from("<8sIIQdQ", self.map)
        assert (magic, version, size) == (b"VELFRAME", 1, len(self.map))
        self._words = np.frombuffer(self.map, "<u8", 5)
        self._pixels = {}
        for number in range(count):
            name, width, height, offset = struct.unpack_from("<40sIIQ", self.map, 64 + 64 * number)
            assert offset % 4096 == 0
            pixels = np.frombuffer(self.map, np.uint8, width * height * 3, offset).reshape(height, width, 3)
            self._pixels[name.rstrip(b"\0").decode()] = pixels

    @property
    def sequence(self) -> int:
        return int(self._words[2])

    @property
    def presented_at(self) -> float:
        return float(self._words[3:4].view("<f8")[0])

    def read(self) -> Pictures:
        """One whole set."""
        while True:
            before = self.sequence
            pictures = {name: pixels.copy() for name, pixels in self._pixels.items()}
            if before % 2 == 0 and self.sequence == before:
                return pictures

    def write(self, pictures: Pictures) -> int:
        self._words[2] |= 1
        for name, pixels in self._pixels.items():
            pixels[...] = pictures.get(name, np.uint8(0))
        self._words[2] += 1
        return self.sequence


def noise(outputs: list[tuple[str, int, int]], seed: int) -> Pictures:
    random = np.random.default_rng(seed)
    return {name: random.integers(0, 256, (height, width, 3), dtype=np.uint8) for name, width, height in outputs}


def same(found: Pictures, expected: Pictures) -> bool:
    return found.keys() == expected.keys() and all(np.array_equal(found[name], expected[name]) for name in found)


def dark(pictures: Pictures) -> bool:
    return not any(picture.any() for picture in pictures.values())
