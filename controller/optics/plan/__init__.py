"""Where to put projectors before anything is measured: predicted resolution, light and focus on a mesh. Entry:
`search`, `optics`.
"""
