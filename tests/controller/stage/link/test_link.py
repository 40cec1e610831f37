"""A house and its members: who joins, who is heard, and what a listener on the wire sees."""

from __future__ import annotations

import contextlib
import queue
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

from controller.core.errors import UsageError, WorkError
from controller.stage.link.joining import Joining, admit
from controller.stage.link.membership import Authority, Membership, leave, membership
from controller.stage.link.session import Link, house_link, member_link

WITHIN_S = 20.0


@dataclass(frozen=True, slots=True)
class Colour:
    name: str
    share: float


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def wait_for(true: Callable[[], bool]) -> None:
    until_s = time.monotonic() + WITHIN_S
    while not true():
        assert time.monotonic() < until_s, "it did not happen in time"
        time.sleep(0.01)


class House:
    """A house on loopback, with the members that joined it."""

    def __init__(self, folder: Path, name: str = "museum") -> None:
        self.folder, self.port = folder, free_port()
        self.authority = Authority(folder / "house", name)
        self.endpoints = (f"tls/127.0.0.1:{self.port}",)

    def joined(self, name: str) -> Membership:
        port = free_port()
        with Joining(self.folder / name, name, host="127.0.0.1", port=port) as joining:
            admit(self.authority, f"127.0.0.1:{port}", joining.code, self.endpoints)
            return joining.wait()

    def opened(self) -> Link:
        return house_link(self.authority, host="127.0.0.1", port=self.port)


@pytest.fixture
def house(tmp_path: Path) -> House:
    return House(tmp_path)


@contextlib.contextmanager
def recorded(port: int) -> Iterator[tuple[int, bytearray]]:
    """A port that leads to ``port``, and all bytes that pass, in both directions."""
    heard = bytearray()
    with socket.create_server(("127.0.0.1", 0)) as server:

        def copy(source: socket.socket, target: socket.socket) -> None:
            with contextlib.suppress(OSError):
                while data := source.recv(65536):
                    heard.extend(data)
                    target.sendall(data)
                target.shutdown(socket.SHUT_WR)

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    near, _ = server.accept()
                    far = socket.create_connection(("127.0.0.1", port))
                    for one, other in ((near, far), (far, near)):
                        threading.Thread(target=copy, args=(one, other), daemon=True).start()

        threading.Thread(target=serve, daemon=True).start()
        yield server.getsockname()[1], heard


def test_house_and_member_speak_in_both_directions(house: House) -> None:
    member = house.joined("left")
    heard: list[Colour] = []
    there: list[bool] = []
    with house.opened() as ours, member_link(member) as theirs:
        ours.subscribe("member/left/colour", Colour, heard.append)
        ours.watch("member/left/alive", there.append)
        ours.answer("member/left/sum", list[int], sum)
        theirs.answer("member/left/double", Colour, lambda one: Colour(one.name, 2 * one.share))
        theirs.appear("member/left/alive")
        wait_for(lambda: there == [True])
        theirs.publish("member/left/colour", Colour("red", 0.25))
        wait_for(lambda: heard == [Colour("red", 0.25)])
        assert ours.ask("member/left/double", Colour("blue", 1.5), Colour) == Colour("blue", 3.0)
        assert theirs.ask("member/left/sum", [1, 2, 4], int) == 7
        theirs.close()
        wait_for(lambda: there == [True, False])


def test_what_the_house_says_to_all_reaches_all(house: House) -> None:
    heard: dict[str, list[str]] = {"left": [], "right": []}
    members = [house.joined(name) for name in heard]
    with house.opened() as ours, contextlib.ExitStack() as stack:
        for one in members:
            link = stack.enter_context(member_link(one))
            link.subscribe("all/word", str, heard[one.name].append)
            link.appear(f"member/{one.name}/alive")

        def both_heard() -> bool:
            ours.publish("all/word", "now", urgent=True)
            return all(words and set(words) == {"now"} for words in heard.values())

        wait_for(both_heard)


def test_an_error_of_the_other_side_keeps_its_code(house: House) -> None:
    member = house.joined("left")

    def refuse(_: bytes) -> None:
        raise UsageError("paint-is-wet", what="The paint is wet.", remedy="Wait.")

    there: list[bool] = []
    with house.opened() as ours, member_link(member) as theirs:
        theirs.answer("member/left/paint", bytes, refuse)
        theirs.answer("member/left/number", int, str)
        theirs.appear("member/left/alive")
        ours.watch("member/left/alive", there.append)
        wait_for(lambda: there == [True])
        with pytest.raises(WorkError) as caught:
            ours.ask("member/left/paint", b"", bytes)
        assert (caught.value.code, caught.value.what, caught.value.remedy) == (
            "paint-is-wet", "The paint is wet.", "Wait.",
        )  # fmt: skip
        with pytest.raises(WorkError, match="does not understand") as caught:
            ours.ask("member/left/number", "seven", str)
        assert caught.value.code == "link-message-wrong"
        with pytest.raises(WorkError) as caught:
            ours.ask("member/left/nothing", b"", bytes)
        assert caught.value.code == "link-no-answer"


def test_a_member_finds_a_house_that_starts_later_and_one_that_returns(house: House) -> None:
    with member_link(house.joined("left")) as theirs:
        theirs.appear("member/left/alive")
        for _ in range(2):
            with house.opened() as ours:
                there: queue.SimpleQueue[bool] = queue.SimpleQueue()
                ours.watch("member/left/alive", there.put)
                assert there.get(timeout=WITHIN_S)


def test_nobody_else_is_heard(house: House, tmp_path: Path) -> None:
    """Of another house, removed, or a member that speaks as another; none passes for the house either."""
    right, left, gone = house.joined("right"), house.joined("left"), house.joined("gone")
    house.authority.remove("gone")
    assert house.joined("another").name == "another"
    other = House(tmp_path / "other")
    stranger = Membership(other.joined("left").folder, "left", "other", house.endpoints)
    heard: list[str] = []
    there: list[bool] = []

    def answers(who: str, _: bytes) -> str:
        return who

    with house.opened() as ours, contextlib.ExitStack() as stack:
        for name in ("left", "right", "gone"):
            ours.subscribe(f"member/{name}/word", str, heard.append)
        ours.watch("member/left/alive", there.append)
        links = {
            "stranger": member_link(stranger), "gone": member_link(gone), "right": member_link(right)
        }  # fmt: skip
        for name, link in links.items():
            stack.enter_context(link)
            link.appear("member/left/alive")
            for key in ("left", "right", "gone"):
                link.answer(f"member/{key}/who", bytes, partial(answers, name))
        questions = [("left", ""), ("gone", ""), ("right", "right")]

        def said() -> bool:
            for link_name, link in links.items():
                for key in ("left", "right", "gone"):
                    link.publish(f"member/{key}/word", f"{link_name} as {key}")
            return bool(heard)

        wait_for(said)
        for name, answer in questions:
            if answer:
                assert ours.ask(f"member/{name}/who", b"", str) == answer
            else:
                with pytest.raises(WorkError, match="does not answer"):
                    ours.ask(f"member/{name}/who", b"", str, within_s=0.5)
        assert set(heard) == {"right as right"}
        assert not there
    impostor = Authority(tmp_path / "impostor", "museum")
    with house_link(impostor, host="127.0.0.1", port=house.port) as false, member_link(left) as theirs:
        theirs.answer("member/left/who", bytes, lambda _: "left")
        time.sleep(0.3)
        with pytest.raises(WorkError, match="does not answer"):
            false.ask("member/left/who", b"", str, within_s=0.5)


def test_no_secret_is_on_the_wire_in_the_clear(house: House) -> None:
    port = free_port()
    with (
        recorded(port) as (joins_at, heard),
        Joining(house.folder / "left", "left", host="127.0.0.1", port=port) as joining,
    ):
        with recorded(house.port) as (linked_at, linked), house.opened() as ours:
            admit(house.authority, f"127.0.0.1:{joins_at}", joining.code, (f"tls/127.0.0.1:{linked_at}",))
        member, code = joining.wait(), joining.code
        with recorded(house.port) as (linked_at, linked), house.opened() as ours:
            member = Membership(member.folder, member.name, member.house, (f"tls/127.0.0.1:{linked_at}",))
            there: list[bool] = []
            with member_link(member) as theirs:
                theirs.answer("member/left/tell", str, lambda said: f"the vault opens with {said}")
                theirs.appear("member/left/alive")
                ours.watch("member/left/alive", there.append)
                wait_for(lambda: there == [True])
                assert ours.ask("member/left/tell", "swordfish", str) == "the vault opens with swordfish"
    assert b"join/hello" in heard, "the recorder heard nothing"
    secrets = [code, code.replace("-", ""), "PRIVATE KEY", "CERTIFICATE", "museum", '"left"']
    assert not [one for one in secrets if one.encode() in heard]
    assert not [one for one in ("swordfish", "vault", "member/", "left") if one.encode() in linked]
    assert len(linked) > 1000


@pytest.mark.parametrize("typed", ["0000-0000", "1234", "", "abcd-efgh", "１２３４５６７８"])
def test_a_wrong_code_admits_nobody(house: House, typed: str) -> None:
    port = free_port()
    with Joining(house.folder / "left", "left", host="127.0.0.1", port=port) as joining:
        joining.code = "1234-5678"
        with pytest.raises(UsageError) as caught:
            admit(house.authority, f"127.0.0.1:{port}", typed, house.endpoints)
        assert caught.value.code == "join-code-wrong"
        assert not house.authority.members
        assert membership(house.folder / "left") is None
        admit(house.authority, f"127.0.0.1:{port}", " 12345678 ", house.endpoints)
        assert joining.wait() == membership(house.folder / "left")


def test_a_code_ends_after_three_wrong_ones_after_its_use_and_with_its_time(house: House) -> None:
    port = free_port()
    address = f"127.0.0.1:{port}"
    with Joining(house.folder / "left", "left", host="127.0.0.1", port=port) as joining:
        for _ in range(3):
            with pytest.raises(UsageError):
                admit(house.authority, address, f"{(int(joining.code[:4]) + 1) % 10000:04}-0000", house.endpoints)
        with pytest.raises(WorkError) as caught:
            admit(house.authority, address, joining.code, house.endpoints)
        assert caught.value.code == "join-code-refused"
        with pytest.raises(WorkError, match="too often"):
            joining.wait()
    with Joining(house.folder / "left", "left", host="127.0.0.1", port=port) as joining:
        admit(house.authority, address, joining.code, house.endpoints)
        house.authority.remove("left")
        with pytest.raises(WorkError) as caught:
            admit(house.authority, address, joining.code, house.endpoints)
        assert caught.value.code == "join-code-expired"
    with Joining(house.folder / "left", "left", host="127.0.0.1", port=port, valid_s=0.0) as joining:
        with pytest.raises(WorkError) as caught:
            admit(house.authority, address, joining.code, house.endpoints)
        assert caught.value.code == "join-code-expired"
        with pytest.raises(WorkError, match="not valid"):
            joining.wait()
    with pytest.raises(WorkError) as caught:
        admit(house.authority, address, "1234-5678", house.endpoints)
    assert caught.value.code == "join-no-answer"


@pytest.mark.parametrize("typed", ["", "a b", "a/b", "x:0", "x:70000", "[::1", "http://x"])
def test_what_is_no_address_is_refused(house: House, typed: str) -> None:
    with pytest.raises(UsageError) as caught:
        admit(house.authority, typed, "1234-5678", house.endpoints)
    assert caught.value.code == "join-address-wrong"


def test_two_members_have_two_names(house: House) -> None:
    house.joined("left")
    with pytest.raises(UsageError) as caught:
        house.joined("left")
    assert caught.value.code == "house-name-taken"
    assert list(house.authority.members) == ["left"]
    for name in ("", "Left", "a b", "a/b", "*", "a" * 64, "-", "ä"):
        with pytest.raises(UsageError) as caught:
            Joining(house.folder / "new", name)
        assert caught.value.code == "house-name-wrong"


def test_keys_are_for_their_user_alone_and_last(house: House) -> None:
    joined = house.joined("left")
    for file in (*joined.folder.iterdir(), *house.authority.folder.iterdir()):
        assert file.stat().st_mode & 0o077 == 0
    again = Authority(house.authority.folder, "museum")
    assert dict(again.members) == dict(house.authority.members)
    assert re.fullmatch(r"left\.[0-9a-f]{16}", again.members["left"].certified)
    (again.folder / "members.json").write_text("{")
    with pytest.raises(UsageError) as caught:
        Authority(again.folder, "museum")
    assert caught.value.code == "house-keys-damaged"
    leave(joined.folder)
    assert membership(joined.folder) is None
