"""The response and colour mixing of a projector. Entry: `radiometry.measure_radiometry`."""
