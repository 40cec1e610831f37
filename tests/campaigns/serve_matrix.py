"""Every fault of every model device at every step of a kiosk: ``python -m tests.campaigns.serve_matrix``."""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

from tests.controller.kiosk.matrix import cases, judge
from tests.controller.kiosk.model import Kiosk


def main() -> int:
    began_s, count, failed = time.monotonic(), 0, []
    for step, fault in cases():
        count += 1
        with tempfile.TemporaryDirectory() as folder:
            try:
                judge(Kiosk(Path(folder)), step, fault)
            except AssertionError as error:
                failed.append(f"{step}, {fault.name}: {str(error).splitlines()[0]}")
    print(f"{count} cases, {len(failed)} failed, {time.monotonic() - began_s:.0f} s")
    print("\n".join(failed))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
