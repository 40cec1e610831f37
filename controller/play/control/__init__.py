"""How others control the player: its socket and requests (`commands`, `protocol`), and the process itself
(`launch`).
"""
