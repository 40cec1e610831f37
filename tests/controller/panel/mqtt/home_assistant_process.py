"""Home Assistant with nothing but its MQTT integration, in an environment that ``.ci/setup-peer homeassistant`` makes.

Arguments: the broker's port, user and password, a folder. Reads one JSON object a line: ``{"wait": N}`` for the states
of all entities once there are N, ``{"call": "switch.turn_on", "data": {...}}`` for an action. Answers with one line.
"""

from __future__ import annotations

import asyncio
import json
import logging
import sys
from pathlib import Path
from typing import Any

from homeassistant import bootstrap, config_entries, core, loader
from homeassistant.auth import auth_manager_from_config
from homeassistant.setup import async_setup_component


def write_settings(folder: Path, port: int, user: str, password: str) -> None:
    """As its dialogue for a new broker writes them."""
    broker = {"broker": "127.0.0.1", "port": port, "username": user, "password": password}
    entry = {"entry_id": "broker", "version": 1, "minor_version": 1, "domain": "mqtt", "title": "broker",
             "data": {**broker, "discovery": True, "discovery_prefix": "homeassistant"}, "options": {},
             "pref_disable_new_entities": False, "pref_disable_polling": False, "source": "user", "unique_id": None,
             "disabled_by": None}  # fmt: skip
    kept = {"version": 1, "minor_version": 1, "key": "core.config_entries", "data": {"entries": [entry]}}
    (folder / ".storage").mkdir(parents=True)
    (folder / ".storage" / "core.config_entries").write_text(json.dumps(kept))
    (folder / "configuration.yaml").write_text("\n")


async def started(folder: Path) -> Any:
    hass = core.HomeAssistant(str(folder))
    hass.config.skip_pip = True
    loader.async_setup(hass)
    hass.config_entries = config_entries.ConfigEntries(hass, {})
    await bootstrap.async_load_base_functionality(hass)
    hass.auth = await auth_manager_from_config(hass, [], [])
    # Its web server listens only after a whole start, which this is not.
    if not await async_setup_component(hass, "mqtt", {}):
        raise SystemExit("the MQTT integration did not start")
    return hass


def states(hass: Any) -> dict[str, Any]:
    return {
        state.entity_id: {"state": state.state, **state.attributes}
        for state in hass.states.async_all()
        if state.domain != "zone"
    }


async def answer(hass: Any, asked: dict[str, Any]) -> Any:
    if "call" in asked:
        domain, action = asked["call"].split(".")
        await hass.services.async_call(domain, action, asked["data"], blocking=True)
        return None
    while len(states(hass)) != asked["wait"]:
        await asyncio.sleep(0.05)
    return states(hass)


async def main() -> None:
    logging.basicConfig(level=logging.WARNING)
    folder = Path(sys.argv[4])
    write_settings(folder, int(sys.argv[1]), sys.argv[2], sys.argv[3])
    hass = await started(folder)
    while line := await asyncio.to_thread(sys.stdin.readline):
        async with asyncio.timeout(60):
            print(json.dumps(await answer(hass, json.loads(line)), default=str), flush=True)
    await hass.async_stop(force=True)


asyncio.run(main())
