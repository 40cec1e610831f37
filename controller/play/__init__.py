"""The player: a process of its own that shows patterns and appearances."""
