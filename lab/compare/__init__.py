"""Compares methods that make an object look like a target. Entry: `methods`, `evaluation`; the interface of a
method is `lab.compare.api`.
"""
