"""Finders of devices, one module per bus (`hal.finding`). Entry: `FINDER` in each module."""
