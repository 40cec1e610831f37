"""All commands. A command parses its arguments, calls one function elsewhere and shows the result.

Heavy imports are inside the commands, so that ``velatura --help`` is fast.
"""
