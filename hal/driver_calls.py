"""Calls into drivers. Every error of a driver, every wrong object that it returns, and every call that does not end
becomes a ``DeviceError``.

Our drivers use ``hal.errors``. One of another author may raise anything or never return, but must not end the program
or block other devices: above all, no lamp may stay on because of it. Such a driver is not type-checked, either: what it
returns is checked against the annotations of ``hal.interfaces`` (``mismatch``).
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import math
import time
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, Final, Union, cast, get_args, get_origin, get_type_hints

from hal.deadline import Deadline, Stop
from hal.errors import DeviceError, DriverFault
from hal.interfaces import (
    AdjustedProjector,
    BundleDisplay,
    ButtonPanel,
    Camera,
    Display,
    Douser,
    LightSensor,
    LiveViewCamera,
    PowerSwitch,
    Projector,
    WatchedCamera,
    WatchedProjector,
)
from hal.runtime.call_threads import CallThreads, LeftBehind


def mismatch(value: object, annotation: Any) -> str:
    """The problem with ``value``, e.g. ``"power is a str, not a Power"``; "" if there is none.

    Knows classes, dataclasses (field by field), unions, ``list``, ``tuple``, ``Sequence``, ``Mapping``, ``Callable``
    and ``Any``. An ``int`` is accepted as a ``float``, a ``bool`` as neither; numbers must be finite.
    """
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin in (Union, types.UnionType):
        problems = [mismatch(value, choice) for choice in arguments]
        return "" if "" in problems else problems[0]
    if origin is not None:
        return _generic(value, origin, arguments)
    return "" if annotation is Any else _of_class(value, type(None) if annotation is None else annotation)


def _generic(value: object, origin: type, arguments: tuple[Any, ...]) -> str:
    if not isinstance(value, origin) or (origin is Sequence and isinstance(value, str | bytes)):
        return _not_a(value, origin.__name__.lower())
    if origin is tuple:
        return _tuple(cast("tuple[Any, ...]", value), arguments)
    if isinstance(value, Mapping):
        return _first(mismatch(key, arguments[0]) or mismatch(value[key], arguments[1]) for key in value)
    return _first(mismatch(item, arguments[0]) for item in value) if isinstance(value, Sequence) else ""


def _of_class(value: object, wanted: type) -> str:
    accepted: tuple[type, ...] = (int, float) if wanted is float else (wanted,)
    if not isinstance(value, accepted) or (isinstance(value, bool) and wanted is not bool):
        return _not_a(value, wanted.__name__)
    if isinstance(value, float) and not math.isfinite(value):
        return f"{value} is not a finite number"
    if dataclasses.is_dataclass(wanted):
        for name, hint in field_types(wanted).items():
            if problem := mismatch(getattr(value, name), hint):
                return f"{name}: {problem}"
    return ""


def _tuple(value: tuple[Any, ...], arguments: tuple[Any, ...]) -> str:
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        return _first(mismatch(item, arguments[0]) for item in value)
    if len(value) != len(arguments):
        return f"a tuple of {len(value)}, not of {len(arguments)}"
    return _first(mismatch(item, hint) for item, hint in zip(value, arguments, strict=True))


@functools.cache
def field_types(kind: type) -> dict[str, Any]:
    """The type of each field of a dataclass, by name."""
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def _first(problems: Iterable[str]) -> str:
    return next((problem for problem in problems if problem), "")


def _not_a(value: object, wanted: str) -> str:
    if value is None:
        return f"nothing (None) instead of a {wanted}"
    return f"a {type(value).__name__} instead of a {wanted}"


GRACE_S: Final = 6.0
"""A call may end so much later than its deadline or cancellation; then it is left behind."""
_URGENT_S: Final = 0.5
"""The same after an urgent request to stop (Ctrl-C twice)."""
_WITHOUT_DEADLINE_S: Final = 4.0
"""Time for a call without a deadline, such as ``close``, before that."""
INTERFACES: Final[Mapping[str, tuple[type, ...]]] = {
    "projector": (Projector, WatchedProjector, AdjustedProjector),
    "camera": (Camera, WatchedCamera, LiveViewCamera),
    "display": (Display, BundleDisplay),
    "power_switch": (PowerSwitch,),
    "douser": (Douser,),
    "light_sensor": (LightSensor,),
    "button_panel": (ButtonPanel,),
}
"""The interface of each kind of device (first), and its optional interfaces."""
_LONGEST_TEXT: Final = 200


class Caller:
    """Calls functions of one plugin. ``who`` starts every message, e.g. ``The driver 'acme' of projector left``.

    ``grace_s``: a call that has not ended so long after its deadline is left behind on its thread.
    """

    def __init__(self, who: str, *, grace_s: float = GRACE_S) -> None:
        self._who = who
        self._grace_s = grace_s
        self._threads = CallThreads(who)

    def call(
        self,
        name: str,
        function: Callable[..., Any],
        returns: Any,
        *args: Any,
        late: Callable[[Any], object] = lambda _: None,
        **kwargs: Any,
    ) -> Any:
        """Call ``function``; its result must fit the annotation ``returns``.

        Raises the driver's own DeviceError unchanged, DriverFault("driver-fault") for other errors except Ctrl-C, and
        DriverFault("driver-stuck") for a call that does not end: it still runs, and ``late`` gets what it may return.
        """
        patience = _Patience(self._grace_s, *args, *kwargs.values())
        try:
            value = self._threads.run(lambda: function(*args, **kwargs), given_up=patience.given_up, late=late)
        except LeftBehind as left:
            raise self._stuck(name, left) from None
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            # A driver may also raise SystemExit and asyncio's cancellation, which are not Exceptions.
            if isinstance(error, DeviceError) and _is_complete(error):
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
            closed_quietly(made)
            shown = f"a {type(made).__name__} without {', '.join(missing)}"
            raise self.fault(f"returned from open: {shown}, which is not a {kind.replace('_', ' ')}")
        also = tuple(extra for extra in optional if all(_has(made, name) for name in _members(extra)))
        return _checked_class(needed, *also)(made, self)

    def end(self) -> None:
        """No call will follow soon."""
        self._threads.end()

    def _stuck(self, name: str, left: LeftBehind) -> DriverFault:
        did = "hangs in earlier calls, and gets no further ones" if left.again else f"did not return from {name}"
        return DriverFault(
            "driver-stuck",
            what=f"{self._who} {did}.",
            remedy="Switch the device off and on, check its cable, then start again. If it happens again, "
            "report it to the driver's author.",
        )

    def fault(self, did: str) -> DriverFault:
        return DriverFault(
            "driver-fault",
            what=f"{self._who} {did}.",
            remedy="This is a mistake in the driver: update it, or report it to its author.",
        )


class _Patience:
    """Until when a call is waited for: by the ``Deadline`` among its arguments."""

    def __init__(self, grace_s: float, *arguments: object) -> None:
        found = next((value for value in arguments if isinstance(value, Deadline)), None)
        self._deadline = found or Deadline(time.monotonic() + _WITHOUT_DEADLINE_S)
        self._grace_s = grace_s
        self._stopped_at_s: float | None = None

    def given_up(self) -> bool:
        now_s, stop = time.monotonic(), self._deadline.cancel
        ends_s, grace_s = self._deadline.at_s, self._grace_s
        if stop is not None and stop.is_set():
            self._stopped_at_s = self._stopped_at_s or now_s
            ends_s = min(ends_s, self._stopped_at_s)
            grace_s = min(grace_s, _URGENT_S) if isinstance(stop, Stop) and stop.urgent else grace_s
        return now_s > ends_s + grace_s


def closed_quietly(made: Any) -> None:
    """Close what may be a device; its errors do not matter."""
    with contextlib.suppress(Exception):
        made.close()


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
    function = member.fget if is_property else member
    # Its parameters may have types that only a type checker has loaded, so they are left out.
    returned = SimpleNamespace(__annotations__={"return": function.__annotations__["return"]})
    returns = get_type_hints(returned, globalns=function.__globals__)["return"]

    def method(self: CheckedDevice, *args: Any, **kwargs: Any) -> Any:
        def looked_up(*given: Any, **named: Any) -> Any:
            return getattr(self._device, name)(*given, **named)

        try:
            return self._caller.call(name, looked_up, returns, *args, **kwargs)
        finally:
            if name == "close":
                self._caller.end()

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


def _is_complete(error: DeviceError) -> bool:
    """A subclass may have forgotten to call DeviceError's constructor."""
    return all(isinstance(getattr(error, name, None), str) for name in ("code", "what", "remedy"))


def _described(error: BaseException) -> str:
    try:
        text = str(error)
    except Exception:  # noqa: BLE001 - its __str__ is the driver's too
        text = ""
    line = "".join(c if c.isprintable() else " " for c in text[:_LONGEST_TEXT]).strip()
    return type(error).__name__ + (f" ({line})" if line else "")
