"""Calls into drivers. Every error of a driver, and every wrong object that it returns, becomes a ``DeviceError``.

Our drivers use ``hal.errors``. One of another author may raise anything, but must not end the program or block
other devices: above all, no lamp may stay on because of it.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, Final, get_type_hints

from hal.annotations import mismatch
from hal.errors import DeviceError, DriverFault
from hal.interfaces import (
    BundleDisplay,
    ButtonPanel,
    Camera,
    Display,
    LightSensor,
    LiveViewCamera,
    PowerSwitch,
    Projector,
    WatchedCamera,
    WatchedProjector,
)

INTERFACES: Final[Mapping[str, tuple[type, ...]]] = {
    "projector": (Projector, WatchedProjector),
    "camera": (Camera, WatchedCamera, LiveViewCamera),
    "display": (Display, BundleDisplay),
    "power_switch": (PowerSwitch,),
    "light_sensor": (LightSensor,),
    "button_panel": (ButtonPanel,),
}
"""The interface of each kind of device (first), and its optional interfaces."""
_LONGEST_TEXT: Final = 200


class Caller:
    """Calls functions of one plugin. ``who`` starts every message, e.g. ``The driver 'acme' of projector left``."""

    def __init__(self, who: str) -> None:
        self._who = who

    def call(self, name: str, function: Callable[..., Any], returns: Any, *args: Any, **kwargs: Any) -> Any:
        """Call ``function``; its result must fit the annotation ``returns``.

        Raises the driver's own DeviceError unchanged, and DriverFault("driver-fault") for other errors except Ctrl-C.
        """
        try:
            value = function(*args, **kwargs)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            # A driver may also raise SystemExit and asyncio's cancellation, which are not Exceptions.
            if isinstance(error, DeviceError) and _is_whole(error):
                raise
            raise self.fault(f"raised {_described(error)} in {name}") from error
        if problem := mismatch(value, returns):
            raise self.fault(f"returned from {name}: {problem}")
        return value

    def device(self, kind: str, made: object) -> Any:
        """``made`` with checked calls: the methods of its kind, and the optional ones that it has.

        Raises DriverFault("driver-fault") for an object that is not a device of this ``kind``.
        """
        needed, *optional = INTERFACES[kind]
        if missing := [name for name in _members(needed) if not _has(made, name)]:
            # It may hold a port that is needed again; errors of its close do not matter.
            with contextlib.suppress(Exception):
                made.close()  # type: ignore[attr-defined]
            told = f"a {type(made).__name__} without {', '.join(missing)}"
            raise self.fault(f"returned from open: {told}, which is not a {kind.replace('_', ' ')}")
        also = tuple(extra for extra in optional if all(_has(made, name) for name in _members(extra)))
        return _checked_class(needed, *also)(made, self)

    def fault(self, did: str) -> DriverFault:
        return DriverFault(
            "driver-fault",
            what=f"{self._who} {did}.",
            remedy="This is a mistake in the driver: update it, or report it to its author.",
        )


class CheckedDevice:
    """A device whose every call goes through a ``Caller``. Its methods come from ``hal.interfaces``."""

    def __init__(self, device: object, caller: Caller) -> None:
        self._device = device
        self._caller = caller


@functools.cache
def _checked_class(*interfaces: type) -> type[CheckedDevice]:
    members = {name: member for interface in interfaces for name, member in _members(interface).items()}
    made = {name: _forwarded(name, member) for name, member in members.items()}
    return type(f"Checked{interfaces[0].__name__}", (CheckedDevice,), made)


def _forwarded(name: str, member: Any) -> Any:
    is_property = isinstance(member, property)
    returns = get_type_hints(member.fget if is_property else member)["return"]

    def method(self: CheckedDevice, *args: Any, **kwargs: Any) -> Any:
        return self._caller.call(name, lambda: getattr(self._device, name)(*args, **kwargs), returns)

    def value(self: CheckedDevice) -> Any:
        return self._caller.call(name, lambda: getattr(self._device, name), returns)

    return property(value) if is_property else functools.wraps(member)(method)


@functools.cache
def _members(interface: type) -> Mapping[str, Any]:
    """The methods and properties of an interface, its bases' among them."""
    return {
        name: member
        for base in reversed(interface.__mro__)
        if getattr(base, "_is_protocol", False) and base.__module__ == Projector.__module__
        for name, member in vars(base).items()
        if not name.startswith("_") and (inspect.isfunction(member) or isinstance(member, property))
    }


def _has(made: object, name: str) -> bool:
    """Without running a property of the driver, which may fail."""
    absent = object()
    if inspect.getattr_static(made, name, absent) is not absent:
        return True
    try:
        return hasattr(made, name)
    except Exception:  # noqa: BLE001 - a driver's __getattr__ may raise anything
        return False


def _is_whole(error: DeviceError) -> bool:
    """A subclass may have forgotten to call DeviceError's constructor."""
    return all(isinstance(getattr(error, name, None), str) for name in ("code", "what", "remedy"))


def _described(error: BaseException) -> str:
    try:
        text = str(error)
    except Exception:  # noqa: BLE001 - its __str__ is the driver's too
        text = ""
    line = "".join(c if c.isprintable() else " " for c in text[:_LONGEST_TEXT]).strip()
    return type(error).__name__ + (f" ({line})" if line else "")
