"""Device profiles, units and settings that are data, not code; found with ``importlib.resources``."""
