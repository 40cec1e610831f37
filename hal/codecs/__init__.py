"""Protocols as pure functions from bytes to values and back; no I/O and no clock."""
