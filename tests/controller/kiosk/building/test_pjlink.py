"""The stage as one PJLink class 2 projector, judged by three clients by other authors."""

from __future__ import annotations

import contextlib
import json
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeAlias

import pytest
from aiopjlink import PJLinkERR3, PJLinkPassword
from hypothesis import given, settings
from hypothesis import strategies as st
from pypjlink import MUTE_AUDIO, MUTE_VIDEO
from pypjlink import Projector as PyPjLink
from pypjlink.projector import ProjectorError

from controller.kiosk.building import pjlink as lines
from controller.kiosk.building.protocol import read, serving
from controller.kiosk.state import KioskState
from hal.codecs.projectors.pjlink import second_level_digest
from tests.aiopjlink_client import talk
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.npm import needs_npm, run_node
from tests.ports import kept_port
from tests.waiting import wait_for

PASSWORD = "JBMIAProjectorLink"


@contextlib.contextmanager
def stage(kiosk: MemoryKiosk, folder: Path, password: str = "", more: str = "") -> Iterator[int]:
    """The port of the served stage."""
    (folder / "password").write_text(password + "\n")
    with kept_port() as port:
        text = f"[pjlink]\nport = {port}\n{more}"
        (folder / "building.toml").write_text(text + (f'password_file = "{folder}/password"\n' if password else ""))
        with serving(kiosk, read(folder)):
            wait_for(lambda: listens(port))
            yield port


def listens(port: int) -> bool:
    with socket.socket() as trial:
        return trial.connect_ex(("127.0.0.1", port)) == 0


def test_aiopjlink_drives_the_stage(kiosk: MemoryKiosk, tmp_path: Path) -> None:
    async def drive(link: Any) -> None:
        sources = link.sources
        assert (await link.power.get()).name == "ON"
        named = await sources.available_with_names()
        assert [name for *_, name in named] == ["Playlist", "marble", "warm wood"]
        assert (await sources.get())[1] == "1"
        await sources.set(sources.Mode.VIDEO, 1)
        assert kiosk.snapshot().in_turn
        assert await sources.get() == (sources.Mode.VIDEO, "1")
        await sources.set(sources.Mode.DIGITAL, 2)
        assert kiosk.snapshot().playing == "warm wood"
        await link.mute.both(True)
        assert kiosk.snapshot().black
        assert await link.mute.status() == (True, True)
        await link.mute.both(False)
        assert not kiosk.snapshot().black
        await link.freeze.set(True)
        assert kiosk.snapshot().paused
        assert await link.freeze.get()
        lamps = await link.lamps.status()
        assert [(hours, state.name) for hours, state in lamps] == [(1204, "ON"), (3120, "OFF")]
        found = {category.name: level.name for category, level in (await link.errors.query()).items()}
        assert found["LAMP"] == "WARN"
        assert set(found.values()) == {"OK", "WARN"}
        assert await link.info.projector_name() == "Head of a boy"
        assert await link.info.manufacturer_name() == "Velatura"
        await link.power.turn_off()
        assert (await link.power.get()).name == "COOLING"
        with pytest.raises(PJLinkERR3):
            await link.freeze.set(True)

    with stage(kiosk, tmp_path) as port:
        talk(f"127.0.0.1:{port}", drive)
    assert kiosk.recorded[1] == ("done-by", "PJLink (127.0.0.1): Show this appearance now (warm wood).")


def test_pypjlink2_drives_the_stage_with_a_password(kiosk: MemoryKiosk, tmp_path: Path) -> None:
    with stage(kiosk, tmp_path, PASSWORD) as port:
        with contextlib.closing(PyPjLink.from_address("127.0.0.1", port, timeout=20)) as link:
            assert link.authenticate(PASSWORD) is True
            assert link.get_power() == "on"
            assert link.get_inputs() == [("VIDEO", 1), ("DIGITAL", 1), ("DIGITAL", 2)]
            link.set_input("DIGITAL", 2)
            assert link.get_input() == ("DIGITAL", 2)
            link.set_mute(MUTE_VIDEO | MUTE_AUDIO, True)
            assert link.get_mute() == (True, True)
            with pytest.raises(ProjectorError):
                link.set_input("DIGITAL", 7)
            assert (link.get_manufacturer(), link.get_name()) == ("Velatura", "Head of a boy")
            assert link.get_lamps() == [(1204, True), (3120, False)]
            link.set_power("off")
            assert link.get_power() == "cooling"
        with contextlib.closing(PyPjLink.from_address("127.0.0.1", port, timeout=20)) as link:
            assert link.authenticate("wrong") is False


@needs_npm
def test_the_npm_client_drives_the_stage_with_a_password(kiosk: MemoryKiosk, tmp_path: Path) -> None:
    def told(password: str) -> list[list[Any]]:
        done = run_node(Path(__file__).with_name("pjlink_client.js"), str(port), password)
        return [json.loads(line) for line in done.splitlines()]

    with stage(kiosk, tmp_path, PASSWORD) as port:
        assert told("wrong")[0] == ["getPowerState", "Authorization failed"]
        assert kiosk.snapshot().state == "playing"
        found = told(PASSWORD)
    inputs = [{"source": 2, "channel": 1, "code": "21", "name": "VIDEO - 1"}]
    inputs += [{"source": 3, "channel": n, "code": f"3{n}", "name": f"DIGITAL - {n}"} for n in (1, 2)]
    silent = {"audio": True, "video": True}
    assert found == [
        ["getPowerState", None, 1],
        ["getClass", None, "2"],
        ["getName", None, "Head", "of", "a", "boy"],  # the client splits every answer at its spaces
        ["getManufacturer", None, "Velatura"],
        ["getInputs", None, inputs],
        ["getLamps", None, [{"hours": 1204, "on": True}, {"hours": 3120, "on": False}]],
        ["getErrors", None, dict.fromkeys(("fan", "temperature", "cover", "filter", "other"), False)
         | {"lamp": "warning"}],
        ["setInput", None],
        ["getInput", None, inputs[2]],
        ["setInput", "Out of parameter"],
        ["setMute", None],
        ["getMute", None, silent],
        ["setMute", None],
        ["getMute", None, dict.fromkeys(silent, False)],
        ["powerOff", None],
        ["getPowerState", None, 2],
    ]  # fmt: skip
    assert ("done-by", "PJLink (127.0.0.1): Show this appearance now (warm wood).") in kiosk.recorded


def test_a_wrong_password_is_refused_and_changes_nothing(kiosk: MemoryKiosk, tmp_path: Path) -> None:
    with stage(kiosk, tmp_path, PASSWORD) as port:
        with pytest.raises(PJLinkPassword):
            talk(f"127.0.0.1:{port}", lambda link: link.power.turn_off(), "wrong")
        talk(f"127.0.0.1:{port}", lambda link: link.power.get(), PASSWORD)
    assert kiosk.snapshot().state == "playing"


def test_the_password_check_of_version_two(kiosk: MemoryKiosk, tmp_path: Path) -> None:
    with stage(kiosk, tmp_path, PASSWORD) as port, socket.create_connection(("127.0.0.1", port), 20) as link:
        file = link.makefile("rb")

        def line() -> bytes:
            found = b""
            while not found.endswith(b"\r"):
                found += file.read(1)
            return found

        assert line().startswith(b"PJLINK 1 ")
        link.sendall(b"PJLINK 2\r")
        salt = bytes.fromhex(line().split()[2].decode())
        link.sendall(second_level_digest(salt, bytes(range(16)), PASSWORD) + b"%2POWR ?\rnonsense\r%1FREZ ?\r")
        assert [line(), line(), line()] == [b"%2POWR=1\r", b"%1ERR1\r", b"%1FREZ=ERR1\r"]


def first_line(link: socket.socket) -> bytes:
    found = b""
    while not found.endswith(b"\r"):
        found += link.recv(1) or b"\r"
    return found


Seen: TypeAlias = tuple[bytes, bytes, bytes]


def second_level(port: int, copied: Seen | None = None) -> tuple[bytes, Seen]:
    """Log in by SHA-256, or as somebody who saw the random numbers and the digest of another log-in; returns the
    answer and what could be seen.
    """
    with socket.create_connection(("127.0.0.1", port), 20) as link:
        first_line(link)
        link.sendall(b"PJLINK 2\r")
        salt = bytes.fromhex(first_line(link).split()[2].decode())
        if copied is None:
            ours = bytes(range(16))
            sent = second_level_digest(salt, ours, PASSWORD)
        else:
            ours = bytes(a ^ b ^ c for a, b, c in zip(copied[0], copied[1], salt, strict=True))
            sent = ours.hex().encode() + copied[2][32:]
        link.sendall(sent + b"%2POWR ?\r")
        return first_line(link), (salt, ours, sent)


def test_a_login_that_was_seen_is_not_taken_again(kiosk: MemoryKiosk, tmp_path: Path) -> None:
    with stage(kiosk, tmp_path, PASSWORD) as port:
        answer, seen = second_level(port)
        assert answer == b"%2POWR=1\r"
        assert second_level(port, seen)[0] == b"PJLINK ERRA\r"
        assert second_level(port)[0] == b"%2POWR=1\r"


def test_one_who_guesses_waits_longer_each_time_and_is_logged(
    kiosk: MemoryKiosk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lines, "WRONG_S", 0.05)
    monkeypatch.setattr(lines, "GROWTH", 2.0)

    def guess(_: int) -> bytes:
        with socket.create_connection(("127.0.0.1", port), 20) as link:
            first_line(link)
            link.sendall(b"0" * 32 + b"%1POWR 0\r")
            return first_line(link)

    with stage(kiosk, tmp_path, PASSWORD) as port, ThreadPoolExecutor(4) as pool:
        began_s = time.monotonic()
        assert set(pool.map(guess, range(4))) == {b"PJLINK ERRA\r"}
        assert time.monotonic() - began_s > 0.1, "also at the same time they come one after the other"
        assert guess(0) == b"PJLINK ERRA\r"
        assert time.monotonic() - began_s > 0.5
    assert [text for code, text in kiosk.recorded if code == "pjlink-password-refused"] == [
        f"PJLink: 127.0.0.1 sent {what}." for what in
        ("a wrong password", "2 wrong passwords in a row", "4 wrong passwords in a row")
    ]  # fmt: skip
    assert kiosk.snapshot().state == "playing"


def test_a_viewer_may_only_ask(kiosk: MemoryKiosk, tmp_path: Path) -> None:
    async def drive(link: Any) -> None:
        with pytest.raises(PJLinkERR3):
            await link.power.turn_off()
        assert (await link.power.get()).name == "ON"

    with stage(kiosk, tmp_path, more='role = "viewer"\n') as port:
        talk(f"127.0.0.1:{port}", drive)


@settings(max_examples=300, deadline=None)
@given(
    st.binary(max_size=160)
    | st.builds(
        lambda head, tail: head + tail + b"\r",
        st.sampled_from([b"%1POWR ", b"%2INNM ?", b"%1INPT ", b"%1AVMT ", b"%2FREZ ", b"%1LAMP "]),
        st.binary(max_size=12),
    ),
    st.text(max_size=80),
)
def test_every_line_gets_one_line_that_is_no_more_than_the_longest(line: bytes, name: str) -> None:
    command = lines.parse_command(line.removesuffix(b"\r"))
    if command is None:
        return
    now = KioskState(1, name, "playing", "", 0.0, playing=name)
    told = lines.answer(command, now, [name], "0.1") if lines.is_question(command) else lines.verb_for(command, [name])
    if isinstance(told, str):
        answer = command.answer(told)
        assert answer.count(b"\r") == 1
        assert len(answer) <= 136


def test_sixteen_of_twenty_clients_are_heard_and_sixteen_again_when_they_have_left(
    kiosk: MemoryKiosk, tmp_path: Path
) -> None:
    with stage(kiosk, tmp_path) as port:

        def heard() -> int:
            with contextlib.ExitStack() as stack:
                clients = [stack.enter_context(socket.create_connection(("127.0.0.1", port), 10)) for _ in range(20)]
                return sum(client.recv(64) == b"PJLINK 0\r" for client in clients)

        # Those of the call before may still be leaving.
        wait_for(lambda: heard() == 16)
        wait_for(lambda: heard() == 16)
