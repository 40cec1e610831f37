"""A public benchmark of methods that make an object look like a target. Entry: `methods`, `judging`; the interface of a
method is `lab.compare.api`.
"""
