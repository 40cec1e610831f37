"""How tests are spread over workers: by file, long files first, users of the finished demo when it is there.

A file is run as a whole by one worker, for what its tests share. Two kinds of long files are divided: those whose tests
share nothing, and those that hold two things. Files that share a machine are run as one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from xdist.scheduler import LoadFileScheduling

MAKES_THE_DEMO: Final = "tests/end_to_end/test_demo.py"
"""Its first test makes it, for all workers."""
NEEDS_THE_DEMO: Final = (
    "tests/end_to_end/test_kiosk_targets.py",
    "tests/end_to_end/test_on_a_cluster.py",
    "tests/end_to_end/test_live.py",
    "tests/end_to_end/test_takeover.py",
    "tests/end_to_end/test_refine.py",
    "tests/end_to_end/test_photograph.py",
    "tests/end_to_end/test_targets.py",
)
"""Meanwhile their workers would only wait: they have other tests first, and these at once when it is there."""
LONGEST_FIRST: Final = (
    "tests/booted/",
    MAKES_THE_DEMO,
    "tests/end_to_end/test_continuing.py",
    "tests/end_to_end/test_drift.py",
    "tests/real_kernel/test_on_kernel.py",
    "tests/end_to_end/test_refusing_devices.py",
    "tests/plugins/test_on_usb_bus.py",
    "tests/end_to_end/test_technician.py",
    "tests/end_to_end/test_never_black.py",
    "tests/end_to_end/test_usb_camera.py",
    "tests/campaigns/test_serve_wires.py",
    "tests/campaigns/test_kills.py",
    "tests/controller/panel/test_in_browser.py",
    "tests/plugins/emulated/cameras/test_gphoto2_peer.py",
    "tests/plugins/finding/test_serial_ports.py",
    "tests/controller/optics/calibrate/geometry/test_self_calibration.py",
    "tests/controller/optics/calibrate/geometry/test_self_calibration_failures.py",
    "tests/controller/optics/calibrate/test_chain.py",
    "tests/lab/study/test_region_solver.py",
    "tests/controller/stage/cluster/test_cluster.py",
    "tests/controller/cli/test_extras.py",
    "tests/end_to_end/test_killed_demo.py",
    "tests/lab/study/test_beyond.py",
    "tests/lab/simulate/test_simulate.py",
)
"""What would keep one worker busy for a minute after the others have ended, were it to come last."""
LONG: Final = (*NEEDS_THE_DEMO, *LONGEST_FIRST)

SHARES_NOTHING: Final = (
    "tests/end_to_end/test_kiosk_targets.py",
    "tests/end_to_end/test_never_black.py",
    "tests/end_to_end/test_refine.py",
    "tests/controller/cli/test_extras.py",
    "tests/lab/simulate/test_simulate.py",
)
"""Each of their tests takes long and starts with what it needs itself, so any worker may have it."""
PARTS: Final[Mapping[str, tuple[str, ...]]] = {
    "tests/real_kernel/test_on_kernel.py": ("::test_keys_",),
}
"""Words in the ids of tests that are a file of their own: another machine is booted for them."""
MACHINES: Final[Mapping[str, tuple[str, ...]]] = {"tests/booted/": ("bookworm", "trixie")}
"""Folders whose files share machines, each booted once: the words in the ids of the tests on each."""


def scope_of(test: str) -> str:
    """What one worker runs as a whole: a file, a part of it, all on one machine, or this one test; ``test``: its id."""
    file = file_of(test)
    for folder, machines in MACHINES.items():
        if file.startswith(folder):
            return next((f"{folder}::{machine}" for machine in machines if machine in test), file)
    if file in SHARES_NOTHING:
        return test
    return next((f"{file}::{part}" for part in PARTS.get(file, ()) if part in test), file)


def file_of(scope: str) -> str:
    return scope.split("::", 1)[0]


class LongestFirst(LoadFileScheduling):  # type: ignore[misc]
    """xdist's scheduling by file, in this order, and no worker keeps a second long file while others could take it."""

    _demo_is_made = False

    def _split_scope(self, nodeid: str) -> str:
        return scope_of(nodeid)

    def mark_test_complete(self, node: Any, item_index: int, duration: float = 0) -> None:
        self._demo_is_made |= file_of(self.registered_collections[node][item_index]) == MAKES_THE_DEMO
        super().mark_test_complete(node, item_index, duration)

    def _reschedule(self, node: Any) -> None:
        # A worker runs a test when it knows the next one. xdist would give it files until it knows three.
        if not node.shutting_down and self.workqueue and self._pending_of(self.assigned_work[node]) >= 2:
            return
        super()._reschedule(node)

    def _assign_work_unit(self, node: Any) -> None:
        unfinished = [file_of(scope) for scope, tests in self.assigned_work[node].items() if not all(tests.values())]
        busy = any(file in LONG for file in unfinished)
        self.workqueue.move_to_end(
            min(self.workqueue, key=lambda scope: self._rank(file_of(scope), busy=busy)), last=False
        )
        super()._assign_work_unit(node)

    def _rank(self, file: str, *, busy: bool) -> int:
        """The file of the lowest rank is the next; for a worker that is ``busy`` with a long one, a short one."""
        waiting = file in NEEDS_THE_DEMO and not self._demo_is_made and self._will_be_made()
        return LONG.index(file) + (2 * len(LONG) if busy or waiting else 0) if file in LONG else len(LONG)

    def _will_be_made(self) -> bool:
        return any(test.startswith(MAKES_THE_DEMO) for test in self.collection)
