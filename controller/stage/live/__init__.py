"""A stream of target pictures: files, frames, a network (docs/how-to/live-targets.md). Entry: `sources`, `streams`."""
