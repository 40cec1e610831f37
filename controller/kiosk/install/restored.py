"""`velatura kiosk install --backup`: a backup on a computer that was blank, with the cables in any order."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import tomlkit

from controller.config import load_stage
from controller.config.loader import FILE
from controller.config.models import StageTables
from controller.config.table import Holds
from controller.core.errors import UsageError, WorkError
from controller.core.kiosk_places import PLAYER_SOCKET, STAGE, STATE, USER
from controller.kiosk.install import steps
from controller.kiosk.install.system import System
from controller.kiosk.outputs import Connected, placed
from controller.kiosk.store import archive
from controller.kiosk.store.references import references
from hal.errors import DeviceError
from hal.player import PlayerClient

MOST_QUESTIONS: Final = 3
ANSWER_S: Final = 10.0
_CONTROLLER: Final = "velatura-controller"
_OWNER: Final = f"{USER}:{USER}"
_UNPACKED: Final = "restore-"
_NOT_MOVED: Final = ("kiosk", "keys", FILE, archive.MARK)

Ask = Callable[[str], str]


@dataclass(frozen=True, slots=True)
class Wanted:
    """An output of the stage: the projector that people know it by, and the serial numbers of its display, if known."""

    output: str
    projector: str
    serials: tuple[str, ...]


def restore(
    system: System, file: Path, *, ask: Ask, say: Callable[[str], None], prefix: Path = Path(sys.prefix)
) -> None:
    """Install the kiosk, find the projectors, and play what the backup has. It can be repeated until it is done.

    Raises UsageError("kiosk-has-stage", "not-a-backup"), WorkError("outputs-not-named"), and as ``steps.install``.
    """
    for cut_off in system.at(STATE).glob(f"{_UNPACKED}*"):
        shutil.rmtree(cut_off, ignore_errors=True)
    if system.read(STAGE / FILE) is not None:
        raise UsageError("kiosk-has-stage", what="This kiosk has a stage already.",
                         remedy=f"Replace it: runuser -u {USER} -- velatura kiosk restore {STAGE} FILE")  # fmt: skip
    archive.check_backup(file)
    steps.install(system, outputs_again=True, restart=False, say=say, prefix=prefix)
    if system.dry:
        say("Then the projectors are found by their serial numbers, or asked for, and the backup is put in place.")
        return
    # It would begin with half of the stage, and show its own text.
    system.run("systemctl", "stop", _CONTROLLER)
    with tempfile.TemporaryDirectory(prefix=_UNPACKED, dir=system.at(STATE)) as name:
        fresh = Path(name)
        archive.restore(fresh, file)
        tables = load_stage(fresh).tables
        there = steps.outputs(system)
        player = system.at(PLAYER_SOCKET)
        found = _found(tables, archive.displays_of(file), there, player, ask=ask, say=say)
        text = _with_places((fresh / FILE).read_text(), found, there)
        text = _with_own_key(fresh, text)
        for part in sorted(fresh.iterdir()):
            if part.name == "keys":
                shutil.copytree(part, system.at(STAGE) / part.name, dirs_exist_ok=True)
            elif part.name not in _NOT_MOVED and not part.name.startswith("."):
                _put(part, system.at(STAGE) / part.name)
        sizes = {(one.width_px, one.height_px) for one in tables.display.outputs}
        steps.write_outputs(system, placed(there, sizes.pop() if len(sizes) == 1 else None))
        system.run("chown", "--recursive", _OWNER, str(STAGE))
        os.sync()
        system.run("systemctl", "start", _CONTROLLER)
        # Last: with it the stage is there, and begins.
        system.write(STAGE / FILE, text, owner=_OWNER)
    for one in references(system.at(STAGE)):
        if one.holds is Holds.KEY_FILE and one.missing:
            say(f"{one.missing} It holds a secret, so it is in no backup: copy it there.")


def _put(part: Path, place: Path) -> None:
    if part.is_dir():
        # What is there is of a restore that was cut off.
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(part, place, symlinks=True)
    else:
        shutil.copy2(part, place)


def matched(wanted: Sequence[Wanted], there: Sequence[Connected]) -> dict[str, str]:
    """Connector by output, where the serial number tells it, or only one of each is left."""
    found: dict[str, str] = {}
    for one in wanted:
        fits = [other.name for other in there if set(one.serials) & set(other.serials)]
        rivals = [other for other in wanted if set(one.serials) & set(other.serials)]
        if len(fits) == 1 and len(rivals) == 1:
            found[one.output] = fits[0]
    left = [one.output for one in wanted if one.output not in found]
    free = [one.name for one in there if one.name not in found.values()]
    if len(left) == len(free) == 1:
        found[left[0]] = free[0]
    return found


def _found(
    tables: StageTables, displays: Mapping[str, tuple[str, ...]], there: Sequence[Connected], player: Path, *,
    ask: Ask, say: Callable[[str], None],
) -> dict[str, str]:  # fmt: skip
    projectors = {table.output: table.name for table in tables.projectors}
    wanted = []
    for output in tables.display.outputs:
        where = output.where or output.name
        serials = displays.get(where, (where,))
        wanted.append(Wanted(output.name, projectors.get(output.name, output.name), serials))
    found = matched(wanted, there)
    left = [one for one in wanted if one.output not in found]
    free = [one for one in there if one.name not in found.values()]
    if left and free:
        found |= _asked(left, there, free, player, ask=ask, say=say)
    for one in wanted:
        if one.output in found:
            say(f"Projector {one.projector} is at {found[one.output]}.")
        else:
            say(f"No projector was found for {one.projector}. Switch it on, and correct its output in stage.toml.")
    return found


def _asked(
    left: Sequence[Wanted], there: Sequence[Connected], free: Sequence[Connected], player: Path, *,
    ask: Ask, say: Callable[[str], None],
) -> dict[str, str]:  # fmt: skip
    """Show a number on each projector, and ask for all of them at once."""
    with _numbers(player, say):
        names = ", ".join(one.projector for one in left)
        numbers = {str(number): one.name for number, one in enumerate(there, 1) if one in free}
        connectors = ", ".join(f"{number} is at {name}" for number, name in numbers.items())
        question = (
            f"Each projector shows a number ({connectors}). Type those of {names}, in this order, with spaces; "
            "- for one that shows none"
        )
        for _ in range(MOST_QUESTIONS):
            words = ask(question).split()
            chosen = [word for word in words if word != "-"]
            if len(words) == len(left) and set(chosen) <= set(numbers) and len(set(chosen)) == len(chosen):
                pairs = zip(left, words, strict=True)
                return {one.output: numbers[word] for one, word in pairs if word != "-"}
            say(f"That is not {len(left)} different ones of {', '.join(numbers)}.")
    raise WorkError("outputs-not-named", what="It is still unknown which projector is at which output.",
                    remedy="Type the same command again.")  # fmt: skip


@contextlib.contextmanager
def _numbers(player: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Numbers on the projectors meanwhile; a player that does not answer is no reason to stop."""
    channel = PlayerClient()
    try:
        channel.request(player, {"op": "identify"}, channel.within(ANSWER_S))
    except DeviceError:
        say("The projectors can't show numbers now. Distinguish them by their connectors.")
    try:
        yield
    finally:
        channel.hang_up()


def _with_places(text: str, found: Mapping[str, str], there: Sequence[Connected]) -> str:
    """stage.toml with where each output is now: by serial number, so that the cables may be swapped later, too."""
    content = tomlkit.parse(text)
    by_name = {one.name: one for one in there}
    for table in content["display"]["outputs"]:
        connector = by_name.get(found.get(str(table["name"]), ""))
        if connector is None:
            continue
        own = [serial for serial in connector.serials if sum(serial in one.serials for one in there) == 1]
        table["where"] = own[0] if own else connector.name
    return tomlkit.dumps(content)


def _with_own_key(stage: Path, text: str) -> str:
    """stage.toml that trusts a new signing key of this computer, too: keys are in no backup."""
    from controller.stage.services.bundle import make_key
    from controller.stage.sessions.calibrations import KEY_FILE

    content = tomlkit.parse(text)
    trusted = content.get("bundle", {}).get("trusted_keys")
    if trusted:
        trusted.append(make_key(stage, (stage / KEY_FILE).stem)["public"])
    return tomlkit.dumps(content)
