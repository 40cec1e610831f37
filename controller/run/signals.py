"""Ctrl-C and other stop signals request a clean stop of the work."""

from __future__ import annotations

import contextlib
import signal
import socket
import threading
from collections.abc import Iterator
from types import FrameType

from hal.deadline import Stop

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)
RESTARTS = signal.SIGUSR1
"""What systemd sends instead of SIGTERM to a service that it starts again at once (``RestartKillSignal=``)."""


@contextlib.contextmanager
def cancelled_by_signals() -> Iterator[Stop]:
    """An event that the first signal of ``STOPPING`` sets; the second makes it urgent.

    Put it into the run's ``Deadline`` and keep the context open while the lamps are cooled, so that a second
    Ctrl-C can't skip that: it only stops waiting for a driver that hangs. On leaving, the previous handlers are
    restored. Outside the main thread, where Python handles no signals, it is an ordinary event.
    """
    cancel = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield cancel
        return
    # A handler that sets the event itself could hang, if it interrupts the main thread inside Event.wait, with the
    # event's lock held. So the interpreter writes a byte for each signal, and a thread sets the event.
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    watcher = threading.Thread(target=_watch, args=(ours, cancel), name="signals", daemon=True)
    watcher.start()
    former = signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
    handlers = {number: signal.getsignal(number) for number in STOPPING}
    try:
        for number, handler in handlers.items():
            if handler is not signal.SIG_IGN:  # nohup or a shell's background job ignores it: keep that
                signal.signal(number, _noticed)
        yield cancel
    finally:
        for number, handler in handlers.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        signal.set_wakeup_fd(former)
        theirs.close()
        watcher.join()
        ours.close()


def _noticed(number: int, frame: FrameType | None) -> None:
    """Replaces the handler that raises KeyboardInterrupt; the byte on the socket does the work."""


def _watch(ours: socket.socket, cancel: Stop) -> None:
    while numbers := ours.recv(64):
        if RESTARTS in numbers and not cancel.is_set():
            cancel.restarting = True
        for _ in (number for number in numbers if number in STOPPING):
            cancel.again()
