"""Emulated projectors with lamps, fans and faults. Entry: `boards`, `serial`, `network`, `lamp`."""
