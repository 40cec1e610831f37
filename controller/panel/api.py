"""The HTTP API: the table of operations as JSON with tokens, its OpenAPI document, and Prometheus metrics."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_1_0_0
from prometheus_client.registry import Collector
from pydantic import TypeAdapter
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from controller.kiosk.building.verbs import Rate, Rates
from controller.kiosk.operations.fields import PlainSchema, object_schema
from controller.kiosk.operations.operation import Answer, Operation
from controller.kiosk.operations.table import OPERATIONS
from controller.kiosk.roles import Role
from controller.panel import answers
from controller.panel.auth.identity import Endpoint, Entry, Visitor
from controller.panel.context import Panel
from controller.run.state_machine import State

PREFIX: Final = "/api/v1"
REFERENCE: Final = "#/components/schemas/{model}"
_ERROR: Final = {"$ref": "#/components/responses/Error"}
BYTES: Final[dict[str, Any]] = {"type": "string", "format": "binary"}
"""A picture or a file. OpenAPI 3.1 needs no schema for it, but generators of clients do."""


def entries(panel: Panel) -> list[Entry]:
    """The routes of the API."""
    rates = Rates(Rate())
    table = [
        Entry(op.method, PREFIX + op.path, "token", op.role, _endpoint(panel, op, rates)) for op in panel.operations
    ]
    table.append(Entry("GET", PREFIX + "/openapi.json", "token", Role.VIEWER, _document(panel.operations)))
    table.append(Entry("GET", "/metrics", "token", Role.VIEWER, _metrics(panel)))
    return table


def body_limits(panel: Panel) -> dict[str, int]:
    """The largest uploads in bytes, by path."""
    images, restore = panel.options.uploads.most_bytes, panel.options.most_restore_bytes
    return {
        PREFIX + "/targets": images,
        PREFIX + "/restore": restore,
        "/do/upload-target": images + 4096,
        "/do/restore": restore + 4096,
    }


def _endpoint(panel: Panel, operation: Operation, rates: Rates) -> Endpoint:
    """``rates``: of each token, for the verbs of a building."""

    async def answer(request: Request, visitor: Visitor) -> Response:
        uploaded = None
        try:
            if operation.building_verb:
                rates.take(visitor.name)
            values = answers.scalar_values(operation, request)
            if operation.upload is not None:
                uploaded = await answers.body_file(request, panel.options.folder / answers.INCOMING)
                values[operation.upload.name] = uploaded
            elif operation.changes:
                values |= await answers.json_values(operation, request)
            return answers.response(
                operation, await answers.run(panel, operation, values, f"Token {visitor.name}"), values
            )
        except answers.FAILURES as error:
            return answers.failure(error)
        finally:
            if uploaded is not None:
                uploaded.unlink(missing_ok=True)

    return answer


def _document(operations: Sequence[Operation]) -> Endpoint:
    async def answer(_: Request, __: Visitor) -> Response:
        return JSONResponse(document(operations))

    return answer


def document(operations: Sequence[Operation] = OPERATIONS) -> dict[str, Any]:
    """The OpenAPI 3.1 document, made from the same table as the routes."""
    paths: dict[str, dict[str, Any]] = {}
    answered, objects = answer_schemas(operations)
    for operation in operations:
        described = _described(operation, answered[operation.name], objects)
        paths.setdefault(operation.path, {})[operation.method.lower()] = described
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "Velatura",
            "version": "1",
            "description": "All operations of the panel. Make tokens on its page Accounts.",
        },
        "servers": [{"url": PREFIX}],
        "security": [{"token": []}],
        "paths": paths,
        "components": {
            "schemas": {name: objects[name] for name in sorted(objects)},
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
            "responses": {
                "Error": {
                    "description": "What happened, and what to do",
                    "content": {"application/json": {"schema": {"$ref": "#/components/schemas/Refusal"}}},
                },
                "Plain": {
                    "description": "Refused before the body was read",
                    "content": {"text/plain": {"schema": {"type": "string"}}},
                },
            },
        },
    }


class _AnswerSchema(PlainSchema):
    """All fields of an answer are always there. A later version may add others."""

    def field_is_required(self, field: Any, total: bool) -> bool:
        return True

    def tuple_schema(self, schema: Any) -> Any:
        # A pair of texts: a schema with a place of its own for each is understood by few generators.
        described = super().tuple_schema(schema)
        if "prefixItems" in described:
            described["items"] = described.pop("prefixItems")[0]
        return described


def answer_schemas(operations: Sequence[Operation]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The JSON Schema of each operation's answer, by its name, and those of the objects in them, by theirs."""
    text = {"type": "string"}
    objects: dict[str, Any] = {
        "Done": _object({"done": {"type": "boolean"}}) | {"description": "It was done."},
        "Refusal": _object(dict.fromkeys(("code", "what", "remedy"), text))
        | {"description": "What happened, and what to do; the code is stable."},
        "Text": _object({"text": text}) | {"description": "A text; it may be empty."},
    }
    values = [operation for operation in operations if operation.answer is Answer.VALUE]
    described, definitions = TypeAdapter.json_schemas(
        [(operation.name, "serialization", answers.adapter(operation)) for operation in values],
        schema_generator=_AnswerSchema, ref_template=REFERENCE,
    )  # fmt: skip
    for name, schema in definitions.get("$defs", {}).items():
        objects[name] = schema | {"description": schema.get("description", "").replace("``", "")}
    general = {Answer.NOTHING: "Done", Answer.TEXT: "Text"}
    answered: dict[str, Any] = {
        operation.name: {"$ref": REFERENCE.format(model=general[operation.answer])}
        if operation.answer in general else BYTES
        for operation in operations
    }  # fmt: skip
    return answered | {str(name): schema for (name, _), schema in described.items()}, objects


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "required": list(properties)}


def _described(operation: Operation, answer: dict[str, Any], objects: dict[str, Any]) -> dict[str, Any]:
    """An operation in the document; the objects in its body are added to ``objects``."""
    content: dict[str, Any] = {operation.answer.media: {"schema": answer}}
    if operation.answer is Answer.PICTURE:
        content["image/jpeg"] = {"schema": BYTES}
    described: dict[str, Any] = {
        "operationId": operation.name,
        "summary": operation.about,
        "description": f"Needs the role {operation.role.name.lower()} or above.",
        "responses": {
            "200": {"description": "Done", "content": content},
            **dict.fromkeys(("401", "403", "404", "409", "422", "429", "502", "507"), _ERROR),
            "413": {"$ref": "#/components/responses/Plain"},
        },
    }
    placed = [(field, operation.where(field)) for field in operation.fields]
    scalars = [(field, where) for field, where in placed if where != "body"]
    if scalars:
        described["parameters"] = [
            {"name": f.name, "in": where, "required": f.required or where == "path", "schema": f.schema}
            for f, where in scalars
        ]
    body = [field for field, where in placed if where == "body"]
    if operation.upload is not None:
        described["requestBody"] = {"required": True, "content": {"application/octet-stream": {"schema": BYTES}}}
    elif body:
        schema = object_schema(body)
        objects |= schema.pop("$defs", {})
        needed = any(field.required for field in body)
        described["requestBody"] = {"required": needed, "content": {"application/json": {"schema": schema}}}
    return described


class KioskFigures(Collector):
    """The kiosk's state as Prometheus metrics, read at each request."""

    def __init__(self, panel: Panel) -> None:
        self._panel = panel

    def collect(self) -> Iterator[Metric]:
        now = self._panel.kiosk.snapshot()
        state = GaugeMetricFamily("velatura_state", "1 for the current state", labels=["state"])
        for possible in State:
            state.add_metric([possible.value], float(now.state == possible.value))
        yield state
        playing = InfoMetricFamily("velatura_playing", "The appearance that is playing")
        playing.add_metric([], {"appearance": now.playing})
        yield playing
        problems = GaugeMetricFamily(
            "velatura_device_problem", "1 while a device has a problem", labels=["device", "kind"]
        )
        for device in now.devices:
            problems.add_metric([device.name, device.kind], float(device.problem is not None))
        yield problems
        hours = GaugeMetricFamily("velatura_lamp_hours", "Hours that a lamp was lit", labels=["projector"])
        strikes = GaugeMetricFamily("velatura_lamp_strikes", "How often a lamp was switched on", labels=["projector"])
        for lamp in now.lamps:
            hours.add_metric([lamp.projector], lamp.hours)
            strikes.add_metric([lamp.projector], float(lamp.strikes))
        yield hours
        yield strikes
        done = sum(step.done for step in now.job.steps) / len(now.job.steps) if now.job and now.job.steps else 0.0
        yield GaugeMetricFamily(
            "velatura_job_running", "1 while a job runs", float(now.job is not None and not now.job.ended)
        )
        yield GaugeMetricFamily("velatura_job_done_ratio", "Progress of the job, the mean of its steps", done)
        yield GaugeMetricFamily(
            "velatura_disk_free_bytes", "Free space on the stage's disk", float(now.disk_free_bytes)
        )
        yield GaugeMetricFamily(
            "velatura_warnings",
            "Problems that belong to no device, such as light in the room",
            float(len(now.warnings)),
        )
        yield GaugeMetricFamily(
            "velatura_failures", "Failed jobs that no operator has confirmed", float(len(now.failures))
        )
        yield GaugeMetricFamily(
            "velatura_brightness_ratio", "The share of the light that is shown; 0 for black",
            0.0 if now.black else now.brightness / 100,
        )  # fmt: skip
        if now.dose_klx_h is not None:
            yield GaugeMetricFamily("velatura_light_dose_lux_seconds", "Light on the object", 3.6e6 * now.dose_klx_h)
        yield GaugeMetricFamily(
            "velatura_open_panels", "Open panels with live updates", float(self._panel.hub.listening)
        )


def _metrics(panel: Panel) -> Endpoint:
    registry = CollectorRegistry(auto_describe=False)
    registry.register(KioskFigures(panel))

    async def answer(_: Request, __: Visitor) -> Response:
        text = await panel.in_thread(lambda: generate_latest(registry))
        return Response(text, media_type=CONTENT_TYPE_PLAIN_1_0_0)

    return answer
