"""The API: as its own document says, for people who read it and people who break it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, settings
from prometheus_client.parser import text_string_to_metric_families
from schemathesis import checks
from schemathesis.pytest.lazy import get_all_tests

from controller.kiosk.operations.operation import Operation
from controller.kiosk.operations.table import OPERATIONS
from controller.kiosk.store.accounts import Role
from controller.panel.api import PREFIX, document
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import Served, served
from tests.controller.panel.test_uploads import jpeg


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("api")
    with served(MemoryKiosk(folder / "pictures", step_s=0.001), folder / "private") as running:
        yield running


def smaller(schema: Any) -> Any:
    """The document with shorter lists and texts: making up 400 rows, or a million characters, takes minutes."""
    if isinstance(schema, dict):
        caps = {"maxItems": 3, "maxLength": 200}
        return {
            key: min(inner, caps[key]) if key in caps and isinstance(inner, int) else smaller(inner)
            for key, inner in schema.items()
        }
    return [smaller(inner) for inner in schema] if isinstance(schema, list) else schema


@pytest.fixture(scope="module")
def schema() -> Any:
    return schemathesis.openapi.from_dict(smaller(document()))


HEADERS: dict[str, dict[str, str]] = {}
CHECKS = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_schema_conformance",
    "unsupported_method",
)
REFUSES_WHAT_IS_WRONG = "negative_data_rejection"
SHORTENED = ("/schedule", "/settings", "/settings/check", "/devices/tried")


FEW = settings(
    max_examples=3,
    deadline=None,
    derandomize=True,
    database=None,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)


def answers_as_the_document_says(case: schemathesis.Case[Any], quick: Served) -> None:
    panel = quick.app.state.panel
    panel.by_token.succeeded("127.0.0.1")
    if quick.address not in HEADERS:  # once: each token makes the file of accounts longer
        HEADERS[quick.address] = quick.token(Role.TECHNICIAN)
    # What was made smaller above is no longer what the panel refuses.
    names = CHECKS if case.operation.path in SHORTENED else (*CHECKS, REFUSES_WHAT_IS_WRONG)
    case.call_and_validate(
        base_url=quick.address + PREFIX,
        headers=HEADERS[quick.address],
        checks=[checks.CHECKS.get_one(name) for name in names],  # type: ignore[misc]
    )


def exercised(operation: Operation) -> Any:
    """The test of one operation."""

    # schemathesis makes up cases where ``parametrize`` collects tests: every worker did, for longer than it took to
    # collect all others. Its way for a schema that is known later makes them up where they run.
    def test(schema: Any, quick: Served) -> None:
        chosen = schema.include(operation_id=operation.name)
        (made,) = get_all_tests(schema=chosen, test_func=answers_as_the_document_says, settings=FEW, given_kwargs=None)
        _, run = made.ok()  # type: ignore[union-attr]
        run(quick=quick)

    return test


# A restored file may be any bytes; its own test checks that.
for _operation in OPERATIONS:
    if _operation.path != "/restore":
        globals()[f"test_as_the_document_says_{_operation.name.replace('-', '_')}"] = exercised(_operation)


def test_every_path_of_the_document_is_an_operation_that_was_exercised() -> None:
    paths = document()["paths"]
    described = {described["operationId"] for methods in paths.values() for described in methods.values()}
    assert described == {operation.name for operation in OPERATIONS}


def test_a_disk_that_takes_no_upload_is_told_in_words(fresh: Served) -> None:
    incoming: Path = fresh.app.state.panel.options.folder / "incoming"
    incoming.write_bytes(b"no folder")
    with fresh.client() as client:
        answer = client.post(f"{PREFIX}/targets", content=jpeg(), headers=fresh.token(Role.TECHNICIAN))
    assert (answer.status_code, answer.json()["code"]) == (507, "upload-not-kept")
    assert "space" in answer.json()["remedy"]


def test_every_operation_stands_in_the_document_with_its_role() -> None:
    paths = document()["paths"]
    for operation in OPERATIONS:
        described = paths[operation.path][operation.method.lower()]
        assert described["operationId"] == operation.name
        assert operation.role.name.lower() in described["description"]


def test_a_machine_can_do_the_whole_job(fresh: Served) -> None:
    token = fresh.token(Role.TECHNICIAN)
    with fresh.client() as client:
        client.headers.update(token)
        target = client.post(f"{PREFIX}/targets", content=jpeg()).json()["target"]
        assert client.get(f"{PREFIX}/targets/{target}/feasibility").content.startswith(b"\x89PNG")
        job = client.post(f"{PREFIX}/appearances", json={"name": "bronze", "target": target}).json()
        assert job["name"] == "New appearance bronze"
        assert client.post(f"{PREFIX}/recalibrations", json={"kind": "full"}).status_code == 409
        for _ in range(200):
            if client.get(f"{PREFIX}/state").json()["job"]["ended"]:
                break
            time.sleep(0.05)
        assert client.post(f"{PREFIX}/play", json={"name": "bronze"}).json() == {"done": True}
        assert client.get(f"{PREFIX}/state").json()["playing"] == "bronze"
        assert client.get(f"{PREFIX}/appearances/bronze/preview").headers["content-type"] == "image/png"
        assert client.delete(f"{PREFIX}/appearances/none").status_code == 404
        schedule = client.get(f"{PREFIX}/schedule").json()
        schedule["rows"].append({"day": "2026-12-24"})
        assert client.put(f"{PREFIX}/schedule", json=schedule).json() == {"done": True}
        schedule = client.get(f"{PREFIX}/schedule").json()
        assert schedule["rows"][-1] == {"day": "2026-12-24", "opens": "", "closes": "", "appearance": ""}
        assert client.put(f"{PREFIX}/schedule", json=schedule).json() == {"done": True}
        schedule["rows"][-1]["opens"] = "25:00"
        assert client.put(f"{PREFIX}/schedule", json=schedule).status_code == 422
        backup = client.post(f"{PREFIX}/backup")
        assert backup.headers["content-disposition"].startswith("attachment")
        assert client.post(f"{PREFIX}/restore", content=backup.content).json() == {"done": True}
        assert client.post(f"{PREFIX}/restore", content=b"x").json()["code"] == "not-a-backup"
        assert [row["level"] for row in client.get(f"{PREFIX}/events?level=error").json()] == ["error"]
        assert "preview" not in str(client.get(f"{PREFIX}/appearances").json())


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"[]",
        b"{",
        b'{"name": 1}',
        b'{"name": "a", "x": 1}',
        b'{"name": "../a"}',
        b"[" * 100_000,
        b'{"name": "\\ud800"}',
        b"\xff",
    ],
)
def test_bodies_that_are_wrong_are_refused_in_words(panel: Served, body: bytes) -> None:
    headers = panel.token(Role.OPERATOR) | {"content-type": "application/json"}
    with panel.client() as client:
        answer = client.post(f"{PREFIX}/play", content=body, headers=headers)
        assert answer.status_code == 422
        assert set(answer.json()) == {"code", "what", "remedy"}


def test_prometheus_reads_our_figures(panel: Served) -> None:
    with panel.client() as client:
        text = client.get("/metrics", headers=panel.token(Role.VIEWER)).text
    rows = {
        (s.name, tuple(sorted(s.labels.items()))): s.value
        for f in text_string_to_metric_families(text)
        for s in f.samples
    }
    assert rows["velatura_lamp_hours", (("projector", "left"),)] == 1204
    assert rows["velatura_device_problem", (("device", "right"), ("kind", "projector"))] == 1
    assert sum(value for (name, _), value in rows.items() if name == "velatura_state") == 1


def test_a_kiosk_error_reaches_the_caller_with_its_remedy(fresh: Served) -> None:
    with fresh.client() as client:
        answer = client.post(f"{PREFIX}/cancel", headers=fresh.token(Role.OPERATOR))
    told = {"code": "nothing-to-cancel", "what": "No job is running.", "remedy": "There is nothing to cancel."}
    assert (answer.status_code, answer.json()) == (409, told)


def test_pictures_of_the_kiosk_can_only_be_those_of_a_run(panel: Served, tmp_path: Path) -> None:
    with panel.client() as client:
        client.headers.update(panel.token(Role.TECHNICIAN))
        assert client.get(f"{PREFIX}/runs/first/pictures/error").status_code == 200
        assert client.get(f"{PREFIX}/runs/first/pictures/secrets").status_code == 422
        for run in ("..", "%2e%2e", "..%2f..", "none"):
            assert client.get(f"{PREFIX}/runs/{run}/pictures/error").status_code in (404, 422)
