"""How callers use a kiosk: the running service (`kiosk`), its socket (`control`), or the folder without a
service (`offline_dispatch`).
"""
