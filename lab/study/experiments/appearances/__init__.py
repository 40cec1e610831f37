"""Appearances against what the paper reports: `experiment`, and the targets it uses."""
