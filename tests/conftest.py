"""What every test may rely on."""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import signal
from collections import Counter
from collections.abc import Generator
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from hal.runtime.caches import SHORTEST, temporary
from tests.scheduling import LongestFirst

# Workers that share the cores: numeric libraries whose threads wait for each other would take several times as long.
WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if WORKERS > 1:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when numpy is imported, which none of the above does

# The same examples in every run; HYPOTHESIS_PROFILE=search looks for new ones. How long drawing them takes says how
# busy the computer is, and nothing about what is tested.
UNTIMED = [HealthCheck.too_slow]
settings.register_profile("suite", derandomize=True, deadline=None, suppress_health_check=UNTIMED)
settings.register_profile("search", print_blob=True, deadline=None, suppress_health_check=UNTIMED)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "suite"))

# A shell that runs us in the background, or nohup, hands down ignored signals, and so would we to the programs that
# these tests start and stop by signals.
signal.signal(signal.SIGINT, signal.default_int_handler)
for number in (signal.SIGHUP, signal.SIGTERM):
    signal.signal(number, signal.SIG_DFL)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Leave tests and their modules out of every search for garbage, now and later: they stay, and are thousands."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()
        atexit.register(gc.unfreeze)  # or extension modules report leaks


def pytest_configure(config: pytest.Config) -> None:
    """Sockets of the stages of this session lie in a folder of its own, which is short, and goes with it."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        stack = contextlib.ExitStack()
        os.environ["XDG_RUNTIME_DIR"] = str(stack.enter_context(temporary(SHORTEST)))
        config.add_cleanup(stack.close)


@pytest.fixture(scope="session", autouse=True)
def cores_shared_between_workers() -> None:
    """Each worker's kernels run on its share of the cores. The programs that tests start take theirs from us."""
    if WORKERS > 1:
        import numba

        numba.set_num_threads(max(1, numba.get_num_threads() // WORKERS))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> LongestFirst | None:
    """Spread tests by file, the long ones first, unless another way is asked for."""
    return LongestFirst(config, log) if config.getoption("dist") == "loadfile" else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Refuse two tests of one id: spread over workers, only one of them would run, and nothing would say so."""
    twice = sorted(name for name, count in Counter(item.nodeid for item in items).items() if count > 1)
    if twice:
        raise pytest.UsageError(f"Several tests have the id {twice[0]}.")
