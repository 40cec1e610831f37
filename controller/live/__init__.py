"""A stream of targets turned into compensation images as they come (docs/live.md)."""
