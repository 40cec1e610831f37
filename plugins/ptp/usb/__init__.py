"""PTP over USB. Entry: `bus` finds a camera, `link` talks to it."""
