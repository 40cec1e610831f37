"""Stages, scenes and their truth, and how they are judged: what several lab.timings share. Not measured by itself."""
