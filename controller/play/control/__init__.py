"""How others control the player: its socket (`server`, `protocol`), the requests (`commands`), and the process
itself (`launch`).
"""
