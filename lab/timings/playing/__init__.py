"""Bundles, the player and live pictures."""
