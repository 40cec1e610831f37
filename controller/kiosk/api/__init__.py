"""The kiosk as its callers see it: over the running service (`kiosk`), by its socket (`control`), or with no
service running (`offline_dispatch`).
"""
