"""Files and bundles that go bad, and what people do about it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

from controller.bundle.install import Starts, current, previous
from controller.stage.rig.lamp_ledger import LampFile
from lab.simulate.disk import STAGE
from lab.simulate.monitors.bundles import SHOWN_S, is_sound
from lab.simulate.monitors.log import PAGE_BYTES, pages_of, readable
from lab.simulate.monitors.monitor import PLAYER_S, REPAIR_S
from lab.simulate.scenarios.power import cut_power
from lab.simulate.scenarios.scenario import DIED, POWER_CUT, STOPPED, WRITTEN_LAST, Incident
from lab.simulate.scenarios.system import SystemUnderTest
from lab.simulate.stage import publish

SECTOR_BYTES: Final = 512
BLOCK_BYTES: Final = 4096
"""Disks and cards of today write and lose so much at a time."""
LOG: Final = STAGE / "kiosk" / "events.sqlite"
MEND_FILE_S: Final = 600.0
_TWINS: Final = {LampFile.NAME: LampFile.COPY, LampFile.COPY: LampFile.NAME}


def damage_file(life: SystemUnderTest, incident: Incident) -> None:
    """While the service is away, a file becomes another one. Somebody puts the settings right after a while.
    Raises Violation.

    With the arguments "stopped" the service has ended as it should: what its log's write-ahead log had is in the file.
    """
    last = pages_of(LOG.with_name(f"{LOG.name}-wal")) if incident.target.endswith(LOG.name) else []
    if incident.arguments == STOPPED and life.service is not None:
        life.end(lit=True)
    else:
        life.end_of_program()
    path = STAGE / incident.target
    life.monitor.log.in_file(LOG)
    before = path.read_bytes() if path.is_file() else None
    twin = _TWINS.get(incident.target)
    if incident.variant == "removed" and twin is not None and not (STAGE / twin).is_file():
        # Without both, it is a stage whose lamps were never lit.
        before = None
    if before is not None:
        life.damaged.add(incident.target)
        # A stage.toml that is gone is not replaced: it would most likely be the wrong folder.
        gone = incident.target == "stage.toml" and incident.variant == "removed"
        life.unreadable |= {incident.target, "kiosk/stage.toml.good"} if gone else {incident.target}
        if incident.variant == "removed":
            path.unlink()
        else:
            path.write_bytes(_damaged(before, incident, last))
        if incident.target.startswith("kiosk/events"):
            life.monitor.log.begun_checks.clear()
            life.monitor.log.damaged(readable(LOG))
            life.monitor.expectation.unsure_until_hours()
        if incident.target.endswith("lamps.json"):
            life.monitor.lamps.ledger_lost()
        if incident.target == "schedule.toml":
            # With other hours for a while, what people said may have ended.
            life.monitor.expectation.unsure_until_hours()
        if incident.target in ("stage.toml", "schedule.toml"):
            life.monitor.expectation.wrong(MEND_FILE_S + REPAIR_S)
            if (
                incident.target not in life.originals
            ):  # of a file that is damaged twice, what it was before the first time
                life.originals[incident.target] = before
                life.later(MEND_FILE_S, partial(_put_right, life, path))
    life.world.scheduler.sleep(2.0)
    life.boot()


def _damaged(content: bytes, incident: Incident, last: Sequence[int]) -> bytes:
    """``last``: the pages that were written last, of a file that has such."""
    at = int(incident.magnitude % 1 * len(content))
    if incident.magnitude >= WRITTEN_LAST and last:
        part, within = divmod(incident.magnitude % 1 * len(last), 1)
        at = max(0, min(int((last[int(part)] - 1 + within) * PAGE_BYTES), len(content) - 1))
    match incident.variant:
        case "empty":
            return b""
        case "cut":
            return content[:at]
        case "block":
            return _flipped(content, at - at % BLOCK_BYTES, BLOCK_BYTES)
        case "half":
            # The first sectors of a block were written, and the others not.
            at -= at % SECTOR_BYTES
            return _zeros(content, at, at - at % BLOCK_BYTES + BLOCK_BYTES)
        case "zeros":
            # The file has its length, and what was to be there was never written.
            return _zeros(content, at - at % SECTOR_BYTES, len(content))
    size = 64
    if len(content) > 8 * SECTOR_BYTES:
        # Disks lose whole sectors; in a small file that would be all of it.
        at, size = at - at % SECTOR_BYTES, SECTOR_BYTES
    return _flipped(content, at, size)


def _flipped(content: bytes, at: int, size: int) -> bytes:
    return content[:at] + bytes(byte ^ 0xA5 for byte in content[at : at + size]) + content[at + size :]


def _zeros(content: bytes, at: int, until: int) -> bytes:
    return content[:at] + bytes(min(until, len(content)) - at) + content[until:]


def _put_right(life: SystemUnderTest, path: Path) -> None:
    if (before := life.originals.pop(path.name, None)) is None:
        return
    path.write_bytes(before)
    life.unreadable.discard(path.name)
    life.repaired_s = life.world.scheduler.now_s
    if life.service is not None:
        life.restart(lit=True)
    life.monitor.disturb(0.0)


def damage_bundle(life: SystemUnderTest, incident: Incident) -> None:
    """The file of the installed bundle goes bad, or those of all, and the player dies, or the power is cut.

    After a while the appearances are published again. Until then the bundle before plays, where there is a sound one.
    """
    bundles, world, monitor = STAGE / "bundles", life.world, life.monitor
    newest, earlier = current(bundles), previous(bundles)
    if newest is None:
        return
    for file in [newest, earlier] if incident.variant == "all" else [newest]:
        if file is not None:
            _spoil(file)
            monitor.bundles.spoilt.setdefault(file.name, world.scheduler.now_s)
    if world.screen.process is not None:
        world.screen.process.kill()
    repaired_s = incident.duration_s or MEND_FILE_S
    monitor.bundle_bad_until_s = max(monitor.bundle_bad_until_s, world.scheduler.now_s + repaired_s)
    monitor.disturb(SHOWN_S if _goes_back(bundles, earlier) else repaired_s, PLAYER_S)
    monitor.disturb_player(repaired_s)

    def repair() -> None:
        publish_again(life)
        monitor.disturb(0.0, PLAYER_S)

    life.later(repaired_s, repair)
    if incident.arguments == POWER_CUT:
        cut_power(life, 0.0)


def publish_again(life: SystemUnderTest) -> None:
    """The appearances, by another computer."""
    publish(STAGE, int(life.world.truth_s))
    written = current(STAGE / "bundles")
    if written is not None:
        # Twice in one second gives the same name, and a sound file in the place of a bad one.
        life.monitor.bundles.spoilt.pop(written.name, None)


def make_bundles_unreadable(life: SystemUnderTest, incident: Incident) -> None:
    """The disk gives errors where bundles are, and then no more: a cable, a controller, no file handle left.

    With the arguments "the player died" it could not read its own program any more either.
    """
    disk, monitor = life.world.disk, life.monitor
    disk.blind = True
    if incident.arguments == DIED and life.world.screen.process is not None:
        life.world.screen.process.kill()
    monitor.disturb(incident.duration_s, PLAYER_S)
    monitor.disturb_player(incident.duration_s)

    def repair() -> None:
        disk.blind = False

    life.later(incident.duration_s, repair)


def _spoil(file: Path) -> None:
    """Twice is as bad as once."""
    content = file.read_bytes()
    half = len(content) // 2
    file.write_bytes(content[:half] + bytes(len(content) - half))


def _goes_back(bundles: Path, earlier: Path | None) -> bool:
    """Whether the player can play the bundle before instead of the newest."""
    if earlier is None or earlier.name == Starts.read(bundles).given_up:
        return False
    return is_sound(earlier)
