"""Emulated devices that misbehave like real ones, on an optical bench. Entry: `bench.DRIVER`."""
