"""The emulated serial projector, addressed with pyserial alone and bytes copied from the manuals."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from plugins.emulated.projectors.board import OptomaBoard, OptomaQuirks
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming
from plugins.emulated.projectors.serial import EmulatedSerialProjector


@pytest.fixture
def emulator(tmp_path: Path) -> Iterator[EmulatedSerialProjector]:
    with EmulatedSerialProjector(tmp_path / "run" / "tty-left", EmulatedLamp(LampTiming(0.2, 1.5))) as made:
        yield made


def heard(line: serial.Serial, ends: int) -> bytes:
    """What comes until so many lines have ended, and whatever follows at once."""
    data = b"".join(bytes(line.read_until(b"\r")) for _ in range(ends))
    return data + bytes(line.read(line.in_waiting))


def say(port: Path, data: bytes, *, ends: int = 1) -> bytes:
    with serial.Serial(str(port), 9600, timeout=20) as line:
        line.write(data)
        return heard(line, ends)


def test_a_whole_evening_in_the_bytes_of_the_manual(emulator: EmulatedSerialProjector) -> None:
    with serial.Serial(str(emulator.port), 9600, timeout=20) as line:

        def ask(data: bytes, ends: int = 1) -> bytes:
            line.write(data)
            return heard(line, ends)

        assert ask(b"~00124 1\r") == b"OK0\r"
        assert ask(b"~0000 1\r", 2) == b"P\rINFO1\r"
        assert ask(b"~00124 1\r") == b"OK1\r"
        assert ask(b"~00108 1\r") == b"OK1200\r"
        assert ask(b"~0002 1\r") == b"P\r"
        assert ask(b"~0000 0\r", 2) == b"P\rINFO2\r"
        assert ask(b"~0000 1\r") == b"F\r"
        assert ask(b"") == b"INFO0\r"


def test_noise_before_a_command_is_forgotten(emulator: EmulatedSerialProjector) -> None:
    assert say(emulator.port, b"\xff\x00garbage~00124 1\r") == b"OK0\r"
    assert say(emulator.port, b"~00999 1\r") == b"F\r"
    assert say(emulator.port, b"hello\r") == b"F\r"


def test_a_wrong_baud_rate_carries_noise_both_ways(emulator: EmulatedSerialProjector) -> None:
    with serial.Serial(str(emulator.port), 19200, timeout=0.3) as line:
        line.write(b"~00124 1\r")
        assert b"OK" not in bytes(line.read(1000))
    with serial.Serial(str(emulator.port), 9600, timeout=20) as line:
        line.write(b"\r~00124 1\r")
        assert bytes(line.read_until(b"OK0\r")).endswith(b"OK0\r")


def test_unplugging_hangs_up_and_plugging_in_gives_another_tty(emulator: EmulatedSerialProjector) -> None:
    before = emulator.path
    with serial.Serial(str(emulator.port), 9600, timeout=1) as line:
        emulator.unplug()
        with pytest.raises(serial.SerialException):
            line.read(1)
    assert not emulator.port.is_symlink()
    emulator.replug()
    assert emulator.port.resolve() == Path(emulator.path or "")
    assert emulator.path != before
    assert say(emulator.port, b"~00124 1\r") == b"OK0\r"


def test_stopping_takes_the_port_away(tmp_path: Path) -> None:
    made = EmulatedSerialProjector(tmp_path / "tty", EmulatedLamp(LampTiming(0.2, 0.3)))
    made.start()
    made.stop()
    made.stop()
    assert list(tmp_path.iterdir()) == []


def test_some_models_acknowledge_a_question_before_they_answer_it() -> None:
    board = OptomaBoard(EmulatedLamp(LampTiming(1, 1)), quirks=OptomaQuirks(ok=b"Ok", p_first=True))
    assert board.feed(b"~00124 1\r") == [b"P\rOk0\r"]


def test_only_its_own_number_and_zero_are_answered() -> None:
    board = OptomaBoard(EmulatedLamp(LampTiming(1, 1)), number=7)
    assert board.feed(b"~07124 1\r~06124 1\r~00124 1\r") == [b"OK0\r", b"OK0\r"]


def test_trouble_is_told_once_unasked() -> None:
    lamp = EmulatedLamp(LampTiming(1, 0))
    board = OptomaBoard(lamp)
    lamp.strike()
    assert board.notices() == [b"INFO1\r"]
    lamp.overheat()
    assert board.notices() == [b"INFO0\r", b"INFO7\r"]
    assert board.notices() == []
