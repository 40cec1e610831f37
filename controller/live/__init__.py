"""A stream of target pictures, as files or frames (docs/how-to/live-targets.md). Entry: `sources`."""
