"""Devices that are replayed from a tape. Entry: `serving`."""
