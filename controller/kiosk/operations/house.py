"""A house of many stages, and a stage's place in one, as operations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Protocol

from pydantic import Field

from controller.core.errors import UsageError
from controller.kiosk.operations.arguments import AppearanceName, FitName, NewName, TargetFile
from controller.kiosk.operations.fields import TEXT
from controller.kiosk.operations.operation import Effect, Jpeg, Names, operation
from controller.kiosk.roles import Role
from controller.kiosk.state import EventRow, KioskState

HOUSE_FILE: Final = "house.toml"
"""In the folder of a stage whose kiosk is that of a house."""
UPDATE_FILE: Final = "update.deb"
"""Beside it: the signed package of Velatura that the house offers its stages."""
MEMBERSHIP: Final = "keys/house"
"""A stage's membership; keys are in no backup."""
_ABOUT_NAME: Final = "the name of a stage of the house: small letters, digits and hyphens"
StageName = Annotated[str, Field(pattern=r"^[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?$", max_length=63,
                                 description=_ABOUT_NAME), TEXT]  # fmt: skip
Stages = Annotated[str, Field(pattern=r"^[^\u0000-\u001f\u007f]+$", max_length=64, description=(
    "a stage, a group of house.toml, or all")), TEXT]  # fmt: skip
Address = Annotated[str, Field(max_length=256, description="name or number of the computer, as it shows it"), TEXT]
Code = Annotated[str, Field(max_length=20, description="the code that it shows"), TEXT]


@dataclass(frozen=True, slots=True)
class StageNow:
    """A stage of the house. ``state``: the last known, None before the first; ``linked``: it answers now;
    ``appearances``: names of those installed; ``backup_unix_s``: of its newest backup here, None without one;
    ``update``: "trial", "done" or "failed", and why, of its last update; empty without one.
    """

    name: str
    linked: bool
    state: KioskState | None
    groups: tuple[str, ...]
    appearances: tuple[str, ...]
    version: str
    backup_unix_s: float | None
    update: str = ""

    @property
    def urgency(self) -> int:
        """Where a person has to look first: 2, 1, or 0."""
        if not self.linked or self.state is None or self.state.state == "fault":
            return 2
        drifts, state = self.state.drifts, self.state
        wrong = state.failures or any(device.problem for device in state.devices) or state.state == "degraded"
        returned = self.update.startswith("failed")
        return 2 if wrong else int(bool(returned or state.warnings or (drifts and drifts[0].advice != "nothing")))


@dataclass(frozen=True, slots=True)
class HouseNow:
    """``stages``: those with problems first, then by name; ``groups`` of house.toml."""

    name: str
    stages: tuple[StageNow, ...]
    groups: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class HouseEvent:
    """A line of a stage's event log."""

    stage: str
    event: EventRow


@dataclass(frozen=True, slots=True)
class Invitation:
    """What a stage shows, to be typed at the house. ``addresses`` of this computer; valid for ``valid_s`` seconds."""

    code: str
    addresses: tuple[str, ...]
    valid_s: float


@dataclass(frozen=True, slots=True)
class StageUpdate:
    """What an update is to a stage. ``version``: what it has now; ``state``: "" (not its update), "waits", "comes" (it
    gets the package), "trial", "done" or "failed", and ``why``.
    """

    name: str
    version: str
    state: str
    why: str = ""


@dataclass(frozen=True, slots=True)
class Rollout:
    """An update of stages. ``version``: that of update.deb, empty without one; ``begun``: it is under way;
    ``stages``: its own in their order, then the others; ``news``: what changes, for the oldest of their versions.
    """

    version: str
    begun: bool
    stages: tuple[StageUpdate, ...]
    news: tuple[str, ...] = ()


class Stagehouse(Protocol):
    """The house's side; ``controller.kiosk.house.house`` has it."""

    def now(self) -> HouseNow: ...
    def picture(self, stage: str) -> bytes | None: ...
    def events(self) -> Sequence[HouseEvent]: ...
    def do(self, stages: str, verb: str, *, target: Path | None = None, **values: object) -> None: ...
    def admit(self, address: str, code: str) -> None: ...
    def remove(self, stage: str) -> None: ...
    def plan(self, stages: str) -> Sequence[str]: ...
    def update(self, stages: str) -> None: ...
    def stop_update(self) -> None: ...
    def rollout(self) -> Rollout: ...


class Membership(Protocol):
    """The stage's side; ``controller.kiosk.house.member`` has it."""

    def invite(self, name: str) -> Invitation: ...
    def leave(self) -> None: ...


def _no_house() -> Stagehouse:
    raise UsageError(
        "no-house", what="This kiosk is not the one of a house.", remedy="Write a house.toml into its stage's folder."
    )


def no_link() -> UsageError:
    """The error where Zenoh is not installed."""
    return UsageError(
        "no-house-link", what="This kiosk can't join a house.", remedy="Install the extra `link` of Velatura."
    )


def _no_member() -> Membership:
    raise no_link()


@dataclass(frozen=True, slots=True)
class House:
    """What these operations work on. Both raise UsageError where this kiosk has no such side."""

    open: Callable[[], Stagehouse] = _no_house
    member: Callable[[], Membership] = _no_member

    @property
    def there(self) -> bool:
        """Whether this kiosk is that of a house."""
        return self.open is not _no_house


@operation("GET /house", Role.VIEWER, Effect.LOOKS, names=Names(socket="house", command="house state"))
def house_state(house: House) -> HouseNow:
    """Every stage of the house. Those with problems are first."""
    return house.open().now()


@operation("GET /house/stages/{member}/picture", Role.VIEWER, Effect.LOOKS, names=Names(part_of="kiosk house state"))
def house_picture(house: House, member: StageName) -> Jpeg:
    """A small picture of what a stage shows."""
    return house.open().picture(member)


@operation("GET /house/events", Role.VIEWER, Effect.LOOKS, names=Names(command="house events"))
def house_events(house: House) -> Sequence[HouseEvent]:
    """The newest events of all stages of the house, oldest first."""
    return house.open().events()


@operation("POST /house/open", Role.OPERATOR, Effect.CHANGES, done="{stages}: open.", names=Names(command="house open"))
def house_open(house: House, stages: Stages) -> None:
    """Open a stage of the house, a group or all."""
    house.open().do(stages, "open")


@operation("POST /house/close", Role.OPERATOR, Effect.CHANGES, done="{stages}: closed; the lamps cool down.",
           asks="Close {stages}? It becomes black, and the lamps have to cool before they can be lit again.",
           names=Names(command="house close"))  # fmt: skip
def house_close(house: House, stages: Stages) -> None:
    """Close a stage of the house, a group or all."""
    house.open().do(stages, "close")


@operation("POST /house/play", Role.OPERATOR, Effect.CHANGES, done="{stages}: {name} plays now.",
           names=Names(command="house show"))  # fmt: skip
def house_play(house: House, stages: Stages, name: AppearanceName) -> None:
    """Show an appearance on a stage of the house, a group or all."""
    house.open().do(stages, "play", name=name)


@operation("POST /house/appearances", Role.OPERATOR, Effect.CHANGES, done="{stages}: the computation has started.",
           names=Names(command="house compute"))  # fmt: skip
def house_compute(house: House, stages: Stages, name: NewName, target: TargetFile, fit: FitName = "fit") -> None:
    """Let a stage of the house, a group or all compute an appearance from a target picture, and install it."""
    house.open().do(stages, "compute", target=target, name=name, fit=fit)


@operation("GET /house/update", Role.TECHNICIAN, Effect.LOOKS, names=Names(command="house update-plan"))
def house_update_plan(house: House, stages: Stages) -> Sequence[str]:
    """Where an update would go first, and what would change. Its package is the file update.deb beside house.toml."""
    return house.open().plan(stages)


@operation("POST /house/update", Role.TECHNICIAN, Effect.CHANGES, done="The update goes to the first stage.",
           asks="Update {stages}? The first stage has to prove it before the others get it.",
           names=Names(command="house update"))  # fmt: skip
def house_update(house: House, stages: Stages) -> None:
    """Bring update.deb to a stage of the house, a group or all. The first stage has to prove it before the others."""
    house.open().update(stages)


@operation("DELETE /house/update", Role.TECHNICIAN, Effect.CHANGES, done="The update goes to no more stages.",
           names=Names(command="house update-stop"))  # fmt: skip
def house_update_stop(house: House) -> None:
    """Bring the update to no more stages. One that has it already keeps it, or goes back, by itself."""
    house.open().stop_update()


@operation("POST /house/stages", Role.TECHNICIAN, Effect.CHANGES, done="The stage belongs to the house now.",
           names=Names(command="house add"))  # fmt: skip
def house_add(house: House, address: Address, code: Code) -> None:
    """Admit a stage that shows a code (`velatura kiosk house join`)."""
    house.open().admit(address, code)


@operation("DELETE /house/stages/{member}", Role.TECHNICIAN, Effect.CHANGES, done="{member} is no longer in the house.",
           asks="Remove {member} from the house? It plays on by itself.",
           names=Names(command="house remove"))  # fmt: skip
def house_remove(house: House, member: StageName) -> None:
    """Remove a stage from the house. Its certificate counts no more."""
    house.open().remove(member)


@operation("POST /house/join", Role.TECHNICIAN, Effect.CHANGES,
           done="Type this code at the house within ten minutes: {code}",
           names=Names(command="house join"))  # fmt: skip
def house_join(house: House, name: StageName) -> Invitation:
    """Let this stage join a house. The answer is a code, to be typed at the house."""
    return house.member().invite(name)


@operation("DELETE /house/join", Role.TECHNICIAN, Effect.CHANGES, done="This stage is in no house any more.",
           asks="Leave the house? The stage plays on by itself.", names=Names(command="house leave"))  # fmt: skip
def house_leave(house: House) -> None:
    """Let this stage leave its house."""
    house.member().leave()


HOUSE_OPERATIONS: Final = (
    house_state, house_picture, house_events, house_open, house_close, house_play, house_compute, house_add,
    house_remove, house_update_plan, house_update, house_update_stop, house_join, house_leave,
)  # fmt: skip
