"""Writes new devices, and settings that the devices contradict, to stage.toml."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from controller.config import Stage, StageTables, write_stage
from controller.config.writer import KeyChange, rewrite_stage
from controller.core.errors import UsageError
from controller.stage.doctor.values import Examination
from hal.finding import Found

CORRECTIONS: Final = ("serial-wrong-baud", "serial-other-profile")
"""Problems that a setting in the finder's table corrects."""
SINGLE: Final[Mapping[str, str]] = {"camera": "camera", "light_sensor": "light_sensor", "button_panel": "key_panel"}
"""Kinds of which a stage has at most one, with the name of the table."""
FIRST_ISO: Final = 100


@dataclass(frozen=True, slots=True)
class Plan:
    """Planned changes: keys, new tables, and both in words."""

    changes: list[KeyChange] = field(default_factory=list)
    tables: dict[str, Any] = field(default_factory=dict)
    words: list[str] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.changes or self.tables)


def plan_for(stage: Stage, seen: Examination) -> Plan:
    """The changes for an existing stage.toml."""
    plan = Plan()
    _correct(stage, seen.found, plan)
    outputs = _outputs(stage.tables, seen.found)
    free = [name for name in outputs if name not in {projector.output for projector in stage.tables.projectors}]
    names = {projector.name for projector in stage.tables.projectors}
    for device in seen.new:
        if device.kind == "projector" and free:
            name = next(f"projector-{n}" for n in range(1, 1000) if f"projector-{n}" not in names)
            names.add(name)
            table = {"name": name, "output": free.pop(0), "driver": device.driver, **device.settings}
            plan.tables.setdefault("projectors", []).append(table)
            plan.words.append(f"projector {name} at {device.address} on output {table['output']}")
        elif device.kind in ("light_sensor", "button_panel") and not getattr(stage.tables, SINGLE[device.kind]):
            table_name = SINGLE[device.kind]
            if table_name not in plan.tables:
                plan.tables[table_name] = {"driver": device.driver, **device.settings}
                plan.words.append(f"[{table_name}] {device.what}")
    return plan


def new_stage(folder: Path, seen: Examination) -> tuple[dict[str, Any], list[str]]:
    """The content of a first stage.toml, and a description. Raises UsageError("doctor-not-enough")."""
    outputs = [table for device in seen.found if device.kind == "display" for table in device.settings["outputs"]]
    projectors = [device for device in seen.new if device.kind == "projector"]
    cameras = [device for device in seen.new if device.kind == "camera"]
    missing = [
        word
        for word, there in (
            ("a projector", projectors),
            ("a camera", cameras),
            ("an output for each projector", len(outputs) >= len(projectors) > 0),
        )
        if not there
    ]
    if missing:
        raise UsageError(
            "doctor-not-enough",
            what=f"No stage.toml was written, because the stage still needs {', '.join(missing)}.",
            remedy="Connect the missing devices and switch them on, or see docs/reference/stage-toml.md.",
        )
    content: dict[str, Any] = {
        "stage": {"name": folder.resolve().name},
        "projectors": [
            {"name": f"projector-{n}", "output": output["name"], "driver": one.driver, **one.settings}
            for n, (one, output) in enumerate(zip(projectors, outputs, strict=False), 1)
        ],
        "camera": {"driver": cameras[0].driver, "iso": FIRST_ISO, **cameras[0].settings},
        "display": {"driver": "player", "outputs": outputs},
    }
    for device in seen.new:
        if device.kind in ("light_sensor", "button_panel"):
            content.setdefault(SINGLE[device.kind], {"driver": device.driver, **device.settings})
    return content, [f"[{name}]" if not isinstance(table, list) else f"{len(table)} [[{name}]]"
                     for name, table in content.items()]  # fmt: skip


def write(folder: Path, stage: Stage | None, seen: Examination) -> tuple[str, ...]:
    """Write the devices found to stage.toml; returns a description of the changes.

    Raises UsageError if the result would not be a valid stage ("doctor-not-enough", or as ``load_stage``); the file
    is then unchanged.
    """
    if stage is None:
        content, words = new_stage(folder, seen)
        write_stage(folder / "stage.toml", content)
        return tuple(words)
    plan = plan_for(stage, seen)
    if plan:
        rewrite_stage(stage.folder / "stage.toml", plan.changes, plan.tables)
    return tuple(plan.words)


def _correct(stage: Stage, found: Sequence[Found], plan: Plan) -> None:
    for device in found:
        if not any(problem.code in CORRECTIONS for problem in device.problems):
            continue
        for position, projector in enumerate(stage.tables.projectors):
            written = projector.model_dump()
            if projector.driver != device.driver or written.get("port") != device.settings.get("port"):
                continue
            wanted = {key: value for key, value in device.settings.items() if written.get(key) != value}
            for key, value in wanted.items():
                plan.changes.append(KeyChange(("projectors", position), key, value))
                plan.words.append(f"{key} = {value!r} for projector {projector.name}")


def _outputs(tables: StageTables, found: Sequence[Found]) -> list[str]:
    own = [output.name for output in tables.display.outputs]
    return own or [
        table["name"] for device in found if device.kind == "display" for table in device.settings["outputs"]
    ]
