"""The player: a process of its own that shows patterns and appearances (`python -m controller.play`). It needs
little more than NumPy and pyglet.
"""
