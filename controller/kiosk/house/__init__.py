"""A house of many stages, and a stage's side in one. Start at ``house`` and ``member``; only kiosks that are linked
import them.
"""
