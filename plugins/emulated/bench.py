"""The emulated stage as a whole: prepares it, serves all of its devices in one process, and prints what it serves."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import os
import secrets
import shlex
import signal
import socket
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

from hal.deadline import Deadline
from hal.errors import DeviceError
from hal.registry import Driver, OpenContext
from plugins.emulated.cameras.body import CameraNames
from plugins.emulated.cameras.camera import PtpIpCamera
from plugins.emulated.cameras.generic import EmulatedGenericBody
from plugins.emulated.core.extensions import extension
from plugins.emulated.core.shot import Expose
from plugins.emulated.core.truth import (
    DEFAULT_BOARD,
    FOLDER,
    USB_FILE,
    BenchTruth,
    CameraTruth,
    LampTruth,
    ObjectTruth,
    ProjectorTruth,
    read_truth,
    write_truth,
)
from plugins.emulated.optics.layout import DARK, SETTINGS, Stands, arranged, read_choice, read_stands
from plugins.emulated.optics.objects import VASE_AND_BUST, default_object, load_object
from plugins.emulated.optics.scenes import built_in
from plugins.emulated.optics.staging import (
    FAST_LAMP,
    FAST_PROFILE,
    device_tables,
    intrinsics_name,
    intrinsics_of,
    random_truth,
    size_named,
)
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming, quick_profile
from plugins.emulated.projectors.projector import BoardProjector
from plugins.emulated.projectors.serial import EmulatedSerialProjector

if TYPE_CHECKING:
    from plugins.emulated.optics.world import World


class OutputLines:
    """Prints what is served on standard output; ``json_lines``: one JSON object for each line."""

    def __init__(self, json_lines: bool) -> None:
        self._json = json_lines
        self._reported_percent = -1

    def say(self, record: Mapping[str, Any], sentence: str) -> None:
        # A reader that went away must not take the bench with it.
        with contextlib.suppress(BrokenPipeError):
            sys.stdout.write((json.dumps(record) if self._json else sentence) + "\n")
            sys.stdout.flush()

    def progress(self, share: float) -> None:
        if (percent := int(100 * share) // 10 * 10) > self._reported_percent:
            self._reported_percent = percent
            self.say({"progress": percent / 100, "what": "rays"}, f"Casting rays through the stage: {percent} %")

    def served(self, device: str, kind: str, address: str) -> None:
        self.say({"device": device, "kind": kind, "address": address}, f"{kind:<10} {device:<10} {address}")

    def environment(self, variables: Mapping[str, str]) -> None:
        words = " ".join(f"{name}={shlex.quote(value)}" for name, value in variables.items())
        self.say({"environment": dict(variables)}, f"To see the USB devices, begin commands with: {words}")

    def mains(self, projector: str, on: bool, damages: int) -> None:
        hurt = f" Its lamp was switched off hot, {damages} times so far." if damages else ""
        self.say(
            {"mains": projector, "on": on, "damages": damages},
            f"Projector {projector} {'has' if on else 'has no'} mains.{hurt}",
        )

    def douser(self, projector: str, is_open: bool) -> None:
        state = "opens" if is_open else "closes"
        self.say({"douser": projector, "open": is_open}, f"The douser of projector {projector} {state}.")

    def ready(self) -> None:
        self.say({"ready": True}, "Ready. Ctrl-C ends.")

    def failed(self, error: DeviceError) -> None:
        if self._json:
            self.say({"error": {"code": error.code, "what": error.what, "remedy": error.remedy}}, "")
        else:
            sys.stderr.write(f"velatura: {error.what}\n{error.remedy}\n")


OBJECT_FILE: Final = f"{FOLDER}/object.npz"
DEVICE_FAILED: Final = 3
HOST: Final = "127.0.0.1"
PORTS: Final = range(20000, 32768)


class EmulatedBench:
    """``hal.interfaces.Bench``.

    ``stands``: where it puts the projectors of a stage that it prepares; ``engine`` None: as the ``room`` says;
    ``built_in``: a name for ``scenes.built_in``, which stands there where no mesh is given
    """

    def __init__(
        self, stands: Stands | None = None, room: str = DARK, engine: str | None = None, built_in: str | None = None
    ) -> None:
        self._stands = stands or Stands()
        self._room = room
        self._engine = engine
        self._built_in = built_in

    def prepare(self, stage: Path, *, size: str, object_file: Path | None, seed: int) -> Mapping[str, Any]:
        """Write ``bench.toml`` and ``bench/``; return the device tables of stage.toml (see ``hal.interfaces.Bench``).

        Raises DeviceError ``size-unknown``, ``object-unreadable``, ``object-no-faces`` before anything is written, or
        ``stage-not-written``.
        """
        size_named(size)
        stands, hung = self._stands, False
        files: Mapping[str, bytes] = {}
        if object_file is None and self._built_in is not None:
            thing = built_in(self._built_in)
            (shape, files), hung = thing.on_stage(), thing.hung
            if stands == Stands(cameras=stands.cameras):
                stands = dataclasses.replace(stands, names=thing.places)
        else:
            shape = default_object() if object_file is None else load_object(object_file)
        kind = self._built_in or (VASE_AND_BUST if object_file is None else "mesh")
        kept = ObjectTruth(kind, OBJECT_FILE, seed)
        truth = arranged(
            random_truth(size, seed, shape, kept, _free_ports(2 * stands.cameras), stands), self._room, shape, hung=hung
        )
        truth = truth if self._engine is None else dataclasses.replace(truth, engine=self._engine)
        with _explained(stage):
            for folder in (FOLDER, "run"):
                (stage / folder).mkdir(parents=True, exist_ok=True)
            shape.save(stage / OBJECT_FILE)
            _write_fast_profile(stage, DEFAULT_BOARD)
            write_truth(stage, truth)
            for n, camera in enumerate(truth.cameras):
                (stage / intrinsics_name(n)).write_text(intrinsics_of(truth.seen_by(camera)), encoding="utf-8")
            for name, data in files.items():
                (stage / name).write_bytes(data)
        return device_tables(truth, shape)

    def disturb(self, stage: Path, changes: Sequence[Mapping[str, Any]]) -> None:
        """``changes``: tables of bench/bumps.toml (``lab.emulated.bumps``, which raises DeviceError for wrong ones)."""
        with _explained(stage):
            extension("bumps", asked_by="A disturbed stage").disturb(stage, changes)

    def serve(self, stage: Path, *, json_lines: bool, scenario: Path | None = None) -> int:
        """Serve the stage's devices until SIGINT or SIGTERM; returns 0, or 3 when a device can't be served.

        ``scenario``: a script of faults, instead of the one in bench.toml; relative to the working folder.
        """

        def start(out: OutputLines, stack: contextlib.ExitStack, stopped: threading.Event) -> Callable[[], None]:
            worlds = _start(stage.resolve(), out, stack, stopped, scenario)

            def look() -> None:
                for world in worlds:
                    _follow_bumps(world, out)

            return look

        return _serve(json_lines, start)

    def replay(self, tape: Path, *, json_lines: bool) -> int:
        """See ``hal.interfaces.Bench``."""

        def start(out: OutputLines, stack: contextlib.ExitStack, stopped: threading.Event) -> Callable[[], None]:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="velatura-tape-")))
            count = extension("tape", asked_by="Replaying a tape")(tape, folder, stack, out.served)
            out.say({"devices": count}, f"{count} devices of the tape.")
            return lambda: None

        return _serve(json_lines, start)


class _Interrupted(Exception):
    """A signal came before everything was up."""


Start = Callable[[OutputLines, contextlib.ExitStack, threading.Event], Callable[[], None]]
"""Brings devices up on the stack, unless the event is set; returns what is called twice a second afterwards."""


def _serve(json_lines: bool, start: Start) -> int:
    """Serve until SIGINT or SIGTERM; 0, or 3 when a device can't be served."""
    out = OutputLines(json_lines)
    stopped = threading.Event()
    with _stop_on_signals(stopped), contextlib.ExitStack() as stack:
        try:
            look = start(out, stack, stopped)
        except DeviceError as error:
            out.failed(error)
            return DEVICE_FAILED
        except _Interrupted:
            return 0
        out.ready()
        while not stopped.wait(0.5):
            look()
    out.say({"stopped": True}, "All devices are off.")
    return 0


def _start(
    stage: Path, out: OutputLines, stack: contextlib.ExitStack, stopped: threading.Event, script: Path | None
) -> list[World]:
    """Bring everything up, a world for each camera; ``stack`` takes it down again.

    Ports are looked at first: casting rays takes a while.
    """
    # Not at the top: a stage that is only prepared casts no rays, and all that these need takes a second to import.
    from plugins.emulated.optics.world import World

    truth = read_truth(stage)
    usb = _usb_devices(stage, truth)
    # Only the first camera may be on the USB bus.
    on_network = truth.cameras[0 if usb is None or not usb.have_camera else 1 :]
    for camera in on_network:
        _require_free(camera.command_port, camera.event_port)
    if script is None and truth.scenario:
        script = stage / truth.scenario
    scripted = extension("scenario", asked_by="A script of faults")(script) if script is not None else None
    lamps = [EmulatedLamp(_timing(projector.lamp)) for projector in truth.projectors]
    boot_s = {name: one.boot_s for one in truth.mains for name in one.feeds}
    wires = {
        projector.name: _on_its_wire(stage, projector, lamp, boot_s.get(projector.name, 0.0))
        for projector, lamp in zip(truth.projectors, lamps, strict=True)
    }
    for family in {projector.board for projector in truth.projectors}:
        with _explained(stage):
            _write_fast_profile(stage, family)

    dmx_nodes = extension("dousers", asked_by="[[dousers]] in bench.toml") if truth.dousers else lambda *_: ()

    def progress(share: float) -> None:
        if stopped.is_set():
            raise _Interrupted
        out.progress(share)

    worlds = []
    for camera in truth.cameras:
        with _explained(stage):
            worlds.append(stack.enter_context(World(stage, truth.seen_by(camera), lamps, progress=progress)))
    worlds[0].warm()
    for world in worlds:
        _follow_bumps(world, out)
    for name, wire in wires.items():
        if scripted is not None:
            wire.scenario = scripted(name, wire)
        stack.enter_context(wire)
        out.served(name, "projector", wire.address)
    covered = {name: wire.lamp for name, wire in wires.items()}
    for node in dmx_nodes(truth.dousers, covered, out.douser):
        out.served("douser", "dmx", stack.enter_context(node).address)
    for world, camera in zip(worlds[-len(on_network) :], on_network, strict=False):
        out.served(camera.name, "camera", stack.enter_context(_network_camera(world, camera)).address)
    out.served("display", "display", str(stage / truth.frames))
    if usb is not None:
        usb.serve(stack, wires, worlds[0].expose, out, script)
    return worlds


class UsbDevices(Protocol):
    """What ``usb`` of ``extensions`` makes of a stage and its truth; it raises DeviceError where these are wrong."""

    @property
    def have_camera(self) -> bool:
        """Whether the stage's camera is one of them."""
        ...

    def serve(
        self,
        stack: contextlib.ExitStack,
        projectors: Mapping[str, BoardProjector],
        expose: Expose,
        out: OutputLines,
        scenario: Path | None,
    ) -> None:
        """Plug them in until ``stack`` ends, and let their relays switch the mains of projectors."""
        ...


def _usb_devices(stage: Path, truth: BenchTruth) -> UsbDevices | None:
    if not truth.mains and not (stage / USB_FILE).exists():
        return None
    devices: UsbDevices = extension("usb", asked_by=f"An emulated USB device ({USB_FILE}, or [[mains]] in bench.toml)")(
        stage, truth
    )
    return devices


def _on_its_wire(stage: Path, truth: ProjectorTruth, lamp: EmulatedLamp, boot_s: float) -> Any:
    """The projector, not started yet; those of other makers, and on a LAN port, are of an extension."""
    if truth.board == DEFAULT_BOARD and not truth.tcp_port:
        return EmulatedSerialProjector(stage / truth.port, lamp, boot_s=boot_s)
    wired = extension("boards", asked_by=f"The board {truth.board} on its wire, as bench.toml has it,")
    return wired(stage, truth, lamp, boot_s)


def _timing(lamp: LampTruth) -> LampTiming:
    return LampTiming(lamp.warm_up_s, lamp.cool_down_s, lamp.drift, lamp.drift_s)


def _write_fast_profile(stage: Path, family: str) -> None:
    """Write the profile with the times of emulated lamps, unless the stage has it: it may have been changed."""
    path = stage / (FAST_PROFILE if family == DEFAULT_BOARD else f"{FOLDER}/{family}-fast.toml")
    if not path.exists():
        times = LampTiming(FAST_LAMP.warm_up_s, FAST_LAMP.cool_down_s)
        path.write_text(quick_profile(times, base=family, stable_s=FAST_LAMP.stable_s), encoding="utf-8")


def _network_camera(world: World, truth: CameraTruth) -> PtpIpCamera:
    # The world spends the exposure time itself, since it must know what is visible meanwhile.
    names = CameraNames(serial=truth.serial_number)
    body = EmulatedGenericBody(world.expose, names=names, time_scale=0.0, raw=truth.raw)
    return PtpIpCamera(body, (truth.command_port, truth.event_port))


def _follow_bumps(world: World, out: OutputLines) -> None:
    try:
        count = world.follow_bumps()
    except DeviceError as error:  # it is half written, or wrong: the stage stays as it was
        out.failed(error)
        return
    if count is not None:
        out.say({"bumps": count}, f"The stage is as it was set up, except for {count} bumps.")


def _free_ports(count: int) -> tuple[int, ...]:
    """So many TCP ports without a listener.

    The stage keeps them while no bench serves it, so they lie outside the range from which the system gives free ports.
    """
    in_any_order = secrets.SystemRandom().sample(PORTS, len(PORTS))
    return tuple(itertools.islice(filter(_is_free, in_any_order), count))


def _is_free(port: int) -> bool:
    try:
        socket.create_server((HOST, port)).close()
    except OSError:
        return False
    return True


def _require_free(*ports: int) -> None:
    for port in ports:
        try:
            socket.create_server((HOST, port)).close()
        except OSError as error:
            raise DeviceError(
                "port-in-use",
                what=f"The camera's TCP port {port} can't be used: {os.strerror(error.errno or 0)}.",
                remedy="End the program that uses it (perhaps another bench), or prepare the stage again.",
            ) from error


@contextlib.contextmanager
def _explained(stage: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise DeviceError(
            "stage-not-written",
            what=f"The stage folder {stage} can't be written: {error.strerror}.",
            remedy="Free space on its disk, or choose a folder that you may write to.",
        ) from error


@contextlib.contextmanager
def _stop_on_signals(stopped: threading.Event) -> Iterator[None]:
    """SIGINT and SIGTERM set ``stopped``; the handlers that were there come back afterwards."""

    def stop(number: int, frame: object) -> None:
        stopped.set()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _open(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> EmulatedBench:
    room, engine, built_in = (read_choice(settings, key) for key in ("room", "engine", "object"))
    return EmulatedBench(read_stands(settings, context.stage), room or DARK, engine, built_in)


DRIVER: Final = Driver(
    kind="bench",
    name="emulated",
    summary="A whole stage in one process: three projectors, a camera and an object, with their optics.",
    open=_open,
    settings=SETTINGS,
)
