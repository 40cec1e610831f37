"""What the kiosk does next: `reconciler` compares the wanted state with the actual one, `stage_states` moves the state
machine. Schedule, clock, job queue and overrides are their inputs.
"""
