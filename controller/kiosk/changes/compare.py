"""From two inventories to the changes between them, in words, each with what to do."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

from controller.core.text import printable
from controller.kiosk.changes.inventory import Fact, Inventory
from controller.kiosk.changes.values import Change


class _Kind(NamedTuple):
    """``title`` of a kind of fact, in a sentence; what to do ``if_changed``."""

    title: str
    if_changed: str


_MEASURE: Final = "Recalibrate (quick) when the stage is closed."
_OLD_ONE: Final = "If the picture is worse than before, install the version of before."
KINDS: Final = {
    "kernel": _Kind("The kernel", f"{_OLD_ONE} It is in the boot menu."),
    "gpu driver": _Kind(
        "The driver of the graphics card", f"Look at the outputs: `velatura kiosk identify`. {_OLD_ONE}"
    ),
    "gpu": _Kind("The graphics card", "Type `velatura kiosk install --outputs`, then look at the outputs."),
    "package": _Kind("The package", _OLD_ONE),
    "edid": _Kind(
        "The display at output",
        "Check its cable, and whether it is the projector of before. If it is another one, calibrate the stage.",
    ),
    "mode": _Kind(
        "The mode of output",
        "Set the mode of before: the calibration holds only for that one. "
        "`velatura kiosk install --outputs` writes it again.",
    ),
    "output order": _Kind(
        "The place of output",
        "Put the cables as they were, or correct the outputs in stage.toml. "
        "`velatura kiosk identify` shows which projector is which.",
    ),
    "serial adapter": _Kind(
        "The serial adapter",
        "Plug it in where it was, or correct the port in stage.toml. `velatura doctor` finds it.",
    ),
    "projector": _Kind("The projector", "If it was exchanged, calibrate the stage."),
    "projector firmware": _Kind("The firmware of projector", f"Check its picture settings. {_MEASURE}"),
    "input": _Kind("The input of projector", "Choose the input of before with its remote control."),
    "keystone": _Kind(
        "The keystone of projector", "Set it as before with its remote control. Otherwise calibrate the stage."
    ),
    "lamp mode": _Kind("The lamp mode of projector", f"Set it as before with its remote control. Or: {_MEASURE}"),
    "camera body": _Kind("The camera", "Connect the camera of before, or calibrate the stage."),
    "camera firmware": _Kind("The firmware of the camera", "Take test shots. If they look as before, do nothing."),
    "camera settings": _Kind("The camera's", "Set the dial to M and the lens to manual focus, then take test shots."),
    "lens": _Kind("The camera's lens", "Mount the lens of before, set to the same length, or calibrate the stage."),
    "settings": _Kind("In stage.toml,", "If this was changed by mistake, correct it in the panel under Settings."),
    "clock": _Kind("The clock:", "Check the time zone and the time server. Opening hours depend on them."),
    "network": _Kind("The network:", "Check the cable and the router. Projectors and people reach each other by it."),
}
"""By the kind of a fact, in the order in which they are shown."""
COME_AND_GO: Final = frozenset({"gpu driver", "gpu", "package", "edid", "serial adapter", "settings", "network"})
"""Kinds of which one that is not listed is not there; of the others it can't be read now."""


def changes(before: Inventory, now: Inventory, nights: Iterable[Inventory] = ()) -> tuple[Change, ...]:
    """What differs, in the order of ``KINDS``; ``nights``: those between, which tell since when."""
    was, new = _by_key(before.facts), _by_key(now.facts)
    # In each: a night in which a device was off does not know.
    seen = [(night.taken_unix_s, _by_key(night.facts)) for night in nights]
    found = []
    swapped = _swapped(was, new)
    for key in sorted(was.keys() | new.keys(), key=lambda key: (_place(key[0]), key[1])):
        absent = "" if key[0] in COME_AND_GO else None
        old, fresh = was.get(key, absent), new.get(key, absent)
        if old == fresh or old is None or fresh is None or key in swapped:
            continue
        since = next((at for at, facts in seen if facts.get(key, absent) not in (None, old)), now.taken_unix_s)
        found.append(_change(*key, old, fresh, since))
    if swapped:
        names = " and ".join(sorted(name for _, name in swapped))
        sentence = f"The displays at outputs {names} have changed places."
        found.append(
            Change("output order", names, "", "", sentence, KINDS["output order"].if_changed, now.taken_unix_s)
        )
    return tuple(sorted(found, key=lambda one: _place(one.kind)))


def unknown(before: Inventory, now: Inventory) -> tuple[str, ...]:
    """What could be read on the good day and can't be now, so that it is not compared."""
    new = _by_key(now.facts)
    keys = [(fact.kind, fact.name) for fact in before.facts if fact.value is not None]
    lost = [key for key in keys if new.get(key, "" if key[0] in COME_AND_GO else None) is None]
    return tuple(printable(f"{_title(kind)} {name}".strip()) for kind, name in lost)


def _by_key(facts: Sequence[Fact]) -> dict[tuple[str, str], str | None]:
    return {(fact.kind, fact.name): fact.value for fact in facts}


def _swapped(
    was: dict[tuple[str, str], str | None], new: dict[tuple[str, str], str | None]
) -> frozenset[tuple[str, str]]:
    """The outputs whose displays are the same as before, at each other's places: somebody swapped cables."""
    moved = [key for key in was if key[0] == "edid" and key in new and was[key] != new[key]]
    before, after = sorted(str(was[key]) for key in moved), sorted(str(new[key]) for key in moved)
    return frozenset(moved) if before == after else frozenset()


def _change(kind: str, name: str, old: str, fresh: str, since_unix_s: float) -> Change:
    title = f"{_title(kind)} {name}".strip()
    if not old:
        sentence = f"{title} is new: {fresh}."
    elif not fresh:
        sentence = f"{title} is gone; it was {old}."
    else:
        sentence = f"{title} was {old}, and is now {fresh}."
    remedy = KINDS[kind].if_changed if kind in KINDS else ""
    return Change(kind, printable(name), printable(old), printable(fresh), printable(sentence), remedy, since_unix_s)


def _title(kind: str) -> str:
    return KINDS[kind].title if kind in KINDS else kind


def _place(kind: str) -> int:
    order = list(KINDS)
    return order.index(kind) if kind in KINDS else len(order)
