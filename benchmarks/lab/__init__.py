"""Stages, scenes and their truth, and how they are judged: what several benchmarks share. Not measured by itself."""
