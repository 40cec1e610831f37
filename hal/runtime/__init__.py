"""Support for this computer: processors, compiled kernels, caches, safe reading of files.

Start with `compute.prepare_threads`, `kernels.Compilation`, `caches.kept` and `files.read_text`.
"""
