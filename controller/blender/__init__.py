"""Targets that Blender renders: the reconstructed object in another material, another light, another shape."""
