"""PTP over USB. Entry: `bus` finds a camera, `link` communicates with it."""
