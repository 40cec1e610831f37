"""Drivers for real devices, one package per family; `plugins.emulated` has the same devices as emulators, with
the bench.
"""
