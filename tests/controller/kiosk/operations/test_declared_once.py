"""One declaration and one method are all that a new operation needs to be offered everywhere."""

from __future__ import annotations

import ast
import asyncio
import inspect
import json
from pathlib import Path
from typing import Annotated, Any

import anyio
import pytest
from pydantic import Field
from typer.testing import CliRunner

from controller.cli import derived
from controller.cli.groups import group
from controller.core.storage import runtime_folder
from controller.kiosk.api.control import NAME, ControlServer, call_kiosk
from controller.kiosk.api.folder import FolderKiosk
from controller.kiosk.api.kiosk import StageKiosk
from controller.kiosk.interface import Kiosk
from controller.kiosk.operations import dispatch
from controller.kiosk.operations.dispatch import socket_table
from controller.kiosk.operations.fields import INTEGER
from controller.kiosk.operations.operation import Effect, Operation, operation
from controller.kiosk.operations.table import AT_SOCKET, OPERATIONS
from controller.kiosk.roles import Role
from controller.panel.api import PREFIX, document
from controller.panel.mqtt.bridge import BuildingControl
from tests.controller.kiosk.vase import vase
from tests.controller.panel.mqtt.test_bridge import MOSQUITTO, broker, building, options, port, wait_for
from tests.controller.panel.served import served

__all__ = ["port"]
Times = Annotated[int, Field(ge=1, le=5, description="how often, 1 to 5"), INTEGER]


@operation("POST /chime", Role.OPERATOR, Effect.SHOWS, offline=True)
def chime(kiosk: Any, times: Times) -> dict[str, int | str]:
    """Sound the bell."""
    return {"rung": times, "at": kiosk.stage.name}


DECLARED = (*OPERATIONS, chime)


@pytest.fixture
def kiosk(tmp_path: Path) -> StageKiosk:
    return StageKiosk(vase(tmp_path / "hall"))


def test_the_document_has_it(kiosk: StageKiosk) -> None:
    described = document(DECLARED)["paths"]["/chime"]["post"]
    assert described["operationId"] == "chime"
    assert "operator" in described["description"]
    body = described["requestBody"]["content"]["application/json"]["schema"]
    assert body["required"] == ["times"]
    assert (body["properties"]["times"]["minimum"], body["properties"]["times"]["maximum"]) == (1, 5)
    answer = described["responses"]["200"]["content"]["application/json"]["schema"]
    assert answer["additionalProperties"] == {"anyOf": [{"type": "integer"}, {"type": "string"}]}


def test_the_api_has_it_with_its_limits_and_its_role(kiosk: StageKiosk, tmp_path: Path) -> None:
    with served(kiosk, tmp_path / "private", operations=DECLARED) as panel, panel.client() as client:
        operator, viewer = panel.token(Role.OPERATOR), panel.token(Role.VIEWER)
        answer = client.post(f"{PREFIX}/chime", json={"times": 3}, headers=operator)
        assert (answer.status_code, answer.json()) == (200, {"rung": 3, "at": "hall"})
        assert client.post(f"{PREFIX}/chime", json={"times": 6}, headers=operator).json()["code"] == "field-wrong"
        assert client.post(f"{PREFIX}/chime", json={"times": 3}, headers=viewer).status_code == 403
        assert "/chime" in client.get(f"{PREFIX}/openapi.json", headers=viewer).json()["paths"]


def test_socket_and_command_line_have_it(kiosk: StageKiosk) -> None:
    program = group("kiosk", "For this test.", {"": tuple(derived.commands("kiosk", DECLARED).values())})
    table = socket_table(kiosk.holders(), DECLARED)
    with ControlServer(runtime_folder(kiosk.stage.resolve()) / NAME, table):
        assert call_kiosk(kiosk.stage, "chime", times=2) == {"rung": 2, "at": "hall"}
        shown = CliRunner().invoke(program, ["chime", str(kiosk.stage), "4", "--json"])
        assert json.loads(shown.output) == {"result": {"rung": 4, "at": "hall"}}
        refused = CliRunner().invoke(program, ["chime", str(kiosk.stage), "9"])
        assert "times" in str(refused.exception)
    told = CliRunner().invoke(program, ["chime", "--help"]).output
    assert "Sound the bell." in told
    assert "How often, 1 to 5." in told


def test_where_no_kiosk_runs_it_is_done_on_the_folder(kiosk: StageKiosk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dispatch, "AT_SOCKET", DECLARED)
    program = group("kiosk", "For this test.", {"": tuple(derived.commands("kiosk", DECLARED).values())})
    shown = CliRunner().invoke(program, ["chime", str(kiosk.stage), "5"])
    assert "rung" in shown.output, shown.exception


@pytest.mark.skipif(not Path(MOSQUITTO).exists(), reason="needs mosquitto (a package of the test set-up)")
def test_the_buildings_control_has_it(kiosk: StageKiosk, tmp_path: Path, port: int) -> None:
    async def story() -> None:
        control = BuildingControl(kiosk, options(tmp_path, port), first_pause_s=0.1, operations=DECLARED)
        async with building(port) as (client, heard), anyio.create_task_group() as tasks:
            tasks.start_soon(control.run)
            await wait_for(heard, "available", "online")
            await client.publish("hall/velatura/command/chime", "3")
            assert json.loads(await wait_for(heard, "answer", "chime"))["done"] is True
            await client.publish("hall/velatura/command/chime", "6")
            assert json.loads(await wait_for(heard, "answer", "chime"))["code"] == "field-wrong"
            await client.publish("hall/velatura/command/set-schedule", "{}")
            assert json.loads(await wait_for(heard, "answer", "set-schedule"))["code"] == "command-unknown"
            tasks.cancel_scope.cancel()

    with broker(tmp_path / "broker", port):
        asyncio.run(story())


def test_a_building_may_only_change_what_is_shown() -> None:
    shown = {"open", "close", "play", "rotate", "identify", "next", "black", "pause", "brightness"}
    assert {one.building_verb for one in OPERATIONS} == {"", *shown}


def test_an_offline_operation_needs_only_what_the_folder_answers() -> None:
    offline = {word for one in AT_SOCKET if one.offline and one.holder == "kiosk" for word in called(one)}
    assert offline == {name for name in vars(FolderKiosk) if not name.startswith("_")}
    assert {word for one in AT_SOCKET if one.holder == "kiosk" for word in called(one)} <= set(dir(Kiosk))


def called(one: Operation) -> set[str]:
    """The methods of the kiosk that an operation calls."""
    tree = ast.parse(inspect.getsource(one.function))
    return {
        node.attr for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "kiosk"
    }  # fmt: skip


def test_no_two_operations_share_a_name_an_address_or_a_command() -> None:
    for names in (
        [one.name for one in AT_SOCKET],
        [one.socket_name for one in AT_SOCKET],
        [(one.method, one.path) for one in OPERATIONS],
        [one.words for one in OPERATIONS if not one.names.part_of],
    ):
        assert len(set(names)) == len(names)
