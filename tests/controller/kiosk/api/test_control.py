from __future__ import annotations

import errno
import json
import socket
import stat
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.core.storage import runtime_folder
from controller.kiosk.api import control
from controller.kiosk.api.control import MOST_CONNECTIONS, NAME, ControlServer, call_kiosk, is_running, plain
from hal.errors import DeviceGone


@dataclass(frozen=True)
class Answer:
    path: Path
    numbers: tuple[int, ...]


def refuse() -> None:
    raise WorkError("busy", what="Another job is running or waiting.", remedy="Wait.")


def lose() -> None:
    raise DeviceGone("port-gone", what="It is away.", remedy="Plug it in.")


def break_down() -> None:
    raise ZeroDivisionError("division by zero")


OPERATIONS: dict[str, Any] = {
    "status": lambda: {"state": "playing"}, "add": lambda one, other=1: one + other, "refuse": refuse, "lose": lose,
    "break": break_down, "answer": lambda: Answer(Path("a"), (1, 2)), "stop": lambda: None,
}  # fmt: skip


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Path]:
    with ControlServer(runtime_folder(tmp_path) / NAME, OPERATIONS):
        yield tmp_path


def said(stage: Path, line: bytes) -> dict[str, Any]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as channel:
        channel.settimeout(20)
        channel.connect(str(runtime_folder(stage) / NAME))
        channel.sendall(line)
        answer: dict[str, Any] = json.loads(channel.makefile("rb").readline())
        return answer


def test_operations_are_done_by_name_with_arguments(stage: Path) -> None:
    assert call_kiosk(stage, "status") == {"state": "playing"}
    assert call_kiosk(stage, "add", one=2) == 3
    assert call_kiosk(stage, "add", one=2, other=3) == 5
    assert call_kiosk(stage, "answer") == {"path": "a", "numbers": [1, 2]}
    assert call_kiosk(stage, "stop") is None


@pytest.mark.parametrize(("op", "code"), [("refuse", "busy"), ("lose", "port-gone"), ("break", "crash")])
def test_what_is_raised_comes_back_with_code_and_sentences_and_the_kiosk_goes_on(
    stage: Path, op: str, code: str
) -> None:
    with pytest.raises(VelaturaError) as error:
        call_kiosk(stage, op)
    assert error.value.code == code
    assert error.value.what
    assert error.value.remedy
    assert call_kiosk(stage, "status")


WRONG = (
    b"\n", b"nonsense\n", b"[]\n", b"{}\n", b'{"op": "shutdown"}\n', b'{"op": ["status"]}\n', b'{"op": "add"}\n',
    b'{"op": "status", "one": 1}\n', b"[" * 100_000 + b"\n", b"\xff\xfe\n", b'{"op": "__class__"}\n',
)  # fmt: skip


@pytest.mark.parametrize("line", WRONG, ids=range(len(WRONG)))
def test_wrong_requests_are_told_and_cost_nothing(stage: Path, line: bytes) -> None:
    answer = said(stage, line)
    assert answer["ok"] is False
    assert answer["error"]["code"] == "request-wrong"
    assert call_kiosk(stage, "status")


def test_an_endless_line_is_cut_off(stage: Path) -> None:
    assert said(stage, b"x" * ((1 << 20) + 1))["error"]["code"] == "request-wrong"


def test_only_the_owner_may_ask(stage: Path) -> None:
    path = runtime_folder(stage) / NAME
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) & 0o077 == 0


def test_those_who_hold_too_many_lines_are_turned_away_and_keep_nobody_out_afterwards(stage: Path) -> None:
    with ExitStack() as stack:
        for _ in range(MOST_CONNECTIONS + 1):
            channel = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
            channel.settimeout(20)
            channel.connect(str(runtime_folder(stage) / NAME))
        assert channel.recv(1) == b""
    for _ in range(1000):
        try:
            assert call_kiosk(stage, "status")
            break
        except VelaturaError:
            continue
    else:
        pytest.fail("nobody is answered any more")


def test_where_no_kiosk_runs_it_is_told(tmp_path: Path) -> None:
    assert not is_running(tmp_path)
    with pytest.raises(UsageError) as error:
        call_kiosk(tmp_path, "status")
    assert error.value.code == "not-serving"


def test_a_kiosk_that_was_killed_leaves_a_socket_that_the_next_one_takes(tmp_path: Path) -> None:
    path = runtime_folder(tmp_path) / NAME
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as left_behind:
        left_behind.bind(str(path))
    with ControlServer(path, OPERATIONS):
        assert call_kiosk(tmp_path, "status")
    assert not path.exists()


def test_values_become_what_json_has() -> None:
    assert plain({1: (Path("x"), {"y"}, None, 1.5, True)}) == {"1": ["x", ["y"], None, 1.5, True]}


def test_a_moment_without_free_file_handles_does_not_end_the_socket(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    accept, failures = socket.socket.accept, [OSError(errno.EMFILE, "Too many open files")]

    def accepting(listener: socket.socket) -> tuple[socket.socket, Any]:
        if failures:
            raise failures.pop()
        return accept(listener)

    monkeypatch.setattr(control, "AGAIN_S", 0.01)
    monkeypatch.setattr(socket.socket, "accept", accepting)
    with ControlServer(runtime_folder(tmp_path) / NAME, OPERATIONS):
        assert call_kiosk(tmp_path, "status", timeout_s=20) == {"state": "playing"}
    assert not failures
