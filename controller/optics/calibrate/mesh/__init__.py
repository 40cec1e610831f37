"""The reconstructed surface as a mesh: `grid_mesh`, PLY and OBJ files (`export`), a scene for Blender
(`blender`).
"""
