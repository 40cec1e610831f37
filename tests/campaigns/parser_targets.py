"""Every parser that reads what a device, a network or a file says, with sound inputs to begin from."""

from __future__ import annotations

import base64
import json
import struct
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from sacn import DataPacket

from controller.bundle import format as bundle_format
from controller.bundle.index import parse_index
from controller.config import load_stage
from controller.core.errors import BundleError, UsageError
from controller.kiosk.building import artnet, osc
from controller.kiosk.building import pjlink as pjlink_stage
from controller.kiosk.building.sacn import SacnOptions, frame_of
from hal.codecs import hid as hid_reports
from hal.codecs.projectors import logins, pjlink, serial_protocol
from hal.codecs.projectors.profiles import parse_profile
from hal.codecs.projectors.serial_protocol import (
    command_bytes,
    head_bytes,
    parse_hours,
    parse_line,
    query_bytes,
    rest_bytes,
)
from hal.codecs.ptp import eos as ptp_eos
from hal.codecs.ptp import ip as ptp_ip
from hal.codecs.ptp import usb as ptp_usb
from hal.codecs.ptp import values as ptp
from hal.codecs.ptp.datasets import DeviceInfo, ObjectInfo, PropertyDescription, StorageInfo
from hal.errors import DeviceBusy, DeviceRefused, ProtocolError
from lab.emulated.projectors.boards import BOARDS
from lab.emulated.projectors.dousers import read_levels
from lab.emulated.tape import parse_tape, unescaped
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming
from plugins.projectors.profile_files import load_profile, shipped_profiles

FOLDER = Path(__file__).parents[2] / "firmware_configs" / "projectors"
PTP_NUMBERS = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 0x4002, 0x4004, 0x4006, 0xFFFF)


@dataclass(frozen=True)
class Target:
    """A parser of bytes; ``refuses``: what it may raise, and nothing else."""

    parse: Callable[[bytes], object]
    seeds: tuple[bytes, ...]
    refuses: tuple[type[Exception], ...] = (ProtocolError,)
    most_bytes: int = 4096


def targets(folder: Path) -> dict[str, Target]:
    """Every parser by name; ``folder`` is where those that read files find them."""
    return {
        "ptp-containers": Target(_ptp_container, _containers()),
        "ptp-datasets": Target(_ptp_dataset, _datasets()),
        "ptp-ip": Target(_ptp_ip, _packets()),
        "eos-records": Target(_eos, _records()),
        "serial-answers": Target(_serial, _answers()),
        "pjlink-answers": Target(_pjlink, tuple(bytes([n]) + answer for n, answer in enumerate(_PJLINK))),
        "logins": Target(_login, _GREETINGS, (ProtocolError, DeviceRefused, DeviceBusy)),
        "frames": Target(_frame, tuple(bytes([n]) + bytes.fromhex("fe0106a9020a") for n in range(len(_FRAMES)))),
        "sacn": Target(_sacn, _levels(), (), 700),
        "osc": Target(lambda data: list(osc.requests(data)), (osc.message("play", "marble", 2.5),), ()),
        "pjlink-questions": Target(_pjlink_asked, (b"%1POWR ?\r", b"%2INPT 31\r"), ()),
        "art-net": Target(artnet.read, _ARTNET, ()),
        "json-rpc": Target(_json_rpc, _JSON_RPC),
        "escapes": Target(lambda data: unescaped(data.decode("latin-1")), (b"on\\r\\x00\\\\",)),
        "pjlink-udp": Target(pjlink.parse_datagram, (b"%2ACKN=00:11:22:aa:bb:cc\r", b"%2ERST=000000\r%2POWR=1\r")),
        "tape": Target(_tape, _TAPES),
        "hid-reports": Target(_hid, _REPORTS),
        "bundle-index": Target(_index, (json.dumps(_INDEX).encode(),), (BundleError,)),
        "bundle-header": Target(_header, (bytes(128), bundle_format.MAGIC + bytes(120)), (BundleError,)),
        "profile-toml": Target(
            _profile, tuple((FOLDER / f"{n}.toml").read_bytes() for n in ("nec", "sanyo", "benq")), (ProtocolError,)
        ),
        "stage-toml": Target(partial(_stage, folder / "stage.toml"), (STAGE.encode(),), (UsageError,)),
    }


def _ptp_container(data: bytes) -> None:
    parsers = (ptp_usb.parse_header, ptp_usb.parse_parameters, ptp_usb.parse_event, ptp_usb.parse_status)
    parsers[data[0] % 4 if data else 0](data[1:])


def _ptp_dataset(data: bytes) -> None:
    if not data:
        return
    which, rest = data[0] % 6, data[1:]
    if which == 5:
        ptp.parse_handles(rest)
    elif which == 4 and rest:
        from hal.codecs.ptp.datasets import parse_value

        parse_value(rest[1:], PTP_NUMBERS[rest[0] % len(PTP_NUMBERS)])
    else:
        (DeviceInfo, ObjectInfo, StorageInfo, PropertyDescription, DeviceInfo)[which].parse(rest)


def _ptp_ip(data: bytes) -> None:
    if len(data) >= 8:
        ptp_ip.parse_header(data[:8])
    if data:
        ptp_ip.parse(data[0] % 16, data[1:])


def _eos(data: bytes) -> None:
    if data[:1] == b"v":
        ptp_eos.parse_view(data[1:])
    elif data[:1] == b"f":
        ptp_eos.parse_image_format(data[1:])
    else:
        ptp_eos.parse_records(data[1:])


_FAMILIES: Final = {
    name: table for name in shipped_profiles() if (table := load_profile(name, Path()).serial) is not None
}
_TABLES: Final = list(_FAMILIES.values())


def _serial(data: bytes) -> None:
    """The first byte is a family, the second a question of it, or a command."""
    if len(data) < 2:
        return
    table = _TABLES[data[0] % len(_TABLES)]
    queries = [None, *table.queries.values()]
    query = queries[data[1] % len(queries)]
    sent = command_bytes(table, next(iter(table.commands)), "00") if query is None else query_bytes(table, query, "00")
    meaning = parse_line(table, data[2:], query, sent=sent)
    value = getattr(meaning, "value", None)
    if query is table.queries.get("lamp_hours") and query is not None and isinstance(value, str):
        parse_hours(value, query.per_hour)


_PJLINK = (
    b"PJLINK 1 498e4a67\r",
    b"%1POWR=1\r",
    b"%1ERST=012000\r",
    b"%1LAMP=22 1 0 0\r",
    b"%1INPT=31\r",
    b"%1INST=11 31 32\r",
    b"%1AVMT=31\r",
    b"%1INF1=maker\r",
    b"%1CLSS=2\r",
)


def _pjlink(data: bytes) -> None:
    if not data:
        return
    names = ("POWR", "ERST", "LAMP", "INPT", "INST", "AVMT", "INF1", "CLSS")
    readers: tuple[Callable[[str], object], ...] = (
        pjlink.parse_power, pjlink.parse_errors, pjlink.parse_lamps, pjlink.parse_input, pjlink.parse_inputs,
        pjlink.parse_mute, pjlink.parse_text, pjlink.parse_class,
    )  # fmt: skip
    which = data[0] % 9
    if which == 0:
        pjlink.parse_greeting(data[1:])
        return
    told = pjlink.parse_answer(data[1:], names[which - 1])
    if isinstance(told, str):
        readers[which - 1](told)


_REPORTS = (
    b"\x03\0BITFT\0\0\x03",
    b"\x01" + bytes([1, 3, 0, 16, 0, 0, 0]),
    b"\x02" + hid_reports.SensorSettings().pack(),
)


def _tape(data: bytes) -> None:
    parse_tape(data.decode("latin-1"))


_TAPES: Final = (
    b"velatura tape 1\n0.1 + 1 serial a\n0.2 > 1 on\\r\n0.3 < 1 OK\n",
    b"velatura tape 1\n0.1 + 1 ptp a\n0.2 { 1 " + base64.b64encode(zlib.compress(bytes(300))) + b"\n",
)


def _hid(data: bytes) -> None:
    report = list(data[1:])
    match data[0] % 3 if data else 0:
        case 0:
            hid_reports.parse_state(report, 1 + (data[0] // 3) % 8 if data else 1)
        case 1:
            hid_reports.parse_reading(report)
        case _:
            hid_reports.parse_settings(report)


_INDEX = {
    "stage": "demo", "calibration": "c", "created_unix_s": 1, "revision": 1,
    "outputs": [{"name": "P1", "width_px": 8, "height_px": 4, "tile_width_px": 8, "tile_height_px": 4}],
    "appearances": [
        {"name": "a", "bands": {"P1": [[4096, 10, "00" * 8, "00" * 32]]}, "thumbnail": None, "metadata": {}}
    ],
    "schedule": [["a", 1000, 0]], "live": None, "codec": "zstd",
}  # fmt: skip


def _index(data: bytes) -> None:
    parse_index(data, data_end=1 << 20)


def _header(data: bytes) -> None:
    bundle_format.parse_header(data, file_size=len(data), trailer_bytes=8)


def _profile(data: bytes) -> None:
    parse_profile(data.decode("latin-1"))


def _stage(file: Path, data: bytes) -> None:
    file.write_bytes(data)
    load_stage(file)


def _containers() -> tuple[bytes, ...]:
    event = struct.pack("<IHHIIII", 24, 4, 0x4002, 1, 5, 0, 0)
    command = ptp_usb.pack_command(0x1001, 1, (1, 2))
    return b"\0" + command, b"\1" + command[12:], b"\2" + event, b"\3" + struct.pack("<HH", 4, 0x2001)


def _datasets() -> tuple[bytes, ...]:
    info = DeviceInfo(6, frozenset({0x1001}), frozenset({0x4002}), frozenset({0x5001}), (0x3801,), (0x3801,),
                      "maker", "model", "1", "7")  # fmt: skip
    handles = struct.pack("<III", 2, 1, 2)
    storage = StorageInfo(3, True, 1 << 30, 1 << 29, 99, "card", "label")
    return b"\0" + info.pack(), b"\2" + storage.pack(), b"\5" + handles, b"\4\x06\1\0\0\0"


def _packets() -> tuple[bytes, ...]:
    packets = (ptp_ip.Ping(), ptp_ip.StartData(1, 99), ptp_ip.Data(1, b"abc"), ptp_ip.EndData(1, b""))
    return tuple(bytes([ptp_ip.parse_header(ptp_ip.pack(one)[:8])[1]]) + ptp_ip.pack(one)[8:] for one in packets)


def _records() -> tuple[bytes, ...]:
    end = struct.pack("<II", 8, 0)
    values = struct.pack("<IIIIIII", 28, 0xC18A, 0xD103, 3, 2, 0x48, 0x50)
    return (
        b"r" + struct.pack("<IIII", 16, 0xC189, 0xD102, 0x60) + end,
        b"r" + values + end,
        b"f" + struct.pack("<IIIII", 1, 16, 1, 0, 3),
        b"v" + struct.pack("<II", 12, 1) + b"jpeg",
    )


def _answers() -> tuple[bytes, ...]:
    """What the emulated board of every family answers to every question of its profile."""
    seeds = []
    for number, (family, table) in enumerate(_FAMILIES.items()):
        board = BOARDS[family](EmulatedLamp(LampTiming(0.0, 0.0))) if family in BOARDS else None
        for at, query in enumerate(table.queries.values(), start=1):
            said = board.feed(query_bytes(table, query, "00")) if board is not None else []
            seeds += [bytes([number, at]) + line for line in said or [b"OK1\r"]]
        seeds.append(bytes([number, 0]) + b"P\r")
    return tuple(seeds)


_FRAMES: Final = [table.frame for table in _TABLES if table.frame is not None]


def _frame(data: bytes) -> None:
    """The first byte is a family whose answers carry their length."""
    if data and len(data) > (count := head_bytes(frame := _FRAMES[data[0] % len(_FRAMES)])):
        assert rest_bytes(frame, data[1 : count + 1], longest=512) <= 512


_GREETINGS: Final = (
    b"\0ESC/VP.net\x10\x03\0\0\x20\0", b"\1NTCONTROL 1 09aaaa34\r", b"\1NTCONTROL 2 09aaaa34\r", b"\x0200001\r",
    b"\x03NOKEY\r\n", b"\x03a1b2c3\r\n", b"\4ok\r\n", b"\4err_auth\r\n", b"\5PJ_OK", b"\6PJACK",
)  # fmt: skip


def _login(data: bytes) -> None:
    """The first byte is the step of a login."""
    if not data:
        return
    readers: tuple[Callable[[bytes], object], ...] = (
        lambda said: logins.escvpnet_headers(said, "left"),
        lambda said: logins.ntcontrol_command(b"QPW", logins.parse_ntcontrol_greeting(said), "admin1", "secret"),
        lambda said: logins.parse_ntcontrol_answer(said, "left"),
        lambda said: logins.adcp_proof(said, "secret", "left"),
        lambda said: logins.check_adcp_accepted(said, "left"), lambda said: logins.check_jvc_greeting(said, "left"),
        logins.jvc_accepted,
    )  # fmt: skip
    readers[data[0] % len(readers)](data[1:])


def _sacn(data: bytes) -> None:
    """Show control's reader, and that of the emulated node."""
    frame_of(data, SacnOptions())
    read_levels(data)


def _levels() -> tuple[bytes, ...]:
    packet = DataPacket(tuple(range(16)), "desk", 1, (1, 2, 3))
    return (bytes(packet.getBytes()),)


def _pjlink_asked(data: bytes) -> None:
    if (command := pjlink_stage.parse_command(data)) is not None:
        pjlink_stage.verb_for(command, ("marble", "warm wood"))


_ARTNET: Final = (
    b"Art-Net\0\0\x50\0\x0e\x01\0\x05\0\0\x04abcd", b"Art-Net\0\0\x20\0\x0e\x20\0\0\x05\0\0",
)  # fmt: skip
_JSON_RPC: Final = (
    b'{"jsonrpc":"2.0","result":{"on":[1,true,null]},"id":7}',
    b'{"jsonrpc":"2.0","error":{"code":-32601,"message":"no"},"id":7}',
)


def _json_rpc(data: bytes) -> None:
    serial_protocol.is_complete(data)
    serial_protocol.parse_message(data, serial_protocol.json_bytes("property.get system.state", 7))


STAGE = """\
[stage]
name = "demo"
[[projectors]]
name = "left"
output = "P1"
driver = "serial"
profile = "optoma-later"
port = "run/tty-left"
[camera]
driver = "ptp"
address = "ptpip:127.0.0.1:15740:15741"
iso = 100
focal_length_px = 5200.0
[display]
driver = "player"
outputs = [{name = "P1", width_px = 280, height_px = 210}]
[[relays]]
name = "cupboard"
driver = "usb-relay"
[[relays.mains]]
channel = 1
feeds = ["left"]
"""


def scratch() -> Path:
    """A folder in memory where there is one."""
    shared = Path("/dev/shm")
    return Path(tempfile.mkdtemp(prefix="velatura-parsers-", dir=shared if shared.is_dir() else None))
