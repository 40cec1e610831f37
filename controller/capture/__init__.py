"""Patterns, exposure brackets, acquisition and the store of captures."""
