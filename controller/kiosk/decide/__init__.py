"""What the kiosk does next: `reconciler` compares the wanted state with the actual one. Schedule, clock, job
queue and overrides are its inputs.
"""
