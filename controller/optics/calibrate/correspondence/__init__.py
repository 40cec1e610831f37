"""Which projector coordinate each camera pixel sees: Gray code and phase shift. Entry: `decode.decode`, `phase_map`."""
