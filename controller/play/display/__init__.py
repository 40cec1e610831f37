"""What the player shows pictures on: a window over all projectors (`window`), a memory file, and which X output
is which projector.
"""
