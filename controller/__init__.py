"""Velatura's controller; `__main__` is the command line. Kept free of imports: the player must start without
loading the rest.
"""
