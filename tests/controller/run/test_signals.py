from __future__ import annotations

import os
import signal
import threading
import time

from controller.run.signals import STOPPING, cancelled_by_signals


def test_every_stopping_signal_sets_the_event_and_the_handlers_come_back() -> None:
    before = {number: signal.getsignal(number) for number in STOPPING}
    for number in STOPPING:
        with cancelled_by_signals() as cancel:
            assert not cancel.is_set()
            os.kill(os.getpid(), number)
            assert cancel.wait(60)
            os.kill(os.getpid(), number)
            time.sleep(0.01)
        assert {each: signal.getsignal(each) for each in STOPPING} == before
    assert signal.set_wakeup_fd(-1) == -1


def test_a_signal_that_was_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with cancelled_by_signals() as cancel:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not cancel.wait(0.05)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_signals_never_meet_a_thread_that_holds_the_events_lock() -> None:
    with cancelled_by_signals() as cancel:
        threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
        end_s = time.monotonic() + 60
        while not cancel.wait(0.00001):  # most of the time inside the event's own code
            assert time.monotonic() < end_s


def test_outside_the_main_thread_the_event_is_a_plain_one() -> None:
    before = signal.getsignal(signal.SIGINT)
    seen: list[object] = []

    def work() -> None:
        with cancelled_by_signals() as cancel:
            seen.append(cancel.is_set())
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False, before]
