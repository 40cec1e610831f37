"""What every test may rely on."""

from __future__ import annotations

import signal

# A shell that runs us in the background, or nohup, hands down ignored signals, and so would we to the programs that
# these tests start and stop by signals.
signal.signal(signal.SIGINT, signal.default_int_handler)
for number in (signal.SIGHUP, signal.SIGTERM):
    signal.signal(number, signal.SIG_DFL)
