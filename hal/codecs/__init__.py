"""Protocols as pure functions from bytes to values and back; nothing here opens, waits or keeps time."""
