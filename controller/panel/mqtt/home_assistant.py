"""Home Assistant's MQTT discovery: the retained messages that make a stage one device with its entities. No I/O.

One message for each entity, which every version of Home Assistant since 2023 reads.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import quote

from controller.kiosk.state import KioskState
from controller.run.state_machine import State

ADVICE: Final = ("nothing", "quick", "full", "look")
"""The values of ``DriftCheck.advice``."""
_ON_OFF: Final = {"payload_on": "true", "payload_off": "false", "state_on": "True", "state_off": "False"}
"""Commands as our verbs read them, states as Home Assistant's templates write them."""
_PROBLEMS: Final = "value_json.problems or value_json.warnings or value_json.failures or value_json.state == 'fault'"


@dataclass(frozen=True, slots=True)
class _Entity:
    """``platform``: Home Assistant's kind of entity; ``key``: its own name; ``values``: what only this entity has."""

    platform: str
    key: str
    name: str
    values: Mapping[str, Any]


def node(topic: str) -> str:
    """``topic`` as a part of a discovery topic, which may have letters, digits, - and _; another for each topic."""
    escaped = quote(topic, safe="").replace("_", "%5F").replace(".", "%2E").replace("~", "%7E")
    return escaped.replace("%", "_")


def own_topics(prefix: str, topic: str) -> str:
    """A filter for the discovery topics of this stage, in use or not."""
    return f"{prefix}/+/{node(topic)}/+/config"


def messages(prefix: str, topic: str, now: KioskState, names: Sequence[str], version: str) -> dict[str, str]:
    """What is to be retained, JSON by topic. ``names``: of the installed appearances; ``prefix``: usually
    "homeassistant"; ``topic``: the first part of the stage's own topics.
    """
    stage = node(topic)
    common = {
        "availability_topic": f"{topic}/available",
        "device": {
            "identifiers": [stage],
            "name": now.stage,
            "manufacturer": "Velatura",
            "model": "Stage",
            "sw_version": version,
        },
        "origin": {"name": "Velatura", "sw_version": version},
        "qos": 1,
    }
    return {
        f"{prefix}/{entity.platform}/{stage}/{entity.key}/config": json.dumps(
            {"name": entity.name, "unique_id": f"{stage}_{entity.key}", **entity.values, **common}
        )
        for entity in (*_controls(topic, names), *_reports(f"{topic}/state", now))
    }


def _controls(topic: str, names: Sequence[str]) -> Iterator[_Entity]:
    """What a person may change: each is one of the building's verbs."""

    def switch(verb: str, name: str, state: str, **more: Any) -> _Entity:
        values = {"command_topic": f"{topic}/command/{verb}", **_ON_OFF, **_state(topic, f"value_json.{state}")}
        return _Entity("switch", verb, name, values | more)

    def button(verb: str, name: str) -> _Entity:
        return _Entity("button", verb, name, {"command_topic": f"{topic}/command", "payload_press": verb})

    yield switch("open", "Open", "open", command_topic=f"{topic}/command", payload_on="open", payload_off="close")
    yield switch("black", "Black", "black")
    yield switch("pause", "Pause", "paused")
    yield switch("identify", "Projector names", "identifying", entity_category="config")
    yield button("next", "Next appearance")
    yield button("rotate", "Playlist")
    brightness = {
        "command_topic": f"{topic}/command/brightness",
        "min": 0,
        "max": 100,
        "step": 1,
        "mode": "slider",
        "unit_of_measurement": "%",
        **_state(topic, "value_json.brightness"),
    }
    yield _Entity("number", "brightness", "Brightness", brightness)
    if names:  # A choice of nothing is none.
        values = {"command_topic": f"{topic}/command/play", "options": list(names)}
        yield _Entity("select", "play", "Appearance", values | _state(topic, "value_json.playing or none"))


def _reports(state: str, now: KioskState) -> Iterator[_Entity]:
    """The stage's own description."""

    def reads(expression: str, **more: Any) -> dict[str, Any]:
        return {"state_topic": state, "value_template": f"{{{{ {expression} }}}}"} | more

    def attributes(expression: str) -> dict[str, str]:
        return {"json_attributes_topic": state, "json_attributes_template": f"{{{{ {expression} | tojson }}}}"}

    def measured(expression: str, unit: str, **more: Any) -> dict[str, Any]:
        return reads(expression, unit_of_measurement=unit, entity_category="diagnostic", **more)

    states = [one.value for one in State]
    reason = attributes("{'reason': value_json.reason}")
    yield _Entity("sensor", "state", "State", reads("value_json.state", device_class="enum", options=states, **reason))
    sentences = "{'problems': value_json.problems, 'warnings': value_json.warnings, 'failures': value_json.failures}"
    problem = reads(f"'ON' if {_PROBLEMS} else 'OFF'", device_class="problem", **attributes(sentences))
    yield _Entity("binary_sensor", "problem", "Problem", problem)
    if now.drifts:
        moved = measured("value_json.drift.moved_px", "px", state_class="measurement")
        yield _Entity("sensor", "drift", "Drift", moved)
        advice = reads("value_json.drift.advice", device_class="enum", options=list(ADVICE))
        yield _Entity("sensor", "drift-advice", "Advice of the drift check", advice | {"entity_category": "diagnostic"})
    if now.dose_klx_h is not None:
        dose = measured("value_json.dose_klx_h", "klx·h", state_class="total_increasing")
        yield _Entity("sensor", "dose", "Light dose", dose)
    for lamp in now.lamps:
        key, there = f"lamp-{node(lamp.projector)}", f"(value_json.lamps.get({json.dumps(lamp.projector)}) or {{}})"
        lit = reads(f"'ON' if {there}.get('lit') else 'OFF'")
        yield _Entity("binary_sensor", key, f"Lamp {lamp.projector}", lit)
        hours = measured(f"{there}.get('hours')", "h", device_class="duration", state_class="total_increasing")
        yield _Entity("sensor", f"{key}-hours", f"Lamp {lamp.projector} hours", hours)


def _state(topic: str, expression: str) -> dict[str, str]:
    return {"state_topic": f"{topic}/state", "value_template": f"{{{{ {expression} }}}}"}
