"""How tests are spread over workers: by file, long files first, files that share a costly fixture on one worker."""

from __future__ import annotations

from typing import Final

from xdist.scheduler import LoadFileScheduling

TOGETHER: Final = {
    "tests/end_to_end/test_demo.py": "the finished demo",
    "tests/end_to_end/test_live.py": "the finished demo",
    "tests/end_to_end/test_on_a_cluster.py": "the finished demo",
    "tests/end_to_end/test_photograph.py": "the finished demo",
    "tests/end_to_end/test_takeover.py": "the finished demo",
    "tests/end_to_end/test_targets.py": "the finished demo",
}
"""A fixture of the session is made once a worker, and the finished demo takes minutes."""
LONGEST_FIRST: Final = (
    "the finished demo",
    "tests/plugins/test_on_usb_bus.py",
    "tests/controller/panel/test_in_browser.py",
    "tests/end_to_end/test_going_on.py",
    "tests/plugins/test_gphoto2_peer.py",
    "tests/plugins/finding/test_serial_ports.py",
    "tests/end_to_end/test_drift.py",
    "tests/end_to_end/test_technician.py",
    "tests/campaigns/test_kills.py",
    "tests/campaigns/test_serve_wires.py",
    "tests/end_to_end/test_usb_camera.py",
    "tests/controller/calibrate/test_chain.py",
    "tests/controller/solve/test_regions.py",
    "tests/end_to_end/test_refusing_devices.py",
    "tests/controller/cluster/test_cluster.py",
    "tests/end_to_end/test_killed_demo.py",
    "tests/controller/study/test_beyond.py",
)
"""What would keep one worker busy for a minute after the other has ended, were it to come last. While the demo compiles
every kernel (a minute and a half, kept on disk), the others have tests that need none: they would compile them, too."""


class LongestFirst(LoadFileScheduling):  # type: ignore[misc]
    """xdist's scheduling by file, with these two additions."""

    def _split_scope(self, nodeid: str) -> str:
        file = nodeid.split("::", 1)[0]
        return TOGETHER.get(file, file)

    def _assign_work_unit(self, node: object) -> None:
        for scope in reversed(LONGEST_FIRST):
            if scope in self.workqueue:
                self.workqueue.move_to_end(scope, last=False)
        super()._assign_work_unit(node)
