"""Solves and scales on a graphics processor, by wgpu. Entry: `engine.GpuEngine`.

Only solve/engines.py imports it, and only where the extra gpu is installed (docs/decisions/0009).
"""
