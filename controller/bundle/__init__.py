"""Bundles, the files that a kiosk plays: `format`, `writer`, `reader`, `signing`, `install`, `describe`."""
