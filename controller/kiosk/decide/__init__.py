"""What the kiosk does next: `reconciler` compares the wanted state with the present one; schedule, clock, job
queue and overrides feed it.
"""
