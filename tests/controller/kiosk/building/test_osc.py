"""OSC, judged by liblo's own programs: oscsend asks, oscdump hears the state."""

from __future__ import annotations

import json
import shutil
import socket
import struct
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pythonosc.osc_packet import OscPacket

from controller.kiosk.building.osc import Listener, OscOptions, message, named, requests, state_of
from controller.kiosk.building.protocol import read, serving
from controller.kiosk.building.verbs import Rate, Verbs
from controller.kiosk.operations.table import brightness, next_appearance
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.ports import kept_port
from tests.waiting import wait_for

(PERCENT,) = brightness.fields
(FADE,) = next_appearance.fields
LAYOUT = Path(__file__).parents[4] / "docs" / "examples" / "show-control" / "osc-layout.json"
liblo = pytest.mark.skipif(
    shutil.which("oscsend") is None or shutil.which("oscdump") is None,
    reason="needs liblo-tools (a package of the test set-up)",
)


@pytest.fixture
def port() -> Iterator[int]:
    with kept_port() as number:
        yield number


@pytest.fixture
def other_port() -> Iterator[int]:
    with kept_port() as number:
        yield number


@liblo
def test_liblo_drives_the_stage_and_hears_it(kiosk: MemoryKiosk, tmp_path: Path, port: int, other_port: int) -> None:
    (tmp_path / "building.toml").write_text(f'[osc]\nport = {port}\nfeedback = ["127.0.0.1:{other_port}"]\n')
    heard = tmp_path / "heard"

    def send(*words: str) -> None:
        subprocess.run(["oscsend", "127.0.0.1", str(port), *words], check=True)

    with heard.open("w") as file:
        dump = subprocess.Popen(["oscdump", "-L", str(other_port)], stdout=file)
        try:
            time.sleep(0.3)
            with serving(kiosk, read(tmp_path)):
                wait_for(lambda: '/velatura/playing s "marble"' in heard.read_text())
                send("/velatura/play", "sf", "warm wood", "2.5")
                wait_for(lambda: '/velatura/playing s "warm wood"' in heard.read_text())
                assert kiosk.asked[-1] == ("play", ("warm wood", 2.5))
                send("/velatura/brightness", "f", "40")
                wait_for(lambda: "/velatura/brightness f 40.0" in heard.read_text())
                send("/velatura/black", "i", "1")
                wait_for(lambda: "/velatura/black i 1" in heard.read_text())
                send("/velatura/next", "i", "0")  # let go: nothing
                send("/velatura/next", "i", "1")
                wait_for(lambda: kiosk.snapshot().playing == "marble")
                send("/velatura/close")
                wait_for(lambda: '/velatura/state s "cooling"' in heard.read_text())
                assert sum("Show the next" in what for _, what in kiosk.recorded) == 1
        finally:
            dump.terminate()
            dump.wait(10)


def test_an_asker_hears_the_state_and_refusals(kiosk: MemoryKiosk, tmp_path: Path, port: int) -> None:
    (tmp_path / "building.toml").write_text(f'[osc]\nport = {port}\nrole = "viewer"\n')
    with serving(kiosk, read(tmp_path)), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker:
        asker.settimeout(10)

        def answer() -> list[object]:
            parsed = OscPacket(asker.recv(4096)).messages[0].message
            return [parsed.address, *parsed.params]

        # The listener may not be there at once, and a datagram to no one is refused at the next call.
        asker.connect(("127.0.0.1", port))
        wait_for(lambda: _sent(asker, message("status")))
        told = {answered[0]: answered[1] for answered in [answer() for _ in range(8)]}
        assert told["/velatura/playing"] == "marble"
        assert told["/velatura/state"] == "playing"
        for verb, code in (("close", "verb-not-allowed"), ("restore", "verb-unknown")):
            asker.send(message(verb))
            assert answer()[:3] == ["/velatura/error", verb, code]
        assert kiosk.snapshot().state == "playing"


def test_a_sender_of_unknown_types_does_not_fill_the_journal(
    kiosk: MemoryKiosk, tmp_path: Path, port: int, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "building.toml").write_text(f"[osc]\nport = {port}\n")
    with serving(kiosk, read(tmp_path)), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker:
        asker.connect(("127.0.0.1", port))
        asker.settimeout(10)
        wait_for(lambda: _sent(asker, message("status")))
        asker.send(b"/velatura/brightness\0\0\0\0,pqxyz\0\0")
        # Answered after the previous one, or dropped with it.
        wait_for(lambda: b"/velatura/error" in asker.recv(4096))
    assert caplog.records == []


def _sent(asker: socket.socket, datagram: bytes) -> bool:
    asker.send(datagram)
    time.sleep(0.05)
    asker.setblocking(False)
    try:
        return bool(asker.recv(4096, socket.MSG_PEEK))
    except (BlockingIOError, ConnectionRefusedError):
        return False
    finally:
        asker.settimeout(10)


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=200) | st.binary(max_size=120).map(lambda tail: message("play", "marble", 1.5)[:24] + tail))
def test_no_datagram_raises(datagram: bytes) -> None:
    for _, verb, arguments in requests(datagram):
        assert isinstance(verb, str)
        named((PERCENT, FADE), arguments)


@settings(max_examples=100, deadline=None)
@given(st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=40), st.floats(0, 100, width=32))
def test_what_was_sent_is_read(name: str, percent: float) -> None:
    assert [one[1:] for one in requests(message("play", name, percent))] == [("play", [name, percent])]


def test_more_arguments_than_values_are_refused_by_name() -> None:
    assert named((PERCENT,), [40.0, 7]) == {"percent": 40.0, "argument 2": 7}
    assert named((FADE,), [0]) is None
    assert named((FADE,), [1, 2.5]) == {"fade_s": 2.5}


def test_the_options_have_the_usual_port() -> None:
    assert OscOptions().address == ("127.0.0.1", 9000)


def test_the_example_layout_sends_only_what_the_stage_understands(kiosk: MemoryKiosk) -> None:
    verbs, told = Verbs(kiosk, "OSC", rate=Rate(burst=50)), state_of(kiosk.snapshot())
    widgets = json.loads(LAYOUT.read_text())["content"]["widgets"]
    assert len(widgets) > 5
    for widget in widgets:
        verb = widget["address"].removeprefix("/velatura/")
        if widget["type"] == "text":
            assert verb in told
            continue
        sent = [*widget.get("preArgs", []), widget.get("on", widget.get("default"))]
        values = named(verbs.fields(verb), sent)
        assert values is not None
        if verb not in ("open", "close"):
            verbs.do(verb, values)


def bundle(at_unix_s: float, *datagrams: bytes) -> bytes:
    """As the specification of OSC 1.0 has it: seconds since 1900, in units of 2**-32."""
    tag = round((at_unix_s + 2_208_988_800) * 2**32)
    return b"#bundle\0" + struct.pack(">Q", tag) + b"".join(struct.pack(">I", len(one)) + one for one in datagrams)


def test_a_bundle_of_the_future_waits_for_its_time_and_one_of_the_past_does_not(
    kiosk: MemoryKiosk, tmp_path: Path, port: int
) -> None:
    (tmp_path / "building.toml").write_text(f"[osc]\nport = {port}\n")
    with serving(kiosk, read(tmp_path)), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker:
        asker.settimeout(10)

        def ask(data: bytes) -> None:
            asker.sendto(data, ("127.0.0.1", port))

        def answered() -> list[str]:
            return [str(word) for word in OscPacket(asker.recv(2000)).messages[0].message.params]

        wait_for(lambda: _listens(port))
        begun_s = time.time()
        ask(bundle(begun_s + 0.6, message("brightness", 40.0)))
        ask(bundle(begun_s - 5.0, message("brightness", 70.0)))
        wait_for(lambda: kiosk.snapshot().brightness == 70)
        assert time.time() < begun_s + 0.6
        wait_for(lambda: kiosk.snapshot().brightness == 40)
        assert time.time() >= begun_s + 0.6
        ask(bundle(begun_s + 7200.0, message("brightness", 10.0)))
        assert answered()[1] == "too-late"
        ask(bundle(begun_s + 3000.0, message("brightness", 20.0)))
    assert kiosk.snapshot().brightness == 40, "what waits ends with the service"


def _listens(port: int) -> bool:
    return f":{port:04X} " in Path("/proc/net/udp").read_text()


def test_only_the_networks_that_are_named_are_heard() -> None:
    listener = Listener(OscOptions(host="0.0.0.0", allow=("192.0.2.0/28",)))
    for host in ("192.0.2.17", "198.51.100.1", "::ffff:198.51.100.1", "192.0.2.15", "127.0.0.1"):
        listener.datagram_received(message("next"), (host, 9000))
    heard = [listener.waiting.get_nowait()[1][0] for _ in range(listener.waiting.qsize())]
    assert heard == ["192.0.2.15", "127.0.0.1"]
