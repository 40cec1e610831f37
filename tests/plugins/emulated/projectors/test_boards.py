"""The emulated control boards, in the bytes that the makers' documents print."""

from __future__ import annotations

import pytest

from lab.emulated.projectors.boards_binary import Ep910Board, NecBoard
from lab.emulated.projectors.boards_marked import ChristieBoard, PanasonicBoard
from lab.emulated.projectors.boards_text import BenqBoard, BenqQuirks, EpsonBoard, EpsonQuirks, SanyoBoard
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming
from tests.plugins.emulated.conftest import Clock


@pytest.fixture
def lamp(clock: Clock) -> EmulatedLamp:
    return EmulatedLamp(LampTiming(60, 120), hours=1500.0, clock=clock)


def test_an_epsons_evening(lamp: EmulatedLamp, clock: Clock) -> None:
    board = EpsonBoard(lamp)
    assert board.feed(b"PWR?\r") == [b"PWR=00\r:"]
    assert board.feed(b"LAMP?\r") == [b"ERR\r:"]
    assert board.feed(b"PWR ON\r") == []
    assert board.notices() == []
    assert board.feed(b"PWR?\r") == [b"PWR=02\r:"]
    clock.now_s += 60
    assert board.notices() == [b":"]
    assert board.feed(b"PWR?\rLAMP?\rMUTE ON\rNONSENSE\r\r") == [b"PWR=01\r:", b"LAMP=1500\r:", b":", b"ERR\r:", b":"]
    assert lamp.shutter_closed
    assert board.feed(b"PWR OFF\r") == [b":"]
    assert board.feed(b"PWR?\rPWR ON\r") == [b"PWR=03\r:", b"ERR\r:"]
    lamp.overheat()
    clock.now_s += 120
    assert board.feed(b"PWR?\r") == [b"PWR=05\r"]


def test_an_epson_may_be_deaf_while_it_warms(lamp: EmulatedLamp, clock: Clock) -> None:
    board = EpsonBoard(lamp, EpsonQuirks(deaf_while_warming=True))
    board.feed(b"PWR ON\r")
    assert board.feed(b"PWR?\r") == []
    clock.now_s += 60
    assert board.feed(b"PWR?\r") == [b"PWR=01\r:"]


def test_a_benqs_evening(lamp: EmulatedLamp, clock: Clock) -> None:
    board = BenqBoard(lamp)
    assert board.feed(b"\r*pow=?#\r") == [b">*pow=?#\r\n*POW=OFF#\r\n"]
    assert board.feed(b"\r*POW=ON#\r") == [b">*POW=ON#\r\n*POW=ON#\r\n"]
    clock.now_s += 60
    assert board.feed(b"\r*ltim=?#\r") == [b">*ltim=?#\r\n*LTIM=1500#\r\n"]
    assert board.feed(b"\r*modelname=?#\r") == [b">*modelname=?#\r\n*MODELNAME=W1110#\r\n"]
    assert board.feed(b"\r*pow=?\r") == [b">*pow=?\r\n*Illegal format#\r\n"]
    assert board.feed(b"\r*teleport=on#\r") == [b">*teleport=on#\r\n*Unsupported item#\r\n"]
    assert board.feed(b"\r*pow=off#\r\r*pow=on#\r")[1] == b">*pow=on#\r\n*Block item#\r\n"


def test_benqs_differ_as_their_users_report(lamp: EmulatedLamp) -> None:
    board = BenqBoard(lamp, BenqQuirks(glued_in_standby=True))
    assert board.feed(b"\r*pow=?#\r") == [b">*pow=?#*POW=OFF#\r\n"]
    board = BenqBoard(lamp, BenqQuirks(echoes=2, bare_hours=True))
    assert board.feed(b"\r*ltim=?#\r") == [b">*ltim=?#\r\n*ltim=?#\r\n*LTIM= 1500\r\n"]
    board = BenqBoard(lamp, BenqQuirks(echoes=0, prompt=False, starless_in_standby=True))
    assert board.feed(b"\r*pow=?#\r") == [b"\r\nPOW=OFF#\r\n"]


def test_a_christies_evening(lamp: EmulatedLamp, clock: Clock) -> None:
    board = ChristieBoard(lamp)
    assert board.feed(b"noise(PWR?)") == [b'(PWR!000 "Standby")']
    assert board.feed(b"(PWR 1)") == []
    assert board.feed(b"(PWR?)") == [b'(PWR!011 "Warming Up")']
    assert board.notices()[0].startswith(b'(65535 00000 FYI00000 "(SST+LAMP?001)')
    clock.now_s += 60
    assert board.feed(b"(PWR?)(SHU?)(LPH?)") == [b'(PWR!001 "On")', b"(SHU!0)", b"(LPH!1500)"]
    assert board.feed(b"(#SHU 1)") == [b"(#SHU 1)"]
    assert lamp.shutter_closed
    assert board.feed(b"(SHU)") == [b'(65535 00000 ERR00005 "SHU: Too Few Parameters")']
    assert board.feed(b"(#PWR 0)(#PWR 1)")[1] == b'(65535 00000 ERR00007 "PWR: Could not be executed")'
    assert board.feed(b"(PWR?)") == [b'(PWR!010 "Cooling Down")']


def test_a_panasonics_evening(lamp: EmulatedLamp, clock: Clock) -> None:
    board = PanasonicBoard(lamp)
    assert board.feed(b"\x02Q$S\x03") == [b"\x020\x03"]
    assert board.feed(bytes.fromhex("02 50 4F 4E 03")) == [bytes.fromhex("02 50 4F 4E 03")]
    assert board.feed(b"\x02Q$S\x03") == [b"\x021\x03"]
    clock.now_s += 60
    assert board.feed(b"\x02Q$S\x03\x02Q$L\x03") == [b"\x022\x03", b"\x021500\x03"]
    assert board.feed(b"\x02OSH:1\x03\x02OSH:7\x03\x02XYZ\x03") == [
        b"\x02OSH:1\x03",
        b"\x02ER402\x03",
        b"\x02ER401\x03",
    ]
    assert board.feed(b"\x02POF\x03\x02Q$S\x03\x02PON\x03") == [b"\x02POF\x03", b"\x023\x03", b"\x02ER401\x03"]


def test_a_necs_evening_in_the_bytes_of_its_manual(lamp: EmulatedLamp, clock: Clock) -> None:
    board = NecBoard(lamp)
    standby = board.feed(bytes.fromhex("00 85 00 00 01 01 87"))[0]
    assert standby[:5] == bytes.fromhex("20 85 01 31 10")
    assert len(standby) == 22
    assert sum(standby[:-1]) & 0xFF == standby[-1]
    assert standby[10] == 0x00
    assert board.feed(b"\xff\xfe" + bytes.fromhex("02 00 00 00 00 02")) == [bytes.fromhex("22 00 01 31 00 54")]
    clock.now_s += 60
    assert board.feed(bytes.fromhex("00 85 00 00 01 01 87"))[0][10] == 0x04
    told = board.feed(bytes.fromhex("03 8A 00 00 00 8D"))[0]
    assert told[:5] == bytes.fromhex("23 8A 01 31 62")
    assert told[5 + 82 : 5 + 86] == bytes.fromhex("C0 65 52 00")  # the manual's example: 5,400,000 s are 1500 hours
    assert board.feed(bytes.fromhex("02 01 00 00 00 03"))[0][:2] == b"\x22\x01"
    assert board.feed(bytes.fromhex("02 00 00 00 00 02"))[0][:2] == b"\xa2\x00"
    assert board.feed(bytes.fromhex("02 00 00 00 00 09")) == [], "a wrong sum is no command"


def test_an_ep910_in_the_bytes_of_its_table(lamp: EmulatedLamp) -> None:
    board = Ep910Board(lamp)
    assert board.feed(b"IR04002?") == [b"IR040020"]
    assert board.feed(b"noise IR040021IR04002?") == [b"IR03002", b"IR040021"]
    assert board.feed(b"IR040027") == [b"IR0500002"]
    assert board.feed(b"IR03099") == [b"IR0500000"]
    lamp.warm_now()
    lamp.extinguish()
    assert board.feed(b"IR04002?") == [b"IR0500001"]


def test_a_sanyos_evening(lamp: EmulatedLamp, clock: Clock) -> None:
    board = SanyoBoard(lamp)
    assert board.feed(b"CR0\r") == [b"80\r"]
    assert board.feed(b"C00\r") == [b"\x06\r"]
    assert board.feed(b"CR0\r") == [b"40\r"]
    clock.now_s += 61
    assert board.feed(b"CR0\rCR3\r") == [b"00\r", b"01500\r"]
    assert board.feed(b"C0D\r") == [b"\x06\r"]
    assert lamp.shutter_closed
    assert board.feed(b"C01\r") == [b"\x06\r"]
    assert board.feed(b"CR0\rC00\r") == [b"20\r", b"?\r"]
    clock.now_s += 121
    assert board.feed(b"CR0\rC99\r") == [b"80\r", b"?\r"]


def test_a_nec_tells_its_operation_status_in_the_basic_information(lamp: EmulatedLamp, clock: Clock) -> None:
    board = NecBoard(lamp)
    question = bytes.fromhex("00 BF 00 00 01 02 C2")
    (told,) = board.feed(question)
    assert told[:2] + told[4:7] == bytes.fromhex("20 BF 10 02 00")
    assert len(told) == 22
    assert sum(told[:-1]) & 0xFF == told[-1]
    lamp.strike()
    assert board.feed(question)[0][6] == 0x04
    lamp.shutter_closed = True
    assert board.feed(question)[0][11] == 0x01
    lamp.extinguish()
    assert board.feed(question)[0][6] == 0x05


def test_a_benq_answers_an_empty_line_with_its_prompt_and_a_command_without(lamp: EmulatedLamp) -> None:
    board = BenqBoard(lamp)
    assert board.feed(b"\r") == [b">"]
    assert board.feed(b"*pow=?#\r\r") == [b"*pow=?#\r\n*POW=OFF#\r\n", b">"]
    assert BenqBoard(lamp, BenqQuirks(prompt=False)).feed(b"\r\r") == []
