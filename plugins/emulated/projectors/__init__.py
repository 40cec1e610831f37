"""Emulated projectors with lamps, fans and faults. Entry: `serial`, `board`, `lamp`."""
