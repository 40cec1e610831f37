"""``python -m controller.play``: starts the player (its protocol: docs/reference/player-protocol.md)."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from controller.bundle.install import CURRENT, CountedStart, current, of_other_format, previous
from controller.bundle.signing import Trust, load_public_key
from controller.core.errors import UsageError, VelaturaError
from controller.play.control.commands import SUFFIX, Commands, SavedRequest, Server
from controller.play.control.notify import log
from controller.play.control.protocol import MAX_RATE_HZ, Suggested
from controller.play.display.outputs import MemoryOutput, Output
from controller.play.frames import FrameFile, OutputSize, parse_outputs, parse_where
from controller.play.loop import Player


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the player until it gets a quit request; the exit code is 0, 1 (failed) or 2 (wrong use)."""
    options = parser().parse_args(arguments)
    if options.host:
        # Of several screens or computers. It has its own players, and so this process becomes it.
        given = sys.argv[1:] if arguments is None else list(arguments)
        os.execv(sys.executable, [sys.executable, "-m", "controller.stage.hosts.conductor", *given])  # noqa: S606
    try:
        return _run(options)
    except VelaturaError as error:
        print(f"{error.what}\n{error.remedy}", file=sys.stderr)  # noqa: T201
        return error.exit_code


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog="python -m controller.play",
        description="Velatura's player. @FILE stands for the arguments in a file, one a line.",
        fromfile_prefix_chars="@",
    )
    made.add_argument("--socket", type=Path, required=True, help="unix socket to serve; made with mode 0600")
    made.add_argument("--outputs", required=True, help="NAME:WIDTHxHEIGHT of each output, with commas between")
    where = made.add_mutually_exclusive_group(required=True)
    where.add_argument("--frames", type=Path, help="file for the shown frames (machines without projectors)")
    where.add_argument("--windows", action="store_true", help="show in one window over all outputs")
    made.add_argument("--where", action="append", default=[], metavar="NAME=OUTPUT",
                        help="connector or display serial number of an output, if that is not its name")  # fmt: skip
    made.add_argument("--bundle", type=Path, help="bundle to load; in a stage, bundles/current is the fallback")
    made.add_argument("--trusted", type=Path, action="append", default=[], help="public key file; may be repeated")
    made.add_argument(
        "--revoked", type=Path, action="append", default=[], help="public key that must not be trusted any more"
    )
    made.add_argument("--allow-unsigned", action="store_true", help="also play bundles without a signature")
    made.add_argument(
        "--resume",
        action="store_true",
        help="file with the last request; the player resumes it after a crash or restart",
    )
    made.add_argument("--suggested", action="store_true", help="start with the bundle's playlist, or as --resume says")
    made.add_argument("--rate", type=float, default=60.0, help="pictures change at multiples of 1/RATE seconds")
    made.add_argument("--part", action="store_true", help="also play bundles that have more outputs than these")
    made.add_argument(
        "--host",
        action="append",
        default=[],
        metavar="NAME=COMPUTER/SCREEN",
        help="where an output is, if not on this computer's screen",
    )
    made.add_argument("--keys", type=Path, help="folder of the authority that other computers belong to")
    made.add_argument("--port", type=int, default=7449, help="TCP port for them")
    made.add_argument(
        "--alone",
        default="3600,on",
        metavar="SECONDS,RULE",
        help="how long players continue without the conductor; then on, black or still",
    )
    return made


def _run(options: argparse.Namespace) -> int:
    sizes = parse_outputs(options.outputs)
    if not 1 <= options.rate <= MAX_RATE_HZ:
        raise UsageError(
            "rate-wrong",
            what=f"A rate of {options.rate:g} pictures a second is not possible.",
            remedy=f"Give a rate from 1 to {MAX_RATE_HZ:g}.",
        )
    keys, revoked = (tuple(map(load_public_key, paths)) for paths in (options.trusted, options.revoked))
    trust = Trust(keys, options.allow_unsigned, revoked)
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(Server(options.socket))
        inbox = FrameFile(options.socket.with_name(options.socket.name + ".inbox"), sizes)
        stack.callback(inbox.path.unlink, missing_ok=True)
        stack.callback(inbox.close)
        output = _open_output(options, sizes)
        stack.callback(output.close)
        if options.bundle is not None and options.bundle.name == CURRENT and not _is_installed(options.bundle):
            options.bundle = None  # Nothing is installed yet, for this version: a kiosk starts all the same.
        start = _counted_start(options.bundle)
        count: dict[str, Any] = {} if start is None else {"on_appearance": start.shown, "on_asked": start.asked}
        player = Player(output, sizes, rate_hz=options.rate, trust=trust, wake=server.wake, **count)
        player.part = options.part
        if options.bundle is not None:
            player.load_bundle(options.bundle if start is None else start.file)
        broken = _end_on_signals(player)
        playing = options.socket.with_name(options.socket.name + SUFFIX) if options.resume else None
        first = Suggested(repeat=0) if options.suggested else None
        commands = Commands(player, server, inbox, SavedRequest(playing), first=first)

        def begin() -> None:
            commands.resume()
            if start is not None:
                start.ready()

        player.run(commands.serve, first=begin)
        if start is not None and not broken.is_set() and not player.skipped:
            start.ended()
    return 1 if broken.is_set() else 0


def _is_installed(link: Path) -> bool:
    """Whether there is a bundle, or was one, that this version could play."""
    folder = link.parent
    return os.path.lexists(link) and not (of_other_format(folder) and current(folder) is None is previous(folder))


def _counted_start(bundle: Path | None) -> CountedStart | None:
    """The start's count where ``bundle`` is the link to a stage's installed bundle; None for any other file."""
    if bundle is None or bundle.name != CURRENT or not bundle.is_symlink():
        return None
    return CountedStart(bundle.parent, log)


def _open_output(options: argparse.Namespace, sizes: tuple[OutputSize, ...]) -> Output:
    if options.windows:
        from controller.play.display.window import WindowOutput

        return WindowOutput(sizes, parse_where(options.where, sizes))
    return MemoryOutput(options.frames, sizes)


def _end_on_signals(player: Player) -> threading.Event:
    """SIGTERM, SIGINT and a broken thread end the loop; the event is set only in the last case. SIGUSR1 ends it, too,
    and leaves the picture to the next player.
    """
    signal.signal(signal.SIGUSR1, lambda *_: player.end(leaving=True))
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: player.end())
    broken = threading.Event()

    def thread_broke(arguments: threading.ExceptHookArgs) -> None:
        sys.__excepthook__(arguments.exc_type, arguments.exc_value or arguments.exc_type(), arguments.exc_traceback)
        broken.set()
        signal.raise_signal(signal.SIGTERM)

    threading.excepthook = thread_broke
    return broken


if __name__ == "__main__":
    sys.exit(main())
