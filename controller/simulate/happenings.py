"""What the items of a script do to a life, and how the witness has to take them."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol

from controller.bundle.install import current, previous
from controller.bundle.reader import Bundle
from controller.bundle.starts import Starts
from controller.core.errors import VelaturaError
from controller.kiosk.api.kiosk import StageKiosk
from controller.kiosk.service import Service
from controller.simulate.calendar import Calendar
from controller.simulate.disk import STAGE, TOTAL_BYTES
from controller.simulate.lamps import RULES, Lamp
from controller.simulate.promises import REPAIR_S, SETTLING_S, Witness
from controller.simulate.scheduler import Event, Killed
from controller.simulate.script import Item
from controller.simulate.stage import TRUST, publish
from controller.simulate.world import SimulatedWorld


class Living(Protocol):
    """A life, as far as it is needed here; see ``life.Life``."""

    world: SimulatedWorld
    witness: Witness
    service: Service | None
    damaged: set[str]
    unreadable: set[str]
    sound: dict[str, bytes]
    repaired_s: float
    news: Event

    def later(self, seconds: float, repair: Callable[[], None]) -> None: ...

    def boot(self) -> None: ...

    def end_of_program(self) -> None: ...

    def restart(self, *, lit: bool) -> None: ...

    def command(self, item: Item) -> None: ...


PLAYER_S: Final = 120.0
"""After trouble with the player: its longest pause before a start, and a start that fails."""
SECTOR_BYTES: Final = 512
MEND_FILE_S: Final = 600.0
GOES_OUT_S: Final = 35.0
"""Longer than a lamp takes to give light, and shorter than its light takes to be stable."""
HOLD_S: Final = 7200.0
"""For so long a kiosk's time may stand still after its clock was set back."""


def happen(life: Living, item: Item) -> None:
    """Let it happen. Raises Broken."""
    _DEEDS[item.what](life, item)


def _line(life: Living, item: Item) -> None:
    line = life.world.lines[item.who]
    line.trouble = item.how
    line.connection += item.how == "gone"
    life.witness.disturb(item.for_s + 120.0)

    def repair() -> None:
        line.trouble = ""

    life.later(item.for_s, repair)


def _lamp_fails(life: Living, item: Item) -> None:
    lamp = life.world.lamps[item.who]
    if item.how == "goes out":
        lamp.lasts_s = GOES_OUT_S
    else:
        lamp.dud = True
        lamp.go_dark()
    life.witness.disturb(item.for_s)
    life.later(item.for_s, partial(_new_lamp, life, lamp))


def _new_lamp(life: Living, lamp: Lamp) -> None:
    """A technician puts in a new one, and opens the stage if it is to be open."""
    lamp.dud, lamp.fault, lamp.lasts_s = False, "", float("inf")
    life.witness.disturb(0.0)
    if life.service is not None:
        for supervisor in life.service.devices.projectors:
            supervisor.forgive()
    life.witness.forgive()


def _lamp_reports(life: Living, item: Item) -> None:
    lamp = life.world.lamps[item.who]
    lamp.fault = item.how
    if item.how in ("temperature", "cover"):
        lamp.go_dark()
    life.witness.disturb(item.for_s)
    life.later(item.for_s, partial(_new_lamp, life, lamp))


def _by_hand(life: Living, item: Item) -> None:
    lamp = life.world.lamps[item.who]
    now_s = life.world.scheduler.now_s
    if item.how == "off":
        lamp.go_dark()
    elif not lamp.lit and not lamp.bad and now_s - lamp.off_at_s >= RULES.minimum_off_s:
        lamp.lit_at_s, lamp.by_hand = now_s, True
    life.witness.disturb(0.0)


def _player(life: Living, item: Item) -> None:
    screen, now_s = life.world.screen, life.world.scheduler.now_s
    witness = life.witness
    fell = item.how in ("killed", "hung") and witness.calm and bool(screen.appearance)
    if item.how in ("killed", "crashes"):
        screen.dies_at_start = max(screen.dies_at_start, int(item.number))
        if screen.process is not None:
            screen.process.kill()
    elif item.how == "crashes at a picture":
        screen.dies_at_play = max(screen.dies_at_play, int(item.number))
        if screen.process is not None:
            screen.process.kill()
    elif item.how == "hung":
        screen.hung = True
    else:
        screen.trouble = item.how

        def repair() -> None:
            screen.trouble = ""

        life.later(item.for_s, repair)
    witness.player_disturbed_until_s = max(witness.player_disturbed_until_s, now_s + item.for_s + PLAYER_S)
    witness.disturb(item.for_s, PLAYER_S)
    if fell:
        witness.player_fell()


def _camera(life: Living, item: Item) -> None:
    camera = life.world.camera
    camera.gone = True
    camera.connection += 1

    def repair() -> None:
        camera.gone = False

    life.later(item.for_s, repair)


def _disk_full(life: Living, item: Item) -> None:
    disk = life.world.disk
    disk.full = True
    life.witness.disturb(item.for_s)

    def repair() -> None:
        disk.full = False

    life.later(item.for_s, repair)


def _disk_low(life: Living, item: Item) -> None:
    disk = life.world.disk
    disk.free_bytes = 1_000_000_000

    def repair() -> None:
        disk.free_bytes = TOTAL_BYTES // 2

    life.later(item.for_s, repair)


def _killed(life: Living, item: Item) -> None:
    lit = life.witness.lamps_that_stay()
    life.end_of_program()
    life.world.scheduler.sleep(2.0)
    life.boot()
    life.witness.stays_lit = lit


def _killed_writing(life: Living, item: Item) -> None:
    life.world.disk.kill_after = int(item.number)
    life.witness.disturb(600.0)


def _power_cut(life: Living, item: Item) -> None:
    world = life.world
    life.end_of_program()
    if world.screen.process is not None:
        world.screen.process.kill()
    for lamp in world.lamps.values():
        lamp.go_dark()
    world.scheduler.sleep(item.for_s + 1.0)
    world.reboot()
    life.witness.disturb(0.0)
    life.witness.forgive()
    life.boot()


def _restarted(life: Living, item: Item) -> None:
    lit = life.witness.lamps_that_stay() if item.how == "lamps stay lit" else {}
    life.restart(lit=item.how == "lamps stay lit")
    life.witness.stays_lit = lit


def _clock(life: Living, item: Item) -> None:
    world, witness = life.world, life.witness
    world.clock_off_s, world.is_synchronised = item.number, False
    _unsure(life, item.for_s + HOLD_S + REPAIR_S)

    def repair() -> None:
        world.clock_off_s, world.is_synchronised = 0.0, True
        _unsure(life, HOLD_S + REPAIR_S)
        if witness.override is not None:
            _unsure_until_hours(life)

    life.later(item.for_s, repair)


def _unsure(life: Living, for_s: float) -> None:
    """For so long nobody knows from outside whether the kiosk takes itself for open."""
    witness = life.witness
    witness.clock_wrong_until_s = max(witness.clock_wrong_until_s, life.world.scheduler.now_s + for_s)


def _unsure_until_hours(life: Living) -> None:
    witness = life.witness
    witness.override = None
    edge_s = witness.next_edge_s()
    _unsure(life, min(edge_s - life.world.scheduler.now_s, 9 * 86_400.0) + SETTLING_S)


def _no_network(life: Living, item: Item) -> None:
    world = life.world
    world.no_network = True

    def repair() -> None:
        world.no_network = False

    life.later(item.for_s, repair)


def _drift(life: Living, item: Item) -> None:
    life.world.drifted = True


def _file_damaged(life: Living, item: Item) -> None:
    """While the service is away, a file becomes another one. Somebody puts the settings right after a while."""
    life.end_of_program()
    path = STAGE / item.who
    before = path.read_bytes() if path.is_file() else None
    if before is not None:
        life.damaged.add(item.who)
        # A stage.toml that is gone is not replaced: it would most likely be the wrong folder.
        gone = item.who == "stage.toml" and item.how == "removed"
        life.unreadable |= {item.who, "kiosk/stage.toml.good"} if gone else {item.who}
        if item.how == "removed":
            path.unlink()
        else:
            path.write_bytes(_damaged(before, item))
        if item.who.startswith("kiosk/events"):
            life.witness.begun_checks.clear()
            _unsure_until_hours(life)
        if item.who.endswith("lamps.json"):
            life.witness.ledger_lost()
        if item.who == "schedule.toml":
            # With other hours for a while, what people said may have ended.
            _unsure_until_hours(life)
        if item.who in ("stage.toml", "schedule.toml"):
            _unsure(life, MEND_FILE_S + REPAIR_S)
            if item.who not in life.sound:  # of a file that is damaged twice, what it was before the first time
                life.sound[item.who] = before
                life.later(MEND_FILE_S, partial(_put_right, life, path))
    life.world.scheduler.sleep(2.0)
    life.boot()


def _damaged(content: bytes, item: Item) -> bytes:
    at = int(item.number * len(content))
    if item.how == "empty":
        return b""
    if item.how == "cut":
        return content[:at]
    size = 64
    if len(content) > 8 * SECTOR_BYTES:
        # Disks lose whole sectors; in a small file that would be all of it.
        at, size = at - at % SECTOR_BYTES, SECTOR_BYTES
    return content[:at] + bytes(byte ^ 0xA5 for byte in content[at : at + size]) + content[at + size :]


def _put_right(life: Living, path: Path) -> None:
    path.write_bytes(life.sound.pop(path.name))
    life.unreadable.discard(path.name)
    life.repaired_s = life.world.scheduler.now_s
    if life.service is not None:
        life.restart(lit=True)
    life.witness.disturb(0.0)


def _bundle_damaged(life: Living, item: Item) -> None:
    """The file of the installed bundle goes bad, or those of all, and the player dies.

    After a while the appearances are published again. Until then the bundle before plays, where there is a sound one.
    """
    bundles, world, witness = STAGE / "bundles", life.world, life.witness
    newest, earlier = current(bundles), previous(bundles)
    if newest is None:
        return
    _spoil(newest)
    if item.how == "all" and earlier is not None:
        _spoil(earlier)
    _player(life, Item(item.at_s, "player", "", "killed"))
    repaired_s = item.for_s or MEND_FILE_S
    witness.disturb(0.0 if _goes_back(bundles, earlier) else repaired_s)
    witness.player_disturbed_until_s = max(
        witness.player_disturbed_until_s, world.scheduler.now_s + repaired_s + PLAYER_S
    )

    def repair() -> None:
        publish(STAGE, int(world.truth_s))
        witness.disturb(0.0)

    life.later(repaired_s, repair)


def _bundles_unreadable(life: Living, item: Item) -> None:
    """The disk gives errors where bundles are, and then no more: a cable, a controller, no file handle left."""
    disk, witness = life.world.disk, life.witness
    disk.blind = True
    witness.disturb(item.for_s)
    witness.player_disturbed_until_s = max(
        witness.player_disturbed_until_s, life.world.scheduler.now_s + item.for_s + PLAYER_S
    )

    def repair() -> None:
        disk.blind = False

    life.later(item.for_s, repair)


def _spoil(file: Path) -> None:
    content = file.read_bytes()
    half = len(content) // 2
    file.write_bytes(content[:half] + bytes(byte ^ 0xA5 for byte in content[half:]))


def _goes_back(bundles: Path, earlier: Path | None) -> bool:
    """Whether the player can play the bundle before instead of the newest."""
    if earlier is None or earlier.name == Starts.read(bundles).given_up:
        return False
    try:
        Bundle.open_trusted(earlier, TRUST).close()
    except VelaturaError:
        return False
    return True


def _command(life: Living, item: Item) -> None:
    life.command(item)


_DEEDS: Final[Mapping[str, Callable[[Living, Item], None]]] = {
    "line": _line, "lamp fails": _lamp_fails, "lamp reports": _lamp_reports, "lamp switched by hand": _by_hand,
    "player": _player, "camera gone": _camera, "disk full": _disk_full, "disk low": _disk_low,
    "file damaged": _file_damaged, "bundle damaged": _bundle_damaged, "bundles unreadable": _bundles_unreadable,
    "killed": _killed, "killed while writing": _killed_writing, "power cut": _power_cut, "restarted": _restarted,
    "clock set": _clock, "network gone": _no_network, "drift": _drift, "command": _command,
}  # fmt: skip


@contextlib.contextmanager
def whole(life: Living) -> Iterator[None]:
    """Of a command in the middle of which the program is killed, nobody knows whether it was kept."""
    try:
        yield
    except Killed:
        _unsure_until_hours(life)
        raise


def arguments_of(life: Living, item: Item, kiosk: StageKiosk) -> dict[str, Any]:
    """The values of a command. Raises VelaturaError."""
    values: dict[str, Any] = json.loads(item.arguments or "{}")
    if item.who == "save-settings":
        values["text"] = _changed(kiosk.settings(), values["text"])
    return values


def _changed(text: str, what: str) -> str:
    if what == "comment":
        return f"{text.rstrip()}\n# A comment.\n"
    if what == "projector":
        plain, other = 'address = "192.0.2.1"', 'address = "192.0.2.1"\nprofile = "pjlink"'
        return text.replace(other, plain) if other in text else text.replace(plain, other)
    return (
        text.replace("power_down_s = 20.0", "power_down_s = 21.0")
        if "power_down_s = 20.0" in text
        else text.replace("power_down_s = 21.0", "power_down_s = 20.0")
    )


def believe(life: Living, item: Item, values: Mapping[str, Any]) -> None:
    """A command was accepted: what it asks for is wanted from now on."""
    witness, now_s = life.witness, life.world.scheduler.now_s
    if item.who in ("start", "play", "rotate"):
        witness.say(True)
        witness.disturb(0.0, SETTLING_S)
        if item.who == "start":
            witness.forgive()
    elif item.who == "stop":
        witness.say(False)
        witness.disturb(0.0, SETTLING_S)
    elif item.who == "set-schedule":
        witness.use(Calendar(values["time_zone"], values["rows"]))
        life.news.set()
        witness.disturb(0.0)
    elif item.who == "test-shots":
        witness.light_until_s = now_s + 900.0 + SETTLING_S
    elif item.who in ("save-settings", "recalibrate", "compare", "cancel"):
        witness.disturb(0.0)
    else:
        witness.disturb(0.0, 60.0)
    if life.world.disk.full:
        _unsure_until_hours(life)
